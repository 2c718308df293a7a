"""Places that explain what was seen, each with its share of the evidence, and which are rivals.

Nothing here knows what a place is, nor when two of them are one: whoever looks for them says so.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ssm_graph.base.frozen import Array

CARRIED: Final = 0.05
"""A rival with more of the evidence makes an answer ambiguous."""
_LOOKED_AT: Final = 40
"""So many times as many of the best rows as are asked for are looked at."""

Same = Callable[[int, NDArray[np.intp]], NDArray[np.bool_]]
"""Says which of some rows are in the place of one row."""


@dataclass(frozen=True, slots=True)
class Hypothesis:
    """A place where what was last seen could have been seen."""

    pose: tuple[float, ...]
    """x, y [m], yaw [rad], and what else whoever looked for it estimates with it."""
    log_evidence: float
    """Of all that was seen, up to a constant."""
    misfit: float = 0.0
    """Loss of log likelihood of one observation, the mean over all."""
    share: float = 1.0
    """Of the evidence of all places, 0 to 1."""

    @property
    def evidence(self) -> dict[str, float]:
        """Share and log evidence by name, for files."""
        return {"share": self.share, "log_evidence": self.log_evidence}


def apart_from_each_other(value: Array, is_same: Same, most: int) -> list[int]:
    """Return rows of the best values (n,), none in the place of a better one."""
    kept: list[int] = []
    left = np.argsort(-value)[: _LOOKED_AT * most]
    while left.size and len(kept) < most:
        best = int(left[0])
        kept.append(best)
        same = is_same(best, left)
        same[0] = True
        left = left[~same]
    return kept


def told(poses: Array, log_evidence: Array, misfit: Array, kept: Sequence[int]) -> list[Hypothesis]:
    """Return rows (n, d) as hypotheses, each with its share beside those that are kept."""
    share = np.exp(log_evidence - log_evidence[list(kept)].max())
    share = share / share[list(kept)].sum()
    return [
        Hypothesis(tuple(pose), float(e), float(m), float(w))
        for pose, e, m, w in zip(poses.tolist(), log_evidence, misfit, share, strict=True)
    ]
