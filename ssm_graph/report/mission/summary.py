"""The outcome of a run on one screen of a terminal."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final

import numpy as np
from rich import box
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from ssm_graph.base.frozen import Array
from ssm_graph.evaluation import Metrics
from ssm_graph.mission.estimate import (
    OUTLIER_WEIGHT,
    AidTable,
    Calibration,
    CurrentTrack,
    Determined,
    Estimate,
    Status,
    Trajectory,
    path_length_m,
)
from ssm_graph.sensors.dvl import N_BEAMS

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
    parts: list[RenderableType] = [_overview(estimate), _axes(estimate.trajectory)]
    if metrics is not None:
        parts.append(_comparison(metrics))
    if estimate.current is not None:
        parts.append(_current(estimate.current))
    if estimate.calibration is not None:
        parts.append(calibration_table(estimate.calibration))
    if estimate.aids is not None:
        parts.append(_aids(estimate.aids))
    parts.extend(Text(f"note: {note}", style="yellow") for note in estimate.notes)
    return Group(*parts)


def _overview(estimate: Estimate) -> Table:
    trajectory, beams = estimate.trajectory, estimate.beams
    time_s = trajectory.time_s
    outlier = beams.weight < OUTLIER_WEIGHT
    n_beams = len(beams.weight)
    share = f" ({100.0 * np.mean(outlier):.1f} %)" if n_beams else ""
    counts = [int(np.sum(outlier & (beams.beam == beam + 1))) for beam in range(N_BEAMS)]
    status = Text(estimate.status.name, style=STATUS_STYLE[estimate.status])
    table = _table("Estimate", ["", ""])
    table.columns[1].justify = "left"
    for heading, value in (
        ("status", status),
        ("why it stopped", Text(estimate.reason)),
        ("method, kernel", Text(f"{estimate.method}, {estimate.kernel}")),
        ("iterations", Text(_count(estimate))),
        ("wall time, s", Text(f"{estimate.wall_s:.2f}")),
        ("keyframes", Text(f"{len(time_s)}")),
        ("duration, s", Text(f"{np.ptp(time_s) if len(time_s) else 0.0:.1f}")),
        ("path length, m", Text(f"{path_length_m(trajectory):.1f}")),
        ("beam speeds used", Text(f"{n_beams}")),
        (f"outliers, weight < {OUTLIER_WEIGHT:g}", Text(f"{int(outlier.sum())}{share}")),
        (
            f"outliers of beams 1 to {N_BEAMS}",
            Text(", ".join(str(count) for count in counts)),
        ),
    ):
        table.add_row(heading, value)
    return table


def _aids(aids: AidTable) -> Table:
    """Return how many measurements of each further aid there were, and how many have no weight."""
    names = ["", "measurements", f"weight < {OUTLIER_WEIGHT:g}"]
    table = _table("Further aids", names, show_header=True)
    for name, (count, outliers) in aids.counts().items():
        table.add_row(name, str(count), str(outliers))
    return table


def _count(estimate: Estimate) -> str:
    if estimate.iterations:
        return str(len(estimate.iterations))
    return f"{estimate.keyframe_iterations:.1f} a keyframe"


def _axes(trajectory: Trajectory) -> RenderableType:
    """Return three numbers per row: final sigmas and biases."""
    if len(trajectory.time_s) == 0:
        return Text("no keyframes", style="red")
    variance = np.maximum(np.diagonal(trajectory.position_cov_enu[-1]), 0.0)
    table = _table("At the last keyframe", ["", "", "", ""])
    for heading, values in (
        ("sigma of position east, north, up, m", np.sqrt(variance)),
        ("sigma of velocity east, north, up, m/s", trajectory.velocity_sigma_enu[-1]),
        ("sigma of roll, pitch, heading, deg", np.rad2deg(trajectory.attitude_sigma[-1])),
        ("roll, pitch, heading, deg", _degrees(trajectory.roll_pitch_heading[-1])),
        ("gyro bias x, y, z, deg/h", trajectory.gyro_bias[-1] * DEG_PER_HOUR),
        ("accelerometer bias x, y, z, ug", trajectory.accel_bias[-1] / MICRO_G),
    ):
        table.add_row(heading, *_numbers(values))
    return table


def _current(current: CurrentTrack) -> Table:
    table = _table("Current of the water", ["", "", "", ""])
    for heading, values in (
        ("mean east, north, up, m/s", current.velocity_enu.mean(axis=0)),
        ("mean sigma east, north, up, m/s", current.sigma_enu.mean(axis=0)),
        ("at the last keyframe, m/s", current.velocity_enu[-1]),
    ):
        table.add_row(heading, *_numbers(values))
    return table


def _comparison(metrics: Metrics) -> Table:
    table = _table(f"Against the reference, {metrics.n_epochs} epochs", ["", ""])
    for heading, value in (
        ("horizontal error, rms, m", metrics.rmse_horizontal_m),
        ("horizontal error, largest, m", metrics.max_horizontal_m),
        ("horizontal error at the end, m", metrics.end_error_m),
        ("vertical error, rms, m", metrics.rmse_vertical_m),
        ("path length compared, m", metrics.path_length_m),
        ("drift, % of path length", metrics.drift_percent),
        ("velocity error, rms, m/s", metrics.rmse_velocity_m_per_s),
        ("heading error, rms, deg", float(np.rad2deg(metrics.rmse_attitude[2]))),
        ("NEES of position / 3, expected 1", metrics.nees_position),
    ):
        table.add_row(heading, *_numbers([value]))
    shares = 100.0 * np.array(metrics.inside_3_sigma)
    inside = ", ".join(f"{share:.1f}" if np.isfinite(share) else "–" for share in shares)
    table.add_row("within 3 sigma east, north, up, %", inside)
    return table


def calibration_table(calibration: Calibration) -> Table:
    """Return what was found of the instruments, each value in the colour of its certainty."""
    names = ["", "value", "sigma", "before", "determined"]
    title = "Calibration, off what the mission states; red is not seen and stays at its prior"
    table = _table(title, names, show_header=True)
    table.columns[0].min_width = 30  # so that all of them fit into 80 columns
    table.columns[4].justify = "left"
    for value in calibration.values:
        numbers = (value.value, value.sigma, value.prior_sigma)
        style = DETERMINED_STYLE[value.determined]
        table.add_row(
            value.label,
            *_numbers(number / value.unit for number in numbers),
            Text(value.determined.name.lower(), style=style),
        )
    return table


def _table(title: str, columns: list[str], *, show_header: bool = False) -> Table:
    table = Table(
        title=title,
        title_justify="left",
        title_style="bold",
        box=box.SIMPLE_HEAD,
        show_header=show_header,
        pad_edge=False,
    )
    for index, name in enumerate(columns):
        table.add_column(
            name,
            justify="left" if index == 0 else "right",
            style="cyan" if index == 0 else "",
            min_width=38 if index == 0 else 9,
            overflow="fold",
        )
    return table


def _degrees(roll_pitch_heading: Array) -> Array:
    angles = np.rad2deg(roll_pitch_heading)
    angles[2] %= 360.0
    return np.asarray(angles)


def _numbers(values: Iterable[float]) -> list[Text]:
    """Return four digits each; what is unknown is a dash."""
    return [
        Text(f"{value:.4g}" if np.isfinite(value) else "–", justify="right") for value in values
    ]
