"""How much a range counts: a similarity weight with the posterior variance, softer to one side.

Walls, hulls and surfaces only ever lengthen a range, so that one which is too long is judged by a
heavier tail than one which is too short. With ``e`` predicted minus measured::

    t = (e^2 + H P H') / sigma^2,    weight = -2 f'(t)

and ``f`` the log kernel with 1 degree of freedom where the range is too long (``e < 0``), 5 else.
Its pull on what is far out never ends, though, so that many such ranges still bend the answer; once
a minimum is found it is polished by the probability that a range is in sight, whose pull has no
mean; how many are too long, and by how much, is found from their errors.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.special import expit, log_ndtr

from factors.similarity import ExpKernel, Kernel, LogKernel, expected_mahalanobis_sq
from ssm_graph.base.frozen import Array
from ssm_graph.systems.visual_ranges.ranges import Indices

NLOS_WEIGHT: Final = 0.05
"""Below it a range is told as not in line of sight."""
SIGMA_OF_MEDIAN: Final = 1.4826
"""A Gaussian's standard deviation over its median absolute value."""
EXCESS: Final = (2.5, 5.0, 10.0, 20.0, 40.0)
"""Sigmas by which ranges are too long in the mean, of which the likeliest is taken."""
LEAST_SHARE: Final = 0.01
MOST_SHARE: Final = 0.95
"""Of ranges that are taken to be too long."""
SHARE_ROUNDS: Final = 60
"""Of the expectation maximisation of a share; it ends within a hundredth then."""


@dataclass(frozen=True, slots=True)
class RangeKernel:
    """The two kernels of a range's residual."""

    longer: Kernel = LogKernel(1.0)
    """Where the measured range is longer than the predicted one."""
    shorter: Kernel = LogKernel(5.0)

    def weight(self, error: Array, variance: Array | float, sigma: Array) -> Array:
        """Return weights (...), each 1 where the residual is as expected.

        Parameters
        ----------
        error : (...) m, predicted minus measured.
        variance : (...) m^2, ``H P H'`` at the posterior; 0 gives the plain M-estimator.
        sigma : (...) m
        """
        t = expected_mahalanobis_sq(error, np.asarray(variance, dtype=np.float64), sigma=sigma)
        return np.where(error < 0.0, self.longer.weight(t), self.shorter.weight(t))

    def deviance(self, error: Array, sigma: Array) -> Array:
        """Return ``-2 (f(t) - f(0))`` (...) of the residual alone: t itself where it is small."""
        t = np.square(error / sigma)
        zero = np.zeros(1)
        longer = self.longer.similarity(zero) - self.longer.similarity(t)
        shorter = self.shorter.similarity(zero) - self.shorter.similarity(t)
        return np.asarray(2.0 * np.where(error < 0.0, longer, shorter))

    def inefficiency(self, error: Array, sigma: Array) -> float:
        """Return by how much the inverse of the weighted information understates the variance.

        Huber's ``E[psi^2] E[w] / E[psi']^2`` of the residuals (...) themselves, with ``psi`` the
        weight times the whitened residual; at least 1.
        """
        if not error.size:
            return 1.0
        r = error / sigma
        step = 1e-4

        def psi(at: Array) -> Array:
            return self.weight(at, 0.0, np.ones_like(at)) * at

        slope = float(np.mean(psi(r + step) - psi(r - step))) / (2.0 * step)
        weight = float(np.mean(self.weight(r, 0.0, np.ones_like(r))))
        return max(float(np.mean(psi(r) ** 2)) * weight / max(slope, 0.1 * weight) ** 2, 1.0)


POLISH: Final = RangeKernel(ExpKernel(2.0), LogKernel(5.0))
"""For a map and what is shown of ranges: nothing pulls that is far too long."""


@dataclass(frozen=True, slots=True)
class SightKernel(RangeKernel):
    """The weight of a range is the probability that it is in sight, by its error.

    A share of the ranges is too long by an exponential, beside the noise that all have. Then what
    the others pull has no mean, however many are too long; the side to which a range may not err
    is judged as by `shorter`.
    """

    share: Array | float = LEAST_SHARE
    """(M,) of ranges that are too long"""
    excess: Array | float = 10.0
    """(M,) mean of what they are too long by, sigmas"""

    def weight(self, error: Array, variance: Array | float, sigma: Array) -> Array:
        """See :meth:`RangeKernel.weight`."""
        t = expected_mahalanobis_sq(error, np.asarray(variance, dtype=np.float64), sigma=sigma)
        return np.asarray(np.exp(self._log_in_sight(error / sigma)) * self.shorter.weight(t))

    def deviance(self, error: Array, sigma: Array) -> Array:
        """See :meth:`RangeKernel.deviance`."""
        r = error / sigma
        zero = np.zeros_like(r)
        fit = self.shorter.similarity(zero) - self.shorter.similarity(np.square(r))
        return np.asarray(2.0 * (fit + self._log_in_sight(r) - self._log_in_sight(zero)))

    def _log_in_sight(self, r: Array) -> Array:
        odds = np.log(self.share) - np.log1p(-np.asarray(self.share))
        return np.asarray(-np.logaddexp(0.0, odds + log_longer(r, self.excess)))


def log_longer(r: Array, excess: Array | float) -> Array:
    """Return the log of how much likelier whitened errors are of ranges that are too long.

    The density of a unit normal plus an exponential of mean ``excess`` over that of the normal;
    ``r`` is predicted minus measured, sigmas.
    """
    rate = 1.0 / np.asarray(excess, dtype=np.float64)
    x = -r - rate
    return np.asarray(np.log(rate * np.sqrt(2.0 * np.pi)) + log_ndtr(x) + 0.5 * np.square(x))


def sight_kernel(error: Array, sigma: Array, anchor: Indices) -> SightKernel:
    """Return the kernel by errors (M,): of each anchor share and excess that are likeliest.

    Parameters
    ----------
    error, sigma : (M,) m
    anchor : (M,)
    """
    share, excess = np.full((2, len(error)), LEAST_SHARE)
    for j in np.unique(anchor):
        own = anchor == j
        odds = log_longer((error[own] / sigma[own])[None], np.array(EXCESS)[:, None])
        p = np.full((len(EXCESS), 1), 0.3)
        for _ in range(SHARE_ROUNDS):
            p = expit(odds + np.log(p) - np.log1p(-p)).mean(axis=1, keepdims=True)
            p = np.clip(p, LEAST_SHARE, MOST_SHARE)
        fit = np.logaddexp(np.log1p(-p), np.log(p) + odds).sum(axis=1)
        best = int(np.argmax(fit))
        share[own], excess[own] = p[best], EXCESS[best]
    return SightKernel(share=share, excess=excess)


def robust_rms(error: Array) -> float:
    """Return the standard deviation (m) that errors have which are not lengthened; NaN without.

    From the median of those that are too short, which walls do not touch; ``error`` (N,) is
    predicted minus measured.
    """
    short = error[error > 0.0]
    return SIGMA_OF_MEDIAN * float(np.median(short)) if short.size else float("nan")
