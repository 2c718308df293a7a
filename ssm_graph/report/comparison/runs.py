"""Figures over many missions: error against rate and size of outliers, consistency, end error.

First which cells of a study a figure shows, and the numbers of their runs; then the drawing.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from ssm_graph.base.frozen import Array
from ssm_graph.evaluation.comparison import has_failed, number, text
from ssm_graph.evaluation.statistics import chi2_interval, mean_with_interval
from ssm_graph.report import style
from ssm_graph.report.style import Band, Curve, Look, Panel

Row = Mapping[str, Any]
Series = tuple[Array, Array, Array, Array]
"""Time (T,) s, horizontal error (N, T) m, velocity error (N, T) m/s, position NEES/3 (N, T)."""
Points = dict[float, list[Row]]
"""Rows by rate or by size, ascending."""

CLEAN: Final = "clean"
SPARSE: Final = "sparse"
SPARSE_RATES: Final = (0.1, 0.2)
"""Of the cell whose end errors are shown, if it is there."""


@dataclass(frozen=True, slots=True)
class Sweep:
    """Cells of one kind and grade that differ in one thing only."""

    kind: str
    grade: str
    fixed: float | tuple[float, float]
    """What they have in common: their sizes (m/s) if the rate varies, or else their rate."""
    points: Points


def has_outliers(row: Row) -> bool:
    """Return whether the DVL of a row's missions has outliers."""
    return text(row, "kind").lower() not in {"", "none", "nan"}


def rate_of(row: Row) -> float:
    """Return the share of outliers, 0 for missions without."""
    return number(row, "rate") if has_outliers(row) else 0.0


def sizes_of(row: Row) -> tuple[float, float]:
    """Return the least and largest size of outliers, m/s; -1 if they are unknown."""
    low, high = number(row, "size_low_m_per_s"), number(row, "size_high_m_per_s")
    return (low, high) if math.isfinite(low) and math.isfinite(high) else (-1.0, -1.0)


def grades_of(rows: Sequence[Row]) -> list[str]:
    """Return the grades in the order of their first row."""
    return list(dict.fromkeys(text(row, "grade") for row in rows))


def methods_of(rows: Sequence[Row]) -> list[str]:
    """Return the methods in the order of their first row."""
    return list(dict.fromkeys(text(row, "method") for row in rows))


def values(rows: Sequence[Row], method: str, metric: str) -> list[float]:
    """Return the finite values of a method's runs that did not fail."""
    told = (number(r, metric) for r in rows if text(r, "method") == method and not has_failed(r))
    return [value for value in told if math.isfinite(value)]


def clean_case(rows: Sequence[Row], grade: str) -> str | None:
    """Return the case without anything wrong, None if it cannot be told.

    Missions with programmed faults have no outliers either, hence the name decides.
    """
    without = [r for r in rows if text(r, "grade") == grade and not has_outliers(r)]
    cases = list(dict.fromkeys(text(row, "case") for row in without))
    named = [case for case in cases if CLEAN in case.lower()]
    return named[0] if named else cases[0] if len(cases) == 1 else None


def rate_sweeps(rows: Sequence[Row]) -> list[Sweep]:
    """Return the kinds and grades with two or more rates, each begun by the clean cell."""
    sweeps = []
    for sweep in _sweeps(rows, varied=rate_of, fixed=sizes_of):
        case = clean_case(rows, sweep.grade)
        clean = [r for r in rows if (text(r, "grade"), text(r, "case")) == (sweep.grade, case)]
        first = next(iter(sweep.points.values()))[0]
        same = [r for r in clean if _duration(r) == _duration(first)]
        begin = {0.0: same or clean} if clean else {}
        sweeps.append(replace(sweep, points={**begin, **sweep.points}))
    return sweeps


def size_sweeps(rows: Sequence[Row]) -> list[Sweep]:
    """Return the kinds and grades with two or more sizes; a size is the middle of its range."""
    known = [row for row in rows if sum(sizes_of(row)) > 0.0]
    return _sweeps(known, varied=lambda row: 0.5 * sum(sizes_of(row)), fixed=rate_of)


