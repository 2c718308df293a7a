"""What whole runs of camera and ranges have to reach, and whether rows of runs reach it.

The limits are those that were set before the runs; a case counts with as many seeds as are named.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Final, NamedTuple

import numpy as np

from benchmarks.report import number_text
from ssm_graph.study.ledger import ERROR, Row

Rows = Mapping[str, Sequence[Row]]
"""Runs that came to something, by case."""
Value = Callable[[Rows], float]

GOOD: Final = ("READY", "MIRROR")


def median(case: str, column: str, *, factor: float = 1.0) -> Value:
    """Return the median over runs; a run without the number counts as infinitely bad."""
    return lambda rows: float(np.median(_sizes(rows[case], column))) * factor


def worst(case: str, column: str, *, factor: float = 1.0) -> Value:
    """Return the largest absolute value; a run without the number counts as infinitely bad."""
    return lambda rows: float(_sizes(rows[case], column).max()) * factor


def root_mean_square(case: str, column: str, *, factor: float = 1.0) -> Value:
    """Return the rms; a run without the number counts as infinitely bad."""
    return lambda rows: float(np.sqrt(np.mean(_sizes(rows[case], column) ** 2))) * factor


def least(case: str, column: str, *, factor: float = 1.0) -> Value:
    """Return the smallest value; a run without the number counts as zero."""
    return lambda rows: (
        factor * float(np.nan_to_num([float(row[column]) for row in rows[case]], nan=0.0).min())
    )


def total(case: str, column: str) -> Value:
    """Return the sum."""
    return lambda rows: float(sum(float(row[column]) for row in rows[case]))


def percent_called(case: str, names: Sequence[str]) -> Value:
    """Return the share of runs with one of these verdicts, %."""
    return lambda rows: 100.0 * float(np.mean([row["verdict"] in names for row in rows[case]]))


def good_and_far_off(case: str, limit: float) -> Value:
    """Return how many runs are called good with a scale that is off by more than a share."""
    return lambda rows: float(
        sum(row["verdict"] in GOOD and not abs(row["scale"]) <= limit for row in rows[case])
    )


def beside(case: str, plain: str, *, factor: float, more: float) -> Value:
    """Return the median metric error, less what the plain case allows for it, m."""
    return lambda rows: (
        median(case, "metric_m")(rows) - factor * median(plain, "metric_m")(rows) - more
    )


def clock_error(case: str, clock_s: float) -> Value:
    """Return by how much the clock is off in the median, ms."""
    return lambda rows: (
        1e3 * float(np.median([abs(float(row["clock_s"]) - clock_s) for row in rows[case]]))
    )


def _sizes(rows: Sequence[Row], column: str) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    values = np.abs([float(row[column]) for row in rows])
    return np.where(np.isnan(values), np.inf, values)


class Goal(NamedTuple):
    """A number and its limit."""

    cases: tuple[str, ...]
    """Of whose runs the number is; the first is the one that is counted"""
    what: str
    value: Value
    limit: float
    is_least: bool = False
    """Whether the limit is one from below"""


def _accuracy(case: str, metric_m: float, scale: float, anchor_m: float) -> tuple[Goal, ...]:
    """Return the goals of a case: medians of path, scale in per cent, and anchor; 0: none."""
    asked = (
        ("metric rms, m", "metric_m", 1.0, metric_m),
        ("scale, %", "scale", 100.0, scale),
        ("worst anchor, m", "anchor_m", 1.0, anchor_m),
    )
    return tuple(
        Goal((case,), f"{what}, median", median(case, column, factor=factor), limit)
        for what, column, factor, limit in asked
        if limit
    )


def _back(case: str, metric_m: float = 0.03) -> tuple[Goal, ...]:
    """Return the goals of a run that something happens to: twice the error of the room's limit."""
    return (
        Goal(
            (case,),
            "poses in the last 10 s, %",
            least(case, "tracked_last", factor=100.0),
            95.0,
            is_least=True,
        ),
        Goal((case,), "metric rms, m, worst", worst(case, "metric_m"), metric_m),
    )


RUNS: Final[Mapping[str, int]] = {
    "kitti-mono": 1,
    "kitti-1": 5,
    "kitchen-mono": 1,
    "kitchen-1": 5,
    "kitchen-3": 5,
    "kitti-1-arm": 5,
    "kitchen-1-arm": 5,
    "kitchen-3-arm": 5,
    "room": 5,
    "room-nlos": 20,
    "room-half": 20,
    "room-clock": 1,
    "room-silent": 1,
    "room-covered": 1,
    "room-carried": 1,
    "room-dropped": 1,
    "room-threads": 5,
    "corridor": 5,
    "corridor-nlos": 5,
    "corridor-open": 5,
    "corridor-mono": 5,
    "corridor-small": 20,
    "room-long": 1,
    "tags-loop-2d_s5": 1,
    "tags-loop-3d_s5": 1,
    "tags-loop-2d-fast_s1": 1,
}
"""Runs of each case that the goals ask for; runs of one path follow each other."""

