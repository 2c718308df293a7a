"""Intervals that say how much a finite number of runs can tell."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.stats import chi2
from scipy.stats import t as student_t

from ssm_graph.errors import DataError


@dataclass(frozen=True, slots=True)
class Interval:
    """A value with the interval that contains the true one at the asked confidence."""

    value: float
    low: float
    high: float

    def __contains__(self, value: float) -> bool:
        return self.low <= value <= self.high


def chi2_interval(dof: int, runs: int, confidence: float = 0.95) -> Interval:
    """Return where the mean of ``nees / dof`` over independent runs lies if all is consistent.

    The sum of ``runs`` NEES of dimension ``dof`` is chi-square distributed with ``runs dof``::

        low, high = chi2.ppf([tail, 1 - tail], runs dof) / (runs dof),  tail = (1 - confidence) / 2

    Divided by ``dof`` as `Metrics.nees_position` is (with a ``dof`` of 3 there), so that 1 is the
    expected value. Epochs of one run depend on each other: count runs, not epochs.
    """
    if dof < 1 or runs < 1:
        raise DataError(f"chi2_interval: dof and runs must be 1 or more, got {dof} and {runs}")
    low, high = chi2.ppf(_tails(confidence), df=runs * dof) / (runs * dof)
    return Interval(value=1.0, low=float(low), high=float(high))


def mean_with_interval(samples: ArrayLike, confidence: float = 0.95) -> Interval:
    """Return the mean of independent samples (N,) with Student's t interval.

    From a single sample nothing is known about its spread: the interval is infinite.
    """
    values = _finite("samples", samples)
    mean = float(values.mean())
    if len(values) == 1:
        return Interval(value=mean, low=-np.inf, high=np.inf)
    error = float(values.std(ddof=1)) / np.sqrt(len(values))
    low, high = mean + error * student_t.ppf(_tails(confidence), df=len(values) - 1)
    return Interval(value=mean, low=float(low), high=float(high))


def paired_ratio(
    a: ArrayLike,
    b: ArrayLike,
    rng: np.random.Generator,
    confidence: float = 0.95,
    *,
    resamples: int = 10_000,
) -> Interval:
    """Return ``mean(a) / mean(b)`` of paired runs with its percentile bootstrap interval.

    Pairs are drawn together: what both methods share in a run, such as its noise, cancels.

    Parameters
    ----------
    a, b : (N,) a number of each run, such as its RMSE, of two methods; above zero.
    rng : source of the resampling; the same seed gives the same interval.
    confidence : of the two-sided interval, 0 to 1.
    resamples : how many times the runs are drawn anew.
    """
    first, second = _finite("a", a), _finite("b", b)
    if len(first) != len(second):
        raise DataError(
            f"paired_ratio: expected as many a as b, got {len(first)} and {len(second)}"
        )
    if np.any(second <= 0.0):
        raise DataError("paired_ratio: b must be above zero")
    drawn = rng.integers(len(first), size=(resamples, len(first)))
    ratios = first[drawn].mean(axis=1) / second[drawn].mean(axis=1)
    low, high = np.quantile(ratios, _tails(confidence))
    return Interval(value=float(first.mean() / second.mean()), low=float(low), high=float(high))


def _tails(confidence: float) -> list[float]:
    if not 0.0 < confidence < 1.0:
        raise DataError(f"confidence must lie between 0 and 1, got {confidence}")
    tail = 0.5 * (1.0 - confidence)
    return [tail, 1.0 - tail]


def _finite(name: str, samples: ArrayLike) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    values = np.asarray(samples, dtype=np.float64).reshape(-1)
    if len(values) == 0 or not np.isfinite(values).all():
        raise DataError(f"{name}: expected one or more finite numbers, got {values.tolist()[:5]}")
    return values
