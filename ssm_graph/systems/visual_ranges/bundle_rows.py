"""The heavy part of a bundle adjustment: observations to the reduced system of the poses.

Points are eliminated one by one (Schur complement). Two forms of the same equations: compiled
loops, and NumPy with a sparse product where numba is not there; a test holds them to be equal.

Observations are sorted by point; those of point ``i`` are ``first[i]:first[i + 1]``. ``column`` is
the block of each pose in the reduced system, -1 where it is held.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from ssm_graph.systems.visual_ranges import bundle_loops
from ssm_graph.systems.visual_ranges.extras import numba_is_used

Array = NDArray[np.float64]
Indices = NDArray[np.int64]


class Views(NamedTuple):
    """Observations, sorted by point."""

    first: Indices
    """(P + 1,) first row of each point"""
    point: Indices
    """(n,)"""
    pose: Indices
    """(n,)"""
    xy: Array
    """(n, 2) normalised, undistorted"""
    scale: Array
    """(n, 2) one over the sigma of each coordinate"""


class Reduced(NamedTuple):
    """The system of the free poses, points eliminated, and what brings the points back."""

    matrix: Array
    """(6F, 6F)"""
    slope: Array
    """(6F,)"""
    inverse: Array
    """(P, 3, 3) of each point's own block, damping included"""
    point_slope: Array
    """(P, 3)"""
    cross: Array
    """(n, 6, 3) of every observation; zero where the pose is held"""


def errors(R_cw: Array, t_cw: Array, points: Array, views: Views) -> Array:
    """Return whitened reprojection errors (n, 2); 1e3 behind the camera."""
    if numba_is_used():
        return np.asarray(bundle_loops.errors_loop(R_cw, t_cw, points, *views[1:]))
    return errors_numpy(R_cw, t_cw, points, views)


def errors_numpy(R_cw: Array, t_cw: Array, points: Array, views: Views) -> Array:
    """Return :func:`errors` by NumPy."""
    x_c = np.einsum("nij,nj->ni", R_cw[views.pose], points[views.point]) + t_cw[views.pose]
    ahead = x_c[:, 2] > 1e-6
    depth = np.where(ahead, x_c[:, 2], 1.0)[:, None]
    return np.where(ahead[:, None], (x_c[:, :2] / depth - views.xy) * views.scale, 1e3)


def reduced(
    R_cw: Array,
    t_cw: Array,
    points: Array,
    views: Views,
    weight: Array,
    column: Indices,
    damping: float,
) -> Reduced:
    """Return the weighted normal equations, damped by a share of their diagonal, and reduced."""
    n_free = int(column.max(initial=-1)) + 1
    if numba_is_used():
        return Reduced(
            *bundle_loops.reduced_loop(R_cw, t_cw, points, *views, weight, column, n_free, damping)
        )
    return reduced_numpy(R_cw, t_cw, points, views, weight, column, damping)


def jacobians(R_cw: Array, t_cw: Array, points: Array, views: Views) -> tuple[Array, Array, Array]:
    """Return whitened errors (n, 2), their Jacobians by pose (n, 2, 6) and by point (n, 2, 3)."""
    R = R_cw[views.pose]
    x_c = np.einsum("nij,nj->ni", R, points[views.point]) + t_cw[views.pose]
    ahead = x_c[:, 2] > 1e-6
    inverse = 1.0 / np.where(ahead, x_c[:, 2], 1.0)
    u, v = x_c[:, 0] * inverse, x_c[:, 1] * inverse
    error = np.where(ahead[:, None], (np.stack([u, v], axis=1) - views.xy) * views.scale, 1e3)
    by_pose = np.zeros((len(u), 2, 6))
    by_pose[:, 0, 0] = by_pose[:, 1, 1] = inverse
    by_pose[:, 0, 2], by_pose[:, 1, 2] = -u * inverse, -v * inverse
    by_pose[:, 0, 3], by_pose[:, 0, 4], by_pose[:, 0, 5] = -u * v, 1.0 + u * u, -v
    by_pose[:, 1, 3], by_pose[:, 1, 4], by_pose[:, 1, 5] = -1.0 - v * v, u * v, u
    by_pose *= np.where(ahead, 1.0, 0.0)[:, None, None] * views.scale[:, :, None]
    return error, by_pose, by_pose[:, :, :3] @ R


