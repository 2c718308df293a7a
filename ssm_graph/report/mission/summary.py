"""The outcome of a run on one screen of a terminal."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Final

import numpy as np
from rich import box
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from ssm_graph.evaluation.errors import Metrics
from ssm_graph.mission.estimate import (
    OUTLIER_WEIGHT,
    Calibration,
    Determined,
    Estimate,
    Status,
    path_length_m,
)
from ssm_graph.mission.fault import DetectedFault
from ssm_graph.report.clock import clocked

STATUS_STYLE: Final = {
    Status.CONVERGED: "bold green",
    Status.MAX_ITERATIONS: "bold yellow",
    Status.INTERRUPTED: "bold yellow",
    Status.SUSPECT: "bold red",
    Status.DIVERGED: "bold white on red",
}
DETERMINED_STYLE: Final = {
    Determined.GREEN: "green",
    Determined.AMBER: "yellow",
    Determined.RED: "red",
}
DEG_PER_HOUR: Final = float(np.rad2deg(1.0)) * 3600.0
"""deg/h in one rad/s."""
MICRO_G: Final = 9.80665e-6
"""m/s^2"""


def summary_table(estimate: Estimate, metrics: Metrics | None = None) -> RenderableType:
    """Return what a user wants to know of a run, ready for ``Console.print``.

    Every row is headed by its unit. Without a reference the comparison is left out; the last
    rows give three numbers each, whose order the heading names.
    """
    begin_s = float(next(iter(estimate.trajectory.time_s), 0.0))
    parts: list[RenderableType] = [_overview(estimate), _last_keyframe(estimate)]
    if metrics is not None:
        parts.append(_comparison(metrics))
    if estimate.current is not None:
        velocity, sigma = estimate.current.velocity_enu, estimate.current.sigma_enu
        rows = (
            ("mean east, north, up, m/s", *velocity.mean(axis=0)),
            ("mean sigma east, north, up, m/s", *sigma.mean(axis=0)),
            ("at the last keyframe, m/s", *velocity[-1]),
        )
        parts.append(_table("Current of the water", rows))
    if estimate.calibration is not None:
        parts.append(calibration_table(estimate.calibration))
    if estimate.aids is not None:
        header = ("", "measurements", f"weight < {OUTLIER_WEIGHT:g}")
        counts = [(name, *map(str, count)) for name, count in estimate.aids.counts().items()]
        parts.append(_table("Further aids", counts, header=header))
    if estimate.faults:
        parts.append(_faults(estimate.faults, begin_s))
    notes = [clocked(note, begin_s) for note in estimate.notes]
    parts.extend(Text(f"note: {note}", style="yellow") for note in notes)
    return Group(*parts)


def _overview(estimate: Estimate) -> Table:
    trajectory, beams = estimate.trajectory, estimate.beams
    time_s, n_beams = trajectory.time_s, estimate.n_beams
    outlier = beams.weight < OUTLIER_WEIGHT
    share = f" ({100.0 * np.mean(outlier):.1f} %)" if len(outlier) else ""
    counts = [int(np.sum(outlier & (beams.beam == beam + 1))) for beam in range(n_beams)]
    count = f"{len(estimate.iterations)}"
    if not estimate.iterations:
        count = f"{estimate.keyframe_iterations:.1f} a keyframe"
    rows = (
        ("status", Text(estimate.status.name, style=STATUS_STYLE[estimate.status])),
        ("why it stopped", estimate.reason),
        ("method, kernel", f"{estimate.method}, {estimate.kernel}"),
        ("iterations", count),
        ("wall time, s", f"{estimate.wall_s:.2f}"),
        ("keyframes", f"{len(time_s)}"),
        ("duration, s", f"{np.ptp(time_s) if len(time_s) else 0.0:.1f}"),
        ("path length, m", f"{path_length_m(trajectory):.1f}"),
        ("beam speeds used", f"{len(outlier)}"),
        (f"outliers, weight < {OUTLIER_WEIGHT:g}", f"{int(outlier.sum())}{share}"),
        (f"outliers of beams 1 to {n_beams}", ", ".join(map(str, counts))),
    )
    table = _table("Estimate", rows)
    table.columns[1].justify = "left"
    return table


def _faults(faults: Sequence[DetectedFault], begin_s: float) -> Table:
    """Return who was off, when and how, red where the answer may be wrong for it."""
    table = Table(
        title="Sensors that were off",
        title_justify="left",
        title_style="bold",
        box=box.SIMPLE_HEAD,
        pad_edge=False,
    )
    for heading in ("sensor", "s since start", "what", "what became of it"):
        table.add_column(heading, overflow="fold")
    for fault in faults:
        treatment = fault.treatment.value
        if fault.rivals:
            treatment += f"; or it is {' or '.join(fault.rivals)}"
        table.add_row(
            Text(fault.sensor, style="bold red" if fault.is_suspect else "yellow"),
            f"{fault.begin_s - begin_s:.0f} - {fault.end_s - begin_s:.0f}",
            fault.what,
            treatment,
        )
    return table


def _last_keyframe(estimate: Estimate) -> RenderableType:
    """Return three numbers per row: final sigmas and biases."""
    trajectory = estimate.trajectory
    if len(trajectory.time_s) == 0:
        return Text("no keyframes", style="red")
    variance = np.maximum(np.diagonal(trajectory.position_cov_enu[-1]), 0.0)
    angles = np.rad2deg(trajectory.roll_pitch_heading[-1])
    angles[2] %= 360.0
    rows = (
        ("sigma of position east, north, up, m", *np.sqrt(variance)),
        ("sigma of velocity east, north, up, m/s", *trajectory.velocity_sigma_enu[-1]),
        ("sigma of roll, pitch, heading, deg", *np.rad2deg(trajectory.attitude_sigma[-1])),
        ("roll, pitch, heading, deg", *angles),
        ("gyro bias x, y, z, deg/h", *(trajectory.gyro_bias[-1] * DEG_PER_HOUR)),
        ("accelerometer bias x, y, z, ug", *(trajectory.accel_bias[-1] / MICRO_G)),
    )
    return _table("At the last keyframe", rows)


def _comparison(metrics: Metrics) -> Table:
    shares = 100.0 * np.array(metrics.inside_3_sigma)
    inside = ", ".join(f"{share:.1f}" if np.isfinite(share) else "–" for share in shares)
    rows = (
        ("horizontal error, rms, m", metrics.rmse_horizontal_m),
        ("horizontal error, largest, m", metrics.max_horizontal_m),
        ("horizontal error at the end, m", metrics.end_error_m),
        ("vertical error, rms, m", metrics.rmse_vertical_m),
        ("path length compared, m", metrics.path_length_m),
        ("drift, % of path length", metrics.drift_percent),
        ("velocity error, rms, m/s", metrics.rmse_velocity_m_per_s),
        ("heading error, rms, deg", float(np.rad2deg(metrics.rmse_attitude[2]))),
        ("NEES of position / 3, expected 1", metrics.nees_position),
        ("within 3 sigma east, north, up, %", inside),
    )
    return _table(f"Against the reference, {metrics.n_epochs} epochs", rows)


def calibration_table(calibration: Calibration) -> Table:
    """Return what was found of the instruments, each value in the colour of its certainty."""
    rows: list[tuple[str | float | Text, ...]] = []
    for value in calibration.values:
        numbers = (value.value, value.sigma, value.prior_sigma)
        how = Text(value.determined.name.lower(), style=DETERMINED_STYLE[value.determined])
        rows.append((value.label, *(number / value.unit for number in numbers), how))
    title = "Calibration, off what the mission states; red is not seen and stays at its prior"
    header = ("", "value", "sigma", "before", "determined")
    table = _table(title, rows, header=header)
    table.columns[0].min_width = 30  # so that all of them fit into 80 columns
    table.columns[4].justify = "left"
    return table


def _table(
    title: str, rows: Iterable[Sequence[str | float | Text]], *, header: Sequence[str] = ()
) -> Table:
    """Return rows of a heading and what it says; numbers with four digits, a dash for unknown."""
    table = Table(
        title=title,
        title_justify="left",
        title_style="bold",
        box=box.SIMPLE_HEAD,
        show_header=bool(header),
        pad_edge=False,
    )
    table.add_column(header[0] if header else "", style="cyan", min_width=38, overflow="fold")
    rows = list(rows)
    for i in range(1, len(rows[0]) if rows else len(header)):
        name = header[i] if header else ""
        table.add_column(name, justify="right", min_width=9, overflow="fold")
    for row in rows:
        table.add_row(*map(_cell, row))
    return table


def _cell(value: str | float | Text) -> Text:
    if isinstance(value, Text):
        return value
    if isinstance(value, str):
        return Text(value)
    return Text(f"{value:.4g}" if np.isfinite(value) else "–", justify="right")
