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
MEMORY_S: Final = 10.0
"""In which odometry of 0.04 rad/sqrt(s) loses 0.13 rad, half a metre at four: less than landmarks
of different groups are apart."""
MOST_NEW: Final = 400
"""Landmarks that heaps may add."""


class Reassociated(NamedTuple):
    """Landmarks of all observations."""

    landmark: NDArray[np.intp]
    """(M,) `UNKNOWN` of those left out."""
    places: Array
    """(L, 2) where the landmarks are, about."""


def reassociate(
    problem: SlamProblem,
    sigma: Array,
    pose: Array,
    places: Array,
    before: NDArray[np.intp] | None = None,
) -> Reassociated:
    """Return landmarks anew.

    Parameters
    ----------
    problem : names it has are not looked at; a range or a bearing alone stays left out.
    sigma : (M, 2) of each observation, m and rad.
    pose : (K, 3) smoothed.
    places : (L, 2) of the landmarks so far.
    before : (M,) landmarks so far: they are met only within `MEMORY_S` of a sighting, as is a heap
        of itself. None: the path is right enough for all of it to be met at any time.
    """
    seen = _Seen(problem, sigma, pose)
    cost = seen.squares(places)
    if before is not None:
        for one in range(len(places)):
            cost[~seen.is_within(np.flatnonzero(before == one)), one] = np.inf
    found = np.full(len(problem.keyframe), UNKNOWN, dtype=np.intp)
    seen.pair(np.unique(problem.keyframe[seen.rows]), cost, found)
    lasts_s = np.inf if before is None else MEMORY_S
    of, to = seen.heaps(seen.rows[found[seen.rows] == UNKNOWN], lasts_s)
    for _ in range(MOST_NEW):
        is_left = found == UNKNOWN
        both = is_left[of] & is_left[to]
        of, to = of[both], to[both]
        size = np.bincount(to, minlength=len(found))
        if size.max(initial=0) < FEWEST:
            break
        heap = of[to == np.argmax(size)]
        place = seen.place[heap].mean(axis=0)
        places = np.vstack([places, place])
        cost = np.column_stack([cost, seen.squares(place[None])])
        if before is not None:
            cost[~seen.is_within(heap), -1] = np.inf
        touched = problem.keyframe[seen.rows[cost[seen.rows, -1] < FITS]]
        seen.pair(np.unique(touched), cost, found)
        if not np.any(found == len(places) - 1):
            break  # all of its heap went to others: the next one would be the same
    _thinned(cost, found, problem.keyframe)
    stays = np.bincount(found[found >= 0], minlength=len(places)) >= FEWEST_LEFT
    number = np.where(stays, np.cumsum(stays) - 1, UNKNOWN)
    landmark = np.where(found >= 0, number[found], UNKNOWN)
    return Reassociated(landmark, places[stays])


def missed(squares: Array) -> Array:
    """Return twice the negative logarithm of likelihoods: Student's, two degrees of freedom."""
    return np.asarray(4.0 * np.log1p(0.5 * np.minimum(squares, FITS)))


def price(n: int) -> float:
    """Return that of a landmark of a log of n observations: two numbers (Schwarz's criterion)."""
    return 2.0 * float(np.log(max(n, 2)))


def _thinned(cost: Array, found: NDArray[np.intp], keyframe: NDArray[np.intp]) -> None:
    """Take out landmarks whose observations are as well of others: of less worth than a price."""
    n, L = len(found), cost.shape[1]
    taken = np.zeros((int(keyframe.max(initial=0)) + 1, L), dtype=bool)
    named = found >= 0
    taken[keyframe[named], found[named]] = True
    while True:
        best, best_gain = -1, 0.0
        for one in np.unique(found[found >= 0]).tolist():
            rows = np.flatnonzero(found == one)
            others = np.where(taken[keyframe[rows]], np.inf, cost[rows]).min(axis=1)
            gain = price(n) - float((missed(others) - missed(cost[rows, one])).sum())
            if gain > best_gain:
                best, best_gain = one, gain
        if best < 0:
            return
        rows = np.flatnonzero(found == best)
        cost[:, best] = np.inf
        others = np.where(taken[keyframe[rows]], np.inf, cost[rows])
        found[rows] = np.where(others.min(axis=1) < FITS, others.argmin(axis=1), UNKNOWN)
        taken[keyframe[rows], best] = False
        moved = rows[found[rows] >= 0]
        taken[keyframe[moved], found[moved]] = True


class _Seen:
    """Observations as places in the map, with axes along and across the sight."""

    def __init__(self, problem: SlamProblem, sigma: Array, pose: Array) -> None:
        self._first = problem.first_of
        self._time_s = problem.time_s[problem.keyframe]
        self.rows = np.flatnonzero(np.isfinite(problem.measured).all(axis=1))
        at, z = pose[problem.keyframe], problem.measured
        angle = at[:, 2] + z[:, 1]
        along = np.stack([np.cos(angle), np.sin(angle)], axis=1)
        self.place = at[:, :2] + z[:, :1] * along
        across = np.stack([-along[:, 1], along[:, 0]], axis=1)
        self._axes = np.stack(
            [along / sigma[:, :1], across / (z[:, :1] * sigma[:, 1:])], axis=1
        )  # (M, 2, 2)

    def is_within(self, rows: NDArray[np.intp]) -> NDArray[np.bool_]:
        """Return which observations (M,) are within `MEMORY_S` of one of some."""
        if not len(rows):
            return np.zeros(len(self._time_s), dtype=bool)
        t = np.sort(self._time_s[rows])
        after = np.minimum(np.searchsorted(t, self._time_s), len(t) - 1)
        apart = np.minimum(
            np.abs(t[after] - self._time_s), np.abs(t[np.maximum(after - 1, 0)] - self._time_s)
        )
        return np.asarray(apart < MEMORY_S)

    def squares(self, places: Array) -> Array:
        """Return how far (M, L) observations are from places, in squares of their sigmas."""
        off = self.place[:, None] - places
        return np.asarray(np.square(np.einsum("mij,mlj->mli", self._axes, off)).sum(axis=2))

    def heaps(
        self, rows: NDArray[np.intp], lasts_s: float
    ) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Return the pairs (P,), (P,) of some observations where the second is near the first.

        Near by the sigmas of the first, and in ``lasts_s``; only those that a tree finds near in
        metres are compared.
        """
        if not len(rows):
            return rows, rows
        reach_m = np.sqrt(IN_A_HEAP) / np.linalg.norm(self._axes[rows], axis=2).min(axis=1)
        near = cKDTree(self.place[rows]).query_ball_point(self.place[rows], reach_m)
        of = np.repeat(rows, [len(one) for one in near])
        to = rows[np.concatenate(near).astype(np.intp)]
        off = np.einsum("pij,pj->pi", self._axes[of], self.place[of] - self.place[to])
        is_near = np.square(off).sum(axis=1) < IN_A_HEAP
        is_near &= np.abs(self._time_s[of] - self._time_s[to]) < lasts_s
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
