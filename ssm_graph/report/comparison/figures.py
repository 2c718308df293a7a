"""Figures of a comparison of methods: one mission in detail, and what many missions tell."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from ssm_graph.base.errors import DataError
from ssm_graph.base.frozen import Array
from ssm_graph.evaluation.errors import ErrorSeries, evaluate
from ssm_graph.mission.estimate import Estimate
from ssm_graph.mission.mission import Reference
from ssm_graph.report import style
from ssm_graph.report.beams import (
    CLASSES,
    dots,
    draw_points,
    innovation_axis,
    points_of,
    top_of_weights,
)
from ssm_graph.report.comparison.runs import (
    Row,
    Series,
    draw_end_error,
    draw_error_against_rate,
    draw_error_against_size,
    draw_grid,
    draw_nees,
)
from ssm_graph.report.style import Curve, Look, Panel

Example = tuple[str, Estimate, Reference]
"""Name of the method, its estimate, and the truth of the mission."""

PER_BEAM: Final = ("ssm-log", "smoother-log")
"""Whose weights are shown, the first that is there."""
PER_PING: Final = "ssmkf-log"
"""Has one auxiliary parameter for all beams of a ping."""
MAX_WINDOWS: Final = 120
"""More epochs than these are shown as rms over windows, or noise would hide the methods."""
WINDOWS_S: Final = (1.0, 2.0, 5.0, 10.0, 20.0, 30.0, 60.0, 120.0, 300.0, 600.0, 1800.0, 3600.0)
LARGE_RATIO: Final = 5.0
"""A panel whose methods differ by more than this is logarithmic."""


def save_figures(
    folder: Path,
    rows: Sequence[Row],
    series: Mapping[tuple[str, str, str], Series],
    examples: Sequence[Example],
) -> list[Path]:
    """Draw and save the figures of a comparison; one whose data are missing is skipped.

    Methods look the same in all figures. Where there are more than eight, lines are drawn for
    those of `ssm_graph.report.style.DEFAULT_METHODS`, and a footnote names the others.

    Raises :class:`DataError`: a file cannot be written.

    Parameters
    ----------
    folder : where the PNG files go; made if it does not exist.
    rows : one mapping for every mission and method, as of a study's table; NaN is unknown.
    series : by case, grade and method: time (T,) s, horizontal error (N, T) m, velocity error
        (N, T) m/s and position NEES divided by 3 (N, T) of N runs; NaN is unknown.
    examples : name, estimate and reference of every method on one and the same mission.

    Returns
    -------
    The files that were written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise DataError(f"{folder}: cannot make the folder: {error.strerror or error}") from error
    names = [str(row["method"]) for row in rows] + [method for _, _, method in series]
    looks = style.looks_of([*names, *(name for name, _, _ in examples)])
    figures = {
        "errors_over_time.png": draw_errors_over_time(examples, looks),
        "beam_weights.png": draw_beam_weights(examples, looks),
        "error_against_rate.png": draw_error_against_rate(rows, looks),
        "error_against_size.png": draw_error_against_size(rows, looks),
        "nees_over_time.png": draw_nees(rows, series, looks),
        "end_error_cdf.png": draw_end_error(rows, looks),
    }
    return [style.save(figure, folder / name) for name, figure in figures.items() if figure]


def draw_errors_over_time(examples: Sequence[Example], looks: Mapping[str, Look]) -> Figure | None:
    """Draw horizontal velocity and position error of every method; None without any."""
    errors = _errors(examples)
    if not errors:
        return None
    methods, left_out = style.shown_methods(errors)
    start_s = min(series.time_s[0] for series in errors.values())
    span_s = max(series.time_s[-1] for series in errors.values()) - start_s
    divisor, label = style.time_axis(np.array([0.0, span_s]))
    n_epochs = max(len(series.time_s) for series in errors.values())
    short_s = span_s / MAX_WINDOWS if n_epochs > MAX_WINDOWS else 0.0
    window_s = short_s and next((w for w in WINDOWS_S if w >= short_s), short_s)
    panels = {}
    for row, what in enumerate(("velocity", "position")):
        curves = []
        for method in reversed(methods):
            own = errors[method]
            vector = own.position_enu if row else own.velocity_enu
            norm = np.hypot(vector[:, 0], vector[:, 1])
            time_s, values = _windowed(own.time_s, norm, start_s, window_s)
            curves.append(Curve((time_s - start_s) / divisor, values, style.line(looks[method])))
        limits, is_log = _scale([curve.y for curve in curves])
        panels[row, 0] = Panel(
            title=f"Horizontal {what} error",
            x=label if row else "",
            y=f"{what} error, {'m' if row else 'm/s'}",
            curves=curves,
            x_limits=(0.0, max(span_s / divisor, 1e-9)),
            y_limits=limits,
            is_log_y=is_log,
        )
    note = "Length of the horizontal error vector"
    note += f", rms over windows of {window_s:g} s." if window_s else "."
    title = "Errors of one mission over time"
    figure = draw_grid(title, panels, methods, looks, note, left_out, height=2.4, width=7.3)
    figure.axes[0].tick_params(labelbottom=False)
    figure.align_ylabels(figure.axes)
    return figure


