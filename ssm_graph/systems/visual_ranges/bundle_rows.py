"""The heavy part of a bundle adjustment: observations to the reduced system of the poses.

Points are eliminated one by one (Schur complement). Two forms of the same equations: compiled
loops, and NumPy with a sparse product where numba is not there; a test holds them to be equal.

Observations are sorted by point; those of point ``i`` are ``first[i]:first[i + 1]``. ``column`` is
the block of each pose in the reduced system, -1 where it is held.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from ssm_graph.systems.visual_ranges.extras import compiled, numba_is_used

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
        return np.asarray(_errors_loop(R_cw, t_cw, points, *views[1:]))
    return errors_numpy(R_cw, t_cw, points, views)


def errors_numpy(R_cw: Array, t_cw: Array, points: Array, views: Views) -> Array:
    """Return :func:`errors` by NumPy."""
    x_c = np.einsum("nij,nj->ni", R_cw[views.pose], points[views.point]) + t_cw[views.pose]
    ahead = x_c[:, 2] > 1e-6
    depth = np.where(ahead, x_c[:, 2], 1.0)[:, None]
    return np.where(ahead[:, None], (x_c[:, :2] / depth - views.xy) * views.scale, 1e3)


def reduced(
    R_cw: Array, t_cw: Array, points: Array, views: Views, weight: Array, column: Indices,
    damping: float,
) -> Reduced:
    """Return the weighted normal equations, damped by a share of their diagonal, and reduced."""
    n_free = int(column.max(initial=-1)) + 1
    if numba_is_used():
        return Reduced(
            *_reduced_loop(R_cw, t_cw, points, *views, weight, column, n_free, damping)
        )
    return reduced_numpy(R_cw, t_cw, points, views, weight, column, damping)


def jacobians(
    R_cw: Array, t_cw: Array, points: Array, views: Views
) -> tuple[Array, Array, Array]:
    """Return whitened errors (n, 2), their Jacobians by pose (n, 2, 6) and by point (n, 2, 3)."""
    R = R_cw[views.pose]
    x_c = np.einsum("nij,nj->ni", R, points[views.point]) + t_cw[views.pose]
    ahead = x_c[:, 2] > 1e-6
    inverse = 1.0 / np.where(ahead, x_c[:, 2], 1.0)
    u, v = x_c[:, 0] * inverse, x_c[:, 1] * inverse
    error = np.where(
        ahead[:, None], (np.stack([u, v], axis=1) - views.xy) * views.scale, 1e3
    )
    by_pose = np.zeros((len(u), 2, 6))
    by_pose[:, 0, 0] = by_pose[:, 1, 1] = inverse
    by_pose[:, 0, 2], by_pose[:, 1, 2] = -u * inverse, -v * inverse
    by_pose[:, 0, 3], by_pose[:, 0, 4], by_pose[:, 0, 5] = -u * v, 1.0 + u * u, -v
    by_pose[:, 1, 3], by_pose[:, 1, 4], by_pose[:, 1, 5] = -1.0 - v * v, u * v, u
    by_pose *= np.where(ahead, 1.0, 0.0)[:, None, None] * views.scale[:, :, None]
    return error, by_pose, by_pose[:, :, :3] @ R


def reduced_numpy(
    R_cw: Array, t_cw: Array, points: Array, views: Views, weight: Array, column: Indices,
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
        matrix, (block[moving], block[moving]),
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
    inverse = np.linalg.inv(own)
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


@compiled
def _errors_loop(  # pragma: no cover  (compiled)
    R_cw: Any, t_cw: Any, points: Any, point: Any, pose: Any, xy: Any, scale: Any
) -> Any:
    n = len(point)
    out = np.empty((n, 2))
    for o in range(n):
        R, t, X = R_cw[pose[o]], t_cw[pose[o]], points[point[o]]
        z = R[2, 0] * X[0] + R[2, 1] * X[1] + R[2, 2] * X[2] + t[2]
        if z <= 1e-6:
            out[o, 0] = out[o, 1] = 1e3
            continue
        x = R[0, 0] * X[0] + R[0, 1] * X[1] + R[0, 2] * X[2] + t[0]
        y = R[1, 0] * X[0] + R[1, 1] * X[1] + R[1, 2] * X[2] + t[1]
        out[o, 0] = (x / z - xy[o, 0]) * scale[o, 0]
        out[o, 1] = (y / z - xy[o, 1]) * scale[o, 1]
    return out


@compiled
def _one_view(  # pragma: no cover  (compiled)
    R: Any, t: Any, X: Any, xy: Any, scale: Any, e: Any, P: Any, Q: Any
) -> None:
    """Fill in error (2,), Jacobians by pose (2, 6) and by point (2, 3) of one observation."""
    P[:] = 0.0
    Q[:] = 0.0
    z = R[2, 0] * X[0] + R[2, 1] * X[1] + R[2, 2] * X[2] + t[2]
    if z <= 1e-6:
        e[:] = 1e3
        return
    inverse = 1.0 / z
    u = (R[0, 0] * X[0] + R[0, 1] * X[1] + R[0, 2] * X[2] + t[0]) * inverse
    v = (R[1, 0] * X[0] + R[1, 1] * X[1] + R[1, 2] * X[2] + t[1]) * inverse
    e[0] = (u - xy[0]) * scale[0]
    e[1] = (v - xy[1]) * scale[1]
    P[0, 0], P[0, 2] = inverse, -u * inverse
    P[0, 3], P[0, 4], P[0, 5] = -u * v, 1.0 + u * u, -v
    P[1, 1], P[1, 2] = inverse, -v * inverse
    P[1, 3], P[1, 4], P[1, 5] = -1.0 - v * v, u * v, u
    for k in range(2):
        for a in range(6):
            P[k, a] *= scale[k]
        for b in range(3):
            Q[k, b] = P[k, 0] * R[0, b] + P[k, 1] * R[1, b] + P[k, 2] * R[2, b]


@compiled
def _reduced_loop(  # pragma: no cover  (compiled)
    R_cw: Any, t_cw: Any, points: Any, first: Any, point: Any, pose: Any, xy: Any, scale: Any,
    weight: Any, column: Any, n_free: int, damping: float,
) -> Any:
    n, n_points = len(point), len(points)
    matrix, slope = np.zeros((6 * n_free, 6 * n_free)), np.zeros(6 * n_free)
    diagonal = np.zeros(6 * n_free)
    inverse, point_slope = np.zeros((n_points, 3, 3)), np.zeros((n_points, 3))
    cross = np.zeros((n, 6, 3))
    e, P, Q = np.zeros(2), np.zeros((2, 6)), np.zeros((2, 3))
    V, Y, W = np.zeros((3, 3)), np.zeros((6, 3)), np.zeros(3)
    for i in range(n_points):
        V[:] = 0.0
        for o in range(first[i], first[i + 1]):
            _one_view(R_cw[pose[o]], t_cw[pose[o]], points[i], xy[o], scale[o], e, P, Q)
            w = weight[o]
            for a in range(3):
                point_slope[i, a] += w * (Q[0, a] * e[0] + Q[1, a] * e[1])
                for b in range(3):
                    V[a, b] += w * (Q[0, a] * Q[0, b] + Q[1, a] * Q[1, b])
            c = column[pose[o]]
            if c < 0:
                continue
            for a in range(6):
                slope[6 * c + a] += w * (P[0, a] * e[0] + P[1, a] * e[1])
                for b in range(6):
                    matrix[6 * c + a, 6 * c + b] += w * (P[0, a] * P[0, b] + P[1, a] * P[1, b])
                for b in range(3):
                    cross[o, a, b] = w * (P[0, a] * Q[0, b] + P[1, a] * Q[1, b])
                diagonal[6 * c + a] += w * (P[0, a] * P[0, a] + P[1, a] * P[1, a])
        for a in range(3):
            V[a, a] = V[a, a] * (1.0 + damping) + 1e-9
        det = (
            V[0, 0] * (V[1, 1] * V[2, 2] - V[1, 2] * V[2, 1])
            - V[0, 1] * (V[1, 0] * V[2, 2] - V[1, 2] * V[2, 0])
            + V[0, 2] * (V[1, 0] * V[2, 1] - V[1, 1] * V[2, 0])
        )
        I = inverse[i]
        I[0, 0] = (V[1, 1] * V[2, 2] - V[1, 2] * V[2, 1]) / det
        I[0, 1] = I[1, 0] = (V[0, 2] * V[2, 1] - V[0, 1] * V[2, 2]) / det
        I[0, 2] = I[2, 0] = (V[0, 1] * V[1, 2] - V[0, 2] * V[1, 1]) / det
        I[1, 1] = (V[0, 0] * V[2, 2] - V[0, 2] * V[2, 0]) / det
        I[1, 2] = I[2, 1] = (V[0, 2] * V[1, 0] - V[0, 0] * V[1, 2]) / det
        I[2, 2] = (V[0, 0] * V[1, 1] - V[0, 1] * V[1, 0]) / det
        for o in range(first[i], first[i + 1]):
            c = column[pose[o]]
            if c < 0:
                continue
            for a in range(6):
                for b in range(3):
                    Y[a, b] = (
                        cross[o, a, 0] * I[0, b] + cross[o, a, 1] * I[1, b] + cross[o, a, 2] * I[2, b]
                    )
                slope[6 * c + a] -= (
                    Y[a, 0] * point_slope[i, 0]
                    + Y[a, 1] * point_slope[i, 1]
                    + Y[a, 2] * point_slope[i, 2]
                )
            for other in range(first[i], first[i + 1]):
                d = column[pose[other]]
                if d < 0:
                    continue
                for b in range(6):
                    W[0], W[1], W[2] = cross[other, b, 0], cross[other, b, 1], cross[other, b, 2]
                    for a in range(6):
                        matrix[6 * c + a, 6 * d + b] -= (
                            Y[a, 0] * W[0] + Y[a, 1] * W[1] + Y[a, 2] * W[2]
                        )
    for k in range(6 * n_free):
        matrix[k, k] += damping * diagonal[k]
    return matrix, slope, inverse, point_slope, cross


def point_steps(system: Reduced, views: Views, column: Indices, step: Array) -> Array:
    """Return the change of every point (P, 3) that goes with a change of the poses (6F,)."""
    block = column[views.pose]
    moved = np.where(
        (block >= 0)[:, None], step.reshape(-1, 6)[np.maximum(block, 0)] if step.size else 0.0, 0.0
    )
    pushed = np.einsum("nab,na->nb", system.cross, moved)
    summed = np.add.reduceat(pushed, views.first[:-1], axis=0) if len(pushed) else pushed
    return -np.einsum("pab,pb->pa", system.inverse, system.point_slope + summed)


def variances(
    R_cw: Array, t_cw: Array, points: Array, views: Views, system: Reduced, column: Indices,
    covariance: Array,
) -> Array:
    """Return the variance (n,) of each whitened reprojection's prediction, mean of both axes.

    ``covariance`` (6F, 6F) is the inverse of the reduced matrix; pose, point and what they share
    count: ``trace(J P J^T) / 2``.
    """
    if numba_is_used():
        return np.asarray(
            _variances_loop(
                R_cw, t_cw, points, *views, column, system.inverse, system.cross, covariance
            )
        )
    return variances_numpy(R_cw, t_cw, points, views, system, column, covariance)


def variances_numpy(
    R_cw: Array, t_cw: Array, points: Array, views: Views, system: Reduced, column: Indices,
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
    along = np.arange(len(left)) - np.repeat(np.cumsum(count[views.point]) - count[views.point],
                                             count[views.point])
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
    return 0.5 * total


@compiled
def _variances_loop(  # pragma: no cover  (compiled)
    R_cw: Any, t_cw: Any, points: Any, first: Any, point: Any, pose: Any, xy: Any, scale: Any,
    column: Any, inverse: Any, cross: Any, covariance: Any,
) -> Any:
    n = len(point)
    out = np.zeros(n)
    e, J, Q = np.zeros(2), np.zeros((2, 6)), np.zeros((2, 3))
    for i in range(len(points)):
        spread = inverse[i].copy()
        begin, end = first[i], first[i + 1]
        m = end - begin
        pushed = np.zeros((m, 6, 3))
        pose_point = np.zeros((m, 6, 3))
        for r in range(m):
            for a in range(6):
                for b in range(3):
                    for c in range(3):
                        pushed[r, a, b] += cross[begin + r, a, c] * inverse[i, c, b]
        for r in range(m):
            k = column[pose[begin + r]]
            if k < 0:
                continue
            for q in range(m):
                d = column[pose[begin + q]]
                if d < 0:
                    continue
                for a in range(6):
                    for b in range(3):
                        total = 0.0
                        for c in range(6):
                            total += covariance[6 * k + a, 6 * d + c] * pushed[q, c, b]
                        pose_point[r, a, b] -= total
            for a in range(3):
                for b in range(3):
                    for c in range(6):
                        spread[a, b] -= pushed[r, c, a] * pose_point[r, c, b]
        for r in range(m):
            o = begin + r
            _one_view(R_cw[pose[o]], t_cw[pose[o]], points[i], xy[o], scale[o], e, J, Q)
            k = column[pose[o]]
            total = 0.0
            for row in range(2):
                for a in range(3):
                    for b in range(3):
                        total += Q[row, a] * spread[a, b] * Q[row, b]
                if k < 0:
                    continue
                for a in range(6):
                    for b in range(6):
                        total += J[row, a] * covariance[6 * k + a, 6 * k + b] * J[row, b]
                    for b in range(3):
                        total += 2.0 * J[row, a] * pose_point[r, a, b] * Q[row, b]
            out[o] = 0.5 * total
    return out