def _sweeps(
    rows: Sequence[Row],
    *,
    varied: Callable[[Row], float],
    fixed: Callable[[Row], float | tuple[float, float]],
) -> list[Sweep]:
    """Return one sweep for each kind and grade: of those possible, the one with most points."""
    groups: dict[tuple[str, str], dict[Any, dict[float, dict[str, list[Row]]]]] = {}
    for row in rows:
        if not has_outliers(row) or not math.isfinite(varied(row)):
            continue
        of_kind = groups.setdefault((text(row, "kind"), text(row, "grade")), {})
        points = of_kind.setdefault((fixed(row), _duration(row)), {})
        cases = points.setdefault(round(varied(row), 9), {})
        cases.setdefault(text(row, "case"), []).append(row)
    sweeps = []
    for (kind, grade), choices in groups.items():
        (common, _), points = max(choices.items(), key=lambda item: len(item[1]))
        if len(points) >= 2:  # of several cases that differ in something else the first
            ordered = {x: next(iter(points[x].values())) for x in sorted(points)}
            sweeps.append(Sweep(kind, grade, common, ordered))
    return sweeps


def _duration(row: Row) -> float:
    value = number(row, "duration_s")
    return value if math.isfinite(value) else -1.0


def end_error_cells(rows: Sequence[Row]) -> list[tuple[str, str, list[Row]]]:
    """Return grade, case and rows of the cell of every grade whose end errors are shown."""
    cells = []
    low, high = SPARSE_RATES
    for grade in grades_of(rows):
        dirty = [row for row in rows if text(row, "grade") == grade and has_outliers(row)]
        sparse = [
            row
            for row in dirty
            if SPARSE in text(row, "kind").lower() and low - 1e-9 <= rate_of(row) <= high + 1e-9
        ]
        if dirty:
            case = text((sparse or dirty)[0], "case")
            cells.append((grade, case, [row for row in dirty if text(row, "case") == case]))
    return cells


def series_cells(
    rows: Sequence[Row], series: Mapping[tuple[str, str, str], Series]
) -> list[list[tuple[str, str]]]:
    """Return case and grade of the clean cells, then of the first cells with outliers."""
    known = {(case, grade) for case, grade, _ in series}
    held = [row for row in rows if (text(row, "case"), text(row, "grade")) in known]
    clean, dirty = [], []
    for grade in grades_of(held):
        case = clean_case(held, grade)
        if case is not None:
            clean.append((case, grade))
        first = next((r for r in held if text(r, "grade") == grade and has_outliers(r)), None)
        if first is not None:
            dirty.append((text(first, "case"), grade))
    return [cells for cells in (clean, dirty) if cells]


Looks = Mapping[str, Look]
Place = tuple[int, int]
"""Row and column."""

MEAN_NOTE: Final = (
    "Mean of the horizontal rms error over the missions that a method finished, with its 95 % "
    "confidence band (Student's t)."
)
BAND_COLOR: Final = "#D9D9D9"
MAX_COLUMNS: Final = 3


def draw_grid(
    title: str,
    panels: Mapping[Place, Panel],
    methods: Sequence[str],
    looks: Looks,
    note: str,
    left_out: Sequence[str] = (),
    *,
    height: float = 2.8,
    width: float | None = None,
    has_markers: bool = False,
    extra: Sequence[object] = (),
) -> Figure:
    """Draw panels on a grid, a legend of the methods beside it and a note below.

    A panel without curves leaves its place empty. Height and width are a panel's, in inches.
    """
    n_rows, n_columns = (1 + max(place[i] for place in panels) for i in (0, 1))
    width = width or {1: 5.0, 2: 3.7}.get(n_columns, 3.1)
    figure = style.new_figure(n_columns * width + 1.7, n_rows * height + 0.8, title)
    grid = figure.subplots(n_rows, n_columns, squeeze=False)
    for i, row in enumerate(grid):
        for j, axes in enumerate(row):
            panel = panels.get((i, j))
            if panel is not None and panel.curves:
                style.draw_panel(axes, panel)
            else:
                figure.delaxes(axes)
    style.add_legend(figure, methods, looks, has_markers=has_markers, extra=extra)
    style.add_footnote(figure, note, left_out)
    return figure


