"""Poses in bulk, the pose from points, and points from two views.

``x_c = R_cw X + t_cw``; a pose is perturbed from the left, ``T_cw <- Exp(xi) T_cw`` to first order
with ``xi = (translation, rotation)``.
"""

from __future__ import annotations

from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from factors import so3
from ssm_graph.systems.visual_ranges.extras import compiled, numba_is_used

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


class Pose(NamedTuple):
    """Map to camera."""

    R_cw: Array
    """(3, 3)"""
    t_cw: Array
    """(3,) map units"""

    @property
    def centre(self) -> Array:
        """The camera's place in the map (3,)."""
        return -self.R_cw.T @ self.t_cw

    def after(self, other: Pose) -> Pose:
        """Return this pose's motion applied after another: ``self @ other``."""
        return Pose(orthonormal(self.R_cw @ other.R_cw), self.R_cw @ other.t_cw + self.t_cw)

    def inverse(self) -> Pose:
        """Return camera to map."""
        return Pose(self.R_cw.T, -self.R_cw.T @ self.t_cw)

    def moved(self, xi: Array) -> Pose:
        """Return the pose perturbed from the left by ``xi`` (6,)."""
        R = so3.exp(xi[3:])
        return Pose(orthonormal(R @ self.R_cw), R @ self.t_cw + xi[:3])


def orthonormal(R: Array) -> Array:
    """Return rotations (..., 3, 3) with one Newton step towards ``R R^T = I``.

    Without it a product of poses, frame by frame, doubles its rounding error every time.
    """
    return np.asarray(R @ (1.5 * np.eye(3) - 0.5 * np.swapaxes(R, -1, -2) @ R))


def in_camera(pose: Pose, points: Array) -> Array:
    """Return points (n, 3) in camera axes."""
    return np.asarray(points @ pose.R_cw.T + pose.t_cw)


class Refined(NamedTuple):
    """A pose from points, and how well they fit."""

    pose: Pose
    information: Array
    """(6, 6) of the left perturbation, weights included."""
    square: Array
    """(n,) squared residuals in sigmas; infinite behind the camera."""


_POSE_STEPS: Final = 8
_SETTLED: Final = 1e-6
DOF: Final = 5.0
"""Of the similarity weight of a reprojection."""


def reprojection_weight(t: Array, dof: float = DOF) -> Array:
    """Return the similarity weight (log kernel, two dimensions) of squared sigmas ``t``."""
    return np.asarray((dof + 2.0) / (dof + t))


def refine_pose(pose: Pose, points: Array, xy: Array, scale: Array) -> Refined:
    """Return the pose that best explains points (n, 3) seen at normalised ``xy`` (n, 2).

    ``scale`` (n, 2) is one over the sigma of each coordinate. Weights by similarity, renewed at
    every step.
    """
    R, t = pose
    for _ in range(_POSE_STEPS):
        information, slope, _ = pose_equations(R, t, points, xy, scale)
        try:
            xi: Array = np.asarray(
                -np.linalg.solve(information + 1e-9 * np.eye(6), slope), dtype=np.float64
            )
        except np.linalg.LinAlgError:
            break
        R, t = Pose(R, t).moved(xi)
        if np.abs(xi).max() < _SETTLED:
            break
    information, _, square = pose_equations(R, t, points, xy, scale)
    return Refined(Pose(R, t), information, square)


def pose_equations(
    R: Array, t: Array, points: Array, xy: Array, scale: Array
) -> tuple[Array, Array, Array]:
    """Return weighted information (6, 6), slope (6,) and squares (n,) of a pose's points."""
    if numba_is_used():
        information, slope, square = _pose_loop(R, t, points, xy, scale, DOF)
        return information, slope, square
    return pose_equations_numpy(R, t, points, xy, scale)


def pose_equations_numpy(
    R: Array, t: Array, points: Array, xy: Array, scale: Array
) -> tuple[Array, Array, Array]:
    """Return :func:`pose_equations` by NumPy."""
    error, jacobian, ahead = _reprojections(R, t, points, xy, scale)
    square = np.where(ahead, (error * error).sum(axis=1), np.inf)
    weight = reprojection_weight(square)
    rows = jacobian.reshape(-1, 6)
    weighted = rows * np.repeat(weight, 2)[:, None]
    return weighted.T @ rows, weighted.T @ error.reshape(-1), square


