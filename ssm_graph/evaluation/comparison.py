"""Methods compared over many missions, mission by mission, with what chance may do to the numbers.

Methods may have run on different seeds: a method's own mean takes all of its runs, every
comparison of two methods only the seeds on which both succeeded.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any, Final

import numpy as np

from ssm_graph.base.errors import DataError
from ssm_graph.base.frozen import Array
from ssm_graph.evaluation.statistics import (
    NOT_PAIRED,
    NOTHING,
    Interval,
    Paired,
    chi2_interval,
    holm,
    mean_with_interval,
    paired_difference,
    paired_ratio,
)

METRICS: Final = ("horizontal_rms_m", "velocity_rms_m_per_s", "end_error_m")
"""What methods are compared by; the lower the better."""
RATIOS: Final = METRICS[:2]
"""Those of which ratios are told: the bootstrap takes its time."""
ORACLE: Final = "oracle"
FILTER_ORACLE: Final = "ekf-oracle"
BASELINES: Final = ("ssm-log", "smoother-log")
"""What the others are compared with unless told, the first that is there."""
MEANS: Final = (
    *("nees_position", "vertical_rms_m", "heading_rms_deg", "path_length_m", "end_error_percent"),
    *("inside_3sigma_east", "inside_3sigma_north", "inside_3sigma_up", "outliers_rejected"),
    *("good_weight", "good_rejected", "iterations", "wall_s"),
)
"""What is told of a method without an interval."""
RESAMPLES: Final = 1000
"""Of the bootstrap: the ends of its intervals move by a few per cent of their width."""

Row = Mapping[str, Any]
Values = Mapping[int, float]
"""A number of each seed that has it."""


@dataclass(frozen=True, slots=True)
class Measure:
    """One metric of one method in a cell."""

    n: int
    """Runs in the mean: those that did not fail and have a finite value."""
    mean: Interval
    """Over these runs, with Student's t interval."""
    to_oracle: Interval
    """Ratio of means over the common seeds, with bootstrap interval; so are the next two."""
    to_filter_oracle: Interval
    to_baseline: Interval
    baseline: Paired
    best: Paired
    """Against the best method that is no oracle."""
    is_leading: bool
    """Whether it is the best method that is no oracle, or not significantly worse."""


@dataclass(frozen=True, slots=True)
class MethodResult:
    """One method in one cell; means are over the runs that did not fail, NaN if unknown."""

    method: str
    n_runs: int
    n_failed: int
    statuses: Mapping[str, int]
    failures: Mapping[str, int]
    """What the failed runs said."""
    measures: Mapping[str, Measure]
    """By name, see `METRICS`."""
    nees_final: Interval
    """Mean of NEES/3 of the last epoch; the interval is where 95 % of such means should lie."""
    means: Mapping[str, float]
    """By name, see `MEANS`."""

    @property
    def is_consistent(self) -> bool:
        """Whether the NEES of the last epoch lies within its interval, or is unknown."""
        return math.isnan(self.nees_final.value) or self.nees_final.value in self.nees_final


@dataclass(frozen=True, slots=True)
class Cell:
    """All methods on the missions of one case, grade and duration."""

    case: str
    grade: str
    kind: str
    rate: float
    size_low_m_per_s: float
    size_high_m_per_s: float
    duration_s: float
    methods: tuple[MethodResult, ...]

    def __getitem__(self, method: str) -> MethodResult:
        return next(result for result in self.methods if result.method == method)


@dataclass(frozen=True, slots=True)
class Comparison:
    """All cells and methods in the order of their first row."""

    baseline: str
    methods: tuple[str, ...]
    cells: tuple[Cell, ...]


def is_oracle(method: str) -> bool:
    """Return whether a method is told what is bad, by its name."""
    return method == ORACLE or method.endswith(f"-{ORACLE}")


def compare_methods(rows: Sequence[Row], *, baseline: str | None = None) -> Comparison:
    """Compare methods in every cell, that is case, grade and duration.

    Parameters
    ----------
    rows : one mapping for every mission and method; what is absent, None, empty or NaN is unknown.
    baseline : method that the others are compared with; otherwise the first of `BASELINES` that
        is there, or else the first method.
    """
    if not rows:
        raise DataError("compare_methods: there are no rows")
    methods = tuple(dict.fromkeys(str(row["method"]) for row in rows))
    if baseline is None:
        baseline = next((name for name in BASELINES if name in methods), methods[0])
    if baseline not in methods:
        raise DataError(
            f"compare_methods: no runs of the baseline {baseline!r}; there are {methods}"
        )
    groups: dict[tuple[str, str, float], dict[str, dict[int, Row]]] = {}
    for row in rows:
        # `number` returns one and the same NaN object: unknown durations make one key.
        key = (text(row, "case"), text(row, "grade"), number(row, "duration_s"))
        runs = groups.setdefault(key, {}).setdefault(str(row["method"]), {})
        seed = int(float(row["seed"]))
        if seed in runs:
            raise DataError(f"compare_methods: seed {seed} of {row['method']} twice in {key}")
        runs[seed] = row
    return Comparison(baseline, methods, tuple(_cell(runs, baseline) for runs in groups.values()))


def number(row: Row, name: str) -> float:
    """Return a number of a row, `math.nan` if it is unknown."""
    value = row.get(name)
    known = math.nan if value is None or value == "" else float(value)
    return math.nan if math.isnan(known) else known


def has_failed(row: Row) -> bool:
    """Return whether a run failed; one that does not say so either way did."""
    failed = row.get("failed")
    return str(failed).strip().lower() not in {"0", "0.0", "false"}