def _errors(examples: Sequence[Example]) -> dict[str, ErrorSeries]:
    """Return the errors by method; estimates without a time in common are left out."""
    errors = {}
    for method, estimate, reference in examples:
        try:
            errors[method] = evaluate(estimate.trajectory, reference).errors
        except DataError:
            continue
    return errors


def _windowed(time_s: Array, values: Array, start_s: float, window_s: float) -> tuple[Array, Array]:
    """Return middles of windows and the rms in each, NaN without a value; as is without windows."""
    if window_s <= 0.0:
        return time_s, values
    window = ((time_s - start_s) / window_s).astype(np.intp)
    known = np.isfinite(values)
    n = int(window.max()) + 1
    count = np.bincount(window[known], minlength=n)
    total = np.bincount(window[known], weights=values[known] ** 2, minlength=n)
    rms = np.where(count > 0, np.sqrt(total / np.maximum(count, 1)), np.nan)
    return np.asarray(start_s + (np.arange(n) + 0.5) * window_s), np.asarray(rms)


def _scale(curves: Sequence[Array]) -> tuple[tuple[float, float] | None, bool]:
    """Return limits, and whether the axis is logarithmic: where methods differ by very much."""
    known = [c[np.isfinite(c) & (c > 0.0)] for c in curves]
    known = [c for c in known if len(c)]
    if not known:
        return None, False
    largest = [float(c.max()) for c in known]
    if max(largest) > LARGE_RATIO * min(largest):
        low = min(float(np.quantile(c, 0.02)) for c in known)
        return (low / 1.2, 1.3 * max(largest)), True
    return (0.0, 1.06 * max(largest)), False


def draw_beam_weights(examples: Sequence[Example], looks: Mapping[str, Look]) -> Figure | None:
    """Draw innovation and auxiliary parameter of each beam; None without beams."""
    told = {m: estimate for m, estimate, _ in examples if len(estimate.beams.time_s)}
    if not told:
        return None
    main = next((m for m in PER_BEAM if m in told), next(iter(told)))
    shown = [PER_PING, main] if PER_PING in told and main != PER_PING else [main]
    beams, n_beams = told[main].beams, told[main].n_beams
    n_rows = (n_beams + 1) // 2
    start_s = float(beams.time_s.min())
    divisor, label = style.time_axis(beams.time_s)
    span = float(np.ptp(beams.time_s)) / divisor or 1.0
    title = f"Innovations of the beams and their weights, {main}"
    figure = style.new_figure(10.0, 3.6 * n_rows + 0.8, title)
    grid = figure.add_gridspec(n_rows, 2)
    columns: tuple[list[Axes], list[Axes]] = ([], [])
    for beam in range(n_beams):
        cell = grid[beam // 2, beam % 2].subgridspec(2, 1, height_ratios=[1.25, 1.0])
        upper = figure.add_subplot(cell[0])
        lower = figure.add_subplot(cell[1], sharex=upper)
        points = points_of(beams, beam)
        since = (points.time_s - start_s) / divisor
        draw_points(upper, since, points.innovation, points.weight)
        for method in shown:
            points = points_of(told[method].beams, beam)
            since = (points.time_s - start_s) / divisor
            size = 2.4 if method == main else 1.8
            lower.plot(since, points.weight, **dots(looks[method].color, size, alpha=0.8))
        upper.set_xlim(-0.01 * span, 1.01 * span)
        innovation_axis(upper, beams.innovation)
        lower.set_ylim(-0.06, top_of_weights(*(told[method].beams for method in shown)))
        style.dress(upper, title=f"Beam {beam + 1}", y="innovation, m/s")
        style.dress(lower, x=label if beam >= n_beams - 2 else "", y="weight, –")
        upper.tick_params(labelbottom=False)
        columns[beam % 2].extend([upper, lower])
    for column in columns:
        figure.align_ylabels(column)
    entries = [(color, f"innovation, {name}") for _, _, color, name, _ in CLASSES]
    entries += [(looks[method].color, f"weight, {method}") for method in reversed(shown)]
    figure.legend(
        handles=[Line2D([], [], **dots(c, 5.0, alpha=1.0, label=name)) for c, name in entries],
        loc="outside right center",
        fontsize=style.SMALL + 1.0,
        frameon=False,
        handlelength=1.2,
        labelspacing=0.8,
        labelcolor=style.INK,
    )
    note = "Innovation axes are linear over the noise of good beams, logarithmic beyond."
    if PER_PING in shown[:-1]:
        note += f" {PER_PING} has one weight for all beams of a ping."
    style.add_footnote(figure, note)
    return figure
