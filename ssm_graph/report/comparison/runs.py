"""Figures over many missions: error against rate and size of outliers, consistency, end error."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import NullLocator

from ssm_graph.base.frozen import Array
from ssm_graph.evaluation import chi2_interval, mean_with_interval
from ssm_graph.evaluation.comparison import has_failed, number
from ssm_graph.report.comparison.cells import (
    Row,
    Series,
    Sweep,
    end_error_cells,
    methods_of,
    rate_sweeps,
    series_cells,
    size_sweeps,
    text,
    values,
)
from ssm_graph.report.comparison.style import (
    Look,
    add_footnote,
    add_legend,
    line,
    log_ticks,
    new_figure,
    shown_methods,
)
from ssm_graph.report.mission.style import dress, time_axis

Looks = Mapping[str, Look]

MEAN_NOTE: Final = (
    "Mean of the horizontal rms error over the missions that a method finished, with its 95 % "
    "confidence band (Student's t)."
)
BAND_COLOR: Final = "#D9D9D9"
MAX_COLUMNS: Final = 3


def draw_error_against_rate(rows: Sequence[Row], looks: Looks) -> Figure | None:
    """Draw the mean error against the share of outliers; None without two rates of a kind."""
    sweeps = rate_sweeps(rows)
    if not sweeps:
        return None
    title = "Horizontal position error against the rate of outliers"
    return _draw_sweeps(sweeps, looks, title, x="rate of outliers, %", factor=100.0)


def draw_error_against_size(rows: Sequence[Row], looks: Looks) -> Figure | None:
    """Draw the mean error against the size of outliers; None without two sizes of a kind."""
    sweeps = size_sweeps(rows)
    if not sweeps:
        return None
    title = "Horizontal position error against the size of outliers"
    return _draw_sweeps(sweeps, looks, title, x="size of outliers (middle of range), m/s")


def _draw_sweeps(
    sweeps: Sequence[Sweep], looks: Looks, title: str, *, x: str, factor: float = 1.0
) -> Figure:
    swept = [row for sweep in sweeps for rows in sweep.points.values() for row in rows]
    methods, left_out = shown_methods(methods_of(swept))
    kinds = list(dict.fromkeys(sweep.kind for sweep in sweeps))
    grades = list(dict.fromkeys(sweep.grade for sweep in sweeps))
    n_rows, n_columns, place = _places(sweeps, kinds, grades)
    figure, panels = _panels(n_rows, n_columns, title)
    is_rate = factor != 1.0
    for sweep, (i, j) in zip(sweeps, place, strict=True):
        axes = panels[i][j]
        extent = _draw_sweep(axes, sweep, methods, looks, factor)
        dress(axes, title=_sweep_title(sweep, is_rate=is_rate), x=x, y="mean horizontal rms, m")
        if extent is not None:
            log_ticks(axes.yaxis, extent[0] / 1.35, extent[1] * 1.35)
        ticks = [factor * at for at in sweep.points]
        if not is_rate:
            log_ticks(axes.xaxis, ticks[0] / 1.25, ticks[-1] * 1.25)
        axes.set_xticks(_apart(ticks, is_log=not is_rate))
        axes.xaxis.set_minor_locator(NullLocator())
    _remove_empty(figure, panels)
    add_legend(figure, methods, looks, has_markers=True)
    add_footnote(figure, MEAN_NOTE, left_out)
    return figure


def _places(
    sweeps: Sequence[Sweep], kinds: Sequence[str], grades: Sequence[str]
) -> tuple[int, int, list[tuple[int, int]]]:
    """Return rows, columns and the place of every sweep: kinds in columns, grades in rows."""
    if len(grades) == 1 or len(kinds) == 1 or len(kinds) > MAX_COLUMNS:
        n_columns = min(len(sweeps), MAX_COLUMNS)
        places = [divmod(k, n_columns) for k in range(len(sweeps))]
        return math.ceil(len(sweeps) / n_columns), n_columns, places
    at = [(grades.index(sweep.grade), kinds.index(sweep.kind)) for sweep in sweeps]
    return len(grades), len(kinds), at


def _draw_sweep(
    axes: Axes, sweep: Sweep, methods: Sequence[str], looks: Looks, factor: float
) -> tuple[float, float] | None:
    """Draw lines and bands; return the least and largest mean."""
    x = factor * np.array(list(sweep.points))
    all_means: list[float] = []
    for method in reversed(methods):  # the first on top
        means, low, high = (np.full(len(x), np.nan) for _ in range(3))
        for k, rows in enumerate(sweep.points.values()):
            samples = [v for v in values(rows, method, "horizontal_rms_m") if v > 0.0]
            if samples:
                mean = mean_with_interval(samples)
                means[k], low[k], high[k] = mean.value, mean.low, mean.high
        known = np.isfinite(means)
        look = looks[method]
        axes.plot(x[known], means[known], marker=look.marker, **line(look))
        if known.any() and np.isfinite(high).any():
            low = np.where(np.isfinite(low), np.maximum(low, 0.05 * means), means)
            high = np.where(np.isfinite(high), high, means)
            axes.fill_between(
                x[known], low[known], high[known], color=look.color, alpha=0.13, linewidth=0.0
            )
        all_means.extend(means[known].tolist())
    return (min(all_means), max(all_means)) if all_means else None


def _sweep_title(sweep: Sweep, *, is_rate: bool) -> str:
    name = sweep.kind.replace("_", " ").capitalize()
    parts = [name, *([f"{sweep.grade} grade"] if sweep.grade else [])]
    if isinstance(sweep.fixed, tuple):
        low, high = sweep.fixed
        if is_rate and high > 0.0:
            parts.append(f"{low:g} m/s" if low == high else f"{low:g}–{high:g} m/s")
    elif math.isfinite(sweep.fixed):
        parts.append(f"rate {100.0 * sweep.fixed:.3g} %")
    return ", ".join(parts)


def _apart(ticks: Sequence[float], *, is_log: bool) -> list[float]:
    """Return the ticks whose labels do not touch."""
    at = np.log(ticks) if is_log else np.asarray(ticks)
    least = 0.055 * float(np.ptp(at))
    kept = [0]
    for k in range(1, len(ticks)):
        if at[k] - at[kept[-1]] >= least:
            kept.append(k)
    return [ticks[k] for k in kept]


def draw_nees(
    rows: Sequence[Row], series: Mapping[tuple[str, str, str], Series], looks: Looks
) -> Figure | None:
    """Draw the mean NEES of position over the runs of clean cells and of ones with outliers."""
    cells = series_cells(rows, series)
    shown_cells = {cell for cells_of in cells for cell in cells_of}
    methods, left_out = shown_methods(m for c, g, m in series if (c, g) in shown_cells)
    if not any(
        np.isfinite(nees).any() for (c, g, _), (*_, nees) in series.items() if (c, g) in shown_cells
    ):
        return None
    title = "Consistency of the position: mean NEES divided by its dimension"
    figure, panels = _panels(len(cells), max(map(len, cells)), title)
    counts: set[int] = set()
    for i, cells_of in enumerate(cells):
        for j, (case, grade) in enumerate(cells_of):
            mine = {m: series[case, grade, m] for m in methods if (case, grade, m) in series}
            counts.add(_draw_nees_panel(panels[i][j], mine, looks))
            label = panels[i][j].get_xlabel()
            dress(panels[i][j], title=_joined(case, grade), x=label, y="mean NEES/3, –")
    _remove_empty(figure, panels)
    band = Patch(color=BAND_COLOR, label="95 % if consistent")
    expected = Line2D([], [], color="#8C8C8C", linewidth=0.8, label="expected, 1")
    add_legend(figure, methods, looks, extra=(band, expected))
    runs = " or ".join(f"{n}" for n in sorted(counts - {0}))
    note = f"Grey band: where 95 % of such means over {runs} runs lie (chi-square). "
    note += "Above it a method claims to be more certain than it is, below it less."
    add_footnote(figure, note, left_out)
    return figure


def _draw_nees_panel(axes: Axes, mine: Mapping[str, Series], looks: Looks) -> int:
    """Draw one cell; return the number of runs that its band is of."""
    n_runs, extremes = 0, [1.0]
    label, span = "", np.zeros(0)
    for method in reversed(list(mine)):
        time_s, _, _, nees = mine[method]
        mean = _mean_over_runs(nees)
        known = np.isfinite(mean) & (mean > 0.0)
        if not known.any():
            continue
        divisor, label = time_axis(time_s)
        span = np.array([time_s[0], time_s[-1]]) / divisor
        axes.plot(time_s / divisor, np.where(known, mean, np.nan), **line(looks[method]))
        extremes += [float(np.quantile(mean[known], 0.01)), float(mean[known].max())]
        n_runs = max(n_runs, int(np.isfinite(nees).any(axis=1).sum()))
    if n_runs > 0:
        band = chi2_interval(3, n_runs)
        axes.fill_between(span, band.low, band.high, color=BAND_COLOR, linewidth=0.0, zorder=0.6)
        axes.axhline(1.0, color="#8C8C8C", linewidth=0.8, zorder=0.7)
        axes.set_xlim(float(span[0]), float(span[1]))
        low, high = min(*extremes, band.low), max(*extremes, band.high)
        log_ticks(axes.yaxis, low / 1.2, high * 1.2)
    axes.set_xlabel(label)
    return n_runs


def _mean_over_runs(nees: Array) -> Array:
    """Return the mean (T,) over the runs that have a value; NaN where none has one."""
    known = np.isfinite(nees)
    count = known.sum(axis=0)
    total = np.where(known, nees, 0.0).sum(axis=0)
    return np.asarray(np.where(count > 0, total / np.maximum(count, 1), np.nan))


def draw_end_error(rows: Sequence[Row], looks: Looks) -> Figure | None:
    """Draw the distribution of the end error, a panel for every grade with outliers."""
    cells = [
        c for c in end_error_cells(rows) if any(_end_errors(c[2], m) for m in methods_of(c[2]))
    ]
    if not cells:
        return None
    methods, left_out = shown_methods(methods_of([row for _, _, mine in cells for row in mine]))
    n_columns = min(len(cells), MAX_COLUMNS)
    title = "Distribution of the horizontal position error at the end of the mission"
    figure, panels = _panels(math.ceil(len(cells) / n_columns), n_columns, title, height=3.4)
    for k, (grade, case, mine) in enumerate(cells):
        axes = panels[k // n_columns][k % n_columns]
        finite: list[float] = []
        for method in reversed(methods):
            errors = _end_errors(mine, method)
            kept = [error for error in errors if math.isfinite(error)]
            share = np.arange(len(kept) + 1) / max(len(errors), 1)
            if kept:
                look = line(looks[method])
                axes.plot([kept[0], *kept], share, drawstyle="steps-post", **look)
                axes.plot([kept[-1], 1e12], share[[-1, -1]], **look)
            finite += kept
        dress(axes, title=_joined(case, grade), x="end error, m", y="share of missions, –")
        if finite:
            log_ticks(axes.xaxis, min(finite) / 1.15, max(finite) * 1.25)
        axes.set_ylim(0.0, 1.03)
    _remove_empty(figure, panels)
    add_legend(figure, methods, looks)
    note = "Empirical distribution; a failed run counts as an unbounded error."
    add_footnote(figure, note, left_out)
    return figure


def _end_errors(rows: Sequence[Row], method: str) -> list[float]:
    """Return the errors in ascending order, infinite for failed runs; unknown ones are left out."""
    mine = [row for row in rows if text(row, "method") == method]
    errors = [math.inf if has_failed(row) else number(row, "end_error_m") for row in mine]
    return sorted(error for error in errors if error > 0.0)


def _joined(case: str, grade: str) -> str:
    name = case.replace("_", " ")
    name = name[:1].upper() + name[1:]
    return f"{name}, {grade} grade" if grade else name


def _panels(
    n_rows: int, n_columns: int, title: str, *, height: float = 2.8
) -> tuple[Figure, list[list[Axes]]]:
    """Return a figure with room for a legend, and its axes."""
    width = {1: 5.0, 2: 3.7}.get(n_columns, 3.1)
    figure = new_figure(n_columns * width + 1.7, n_rows * height + 0.8, title)
    grid = figure.subplots(n_rows, n_columns, squeeze=False)
    return figure, [list(axes) for axes in grid]


def _remove_empty(figure: Figure, panels: Sequence[Sequence[Axes]]) -> None:
    for axes in [axes for row in panels for axes in row if not axes.lines]:
        figure.delaxes(axes)
