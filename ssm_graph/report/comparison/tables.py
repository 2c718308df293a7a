"""A comparison of methods as Markdown to read and as LaTeX to print."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from itertools import groupby
from typing import Final

from ssm_graph.evaluation import Cell, Comparison, Measure, MethodResult
from ssm_graph.report.comparison.legend import LEGEND
from ssm_graph.report.comparison.sums import sums
from ssm_graph.report.comparison.text import (
    decimals_of,
    digits,
    interval,
    plain,
    probability,
    table,
)

MAX_OPEN_CELLS: Final = 6
"""With more cells than these their tables are folded away."""
MAX_COLUMNS: Final = 7
"""Of numbers in a LaTeX table."""
HEADLINES: Final = (
    ("horizontal_rms_m", "Horizontal rms error", "m", 1.0),
    ("velocity_rms_m_per_s", "Velocity rms error", "mm/s", 1000.0),
)
"""Metric, what it is called, its unit here and how many of these make one of its own."""
COLUMNS: Final = (
    "method; runs; failed; horizontal rms, m; velocity rms, mm/s; vertical rms, m; "
    "heading rms, deg; end error, m; end error, % of path; ratio to oracle, 1; "
    "ratio to ekf-oracle, 1; ratio to {baseline}, 1; pairs, 1; Δ horizontal, m; p horizontal, 1; "
    "p Holm horizontal, 1; Δ velocity, mm/s; p Holm velocity, 1; NEES/3 final, 1; "
    "NEES/3 epochs, 1; inside 3σ E/N/U, %; outliers rejected, %; good weight, 1; "
    "good rejected, %; iterations, 1; wall time, s; status, runs"
)
"""Of the table of a cell."""


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
    lines += [*sums(comparison), "## Every cell", ""]
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
    header = [name.format(baseline=baseline) for name in COLUMNS.split("; ")]
    lines = table(header, [_cells(result) for result in cell.methods])
    failures = [
        f"- {plain(result.method)}: {n} of {result.n_runs} runs failed: {plain(said) or '?'}"
        for result in cell.methods
        for said, n in result.failures.items()
    ]
    lines += ["", *failures] if failures else []
    if is_folded:
        return ["<details>", f"<summary>{plain(name)}</summary>", "", *lines, "", "</details>", ""]
    return [f"### {plain(name)}", "", *lines, ""]


def _cells(result: MethodResult) -> list[str]:
    means, n_runs = result.means, result.n_runs
    horizontal, velocity, end = (
        result.measures[name]
        for name in ("horizontal_rms_m", "velocity_rms_m_per_s", "end_error_m")
    )
    inside = [100.0 * means[f"inside_3sigma_{axis}"] for axis in ("east", "north", "up")]
    return [
        result.method,
        str(n_runs),
        f"{result.n_failed} †" if result.n_failed else "0",
        _marked(horizontal, n_runs),
        _marked(velocity, n_runs, 1000.0),
        digits(means["vertical_rms_m"]),
        digits(means["heading_rms_deg"]),
        _marked(end, n_runs),
        digits(means["end_error_percent"]),
        interval(horizontal.to_oracle),
        interval(horizontal.to_filter_oracle),
        interval(horizontal.to_baseline),
        str(horizontal.baseline.n_pairs) if horizontal.baseline.n_pairs else "–",
        interval(horizontal.baseline.difference),
        probability(horizontal.baseline.p),
        probability(horizontal.baseline.p_holm),
        interval(velocity.baseline.difference, 1000.0),
        probability(velocity.baseline.p_holm),
        interval(result.nees_final) + ("" if result.is_consistent else " !"),
        digits(means["nees_position"]),
        "/".join("–" if math.isnan(share) else f"{share:.1f}" for share in inside),
        digits(100.0 * means["outliers_rejected"]),
        digits(means["good_weight"]),
        digits(100.0 * means["good_rejected"]),
        digits(means["iterations"]),
        digits(means["wall_s"]),
        ", ".join(f"{n} {status}" for status, n in result.statuses.items()),
    ]


def _marked(measure: Measure, n_runs: int, scale: float = 1.0) -> str:
    missing = n_runs - measure.n
    return interval(measure.mean, scale) + (f" †{missing}" if missing else "")


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
