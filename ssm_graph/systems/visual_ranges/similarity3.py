"""Similarities of space: a rotation, a translation and a scale, and the one between point sets.

Named apart from the similarity weights of measurements, with which it shares the word alone.

References
----------
.. [1] S. Umeyama, "Least-Squares Estimation of Transformation Parameters Between Two Point
   Patterns", PAMI 13(4), 1991.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ssm_graph.base.errors import DataError

Array = NDArray[np.float64]


class Sim3(NamedTuple):
    """``x -> scale R x + t``."""

    R: Array
    """(3, 3)"""
    t: Array
    """(3,)"""
    scale: float = 1.0

    def apply(self, points: Array) -> Array:
        """Return points (..., 3) moved."""
        return np.asarray(self.scale * (points @ self.R.T) + self.t)

    def after(self, other: Sim3) -> Sim3:
        """Return ``self`` applied after ``other``."""
        return Sim3(self.R @ other.R, self.apply(other.t), self.scale * other.scale)

    def inverse(self) -> Sim3:
        """Return the way back."""
        R = self.R.T
        return Sim3(R, -(R @ self.t) / self.scale, 1.0 / self.scale)

    @property
    def angle(self) -> float:
        """Angle of the rotation, rad."""
        return float(np.arccos(np.clip(0.5 * (np.trace(self.R) - 1.0), -1.0, 1.0)))


IDENTITY = Sim3(np.eye(3), np.zeros(3))


def umeyama(source: Array, target: Array, *, with_scale: bool) -> Sim3:
    """Return the similarity that takes ``source`` (N, 3) nearest to ``target`` (N, 3), [1]_.

    Raises :class:`DataError` for fewer than 3 points.
    """
    if len(source) < 3 or source.shape != target.shape:
        raise DataError(
            f"alignment: expected at least 3 pairs of points, got {len(source)} and {len(target)}"
        )
    a, b = source.mean(axis=0), target.mean(axis=0)
    from_a, from_b = source - a, target - b
    U, size, Vt = np.linalg.svd(from_b.T @ from_a / len(source))
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(U) * np.linalg.det(Vt)) or 1.0])
    R = (U * sign) @ Vt
    variance = float(np.mean(np.sum(from_a**2, axis=1)))
    scale = float(size @ sign) / variance if with_scale and variance > 0.0 else 1.0
    return Sim3(R, b - scale * (R @ a), scale)
