"""Which landmark each observation is of, once the whole log was smoothed with a first opinion.

Along the smoothed path an observation is a place in the map. In every scan observations and
landmarks are paired anew, each once and the nearest ones; what is left over lies in heaps where the
first pass had no landmark, or one in the place of two that stand close together. The densest heap
becomes a landmark, until there is none.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from scipy.spatial import cKDTree

from ssm_graph.base import chi2
from ssm_graph.base.frozen import Array
from ssm_graph.systems.landmark_slam.problem import UNKNOWN, SlamProblem

FITS: Final = float(chi2.ppf(0.997, 2))
"""Square of sigmas within which an observation may be of a landmark: three sigmas on one axis."""
IN_A_HEAP: Final = float(chi2.ppf(0.95, 2))
"""Square of sigmas within which leftovers are of one heap."""
FEWEST: Final = 5
"""Observations that make a heap a landmark."""
FEWEST_LEFT: Final = 3
"""Observations with which a landmark stays."""
MOST_NEW: Final = 400
"""Landmarks that heaps may add."""


class Reassociated(NamedTuple):
    """Landmarks of all observations."""

    landmark: NDArray[np.intp]
    """(M,) `UNKNOWN` of those left out."""
    places: Array
    """(L, 2) where the landmarks are, about."""
    squares: Array
    """(M,) by which each misses its landmark, in its sigmas; `FITS` of those left out."""


def reassociate(problem: SlamProblem, sigma: Array, pose: Array, places: Array) -> Reassociated:
    """Return landmarks anew.

    Parameters
    ----------
    problem : names it has are not looked at; a range or a bearing alone stays left out.
    sigma : (M, 2) of each observation, m and rad.
    pose : (K, 3) smoothed.
    places : (L, 2) of the landmarks so far.
    """
    seen = _Seen(problem, sigma, pose)
    cost = seen.squares(places)
    found = np.full(len(problem.keyframe), UNKNOWN, dtype=np.intp)
    seen.pair(np.unique(problem.keyframe[seen.rows]), cost, found)
    of, to = seen.heaps(seen.rows[found[seen.rows] == UNKNOWN])
    for _ in range(MOST_NEW):
        is_left = found == UNKNOWN
        both = is_left[of] & is_left[to]
        of, to = of[both], to[both]
        size = np.bincount(to, minlength=len(found))
        if size.max(initial=0) < FEWEST:
            break
        place = seen.place[of[to == np.argmax(size)]].mean(axis=0)
        places = np.vstack([places, place])
        cost = np.column_stack([cost, seen.squares(place[None])])
        touched = problem.keyframe[seen.rows[cost[seen.rows, -1] < FITS]]
        seen.pair(np.unique(touched), cost, found)
        if not np.any(found == len(places) - 1):
            break  # all of its heap went to others: the next one would be the same
    stays = np.bincount(found[found >= 0], minlength=len(places)) >= FEWEST_LEFT
    number = np.where(stays, np.cumsum(stays) - 1, UNKNOWN)
    squares = np.where(found >= 0, cost[np.arange(len(found)), found], FITS)
    landmark = np.where(found >= 0, number[found], UNKNOWN)
    return Reassociated(landmark, places[stays], np.where(landmark >= 0, squares, FITS))


class _Seen:
    """Observations as places in the map, with axes along and across the sight."""

    def __init__(self, problem: SlamProblem, sigma: Array, pose: Array) -> None:
        self._first = problem.first_of
        self.rows = np.flatnonzero(np.isfinite(problem.measured).all(axis=1))
        at, z = pose[problem.keyframe], problem.measured
        angle = at[:, 2] + z[:, 1]
        along = np.stack([np.cos(angle), np.sin(angle)], axis=1)
        self.place = at[:, :2] + z[:, :1] * along
        across = np.stack([-along[:, 1], along[:, 0]], axis=1)
        self._axes = np.stack(
            [along / sigma[:, :1], across / (z[:, :1] * sigma[:, 1:])], axis=1
        )  # (M, 2, 2)

    def squares(self, places: Array) -> Array:
        """Return how far (M, L) observations are from places, in squares of their sigmas."""
        off = self.place[:, None] - places
        return np.asarray(np.square(np.einsum("mij,mlj->mli", self._axes, off)).sum(axis=2))

    def heaps(self, rows: NDArray[np.intp]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Return the pairs (P,), (P,) of some observations where the second is near the first.

        Near by the sigmas of the first; only those that a tree finds near in metres are compared.
        """
        if not len(rows):
            return rows, rows
        reach_m = np.sqrt(IN_A_HEAP) / np.linalg.norm(self._axes[rows], axis=2).min(axis=1)
        near = cKDTree(self.place[rows]).query_ball_point(self.place[rows], reach_m)
        of = np.repeat(rows, [len(one) for one in near])
        to = rows[np.concatenate(near).astype(np.intp)]
        off = np.einsum("pij,pj->pi", self._axes[of], self.place[of] - self.place[to])
        is_near = np.square(off).sum(axis=1) < IN_A_HEAP
        return of[is_near], to[is_near]

    def pair(self, keyframes: NDArray[np.intp], cost: Array, found: NDArray[np.intp]) -> None:
        """Write the landmarks of some scans: as many pairs that fit as there are, and nearest."""
        whole = np.zeros(len(found), dtype=bool)
        whole[self.rows] = True
        for k in keyframes.tolist():
            rows = np.arange(self._first[k], self._first[k + 1])
            rows = rows[whole[rows]]
            found[rows] = UNKNOWN
            own = cost[rows]
            chosen = linear_sum_assignment(np.where(own < FITS, own - FITS, 0.0))
            for i, j in zip(*chosen, strict=True):
                if own[i, j] < FITS:
                    found[rows[i]] = j
