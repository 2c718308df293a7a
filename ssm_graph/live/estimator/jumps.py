"""What a jump of a gyro's bias that the data do not exclude yet may have moved the answer by.

Others tell a bias of a gyro slowly: about the vertical they see no more than a course that bends.
Until then the answer is led astray by a bias that it takes for known, and its sigmas know nothing
of it. So hypotheses go along with the measure of the lanes: one axis jumped at one time, every
`SPACING_S` anew. What a unit of the jump has moved since, in the truth against the measure, and
what it does to every innovation, is a column that the filter leads on; their product with the
innovations is what the data say of its size (Willsky and Jones, IEEE Trans. Automatic Control 21,
1976). Weighed by how likely the data make each, whatever its size, what they would have moved is
added to the covariance that is published.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any, Final, NamedTuple

import numpy as np

from ssm_graph.base.frozen import Array
from ssm_graph.engine.error_state import GYRO_BIAS

SPACING_S: Final = 5.0
"""Between the times at which a jump may have been."""
MEMORY_S: Final = 240.0
"""Older ones are not asked for: as long as the longest lane."""
JUMP: Final = math.radians(0.1)
"""rad/s, sigma that lanes which forget a bias of a gyro give it; from ten times as much on others
find a jump within seconds,"""
SIZE: Final = 0.5 * JUMP
"""and that of the jumps that may have been: large ones are soon told from it."""
PER_H: Final = 30.0
"""Jumps of an axis in an hour: far above what sound gyros do, so that sigmas cover one before it is
certain. Hence only what the data add to these odds counts: a jump that they say nothing of adds
nothing. Chosen with the size on tactical missions of 250 s, seeds 31002 to 31007 of
``benchmarks.trust.live``, of which 1 stays GOOD beyond 5 sigma for more than 10 s; at 0.1 it is 5.
Sound missions, 31010 to 31013, have velocity sigmas larger by 4 to 13 %, of attitude by 6 to 30."""
MOST: Final = 500.0
"""Logarithm of the largest likelihood ratio."""
AXES: Final = 3
TIMES: Final = round(MEMORY_S / SPACING_S)


class Jumps(NamedTuple):
    """M jumps that may have been, those of the three axes at one time beside each other."""

    moved: Array
    """(M, n) what one of 1 rad/s has moved the truth by, from what the measure says"""
    information: Array
    """(M,) of its size, as the data have it, s^2/rad^2"""
    score: Array
    """(M,) the same times its likeliest size, s/rad"""
    begun_s: Array
    """(M / 3,) when, s; NaN where there is none yet"""

    @classmethod
    def none(cls, n: int) -> Jumps:
        """Return room for those of a state of ``n``."""
        M = AXES * TIMES
        return cls(np.zeros((M, n)), np.zeros(M), np.zeros(M), np.full(TIMES, np.nan))

    def pack(self) -> Iterator[tuple[str, Array]]:
        """Yield name and array of everything."""
        for name, array in self._asdict().items():
            yield f"jump_{name}", array

    @classmethod
    def unpack(cls, arrays: Mapping[str, Array]) -> Jumps:
        """Return what was packed."""
        return cls(*(arrays[f"jump_{name}"] for name in cls._fields))

    def updated(self, jacobian: Array, solved: Array, whitened: Array, gain: Array) -> Jumps:
        """Return them after an update of the measure.

        Parameters
        ----------
        jacobian : (m, n) of what was measured.
        solved : (m, m) inverse covariance of the innovations.
        whitened : (m,) that times the innovations.
        gain : (n, m) of the measure.
        """
        seen = self.moved @ jacobian.T
        return self._replace(
            moved=self.moved - seen @ gain.T,
            information=self.information + np.sum((seen @ solved) * seen, axis=1),
            score=self.score + seen @ whitened,
        )

    def with_next(self, time_s: float) -> Jumps:
        """Return them with one more time, in the place of the oldest, where it is due."""
        if np.any(time_s - self.begun_s < SPACING_S):
            return self
        at = int(np.argmin(np.where(np.isnan(self.begun_s), -np.inf, self.begun_s)))
        own = np.s_[AXES * at : AXES * (at + 1)]
        made: dict[str, Any] = {name: array.copy() for name, array in self._asdict().items()}
        made["moved"][own] = 0.0
        made["moved"][own, GYRO_BIAS] = np.eye(AXES)
        made["information"][own] = made["score"][own] = 0.0
        made["begun_s"][at] = time_s
        return Jumps(**made)

    def unexcluded(self, n: int) -> Array:
        """Return the covariance (n, n) that they add to that of the first components."""
        variance = 1.0 / (self.information + SIZE**-2)
        size = variance * self.score
        best = np.exp(np.minimum(0.5 * size * self.score, MOST))
        # Averaged over all sizes it may have: of noise alone its mean is one.
        likelihood = best * np.sqrt(variance) / SIZE
        odds = PER_H / 3600.0 * SPACING_S * np.maximum(likelihood - 1.0, 0.0)
        share = odds / (1.0 + odds.sum())
        moved = self.moved[:, :n] * np.sqrt(share * (size**2 + variance))[:, None]
        return np.asarray(moved.T @ moved)
