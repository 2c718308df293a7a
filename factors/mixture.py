"""Sound measurements with some among them that may be anything: a normal noise and a uniform one.

The log kernel lets go of gross errors little by little, and each still pulls; where all else is
normal, what is gross can be told from what is sound. With a share ``e`` that lies anywhere in a
volume ``A`` of whitened space the density is ``(1 - e) N(t) + e / A``, and the weight the
probability that a measurement is sound [1]_::

    weight = 1 / (1 + exp((t - even) / 2)),    even = -2 ln(e / (1 - e) (2 pi)^(dim/2) / A)

References
----------
.. [1] G. E. P. Box, G. C. Tiao, "A Bayesian Approach to Some Outlier Problems", Biometrika 55,
   1968.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar, Final, NamedTuple, final

import numpy as np

from factors.similarity import Array, Kernel
from factors.tails import DOUBTED_SQ

ROUNDS: Final = 30
MOST_GROSS: Final = 0.4
"""Share beyond which sigmas are wrong rather than measurements."""
LEAST_GROSS: Final = 1e-12
"""Share that is next to none: its logarithm is still a number."""


def _logistic(x: Array) -> Array:
    """Return ``1 / (1 + exp(-x))``, which never overflows."""
    return np.asarray(0.5 + 0.5 * np.tanh(0.5 * x))


@final
@dataclass(frozen=True)
class MixtureKernel(Kernel):
    """``f = ln(exp(-t/2) + exp(-even/2))``: normal, or anywhere."""

    name: ClassVar[str] = "mixture"
    even: float
    """``t`` at which a measurement is as likely gross as sound."""

    def similarity(self, t: Array, *, dim: int = 1) -> Array:  # noqa: ARG002
        """Return ``f(t)``."""
        return np.logaddexp(-0.5 * t, -0.5 * self.even)

    def _weight(self, t: Array, dim: int | Array) -> Array:  # noqa: ARG002
        return _logistic(0.5 * (self.even - t))


class LikeliestMixture(NamedTuple):
    """The mixture under which measurements are likeliest."""

    kernel: MixtureKernel
    evidence: float
    """Logarithm of how likely it makes them, as :func:`factors.tails.tail_evidence` has it"""


def likeliest_mixture(t: Array, telling: Array, *, dim: int) -> LikeliestMixture | None:
    """Return the mixture of greatest likelihood; None if more than sound ones would be gross.

    By expectation maximisation of the share; gross ones lie within the farthest, and one is
    supposed beforehand, as for tails.

    Parameters
    ----------
    t, telling : as of :func:`factors.tails.tail_evidence`.
    dim : of the measurements.
    """
    t, telling = np.append(t, DOUBTED_SQ), np.append(telling, 1.0)
    ball = math.pi ** (0.5 * dim) / math.gamma(0.5 * dim + 1.0)
    log_ratio = 0.5 * dim * math.log(2.0 * math.pi / float(np.max(t))) - math.log(ball)
    share = 0.1
    for _ in range(ROUNDS):
        even = -2.0 * (math.log(share / (1.0 - share)) + log_ratio)
        gross = _logistic(0.5 * (t - even))
        share = max(float(np.average(gross, weights=telling)), LEAST_GROSS)
        if share > MOST_GROSS:
            return None
    logs = np.logaddexp(-0.5 * t, -0.5 * even)
    constant = math.log1p(-share) - 0.5 * dim * math.log(2.0)
    return LikeliestMixture(
        MixtureKernel(float(max(round(even), dim))), float(telling @ (logs + constant))
    )