@compiled
def _pose_loop(  # pragma: no cover  (compiled)
    R: Any, t: Any, points: Any, xy: Any, scale: Any, dof: float
) -> Any:
    information, slope, square = np.zeros((6, 6)), np.zeros(6), np.zeros(len(points))
    J = np.zeros((2, 6))
    for i in range(len(points)):
        X = points[i]
        z = R[2, 0] * X[0] + R[2, 1] * X[1] + R[2, 2] * X[2] + t[2]
        if z <= 1e-6:
            square[i] = np.inf
            continue
        f = 1.0 / z
        u = (R[0, 0] * X[0] + R[0, 1] * X[1] + R[0, 2] * X[2] + t[0]) * f
        v = (R[1, 0] * X[0] + R[1, 1] * X[1] + R[1, 2] * X[2] + t[1]) * f
        a, b = scale[i, 0], scale[i, 1]
        e0, e1 = (u - xy[i, 0]) * a, (v - xy[i, 1]) * b
        square[i] = e0 * e0 + e1 * e1
        w = (dof + 2.0) / (dof + square[i])
        J[0, 0], J[0, 2] = f * a, -u * f * a
        J[0, 3], J[0, 4], J[0, 5] = -u * v * a, (1.0 + u * u) * a, -v * a
        J[1, 1], J[1, 2] = f * b, -v * f * b
        J[1, 3], J[1, 4], J[1, 5] = (-1.0 - v * v) * b, u * v * b, u * b
        for k in range(6):
            slope[k] += w * (J[0, k] * e0 + J[1, k] * e1)
            for m in range(6):
                information[k, m] += w * (J[0, k] * J[0, m] + J[1, k] * J[1, m])
    return information, slope, square


def _reprojections(
    R: Array, t: Array, points: Array, xy: Array, scale: Array
) -> tuple[Array, Array, Mask]:
    """Return whitened errors (n, 2), Jacobians (n, 2, 6) and which points lie ahead."""
    x_c = points @ R.T + t
    ahead = x_c[:, 2] > 1e-6
    inverse = 1.0 / np.where(ahead, x_c[:, 2], 1.0)
    u, v = x_c[:, 0] * inverse, x_c[:, 1] * inverse
    error = (np.stack([u, v], axis=1) - xy) * scale
    J = np.zeros((len(points), 2, 6))
    J[:, 0, 0] = J[:, 1, 1] = inverse
    J[:, 0, 2], J[:, 1, 2] = -u * inverse, -v * inverse
    J[:, 0, 3], J[:, 0, 4], J[:, 0, 5] = -u * v, 1.0 + u * u, -v
    J[:, 1, 3], J[:, 1, 4], J[:, 1, 5] = -1.0 - v * v, u * v, u
    return error, J * scale[:, :, None], ahead


class Triangulated(NamedTuple):
    """Points from pairs of views."""

    points: Array
    """(n, 3)"""
    parallax: Array
    """(n,) rad between the two rays"""
    depth: Array
    """(n, 2) in either camera"""


def triangulate(R1: Array, t1: Array, R2: Array, t2: Array, xy1: Array, xy2: Array) -> Triangulated:
    """Return the points nearest to both rays; poses (n, 3, 3), (n, 3) or one for all."""
    ray1 = np.concatenate([xy1, np.ones((len(xy1), 1))], axis=1)
    ray2 = np.concatenate([xy2, np.ones((len(xy2), 1))], axis=1)
    d1 = np.einsum("...ji,...j->...i", R1, ray1)
    d2 = np.einsum("...ji,...j->...i", R2, ray2)
    c1 = -np.einsum("...ji,...j->...i", R1, np.broadcast_to(t1, ray1.shape))
    c2 = -np.einsum("...ji,...j->...i", R2, np.broadcast_to(t2, ray2.shape))
    base = c2 - c1
    a, b, c = (d1 * d1).sum(-1), (d1 * d2).sum(-1), (d2 * d2).sum(-1)
    p, q = (d1 * base).sum(-1), (d2 * base).sum(-1)
    det = np.maximum(a * c - b * b, 1e-18)
    z1, z2 = (c * p - b * q) / det, (b * p - a * q) / det
    points = 0.5 * (c1 + z1[:, None] * d1 + c2 + z2[:, None] * d2)
    sine = np.linalg.norm(so3.cross(d1, d2), axis=-1)
    return Triangulated(points, np.arctan2(sine, b), np.stack([z1, z2], axis=1))


def reprojection_square(R: Array, t: Array, points: Array, xy: Array, scale: Array) -> Array:
    """Return squared errors in sigmas (n,) of points, each in its pose; infinite behind it."""
    x_c = np.einsum("...ij,...j->...i", R, points) + t
    ahead = x_c[:, 2] > 1e-6
    error = (x_c[:, :2] / np.where(ahead, x_c[:, 2], 1.0)[:, None] - xy) * scale
    return np.where(ahead, (error * error).sum(axis=1), np.inf)
