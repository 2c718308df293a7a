"""Arithmetic of a study: every method on every case and grade, compared with the oracle."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from benchmarks.study_runs import Run
from ssm_graph.data import Array
from ssm_graph.evaluation import Interval, chi2_interval, mean_with_interval, paired_ratio

ORACLE = "oracle"
NOTHING = Interval(math.nan, math.nan, math.nan)


@dataclass(frozen=True, slots=True)
class Row:
    """One method on one case and grade; failed runs are counted, and in no mean."""

    case: str
    grade: str
    method: str
    n_runs: int
    n_failed: int
    """Runs without a trajectory."""
    statuses: str
    rms_horizontal_m: Interval
    """Mean over runs, with Student's t interval."""
    ratio: Interval
    """Its ratio to that of the oracle over the runs that both finished, with bootstrap interval."""
    rms_vertical_m: float
    rms_velocity_m_per_s: float
    end_error_m: float
    nees_final: Interval
    """Mean over runs; the interval is where it should lie, not how well it is known."""
    nees_mean: float
    inside: tuple[float, float, float]
    """Share of all epochs of all runs within three sigmas, east, north, up."""
    n_large_outliers: int
    rejected: float
    """Share of them, pooled over runs."""
    good_weight: float
    good_rejected: float
    iterations: float
    seconds: float
    """Mean wall time, building included."""

    @property
    def is_consistent(self) -> bool:
        """Whether the NEES of the final epoch lies within its chi-square interval."""
        return self.nees_final.low <= self.nees_final.value <= self.nees_final.high


def summarise(runs: Sequence[Run]) -> list[Row]:
    """Return one row for every case, grade and method, in the order of their first run."""
    groups: dict[tuple[str, str], dict[str, list[Run]]] = {}
    for run in runs:
        groups.setdefault((run.case, run.grade), {}).setdefault(run.method, []).append(run)
    return [
        _row(of_method, methods.get(ORACLE, []))
        for methods in groups.values()
        for of_method in methods.values()
    ]


def _row(runs: list[Run], oracle: list[Run]) -> Row:
    done = [run for run in runs if run.has_result]
    first = runs[0]
    n_large = sum(run.n_large_outliers for run in done)
    n_rejected = sum(run.n_large_rejected for run in done)
    return Row(
        case=first.case,
        grade=first.grade,
        method=first.method,
        n_runs=len(runs),
        n_failed=len(runs) - len(done),
        statuses=", ".join(f"{n} {s}" for s, n in Counter(run.status for run in runs).items()),
        rms_horizontal_m=_mean_interval(_values(done, "rms_horizontal_m")),
        ratio=ratio_to(oracle, done),
        rms_vertical_m=_mean(_values(done, "rms_vertical_m")),
        rms_velocity_m_per_s=_mean(_values(done, "rms_velocity_m_per_s")),
        end_error_m=_mean(_values(done, "end_error_m")),
        nees_final=nees_interval(_values(done, "nees_final")),
        nees_mean=_mean(_values(done, "nees_mean")),
        inside=pooled_inside(done),
        n_large_outliers=n_large,
        rejected=n_rejected / n_large if n_large else math.nan,
        good_weight=_mean(_values(done, "good_weight")),
        good_rejected=_mean(_values(done, "good_rejected")),
        iterations=_mean(_values(done, "iterations")),
        seconds=_mean(_values(done, "build_s") + _values(done, "solve_s")),
    )


def ratio_to(oracle: Sequence[Run], runs: Sequence[Run]) -> Interval:
    """Return the ratio of mean horizontal rms over the seeds that both finished."""
    told = {run.seed: run.rms_horizontal_m for run in oracle if run.has_result}
    ours = {run.seed: run.rms_horizontal_m for run in runs if run.has_result}
    seeds = sorted(told.keys() & ours.keys())
    if not seeds:
        return NOTHING
    return paired_ratio(
        [ours[seed] for seed in seeds],
        [told[seed] for seed in seeds],
        np.random.default_rng(0),
    )


def nees_interval(nees: Array) -> Interval:
    """Return the mean of NEES/3 of independent runs, and where 95 % of such means should lie."""
    finite = nees[np.isfinite(nees)]
    if len(finite) == 0:
        return NOTHING
    expected = chi2_interval(3, len(finite))
    return Interval(float(finite.mean()), expected.low, expected.high)


def pooled_inside(runs: Sequence[Run]) -> tuple[float, float, float]:
    """Return the share of all epochs within three sigmas, east, north, up."""
    n_epochs = _values(runs, "n_epochs")
    if n_epochs.sum() == 0:
        return math.nan, math.nan, math.nan
    east, north, up = (
        float(n_epochs @ _values(runs, f"inside_{axis}") / n_epochs.sum())
        for axis in ("east", "north", "up")
    )
    return east, north, up


def _values(runs: Sequence[Run], name: str) -> Array:
    return np.array([getattr(run, name) for run in runs], dtype=np.float64)


def _mean(values: Array) -> float:
    finite = values[np.isfinite(values)]
    return float(finite.mean()) if len(finite) else math.nan


def _mean_interval(values: Array) -> Interval:
    return mean_with_interval(values) if len(values) else NOTHING
