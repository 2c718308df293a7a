"""The compiled form of :mod:`.bundle_rows`: loops over points and their observations."""

from __future__ import annotations

from typing import Any

import numpy as np

from ssm_graph.systems.visual_ranges.extras import compiled


@compiled
def errors_loop(  # pragma: no cover  (compiled)
    R_cw: Any, t_cw: Any, points: Any, point: Any, pose: Any, xy: Any, scale: Any
) -> Any:
    """Return :func:`.bundle_rows.errors`."""
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
def _gathered(  # pragma: no cover  (compiled)
    o: int, w: float, c: int, e: Any, P: Any, Q: Any, system: Any, V: Any, pull: Any
) -> None:
    """Add one observation to the blocks of its pose (block ``c``) and its point."""
    matrix, slope, diagonal, cross = system
    for a in range(3):
        pull[a] += w * (Q[0, a] * e[0] + Q[1, a] * e[1])
        for b in range(3):
            V[a, b] += w * (Q[0, a] * Q[0, b] + Q[1, a] * Q[1, b])
    if c < 0:
        return
    for a in range(6):
        slope[6 * c + a] += w * (P[0, a] * e[0] + P[1, a] * e[1])
        for b in range(6):
            matrix[6 * c + a, 6 * c + b] += w * (P[0, a] * P[0, b] + P[1, a] * P[1, b])
        for b in range(3):
            cross[o, a, b] = w * (P[0, a] * Q[0, b] + P[1, a] * Q[1, b])
        diagonal[6 * c + a] += w * (P[0, a] * P[0, a] + P[1, a] * P[1, a])


@compiled
def _inverted(V: Any, out: Any) -> None:  # pragma: no cover  (compiled)
    """Fill in the inverse of a symmetric matrix (3, 3)."""
    det = (
        V[0, 0] * (V[1, 1] * V[2, 2] - V[1, 2] * V[2, 1])
        - V[0, 1] * (V[1, 0] * V[2, 2] - V[1, 2] * V[2, 0])
        + V[0, 2] * (V[1, 0] * V[2, 1] - V[1, 1] * V[2, 0])
    )
    out[0, 0] = (V[1, 1] * V[2, 2] - V[1, 2] * V[2, 1]) / det
    out[0, 1] = out[1, 0] = (V[0, 2] * V[2, 1] - V[0, 1] * V[2, 2]) / det
    out[0, 2] = out[2, 0] = (V[0, 1] * V[1, 2] - V[0, 2] * V[1, 1]) / det
    out[1, 1] = (V[0, 0] * V[2, 2] - V[0, 2] * V[2, 0]) / det
    out[1, 2] = out[2, 1] = (V[0, 2] * V[1, 0] - V[0, 0] * V[1, 2]) / det
    out[2, 2] = (V[0, 0] * V[1, 1] - V[0, 1] * V[1, 0]) / det


@compiled
def _eliminated(  # pragma: no cover  (compiled)
    begin: int, end: int, block: Any, inverse: Any, pull: Any, system: Any
) -> None:
    """Take a point out: subtract what its observations share from the system of the poses."""
    matrix, slope, _, cross = system
    Y = np.zeros((6, 3))
    for o in range(begin, end):
        c = block[o]
        if c < 0:
            continue
        for a in range(6):
            for b in range(3):
                Y[a, b] = (
                    cross[o, a, 0] * inverse[0, b]
                    + cross[o, a, 1] * inverse[1, b]
                    + cross[o, a, 2] * inverse[2, b]
                )
            slope[6 * c + a] -= Y[a, 0] * pull[0] + Y[a, 1] * pull[1] + Y[a, 2] * pull[2]
        for other in range(begin, end):
            d = block[other]
            if d < 0:
                continue
            for b in range(6):
                x, y, z = cross[other, b, 0], cross[other, b, 1], cross[other, b, 2]
                for a in range(6):
                    matrix[6 * c + a, 6 * d + b] -= Y[a, 0] * x + Y[a, 1] * y + Y[a, 2] * z