def text(row: Row, name: str) -> str:
    """Return a text of a row, empty if it is unknown."""
    value = row.get(name)
    return "" if value is None else str(value)


def _cell(runs: Mapping[str, Mapping[int, Row]], baseline: str) -> Cell:
    first = next(iter(next(iter(runs.values())).values()))
    done = {
        method: {seed: row for seed, row in of_seed.items() if not has_failed(row)}
        for method, of_seed in runs.items()
    }
    measures = {metric: _measures(done, metric, baseline) for metric in METRICS}
    return Cell(
        case=text(first, "case"),
        grade=text(first, "grade"),
        kind=text(first, "kind"),
        rate=number(first, "rate"),
        size_low_m_per_s=number(first, "size_low_m_per_s"),
        size_high_m_per_s=number(first, "size_high_m_per_s"),
        duration_s=number(first, "duration_s"),
        methods=tuple(
            _result(method, list(of_seed.values()), {m: measures[m][method] for m in METRICS})
            for method, of_seed in runs.items()
        ),
    )


def _measures(
    done: Mapping[str, Mapping[int, Row]], metric: str, baseline: str
) -> dict[str, Measure]:
    """Return one metric of every method of a cell."""
    values: dict[str, Values] = {}
    for method, of_seed in done.items():
        told = {seed: number(row, metric) for seed, row in of_seed.items()}
        values[method] = {seed: value for seed, value in told.items() if math.isfinite(value)}
    best = _best({method: v for method, v in values.items() if not is_oracle(method)})
    to_baseline = _against(baseline, values)
    to_best = to_baseline if best == baseline else _against(best, values)
    against_baseline = _corrected(to_baseline)
    against_best = _corrected({m: pair for m, pair in to_best.items() if not is_oracle(m)})
    others: Mapping[str, Values] = values if metric in RATIOS else {}
    measures = {}
    for method, own in values.items():
        paired = against_best.get(method, NOT_PAIRED)
        measures[method] = Measure(
            n=len(own),
            mean=mean_with_interval(list(own.values())) if own else NOTHING,
            to_oracle=_ratio(own, others.get(ORACLE, {})),
            to_filter_oracle=_ratio(own, others.get(FILTER_ORACLE, {})),
            to_baseline=NOTHING if method == baseline else _ratio(own, others.get(baseline, {})),
            baseline=against_baseline[method],
            best=paired,
            is_leading=method == best or (paired.n_pairs > 0 and not paired.is_worse),
        )
    return measures


def _best(values: Mapping[str, Values]) -> str:
    """Return the method with the lowest mean, empty if no method has a value.

    Each is compared with the best so far over common seeds, without such by their own means.
    """
    best = ""
    for method, own in values.items():
        if not own:
            continue
        ours, theirs = _common(own, values.get(best, {}))
        if best and len(ours) == 0:
            ours, theirs = np.array(list(own.values())), np.array(list(values[best].values()))
        if not best or ours.mean() < theirs.mean():
            best = method
    return best


def _against(other: str, values: Mapping[str, Values]) -> dict[str, Paired]:
    """Return every method minus the other, p values as yet uncorrected."""
    paired = {method: NOT_PAIRED for method in values}
    for method, own in values.items():
        ours, theirs = _common(own, values.get(other, {}))
        if method == other or len(ours) == 0:
            continue
        paired[method] = paired_difference(ours, theirs, other=other)
    return paired


def _corrected(paired: Mapping[str, Paired]) -> dict[str, Paired]:
    """Return the same with Holm's correction over all of them."""
    corrected = holm([pair.p for pair in paired.values()])
    return {
        method: replace(pair, p_holm=float(p))
        for (method, pair), p in zip(paired.items(), corrected, strict=True)
    }


def _ratio(own: Values, other: Values) -> Interval:
    """Return the ratio of means over common seeds; a single pair says nothing of its spread."""
    ours, theirs = _common(own, other)
    if len(ours) == 0 or np.any(theirs <= 0.0):
        return NOTHING
    if len(ours) == 1:
        return Interval(float(ours[0] / theirs[0]), -math.inf, math.inf)
    return paired_ratio(ours, theirs, np.random.default_rng(0), resamples=RESAMPLES)


def _common(a: Values, b: Values) -> tuple[Array, Array]:
    seeds = sorted(a.keys() & b.keys())
    return np.array([a[seed] for seed in seeds]), np.array([b[seed] for seed in seeds])


def _result(method: str, rows: list[Row], measures: dict[str, Measure]) -> MethodResult:
    failed = [row for row in rows if has_failed(row)]
    done = [row for row in rows if not has_failed(row)]
    return MethodResult(
        method=method,
        n_runs=len(rows),
        n_failed=len(failed),
        statuses=MappingProxyType(Counter(text(row, "status") for row in rows)),
        failures=MappingProxyType(Counter(text(row, "error") for row in failed)),
        measures=MappingProxyType(measures),
        nees_final=_nees(done),
        means=MappingProxyType({name: _mean(done, name) for name in MEANS}),
    )


def _nees(rows: list[Row]) -> Interval:
    values = _known(rows, "nees_position_final")
    if len(values) == 0:
        return NOTHING
    return replace(chi2_interval(3, len(values)), value=float(values.mean()))


def _mean(rows: list[Row], name: str) -> float:
    values = _known(rows, name)
    return float(values.mean()) if len(values) else math.nan


def _known(rows: list[Row], name: str) -> Array:
    """Return the values that are told; an infinite one stays, and is seen in the mean."""
    values = np.array([number(row, name) for row in rows], dtype=np.float64)
    return np.asarray(values[~np.isnan(values)])
