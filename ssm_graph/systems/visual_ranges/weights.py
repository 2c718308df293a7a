"""How much a range counts: a similarity weight with the posterior variance, softer to one side.

Walls, hulls and surfaces only ever lengthen a range, so that one which is too long is judged by a
heavier tail than one which is too short. With ``e`` predicted minus measured::

    t = (e^2 + H P H') / sigma^2,    weight = -2 f'(t)

and ``f`` the log kernel with 1 degree of freedom where the range is too long (``e < 0``), 5 else.
Its pull on what is far out never ends, though, so that many such ranges still bend the answer; once
a minimum is found it is polished by correntropy to the longer side, whose pull does end.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from factors.similarity import ExpKernel, Kernel, LogKernel, expected_mahalanobis_sq
from ssm_graph.base.frozen import Array

NLOS_WEIGHT: Final = 0.05
"""Below it a range is told as not in line of sight."""
SIGMA_OF_MEDIAN: Final = 1.4826
"""A Gaussian's standard deviation over its median absolute value."""


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
"""For a minimum that is found: nothing pulls that is far too long."""


def robust_rms(error: Array) -> float:
    """Return the standard deviation (m) that errors have which are not lengthened; NaN without.

    From the median of those that are too short, which walls do not touch; ``error`` (N,) is
    predicted minus measured.
    """
    short = error[error > 0.0]
    return SIGMA_OF_MEDIAN * float(np.median(short)) if short.size else float("nan")