GOALS: Final[tuple[Goal, ...]] = (
    *_accuracy("room", 0.015, 0.5, 0.15),
    Goal(("room",), "started after, s, median", median("room", "started_s"), 12.0),
    *_accuracy("corridor", 0.035, 0.3, 0.4),
    *_accuracy("corridor-nlos", 0.035, 0.0, 0.0),
    *_accuracy("corridor-open", 0.09, 0.0, 0.0),
    Goal(
        ("corridor-mono",), "scale-aligned rms, m, median", median("corridor-mono", "similar_m"),
        0.10,
    ),
    Goal(("corridor-small",), "false loops, sum", total("corridor-small", "taken_false"), 0.0),
    Goal(("corridor",), "false loops, sum", total("corridor", "taken_false"), 0.0),
    Goal(("kitchen-mono",), "scale-aligned rms, m", median("kitchen-mono", "similar_m"), 0.055),
    *_accuracy("kitchen-1", 0.08, 4.0, 0.0),
    *_accuracy("kitchen-3", 0.06, 2.5, 0.0),
    Goal(
        ("kitti-mono",), "images with a pose, %", least("kitti-mono", "tracked", factor=100.0),
        100.0, is_least=True,
    ),
    Goal(("kitti-mono",), "scale-aligned rms, m", median("kitti-mono", "similar_m"), 0.35),
    *_accuracy("kitti-1", 0.45, 0.7, 0.0),
    Goal(
        ("kitti-1",), "called MIRROR, %", percent_called("kitti-1", ("MIRROR",)), 100.0,
        is_least=True,
    ),
    *_accuracy("kitti-1-arm", 0.45, 0.7, 0.0),
    Goal(
        ("kitti-1-arm",), "called MIRROR, %", percent_called("kitti-1-arm", ("MIRROR",)), 100.0,
        is_least=True,
    ),
    *_accuracy("kitchen-1-arm", 0.08, 4.0, 0.0),
    *_accuracy("kitchen-3-arm", 0.06, 2.5, 0.0),
    Goal(("room-nlos",), "scale, %, rms", root_mean_square("room-nlos", "scale", factor=100), 1.0),
    Goal(("room-nlos",), "scale, %, worst", worst("room-nlos", "scale", factor=100.0), 2.5),
    Goal(
        ("room-nlos", "room"), "metric rms, m, above 1.5 times that in sight and 5 mm",
        beside("room-nlos", "room", factor=1.5, more=0.005), 0.0,
    ),
    Goal(
        ("room-nlos",), "ranges 0.5 m too long with a weight below 0.1, %, least",
        least("room-nlos", "nlos_dropped", factor=100.0), 95.0, is_least=True,
    ),
    Goal(
        ("room-nlos",), "mean weight of ranges in sight, least",
        least("room-nlos", "clear_weight"), 0.8, is_least=True,
    ),
    Goal(
        ("room-half",), "called good with a scale more than 5 % off, runs",
        good_and_far_off("room-half", 0.05), 0.0,
    ),
    *_back("room-covered"),
    *_back("room-carried"),
    *_back("room-dropped"),
    *_back("room-silent"),
    *_back("room-clock"),
    Goal(("room-clock",), "clock, ms off, median", clock_error("room-clock", -0.05), 5.0),
    Goal(
        ("room-threads",), "images a second of wall, least", least("room-threads", "rate_hz"), 30.0,
        is_least=True,
    ),
    Goal(
        ("room-threads",), "tracking, 99th percentile, ms of wall, worst",
        worst("room-threads", "tracking_p99_s", factor=1e3), 33.0,
    ),
    *_accuracy("tags-loop-2d_s5", 0.10, 0.7, 0.5),
    *_accuracy("tags-loop-3d_s5", 0.10, 0.7, 0.5),
    Goal(
        ("tags-loop-2d-fast_s1",), "called good with a scale more than 5 % off, runs",
        good_and_far_off("tags-loop-2d-fast_s1", 0.05), 0.0,
    ),
    Goal(("room-long",), "memory at its highest, MiB", worst("room-long", "peak_mib"), 1024.0),
)  # fmt: skip

HEADER: Final = ("case", "what", "goal", "measured", "runs", "")


def goal_cells(goal: Goal, rows: Rows, about: str) -> tuple[str, ...]:
    """Return the cells of a goal: the case, what, limit, number, runs done of runs asked, word."""
    sign = "≥" if goal.is_least else "≤"
    asked = RUNS[goal.cases[0]]
    limit = f"{sign} {goal.limit:g}"
    if any(not rows.get(case) for case in goal.cases):
        return about, goal.what, limit, "–", f"0 of {asked}", "not run"
    n, value = len(rows[goal.cases[0]]), goal.value(rows)
    is_met = value >= goal.limit if goal.is_least else value <= goal.limit
    word = ("met" if is_met else "missed") + ("" if n >= asked else " so far")
    shown = number_text(value) if np.isfinite(value) else "none"
    return about, goal.what, limit, shown, f"{n} of {asked}", word


def good_rows(rows: Sequence[Row]) -> list[Row]:
    """Return the rows of runs that came to something."""
    return [row for row in rows if ERROR not in row]