def draw_error_against_rate(rows: Sequence[Row], looks: Looks) -> Figure | None:
    """Draw the mean error against the share of outliers; None without two rates of a kind."""
    title = "Horizontal position error against the rate of outliers"
    return _draw_sweeps(rate_sweeps(rows), looks, title, x="rate of outliers, %", factor=100.0)


def draw_error_against_size(rows: Sequence[Row], looks: Looks) -> Figure | None:
    """Draw the mean error against the size of outliers; None without two sizes of a kind."""
    title = "Horizontal position error against the size of outliers"
    return _draw_sweeps(
        size_sweeps(rows), looks, title, x="size of outliers (middle of range), m/s"
    )


def _draw_sweeps(
    sweeps: Sequence[Sweep], looks: Looks, title: str, *, x: str, factor: float = 1.0
) -> Figure | None:
    if not sweeps:
        return None
    swept = [row for sweep in sweeps for rows in sweep.points.values() for row in rows]
    methods, left_out = style.shown_methods(methods_of(swept))
    panels = {
        place: _sweep_panel(sweep, methods, looks, x, factor)
        for sweep, place in zip(sweeps, _places(sweeps), strict=True)
    }
    return draw_grid(title, panels, methods, looks, MEAN_NOTE, left_out, has_markers=True)


def _places(sweeps: Sequence[Sweep]) -> list[Place]:
    """Return the place of every sweep: kinds in columns, grades in rows, where that is a table."""
    kinds = list(dict.fromkeys(sweep.kind for sweep in sweeps))
    grades = list(dict.fromkeys(sweep.grade for sweep in sweeps))
    if len(grades) == 1 or len(kinds) == 1 or len(kinds) > MAX_COLUMNS:
        return [divmod(k, min(len(sweeps), MAX_COLUMNS)) for k in range(len(sweeps))]
    return [(grades.index(sweep.grade), kinds.index(sweep.kind)) for sweep in sweeps]


def _sweep_panel(
    sweep: Sweep, methods: Sequence[str], looks: Looks, x: str, factor: float
) -> Panel:
    """Return lines and bands; a rate has a factor that makes it per cent, a size has none."""
    ticks = [factor * at for at in sweep.points]
    is_rate, at = factor != 1.0, np.array(ticks)
    curves, bands, all_means = [], [], []
    for method in reversed(methods):  # the first on top
        look, intervals = looks[method], []
        for rows in sweep.points.values():
            samples = [v for v in values(rows, method, "horizontal_rms_m") if v > 0.0]
            mean = mean_with_interval(samples) if samples else None
            intervals.append((mean.value, mean.low, mean.high) if mean else (math.nan,) * 3)
        means, low, high = np.array(intervals).T
        known = np.isfinite(means)
        curves.append(Curve(at[known], means[known], {**style.line(look), "marker": look.marker}))
        if known.any() and np.isfinite(high).any():
            low = np.where(np.isfinite(low), np.maximum(low, 0.05 * means), means)
            high = np.where(np.isfinite(high), high, means)
            band = {"color": look.color, "alpha": 0.13}
            bands.append(Band(at[known], low[known], high[known], band))
        all_means += means[known].tolist()
    return Panel(
        title=_sweep_title(sweep, is_rate=is_rate),
        x=x,
        y="mean horizontal rms, m",
        bands=bands,
        curves=curves,
        y_limits=(min(all_means) / 1.35, max(all_means) * 1.35) if all_means else None,
        is_log_y=True,
        x_limits=None if is_rate else (ticks[0] / 1.25, ticks[-1] * 1.25),
        is_log_x=not is_rate,
        x_ticks=_apart(ticks, is_log=not is_rate),
    )


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
    places = {cell: (i, j) for i, row in enumerate(cells) for j, cell in enumerate(row)}
    mine = {key: told for key, told in series.items() if key[:2] in places}
    if not any(np.isfinite(nees).any() for *_, nees in mine.values()):
        return None
    methods, left_out = style.shown_methods(method for _, _, method in mine)
    panels, counts = {}, set()
    for (case, grade), place in places.items():
        told = {m: mine[case, grade, m] for m in methods if (case, grade, m) in mine}
        panels[place], n_runs = _nees_panel(told, looks, _joined(case, grade))
        counts.add(n_runs)
    band = Patch(color=BAND_COLOR, label="95 % if consistent")
    expected = Line2D([], [], color=style.GREY, linewidth=0.8, label="expected, 1")
    runs = " or ".join(f"{n}" for n in sorted(counts - {0}))
    note = f"Grey band: where 95 % of such means over {runs} runs lie (chi-square). "
    note += "Above it a method claims to be more certain than it is, below it less."
    title = "Consistency of the position: mean NEES divided by its dimension"
    return draw_grid(title, panels, methods, looks, note, left_out, extra=(band, expected))