@compiled
def reduced_loop(  # pragma: no cover  (compiled)
    R_cw: Any, t_cw: Any, points: Any, first: Any, point: Any, pose: Any, xy: Any, scale: Any,
    weight: Any, column: Any, n_free: int, damping: float,
) -> Any:  # fmt: skip
    """Return the fields of :class:`.bundle_rows.Reduced`."""
    n, n_points = len(point), len(points)
    matrix, slope = np.zeros((6 * n_free, 6 * n_free)), np.zeros(6 * n_free)
    diagonal, cross = np.zeros(6 * n_free), np.zeros((n, 6, 3))
    system = (matrix, slope, diagonal, cross)
    inverse, point_slope = np.zeros((n_points, 3, 3)), np.zeros((n_points, 3))
    block = column[pose]
    e, P, Q, V = np.zeros(2), np.zeros((2, 6)), np.zeros((2, 3)), np.zeros((3, 3))
    for i in range(n_points):
        V[:] = 0.0
        for o in range(first[i], first[i + 1]):
            _one_view(R_cw[pose[o]], t_cw[pose[o]], points[i], xy[o], scale[o], e, P, Q)
            _gathered(o, weight[o], block[o], e, P, Q, system, V, point_slope[i])
        for a in range(3):
            V[a, a] = V[a, a] * (1.0 + damping) + 1e-9
        _inverted(V, inverse[i])
        _eliminated(first[i], first[i + 1], block, inverse[i], point_slope[i], system)
    for k in range(6 * n_free):
        matrix[k, k] += damping * diagonal[k]
    return matrix, slope, inverse, point_slope, cross


@compiled
def _shared(  # pragma: no cover  (compiled)
    begin: int, end: int, block: Any, inverse: Any, cross: Any, covariance: Any
) -> Any:
    """Return a point's covariance (3, 3), and that with each of its poses (m, 6, 3)."""
    spread = inverse.copy()
    m = end - begin
    pushed, with_pose = np.zeros((m, 6, 3)), np.zeros((m, 6, 3))
    for r in range(m):
        for a in range(6):
            for b in range(3):
                for c in range(3):
                    pushed[r, a, b] += cross[begin + r, a, c] * inverse[c, b]
    for r in range(m):
        k = block[begin + r]
        if k < 0:
            continue
        for q in range(m):
            d = block[begin + q]
            if d < 0:
                continue
            for a in range(6):
                for b in range(3):
                    total = 0.0
                    for c in range(6):
                        total += covariance[6 * k + a, 6 * d + c] * pushed[q, c, b]
                    with_pose[r, a, b] -= total
        for a in range(3):
            for b in range(3):
                for c in range(6):
                    spread[a, b] -= pushed[r, c, a] * with_pose[r, c, b]
    return spread, with_pose


@compiled
def variances_loop(  # pragma: no cover  (compiled)
    R_cw: Any, t_cw: Any, points: Any, first: Any, point: Any, pose: Any, xy: Any, scale: Any,
    column: Any, inverse: Any, cross: Any, covariance: Any,
) -> Any:  # fmt: skip
    """Return :func:`.bundle_rows.variances`."""
    out, block = np.zeros(len(point)), column[pose]
    e, J, Q = np.zeros(2), np.zeros((2, 6)), np.zeros((2, 3))
    for i in range(len(points)):
        begin, end = first[i], first[i + 1]
        spread, with_pose = _shared(begin, end, block, inverse[i], cross, covariance)
        for o in range(begin, end):
            _one_view(R_cw[pose[o]], t_cw[pose[o]], points[i], xy[o], scale[o], e, J, Q)
            k, total = block[o], 0.0
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
                        total += 2.0 * J[row, a] * with_pose[o - begin, a, b] * Q[row, b]
            out[o] = 0.5 * total
    return out
