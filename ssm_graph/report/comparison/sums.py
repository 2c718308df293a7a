"""What all cells of a comparison say together: how many times the error of others a method has."""

from __future__ import annotations

from collections.abc import Sequence
from statistics import geometric_mean
from typing import Final

from ssm_graph.evaluation import (
    FILTER_ORACLE,
    ORACLE,
    Cell,
    Comparison,
    Interval,
    Measure,
    MethodResult,
)
from ssm_graph.report.comparison.text import digits, table

COLUMNS: Final = (("horizontal", "horizontal_rms_m"), ("velocity", "velocity_rms_m_per_s"))
"""Their short names, and those in `MethodResult.measures`."""


def sums(comparison: Comparison) -> list[str]:
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
    for short, metric in COLUMNS:
        for other in dict.fromkeys((comparison.baseline, ORACLE, FILTER_ORACLE)):
            entries = [_ratio(of, metric, other, comparison.baseline) for of in results.values()]
            if any(entry != "–" for entry in entries):
                header.append(f"{short} to {other}, 1")
                columns.append(entries)
    rows = zip(results, *columns, strict=True)
    return table(header, [row for row in rows if results[row[0]]])


def _ratio(results: Sequence[MethodResult], metric: str, other: str, baseline: str) -> str:
    """Return the mean ratio of some cells, with the worst, and how many cells have none."""
    shown = [_to(result.measures[metric], other, baseline) for result in results]
    known = [ratio.value for ratio in shown if ratio.value > 0.0]
    if not known:
        return "–"
    worst = f" (≤ {digits(max(known))})" if len(known) > 1 else ""
    missing = f" †{len(shown) - len(known)}" if len(known) < len(shown) else ""
    return digits(geometric_mean(known)) + worst + missing


def _to(measure: Measure, other: str, baseline: str) -> Interval:
    if other == baseline:
        return measure.to_baseline
    return measure.to_oracle if other == ORACLE else measure.to_filter_oracle
