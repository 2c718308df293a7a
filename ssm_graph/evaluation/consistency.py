"""Whether an estimator's own account of its error is true: of any state, any system.

NEES and NIS against chi-square bounds, shares of errors within 1, 2, 3 sigma, and rates with
intervals for whatever either happens or does not (containment, false convergence, missed alarms).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import betaincinv

from ssm_graph.base.errors import DataError
from ssm_graph.base.units import wrapped
from ssm_graph.evaluation.errors import normalized_error_squared
from ssm_graph.evaluation.statistics import Interval, chi2_interval

SIGMAS: Final = (1, 2, 3)
"""At which shares are told."""
NORMAL_SHARES: Final = (0.682689, 0.954500, 0.997300)
"""Of a normal variable within as many sigma."""


def circular_mean(angle_rad: ArrayLike, weights: ArrayLike | None = None) -> float:
    """Return the mean direction of angles (N,) [rad], within [-pi, pi).

    Raises :class:`DataError` where they cancel and there is none.
    """
    angles = np.asarray(angle_rad, dtype=np.float64)
    w = np.ones(angles.shape) if weights is None else np.asarray(weights, dtype=np.float64)
    x, y = float(w @ np.cos(angles)), float(w @ np.sin(angles))
    if np.hypot(x, y) <= 1e-12 * float(np.abs(w).sum()):
        raise DataError(f"circular_mean: {len(angles)} angles have no mean direction: they cancel")
    return float(wrapped(np.arctan2(y, x)))


@dataclass(frozen=True, slots=True)
class Consistency:
    """How true the sigmas of independent runs are."""

    nees: Interval
    """Mean of NEES / n; the interval is where 95 % of such means lie if all is consistent."""
    shares: tuple[float, float, float]
    """Of single errors within 1, 2, 3 sigma; see `NORMAL_SHARES`."""
    n_runs: int

    @property
    def is_consistent(self) -> bool:
        """Whether the mean lies within its interval."""
        return self.nees.value in self.nees


def consistency(errors: ArrayLike, covs: ArrayLike) -> Consistency:
    """Return what the errors (N, n) of independent runs say of their covariances (N, n, n).

    A covariance that is not positive definite makes the mean NaN: nothing is consistent with it.
    """
    e, p = np.asarray(errors, dtype=np.float64), np.asarray(covs, dtype=np.float64)
    n_runs, n = e.shape
    expected = chi2_interval(n, n_runs)
    mean = float(np.mean(normalized_error_squared(e, p))) / n
    ratio = np.abs(e) / np.sqrt(np.einsum("...ii->...i", p))
    one, two, three = (float(np.mean(ratio <= k)) for k in SIGMAS)
    return Consistency(Interval(mean, expected.low, expected.high), (one, two, three), n_runs)


def rate_with_interval(happened: ArrayLike, confidence: float = 0.95) -> Interval:
    """Return the share of true values of (N,) with Clopper and Pearson's exact interval."""
    values: NDArray[np.bool_] = np.asarray(happened, dtype=bool)
    n, k = values.size, int(values.sum())
    if n == 0:
        raise DataError("rate_with_interval: there are no trials")
    tail = 0.5 * (1.0 - confidence)
    low = float(betaincinv(k, n - k + 1, tail)) if k > 0 else 0.0
    high = float(betaincinv(k + 1, n - k, 1.0 - tail)) if k < n else 1.0
    return Interval(k / n, low, high)
