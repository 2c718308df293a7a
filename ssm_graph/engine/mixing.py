"""Faster and surer reweighting: weights mixed over two passes."""

from __future__ import annotations

import numpy as np

from factors.similarity import WEIGHT_FLOOR
from ssm_graph.base.frozen import Array


class Mixing:
    """Anderson acceleration of depth one for the fixed point of the weights [1]_.

    Plain reweighting closes in by a constant factor a pass; two passes tell the factor, and the
    rest of the way is taken at once. The fixed point stays what it is.

    References
    ----------
    .. [1] H. F. Walker, P. Ni, "Anderson Acceleration for Fixed-Point Iterations", SIAM Journal on
       Numerical Analysis 49, 2011.
    """

    def __init__(self) -> None:
        self._last: tuple[Array, Array] | None = None

    def next_weights(self, used: Array, settled: Array) -> Array:
        """Return the weights to try next, from those used and those they led to."""
        change = settled - used
        last, self._last = self._last, (change, settled)
        if last is None:
            return settled
        turn = change - last[0]
        length_sq = float(turn @ turn)
        if length_sq < 1e-16:
            return settled
        mixed = settled - float(change @ turn) / length_sq * (settled - last[1])
        return np.asarray(np.clip(mixed, WEIGHT_FLOOR, max(1.0, 2.0 * float(settled.max()))))
