"""Which cells of a study a figure shows, and the numbers of their runs; nothing is drawn here."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

from ssm_graph.base.frozen import Array
from ssm_graph.evaluation.comparison import has_failed, number, text

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
