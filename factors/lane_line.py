"""A point of a curve that was seen lies on a line of the map."""

from __future__ import annotations

from typing import NamedTuple

import gtsam
import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


class LineResidual(NamedTuple):
    """Residuals of curve points and their Jacobian blocks; leading axes broadcast."""

    error: Array
    """(...) m, how far the point lies from the line, along the line's normal."""
    error_D_pose: Array
    """(..., 3) with respect to a shift along the vehicle's axes and a turn (tangent of `Pose2`)."""


def line_residual(
    x_y: Array, yaw: ArrayLike, *, point_b: Array, foot: Array, normal: Array
) -> LineResidual:
    """Return how far curve points lie beside the map's line.

    With the pose ``T = (R, t)`` of the vehicle and the foot ``q`` of the point on the map::

        error = normal . (R point_b + t - q)

    Along the line nothing is measured: on a straight one the pose stays free along it.

    Parameters
    ----------
    x_y : (..., 2) position t, m.
    yaw : (...) rad, anticlockwise from x.
    point_b : (..., 2) point in vehicle axes, x forward, y left, m.
    foot : (..., 2) the nearest place on the line, m.
    normal : (..., 2) unit normal of the line there.
    """
    c, s = np.cos(yaw), np.sin(yaw)
    n_forward = c * normal[..., 0] + s * normal[..., 1]
    n_left = c * normal[..., 1] - s * normal[..., 0]
    off = np.sum(normal * (x_y - foot), axis=-1)
    error = n_forward * point_b[..., 0] + n_left * point_b[..., 1] + off
    turn = n_left * point_b[..., 0] - n_forward * point_b[..., 1]
    return LineResidual(error, np.stack(np.broadcast_arrays(n_forward, n_left, turn), axis=-1))


def curve_covariance(
    x: Array, weight: Array, *, offset: ArrayLike, slope: float, scatter: float
) -> Array:
    """Return the covariance (..., m, m) of the errors of a curve's points, m^2.

    Offset and slope of a detection are common to its points, what is left is each point's own and
    grows as its similarity weight falls::

        offset^2 1 1' + slope^2 x x' + scatter^2 diag(1 / weight)

    Parameters
    ----------
    x : (..., m) of the points along the vehicle, m.
    weight : (..., m) similarity weights, above zero.
    offset : (...) standard deviation of the curve's offset, m.
    slope : of its slope.
    scatter : of a point, m.
    """
    common = np.square(np.asarray(offset))[..., None, None]
    tilt = slope**2 * x[..., :, None] * x[..., None, :]
    own = scatter**2 / weight
    return np.asarray(common + tilt + own[..., None] * np.eye(x.shape[-1]))


def lane_line_factor(
    pose: int, *, point_b: Array, foot: Array, normal: Array, covariance: Array
) -> gtsam.CustomFactor:
    """Wrap :func:`line_residual` as a factor of all points (m) of a curve on a ``Pose2``.

    ``covariance`` (m, m) is that of :func:`curve_covariance`. The foot points stay what they are:
    for a pose that moved much, find them again and make the factor anew.
    """
    points, feet, normals = (np.array(a, dtype=np.float64) for a in (point_b, foot, normal))
    if points.ndim != 2 or points.shape[1] != 2 or not points.shape == feet.shape == normals.shape:
        raise ValueError(
            "lane_line_factor: expected point_b, foot and normal of one shape (m, 2), got "
            f"{points.shape}, {feet.shape} and {normals.shape}"
        )

    def error(_: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Array] | None) -> Array:
        at = values.atPose2(pose)
        found = line_residual(
            np.array([at.x(), at.y()]), at.theta(), point_b=points, foot=feet, normal=normals
        )
        if jacobians is not None:
            jacobians[0] = np.asfortranarray(found.error_D_pose)
        return found.error

    return gtsam.CustomFactor(gtsam.noiseModel.Gaussian.Covariance(covariance), [pose], error)