def _nees_panel(told: Mapping[str, Series], looks: Looks, title: str) -> tuple[Panel, int]:
    """Return one cell, and the number of runs that its band is of."""
    n_runs, extremes, curves = 0, [1.0], []
    label, span = "", np.zeros(2)
    for method in reversed(list(told)):
        time_s, _, _, nees = told[method]
        mean = _mean_over_runs(nees)
        known = np.isfinite(mean) & (mean > 0.0)
        if not known.any():
            continue
        divisor, label = style.time_axis(time_s)
        span = np.array([time_s[0], time_s[-1]]) / divisor
        curves.append(
            Curve(time_s / divisor, np.where(known, mean, np.nan), style.line(looks[method]))
        )
        extremes += [float(np.quantile(mean[known], 0.01)), float(mean[known].max())]
        n_runs = max(n_runs, int(np.isfinite(nees).any(axis=1).sum()))
    look: dict[str, Any] = {"title": title, "x": label, "y": "mean NEES/3, –"}
    if n_runs == 0:
        return Panel(**look), 0
    band = chi2_interval(3, n_runs)
    low, high = min(*extremes, band.low), max(*extremes, band.high)
    panel = Panel(
        bands=[Band(span, band.low, band.high, {"color": BAND_COLOR, "zorder": 0.6})],
        curves=curves,
        level=1.0,
        x_limits=(float(span[0]), float(span[1])),
        y_limits=(low / 1.2, high * 1.2),
        is_log_y=True,
        **look,
    )
    return panel, n_runs


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
    methods, left_out = style.shown_methods(
        methods_of([row for _, _, mine in cells for row in mine])
    )
    panels = {
        divmod(k, min(len(cells), MAX_COLUMNS)): _end_error_panel(
            {method: _end_errors(mine, method) for method in reversed(methods)},
            looks,
            _joined(case, grade),
        )
        for k, (grade, case, mine) in enumerate(cells)
    }
    title = "Distribution of the horizontal position error at the end of the mission"
    note = "Empirical distribution; a failed run counts as an unbounded error."
    return draw_grid(title, panels, methods, looks, note, left_out, height=3.4)


def _end_error_panel(errors: Mapping[str, list[float]], looks: Looks, title: str) -> Panel:
    """Return the share of missions (failed ones last) over their error, by method."""
    curves, finite = [], []
    for method, ascending in errors.items():
        kept = np.array([error for error in ascending if math.isfinite(error)])
        share = np.arange(len(kept) + 1) / max(len(ascending), 1)
        if len(kept):
            steps = {**style.line(looks[method]), "drawstyle": "steps-post"}
            curves.append(Curve(np.r_[kept[0], kept, 1e12], np.r_[share, share[-1]], steps))
            finite += kept.tolist()
    return Panel(
        title=title,
        x="end error, m",
        y="share of missions, –",
        curves=curves,
        x_limits=(min(finite) / 1.15, max(finite) * 1.25) if finite else None,
        is_log_x=True,
        y_limits=(0.0, 1.03),
    )


def _end_errors(rows: Iterable[Row], method: str) -> list[float]:
    """Return the errors in ascending order, infinite for failed runs; unknown ones are left out."""
    mine = [row for row in rows if text(row, "method") == method]
    errors = [math.inf if has_failed(row) else number(row, "end_error_m") for row in mine]
    return sorted(error for error in errors if error > 0.0)


def _joined(case: str, grade: str) -> str:
    name = case.replace("_", " ")
    name = name[:1].upper() + name[1:]
    return f"{name}, {grade} grade" if grade else name