def reduced_numpy(
    R_cw: Array,
    t_cw: Array,
    points: Array,
    views: Views,
    weight: Array,
    column: Indices,
    damping: float,
) -> Reduced:
    """Return :func:`reduced` by NumPy and a sparse product."""
    n_free, n_points = int(column.max(initial=-1)) + 1, len(points)
    error, by_pose, by_point = jacobians(R_cw, t_cw, points, views)
    block = column[views.pose]
    moving = block >= 0
    by_pose = by_pose * moving[:, None, None]
    weighted = by_pose * weight[:, None, None]
    cross = np.einsum("nka,nkb->nab", weighted, by_point)
    matrix = np.zeros((n_free, n_free, 6, 6))
    slope = np.zeros((n_free, 6))
    np.add.at(
        matrix,
        (block[moving], block[moving]),
        np.einsum("nka,nkb->nab", weighted, by_pose)[moving],
    )
    np.add.at(slope, block[moving], np.einsum("nka,nk->na", weighted, error)[moving])
    own = np.zeros((n_points, 3, 3))
    point_slope = np.zeros((n_points, 3))
    weighted_point = by_point * weight[:, None, None]
    np.add.at(own, views.point, np.einsum("nka,nkb->nab", weighted_point, by_point))
    np.add.at(point_slope, views.point, np.einsum("nka,nk->na", weighted_point, error))
    diagonal = np.arange(3)
    own[:, diagonal, diagonal] *= 1.0 + damping
    own[:, diagonal, diagonal] += 1e-9
    inverse: Array = np.asarray(np.linalg.inv(own), dtype=np.float64)
    across = cross[moving]
    rows = (block[moving, None] * 6 + np.arange(6))[:, :, None]
    columns = (views.point[moving, None] * 3 + diagonal)[:, None, :]
    W = sparse.csr_matrix(
        (across.ravel(), tuple(np.broadcast_to(i, across.shape).ravel() for i in (rows, columns))),
        shape=(6 * n_free, 3 * n_points),
    )
    V = sparse.bsr_matrix(
        (inverse, np.arange(n_points), np.arange(n_points + 1)),
        shape=(3 * n_points, 3 * n_points),
    )
    WV = (W @ V).tocsr()
    dense = matrix.transpose(0, 2, 1, 3).reshape(6 * n_free, 6 * n_free)
    dense[np.diag_indices(6 * n_free)] *= 1.0 + damping
    full = dense - (WV @ W.T).toarray()
    return Reduced(
        full, slope.reshape(-1) - WV @ point_slope.reshape(-1), inverse, point_slope, cross
    )


def point_steps(system: Reduced, views: Views, column: Indices, step: Array) -> Array:
    """Return the change of every point (P, 3) that goes with a change of the poses (6F,)."""
    block = column[views.pose]
    moved = np.where(
        (block >= 0)[:, None], step.reshape(-1, 6)[np.maximum(block, 0)] if step.size else 0.0, 0.0
    )
    pushed = np.einsum("nab,na->nb", system.cross, moved)
    summed = np.add.reduceat(pushed, views.first[:-1], axis=0) if len(pushed) else pushed
    return np.asarray(-np.einsum("pab,pb->pa", system.inverse, system.point_slope + summed))


def variances(
    R_cw: Array,
    t_cw: Array,
    points: Array,
    views: Views,
    system: Reduced,
    column: Indices,
    covariance: Array,
) -> Array:
    """Return the variance (n,) of each whitened reprojection's prediction, mean of both axes.

    ``covariance`` (6F, 6F) is the inverse of the reduced matrix; pose, point and what they share
    count: ``trace(J P J^T) / 2``.
    """
    if numba_is_used():
        return np.asarray(
            bundle_loops.variances_loop(
                R_cw, t_cw, points, *views, column, system.inverse, system.cross, covariance
            )
        )
    return variances_numpy(R_cw, t_cw, points, views, system, column, covariance)


def variances_numpy(
    R_cw: Array,
    t_cw: Array,
    points: Array,
    views: Views,
    system: Reduced,
    column: Indices,
    covariance: Array,
) -> Array:
    """Return :func:`variances` by NumPy, a point at a time in pairs of its observations."""
    _, by_pose, by_point = jacobians(R_cw, t_cw, points, views)
    block = column[views.pose]
    by_pose = by_pose * (block >= 0)[:, None, None]
    P = covariance.reshape(-1, 6, covariance.shape[0] // 6 or 1, 6).transpose(0, 2, 1, 3)
    count = np.diff(views.first)
    left = np.repeat(np.arange(len(views.point)), count[views.point])
    begin = np.repeat(views.first[views.point], count[views.point])
    along = np.arange(len(left)) - np.repeat(
        np.cumsum(count[views.point]) - count[views.point], count[views.point]
    )
    right = begin + along
    both = (block[left] >= 0) & (block[right] >= 0)
    left, right = left[both], right[both]
    shared = P[block[left], block[right]]  # (pairs, 6, 6)
    V = system.inverse[views.point]
    pushed = np.einsum("nab,nbc->nac", system.cross, V)  # (n, 6, 3)
    PW = np.einsum("nab,nbc->nac", shared, pushed[right])  # (pairs, 6, 3)
    pose_point = np.zeros((len(views.point), 6, 3))
    np.add.at(pose_point, left, -PW)
    spread = np.zeros((len(points), 3, 3))
    np.add.at(spread, views.point[left], np.einsum("nab,nac->nbc", pushed[left], PW))
    own = np.zeros((len(views.point), 6, 6))
    own[block >= 0] = P[block[block >= 0], block[block >= 0]]
    point_cov = (system.inverse + spread)[views.point]
    total = np.einsum("nka,nab,nkb->n", by_pose, own, by_pose)
    total += np.einsum("nka,nab,nkb->n", by_point, point_cov, by_point)
    total += 2.0 * np.einsum("nka,nab,nkb->n", by_pose, pose_point, by_point)
    return np.asarray(0.5 * total)
