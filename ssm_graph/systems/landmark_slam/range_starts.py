"""First places of landmarks that were never seen as a whole: from ranges alone, or bearings alone.

Along a first path, with what was measured of a landmark: from places all around, Gauss-Newton with
weights, and of what they come to the one that misses least. A path that never turned leaves two,
mirrored in it; the nearer one is taken, and nothing here says which is true.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from factors.bearing_range import bearing_range_residual
from ssm_graph.base.frozen import Array
from ssm_graph.systems.landmark_slam.problem import SlamProblem

AROUND: Final = 24
"""Directions that are tried, at the first range, or at `DISTANCES_M` where there is none."""
DISTANCES_M: Final = (1.0, 5.0, 25.0, 100.0)
MOST: Final = 200
"""Observations of a landmark that are used, the first ones: where a path by odometry is best."""
ROUNDS: Final = 30
COARSE: Final = 10.0
"""Sigmas of the observations that a path by odometry may be off by."""


def placed(problem: SlamProblem, sigma: Array, pose: Array, landmarks: Array) -> Array:
    """Return places (L, 2) with those that are NaN found from what there is.

    Parameters
    ----------
    problem : its observations.
    sigma : (2,) of ranges [m] and bearings [rad].
    pose : (K, 3) a first path.
    landmarks : (L, 2) m; NaN of a landmark without a place.
    """
    found = landmarks.copy()
    for i in np.flatnonzero(np.isnan(landmarks[:, 0])).tolist():
        rows = np.flatnonzero(problem.landmark == i)[:MOST]
        if len(rows):
            at, z = pose[problem.keyframe[rows]], problem.measured[rows]
            found[i] = _place(at, z, COARSE * sigma * problem.scales[rows])
    return found


def _place(at: Array, measured: Array, sigma: Array) -> Array:
    angle = np.arange(AROUND) * (2.0 * np.pi / AROUND)
    ray = np.column_stack([np.cos(angle), np.sin(angle)])
    first = measured[0, 0]
    reach = DISTANCES_M if np.isnan(first) else (float(first),)
    places = np.concatenate([at[0, :2] + r * ray for r in reach])
    there = np.isfinite(measured)
    scale = there / sigma
    cost = np.full(len(places), np.inf)
    for _ in range(ROUNDS):
        told = bearing_range_residual(at, places[:, None], measured=measured)
        error = np.where(there, told.error, 0.0) * scale
        slopes = told.error_D_landmark * scale[..., None]
        squares = np.square(error).sum(axis=2)
        weight = 1.0 / (1.0 + squares)  # Cauchy's
        cost = np.log1p(squares).sum(axis=1)
        normal = np.einsum("nm,nmri,nmrj->nij", weight, slopes, slopes, optimize=True)
        right = np.einsum("nm,nmri,nmr->ni", weight, slopes, error, optimize=True)
        damped = normal + 1e-3 * np.trace(normal, axis1=1, axis2=2)[:, None, None] * np.eye(2)
        places = places - np.linalg.solve(damped + 1e-12 * np.eye(2), right[..., None])[..., 0]
    return np.asarray(places[np.argmin(cost)])
