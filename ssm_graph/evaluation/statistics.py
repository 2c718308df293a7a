"""Intervals that say how much a finite number of runs can tell."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from ssm_graph.base import chi2
from ssm_graph.base.errors import DataError

SIGNIFICANT_P: Final = 0.05
"""Chance of a false alarm that is accepted."""


@dataclass(frozen=True, slots=True)
class Interval:
    """A value with the interval that contains the true one at the asked confidence."""

    value: float
    low: float
    high: float

    def __contains__(self, value: float) -> bool:
        return self.low <= value <= self.high

    @property
    def half_width(self) -> float:
        """Half of its width; infinite where nothing is known."""
        return 0.5 * (self.high - self.low)


@dataclass(frozen=True, slots=True)
class SignedRank:
    """Outcome of Wilcoxon's signed-rank test of paired differences."""

    p: float
    """Two-sided; 1 if all differences are zero."""
    effect: float
    """Rank-biserial correlation, -1 (every difference below zero) to 1 (every one above)."""


@dataclass(frozen=True, slots=True)
class Paired:
    """A method minus another on the runs that both finished."""

    other: str
    """Empty if there is nothing to compare with."""
    n_pairs: int
    difference: Interval
    """Mean over the pairs with Student's t interval; below zero the other is worse."""
    p: float
    """Two-sided, of Wilcoxon's signed-rank test."""
    p_holm: float
    """The same, corrected by `holm` for the number of methods; NaN before."""
    effect: float
    """Rank-biserial correlation, -1 (always better than the other) to 1 (always worse)."""

    @property
    def is_worse(self) -> bool:
        """Whether the method is worse than the other, by more than chance explains."""
        return self.p_holm <= SIGNIFICANT_P and self.effect > 0.0


NOTHING: Final = Interval(np.nan, np.nan, np.nan)
NOT_PAIRED: Final = Paired("", 0, NOTHING, np.nan, np.nan, np.nan)


def chi2_interval(dof: int, runs: int, confidence: float = 0.95) -> Interval:
    """Return where the mean of ``nees / dof`` over independent runs lies if all is consistent.

    The sum of ``runs`` NEES of dimension ``dof`` is chi-square distributed with ``runs dof``::

        low, high = chi2.ppf([tail, 1 - tail], runs dof) / (runs dof),  tail = (1 - confidence) / 2

    Divided by ``dof`` as `Metrics.nees_position` is (with a ``dof`` of 3 there), so that 1 is the
    expected value. Epochs of one run depend on each other: count runs, not epochs.
    """
    if dof < 1 or runs < 1:
        raise DataError(f"chi2_interval: dof and runs must be 1 or more, got {dof} and {runs}")
    low, high = chi2.ppf(_tails(confidence), runs * dof) / (runs * dof)
    return Interval(value=1.0, low=float(low), high=float(high))


def mean_with_interval(samples: ArrayLike, confidence: float = 0.95) -> Interval:
    """Return the mean of independent samples (N,) with Student's t interval.

    From a single sample nothing is known about its spread: the interval is infinite.
    """
    values = _finite("samples", samples)
    mean = float(values.mean())
    if len(values) == 1:
        return Interval(value=mean, low=-np.inf, high=np.inf)
    from scipy.stats import t as student_t

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


def signed_rank(differences: ArrayLike) -> SignedRank:
    """Test whether paired differences (N,) lie symmetrically about zero (Wilcoxon).

    Differences of exactly zero are left out, as Wilcoxon did: they say neither better nor worse.
    Fewer than six others can never give a ``p`` of 0.05 or less.
    """
    from scipy.stats import wilcoxon

    values = _finite("differences", differences)
    values = values[values != 0.0]
    if len(values) == 0:
        return SignedRank(p=1.0, effect=0.0)
    _, place, counts = np.unique(np.abs(values), return_inverse=True, return_counts=True)
    ranks = (np.cumsum(counts) - 0.5 * (counts - 1))[place]  # equal ones share their mean rank
    effect = float(ranks @ np.sign(values) / ranks.sum())
    return SignedRank(p=float(wilcoxon(values).pvalue), effect=effect)


def paired_difference(a: ArrayLike, b: ArrayLike, *, other: str) -> Paired:
    """Return ``a - b`` of paired runs (N,), where ``b`` is of the method named ``other``."""
    first, second = _finite("a", a), _finite("b", b)
    if len(first) != len(second):
        raise DataError(
            f"paired_difference: expected as many a as b, got {len(first)} and {len(second)}"
        )
    difference = first - second
    test = signed_rank(difference)
    interval = mean_with_interval(difference)
    return Paired(other, len(first), interval, p=test.p, p_holm=np.nan, effect=test.effect)


def holm(p_values: ArrayLike) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    """Return p values (N,) of one family of tests, corrected for their number (Holm's steps).

    Rejecting where the result is at most ``alpha`` keeps the chance of one or more false alarms
    in the family at or below ``alpha``. NaN, a test not made, stays and does not count.
    """
    p = np.asarray(p_values, dtype=np.float64).reshape(-1)
    corrected = np.full(len(p), np.nan)
    made = np.flatnonzero(~np.isnan(p))
    order = made[np.argsort(p[made], kind="stable")]
    steps = np.arange(len(order), 0, -1)
    corrected[order] = np.minimum(np.maximum.accumulate(steps * p[order]), 1.0)
    return corrected


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
