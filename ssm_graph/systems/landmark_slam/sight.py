"""What is in view and was not seen: it tells places that stand in a map twice from those there are.

A landmark is visited where it is in view of some scans of a stretch of time, and of the landmarks
that there are most are seen at most visits; how many the log tells. Of a place that is there twice
one or the other stays unseen whenever it is visited. Scans of one visit are alike (what hides a
landmark goes on to hide it), so each visit counts once.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from factors.bearing_range import half_turn
from ssm_graph.base.frozen import Array
from ssm_graph.systems.landmark_slam.problem import SlamProblem

NEAREST, FARTHEST, WIDEST = 0.02, 0.9, 0.9
"""Shares of the observations that are nearer, nearer, and less far off the axis than the edges of
the view: at its very rim much is missed."""
FEWEST_SCANS: Final = 3
"""Of a visit."""


class View(NamedTuple):
    """Where landmarks are seen from a pose."""

    nearest_m: float
    farthest_m: float
    widest_rad: float
    """Off the axis, to either side"""

    @classmethod
    def of(cls, problem: SlamProblem) -> View:
        """Return the view that a log's own observations tell; without any there is none."""
        whole = problem.measured[np.isfinite(problem.measured).all(axis=1)]
        if not len(whole):
            return cls(0.0, 0.0, 0.0)
        near, far = np.quantile(whole[:, 0], [NEAREST, FARTHEST]).tolist()
        return cls(near, far, float(np.quantile(np.abs(whole[:, 1]), WIDEST)))

    def has(self, pose: Array, places: Array) -> NDArray[np.bool_]:
        """Return which places (..., L, 2) are in view of poses (..., 3): (..., L)."""
        off = places - pose[..., None, :2]
        away = np.hypot(off[..., 0], off[..., 1])
        bearing = half_turn(np.arctan2(off[..., 1], off[..., 0]) - pose[..., 2:])
        is_far = (away < self.nearest_m) | (away > self.farthest_m)
        return np.asarray(~is_far & (np.abs(bearing) < self.widest_rad))


def unseen(
    view: View,
    problem: SlamProblem,
    block: NDArray[np.intp],
    pose: Array,
    places: Array,
    landmark: NDArray[np.intp],
) -> Array:
    """Return twice the negative logarithms of the likelihoods of visits (B,), by their blocks.

    Parameters
    ----------
    problem : names it has are not looked at; poses that saw nothing visit nothing.
    block : (K,) of each pose, ascending from 0.
    pose, places : (K, 3) and (L, 2) of the map, m and rad.
    landmark : (M,) of the observations, `problem.UNKNOWN` of those left out.
    """
    L, named = len(places), landmark >= 0
    sees = np.unique(problem.keyframe)
    scans, seen = np.zeros((2, block[-1] + 1, L))
    np.add.at(scans, block[sees], view.has(pose[sees], places))
    np.add.at(seen, (block[problem.keyframe[named]], landmark[named]), 1)
    is_visit = scans >= FEWEST_SCANS
    n, n_seen = is_visit.sum(axis=1), (is_visit & (seen > 0)).sum(axis=1)
    share = (n_seen.sum() + 1) / (n.sum() + 2)
    return np.asarray(-2.0 * (n_seen * np.log(share) + (n - n_seen) * np.log1p(-share)))
