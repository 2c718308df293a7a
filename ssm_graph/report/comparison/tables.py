"""A comparison of methods as Markdown to read and as LaTeX to print."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from itertools import groupby
from statistics import geometric_mean
from typing import Final

from ssm_graph.evaluation.comparison import (
    FILTER_ORACLE,
    ORACLE,
    Cell,
    Comparison,
    Measure,
    MethodResult,
)
from ssm_graph.evaluation.statistics import Interval

MAX_OPEN_CELLS: Final = 6
"""With more cells than these their tables are folded away."""
MAX_COLUMNS: Final = 7
"""Of numbers in a LaTeX table."""
HEADLINES: Final = (
    ("horizontal_rms_m", "Horizontal rms error", "m", 1.0),
    ("velocity_rms_m_per_s", "Velocity rms error", "mm/s", 1000.0),
)
"""Metric, what it is called, its unit here and how many of these make one of its own."""
UNKNOWN: Final = "–"

LEGEND: Final = """\
**Rms and end error**: mean over the runs of a method ± half of its 95 % interval (Student's t); in
the tables of single cells the interval is in brackets. Errors count from the first ping on.
**Bold** in the headline: the best method that is no oracle, and those not significantly worse than
it (Wilcoxon's signed-rank test of the runs that both finished, p > 0.05 after Holm's correction
over the methods of the cell). Best is the lowest mean over common seeds. Few runs show few
differences: with fewer than six pairs none is ever significant, and bold says nothing. Cells are
not corrected for each other. **†k**: k runs failed or gave no such number and are in no mean and no
pair; what fails on the hard missions looks better than it is. **Runs, failed**: missions tried, and
those of them without a result. **Ratio, 1**: of mean horizontal rms, over the seeds that both
finished, with the 95 % interval of a paired bootstrap; below 1 the method is better than what it is
divided by. **Cells together**: the geometric mean of these ratios over the cells, of velocity too,
with the highest of them (≤) and the number of cells without one (†); on clean data the ratio to the
oracle of its kind is what a robust method costs there. Oracles are told which measurements are bad;
`oracle` is a smoother, `ekf-oracle` a filter, which is the fairer measure of filters. **Δ**: method
minus baseline, mean over the pairs with its 95 % interval (Student's t); below zero the method is
better. **Pairs**: seeds that both finished. **p**: Wilcoxon's signed-rank test, two-sided; **p
Holm**: corrected for the number of methods of the cell. **NEES/3 final**: position at the last
epoch, mean over runs, expected 1, in brackets where 95 % of such means lie if the covariance is
right; `!` marks one outside. **NEES/3 epochs**: mean over all epochs, which depend on each other:
no interval. **Inside 3σ**: share of epochs with the position error within three sigmas, east,
north, up, expected 99.7 %. **Outliers rejected**: share of the outliers that the method left out.
**Good weight, good rejected**: mean weight of good measurements, and the share of them left out.
**Iterations, wall time**: means over runs; filters share the work of many runs, smoothers on one
mission their first pass, which is not in it. **Status**: how many runs ended how. A dash is unknown
or not applicable.
"""
"""What the columns of a comparison mean."""


def table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Return the lines of a Markdown table, the first column to the left."""
    ruler = ["---" if column == 0 else "---:" for column in range(len(header))]
    texts = [[plain(text) for text in line] for line in (header, *rows)]
    return ["| " + " | ".join(cells) + " |" for cells in (texts[0], ruler, *texts[1:])]


def plain(text: str) -> str:
    """Return a text on one line that ends no cell of a table."""
    return " ".join(text.split()).replace("|", "\\|").replace("<", "&lt;")


def interval(shown: Interval, scale: float = 1.0) -> str:
    """Return a value with its interval in brackets, as far as there are any."""
    if math.isnan(shown.value) or not math.isfinite(shown.half_width):
        return digits(scale * shown.value)
    return (
        f"{digits(scale * shown.value)} [{digits(scale * shown.low)}, {digits(scale * shown.high)}]"
    )


def probability(p: float) -> str:
    """Return a p value with two digits, small ones as a bound."""
    if math.isnan(p):
        return UNKNOWN
    return "< 0.001" if p < 0.001 else f"{p:.2g}"


def digits(value: float) -> str:
    """Return a number with three digits that count."""
    if not math.isfinite(value):
        return UNKNOWN if math.isnan(value) else f"{value}"
    if value != 0.0 and not 1e-4 <= abs(value) < 1e6:
        return f"{value:.2e}"
    decimals = decimals_of(value)
    return f"{round(value, decimals):.{max(decimals, 0)}f}"


def decimals_of(value: float) -> int:
    """Return how many decimals show three digits; below zero if not all of the integer ones."""
    if value == 0.0:
        return 0
    return 2 - int(f"{abs(value):.2e}".partition("e")[2])


def markdown(
    comparison: Comparison, *, title: str, command: str, code: str, notes: Sequence[str] = ()
) -> str:
    """Return the whole report: headed by the command and the version of the code that made it.

    Notes are what else a reader has to know, one paragraph each.
    """
    about = f"Code: {code}. Baseline: `{comparison.baseline}`. The legend is at the end."
    lines = [f"# {title}", "", f"    {command}", "", about, ""]
    for note in notes:
        lines += [note, ""]
    for grade, kind in dict.fromkeys((cell.grade, cell.kind) for cell in comparison.cells):
        cells = [cell for cell in comparison.cells if (cell.grade, cell.kind) == (grade, kind)]
        lines += [f"## {_heading(grade, kind)}", ""]
        for metric, name, unit, scale in HEADLINES:
            lines += [f"### {name}, {unit}", ""]
            lines += _headline(comparison, cells, metric, unit, scale)
            lines.append("")
    lines += [*_sums(comparison), "## Every cell", ""]
    is_folded = len(comparison.cells) > MAX_OPEN_CELLS
    for cell in comparison.cells:
        lines += _details(cell, comparison.baseline, is_folded=is_folded)
    return "\n".join([*lines, "## Legend", "", LEGEND])


def _heading(grade: str, kind: str) -> str:
    return ", ".join(part for part in (grade.lower(), kind) if part) or "all"


def _headline(
    comparison: Comparison, cells: Sequence[Cell], metric: str, unit: str, scale: float
) -> list[str]:
    header = ["method", "runs", *(f"{label}, {unit}" for label in column_labels(cells))]
    rows = []
    for method in _methods(comparison, cells):
        results = [_result(cell, method) for cell in cells]
        entries = [_headline_entry(result, metric, scale) for result in results]
        rows.append([method, _runs(results), *entries])
    return table(header, rows)


def _headline_entry(result: MethodResult | None, metric: str, scale: float) -> str:
    if result is None:
        return ""
    value, *missing = entry(result.measures[metric], result.n_runs, scale).split(" †")
    bold = f"**{value}**" if result.measures[metric].is_leading else value
    return " †".join([bold, *missing])


def entry(measure: Measure, n_runs: int, scale: float) -> str:
    """Return a mean ± half of its interval, with a mark if runs are missing in it."""
    mark = f" †{n_runs - measure.n}" if n_runs > measure.n else ""
    value, half = scale * measure.mean.value, scale * measure.mean.half_width
    if not math.isfinite(half):
        return digits(value) + mark
    decimals = max(decimals_of(max(abs(value), half)), 0)
    return f"{value:.{decimals}f} ± {half:.{decimals}f}{mark}"


def column_labels(cells: Sequence[Cell]) -> list[str]:
    """Return what tells the cells of one table apart, at least their rate or case."""
    parts = [
        [cell.kind for cell in cells],
        [f"{100.0 * cell.rate:g} %" if math.isfinite(cell.rate) else "" for cell in cells],
        [_size(cell) for cell in cells],
        [_duration(cell) for cell in cells],
    ]
    varying = [part for part in parts if len(set(part)) > 1] or [parts[1]]
    labels = [
        ", ".join(filter(None, words)) or cell.case
        for cell, words in zip(cells, zip(*varying, strict=True), strict=True)
    ]
    if len(set(labels)) == len(labels):
        return labels
    return [f"{cell.case}, {label}" for cell, label in zip(cells, labels, strict=True)]


def _size(cell: Cell) -> str:
    low, high = cell.size_low_m_per_s, cell.size_high_m_per_s
    return f"{low:g} to {high:g} m/s" if math.isfinite(low + high) else ""


def _duration(cell: Cell) -> str:
    return f"{cell.duration_s:g} s" if math.isfinite(cell.duration_s) else ""


def _methods(comparison: Comparison, cells: Sequence[Cell]) -> list[str]:
    return [name for name in comparison.methods if any(_result(cell, name) for cell in cells)]


def _result(cell: Cell, method: str) -> MethodResult | None:
    return next((result for result in cell.methods if result.method == method), None)


def _runs(results: Sequence[MethodResult | None]) -> str:
    counts = sorted({result.n_runs for result in results if result})
    return " to ".join(str(count) for count in dict.fromkeys((counts[0], counts[-1])))


def _details(cell: Cell, baseline: str, *, is_folded: bool) -> list[str]:
    (label,) = column_labels([cell])
    about = (cell.case, cell.grade.lower(), cell.kind, label, _size(cell), _duration(cell))
    name = ", ".join(dict.fromkeys(part for part in about if part))
    header = [name.format(baseline=baseline) for name in COLUMNS]
    lines = table(header, [[show(r) for show in COLUMNS.values()] for r in cell.methods])
    failures = [
        f"- {plain(result.method)}: {n} of {result.n_runs} runs failed: {plain(said) or '?'}"
        for result in cell.methods
        for said, n in result.failures.items()
    ]
    lines += ["", *failures] if failures else []
    if is_folded:
        return ["<details>", f"<summary>{plain(name)}</summary>", "", *lines, "", "</details>", ""]
    return [f"### {plain(name)}", "", *lines, ""]


def _sums(comparison: Comparison) -> list[str]:
    """Return the lines of a table for each grade, with and without outliers; none for one cell."""
    if len(comparison.cells) < 2:
        return []
    groups: dict[str, list[Cell]] = {}
    for cell in comparison.cells:
        outliers = "clean" if cell.kind == "none" else "outliers" if cell.kind else ""
        groups.setdefault(", ".join(filter(None, (cell.grade.lower(), outliers))), []).append(cell)
    lines = ["## Cells together", ""]
    for name, cells in groups.items():
        noun = "cell" if len(cells) == 1 else "cells"
        lines += [f"### {name or 'all'}, {len(cells)} {noun}", ""]
        lines += [*_group(comparison, cells), ""]
    return lines


def _group(comparison: Comparison, cells: Sequence[Cell]) -> list[str]:
    header, columns = ["method"], []
    results = {
        method: [result for cell in cells for result in cell.methods if result.method == method]
        for method in comparison.methods
    }
    for short, metric in (("horizontal", _HORIZONTAL), ("velocity", _VELOCITY)):
        for other in dict.fromkeys((comparison.baseline, ORACLE, FILTER_ORACLE)):
            entries = [_ratio(of, metric, other, comparison.baseline) for of in results.values()]
            if any(entry != UNKNOWN for entry in entries):
                header.append(f"{short} to {other}, 1")
                columns.append(entries)
    rows = zip(results, *columns, strict=True)
    return table(header, [row for row in rows if results[row[0]]])


def _ratio(results: Sequence[MethodResult], metric: str, other: str, baseline: str) -> str:
    """Return the mean ratio of some cells, with the worst, and how many cells have none."""
    shown = [_to(result.measures[metric], other, baseline) for result in results]
    known = [ratio.value for ratio in shown if ratio.value > 0.0]
    if not known:
        return UNKNOWN
    worst = f" (≤ {digits(max(known))})" if len(known) > 1 else ""
    missing = f" †{len(shown) - len(known)}" if len(known) < len(shown) else ""
    return digits(geometric_mean(known)) + worst + missing


def _to(measure: Measure, other: str, baseline: str) -> Interval:
    if other == baseline:
        return measure.to_baseline
    return measure.to_oracle if other == ORACLE else measure.to_filter_oracle


def _mean_of(name: str, scale: float = 1.0) -> Callable[[MethodResult], str]:
    return lambda result: digits(scale * result.means[name])


def _of(metric: str, show: Callable[[Measure], str]) -> Callable[[MethodResult], str]:
    return lambda result: show(result.measures[metric])


def _marked(metric: str, scale: float = 1.0) -> Callable[[MethodResult], str]:
    """Return what shows a mean with its interval, and how many runs are missing in it."""

    def show(result: MethodResult) -> str:
        measure = result.measures[metric]
        missing = result.n_runs - measure.n
        return interval(measure.mean, scale) + (f" †{missing}" if missing else "")

    return show


def _inside(result: MethodResult) -> str:
    shares = [100.0 * result.means[f"inside_3sigma_{axis}"] for axis in ("east", "north", "up")]
    return "/".join(UNKNOWN if math.isnan(share) else f"{share:.1f}" for share in shares)


_HORIZONTAL, _VELOCITY = "horizontal_rms_m", "velocity_rms_m_per_s"
COLUMNS: Final[Mapping[str, Callable[[MethodResult], str]]] = {
    "method": lambda result: result.method,
    "runs": lambda result: str(result.n_runs),
    "failed": lambda result: f"{result.n_failed} †" if result.n_failed else "0",
    "horizontal rms, m": _marked(_HORIZONTAL),
    "velocity rms, mm/s": _marked(_VELOCITY, 1000.0),
    "vertical rms, m": _mean_of("vertical_rms_m"),
    "heading rms, deg": _mean_of("heading_rms_deg"),
    "end error, m": _marked("end_error_m"),
    "end error, % of path": _mean_of("end_error_percent"),
    "ratio to oracle, 1": _of(_HORIZONTAL, lambda m: interval(m.to_oracle)),
    "ratio to ekf-oracle, 1": _of(_HORIZONTAL, lambda m: interval(m.to_filter_oracle)),
    "ratio to {baseline}, 1": _of(_HORIZONTAL, lambda m: interval(m.to_baseline)),
    "pairs, 1": _of(_HORIZONTAL, lambda m: str(m.baseline.n_pairs or UNKNOWN)),
    "Δ horizontal, m": _of(_HORIZONTAL, lambda m: interval(m.baseline.difference)),
    "p horizontal, 1": _of(_HORIZONTAL, lambda m: probability(m.baseline.p)),
    "p Holm horizontal, 1": _of(_HORIZONTAL, lambda m: probability(m.baseline.p_holm)),
    "Δ velocity, mm/s": _of(_VELOCITY, lambda m: interval(m.baseline.difference, 1000.0)),
    "p Holm velocity, 1": _of(_VELOCITY, lambda m: probability(m.baseline.p_holm)),
    "NEES/3 final, 1": lambda result: (
        interval(result.nees_final) + ("" if result.is_consistent else " !")
    ),
    "NEES/3 epochs, 1": _mean_of("nees_position"),
    "inside 3σ E/N/U, %": _inside,
    "outliers rejected, %": _mean_of("outliers_rejected", 100.0),
    "good weight, 1": _mean_of("good_weight"),
    "good rejected, %": _mean_of("good_rejected", 100.0),
    "iterations, 1": _mean_of("iterations"),
    "wall time, s": _mean_of("wall_s"),
    "status, runs": lambda result: ", ".join(f"{n} {s}" for s, n in result.statuses.items()),
}
"""Of the table of a cell: its header, and what it says of a method."""


def latex(comparison: Comparison, *, caption: str, label: str) -> str:
    """Return tables of horizontal and velocity error for a document that loads ``booktabs``.

    There is one for each grade, or where that had more than seven columns one for each kind, cut
    where even that is too wide. The caption is plain text. The label is that of an only table;
    several are numbered, ``label-1`` and on.
    """
    chunks: list[Sequence[Cell]] = []
    for grade in dict.fromkeys(cell.grade for cell in comparison.cells):
        cells = [cell for cell in comparison.cells if cell.grade == grade]
        kinds = [cells]
        if len(cells) > MAX_COLUMNS:
            order = list(dict.fromkeys(cell.kind for cell in cells))
            cells.sort(key=lambda cell: order.index(cell.kind))
            kinds = [list(group) for _, group in groupby(cells, key=lambda cell: cell.kind)]
        for group in kinds:
            chunks += [group[i : i + MAX_COLUMNS] for i in range(0, len(group), MAX_COLUMNS)]
    labels = [label] if len(chunks) == 1 else [f"{label}-{i + 1}" for i in range(len(chunks))]
    return "\n".join(
        _float(comparison, cells, caption, name) for cells, name in zip(chunks, labels, strict=True)
    )


def _float(comparison: Comparison, cells: Sequence[Cell], caption: str, label: str) -> str:
    kinds = {cell.kind for cell in cells}
    about = _heading(cells[0].grade, kinds.pop() if len(kinds) == 1 else "")
    stop = "" if caption.endswith((".", "!", "?")) else "."
    explained = (
        rf"{_escape(caption)}{stop} {_escape(about)}. Mean over runs $\pm$ half of its 95 \% "
        r"interval; bold: the best method that is no oracle, and those not significantly worse "
        r"(paired Wilcoxon test, Holm, 5 \%); $\dagger$: number of runs that failed or gave no "
        r"value, in no mean."
    )
    lines = [r"\begin{table}", r"\centering", r"\footnotesize", r"\setlength{\tabcolsep}{3pt}"]
    lines += [rf"\caption{{{explained}}}", rf"\label{{{label}}}"]
    for metric, name, unit, scale in HEADLINES:
        units = [rf"{_escape(text)} [{unit}]" for text in column_labels(cells)]
        lines += [rf"\begin{{tabular}}{{l{'r' * len(cells)}}}", r"\toprule"]
        lines += [" & ".join([name, *units]) + r" \\", r"\midrule"]
        for method in _methods(comparison, cells):
            entries = [_latex_entry(_result(cell, method), metric, scale) for cell in cells]
            lines.append(" & ".join([_escape(method), *entries]) + r" \\")
        lines += [r"\bottomrule", r"\end{tabular}", r"\par\medskip"]
    lines[-1] = r"\end{table}"
    return "\n".join([*lines, ""])


def _latex_entry(result: MethodResult | None, metric: str, scale: float) -> str:
    if result is None:
        return ""
    measure = result.measures[metric]
    value, _, missing = entry(measure, result.n_runs, scale).partition(" †")
    math_text = "--" if value == "–" else f"${value.replace('±', chr(92) + 'pm')}$"
    bold = rf"{{\boldmath{math_text}}}" if measure.is_leading else math_text
    return bold + (rf"$^{{\dagger {missing}}}$" if missing else "")


def _escape(text: str) -> str:
    """Return plain text as LaTeX."""
    special = {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}"}
    escaped = re.sub(r"[\\~^%_&#${}]", lambda found: special.get(found[0], "\\" + found[0]), text)
    return escaped.replace("–", "--").replace("<", "$<$").replace(">", "$>$")
