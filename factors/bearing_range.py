"""Range and bearing from a pose in the plane to a landmark whose place is a variable too."""

from __future__ import annotations

from typing import NamedTuple

import gtsam
import numpy as np

from factors.checks import check_numbers
from factors.so3 import Array

CLOSEST_M = 1e-6
"""Nearer than this a landmark has no direction; the Jacobian stays finite."""
MOST_BEARING_RAD = 2.0 * np.pi
"""A bearing beyond a full turn is one in degrees."""


class BearingRangeResidual(NamedTuple):
    """Residuals of range and bearing and their Jacobian blocks; leading axes broadcast."""

    error: Array
    """(..., 2) m and rad, predicted minus measured; the bearing's within half a turn."""
    error_D_pose: Array
    """(..., 2, 3) with respect to x, y and heading of the pose."""
    error_D_landmark: Array
    """(..., 2, 2)"""


def range_bearing(pose: Array, landmark: Array) -> Array:
    """Return range [m] and bearing [rad, within half a turn] of landmarks (..., 2), as (..., 2).

    With ``d = m - p``: ``range = |d|``, ``bearing = atan2(d_y, d_x) - heading``, positive from x to
    y; ``pose`` (..., 3) is x, y [m] and heading [rad].
    """
    dx, dy = landmark[..., 0] - pose[..., 0], landmark[..., 1] - pose[..., 1]
    return np.stack([np.hypot(dx, dy), half_turn(np.arctan2(dy, dx) - pose[..., 2])], axis=-1)


def half_turn(angle: Array) -> Array:
    """Return angles within [-pi, pi)."""
    return np.asarray((angle + np.pi) % (2.0 * np.pi) - np.pi)


def bearing_range_residual(
    pose: Array, landmark: Array, *, measured: Array
) -> BearingRangeResidual:
    """Return residuals of ranges and bearings, with Jacobians.

    Parameters
    ----------
    pose : (..., 3) x, y [m] and heading [rad].
    landmark : (..., 2) m
    measured : (..., 2) range [m] and bearing [rad]; NaN where there is none, which stays NaN.
    """
    predicted = range_bearing(pose, landmark)
    error = predicted - measured
    error[..., 1] = half_turn(error[..., 1])
    return BearingRangeResidual(error, *range_bearing_slopes(pose, landmark))


def range_bearing_slopes(pose: Array, landmark: Array) -> tuple[Array, Array]:
    """Return the derivatives (..., 2, 3) and (..., 2, 2) of `range_bearing`."""
    d = landmark - pose[..., :2]
    r = np.maximum(np.hypot(d[..., 0], d[..., 1]), CLOSEST_M)
    along = d / r[..., None]
    across = np.stack([-along[..., 1], along[..., 0]], axis=-1) / r[..., None]
    to_landmark = np.stack([along, across], axis=-2)
    to_pose = np.concatenate([-to_landmark, np.zeros((*r.shape, 2, 1))], axis=-1)
    to_pose[..., 1, 2] = -1.0
    return to_pose, to_landmark


def bearing_range_factor(
    pose: int,
    landmark: int,
    *,
    range_m: float,
    bearing_rad: float,
    range_sigma: float,
    bearing_sigma: float,
    weight: float = 1.0,
) -> gtsam.BearingRangeFactor2D:
    """Return GTSAM's factor of a ``Pose2`` and a ``Point2`` with a weight of its own.

    The effective covariance is that of the sigmas divided by ``weight``.

    Raises
    ------
    ValueError
        If a number is not finite, a sigma, the weight or the range is not above zero, or the
        bearing is one in degrees.
    """
    name = "bearing_range_factor"
    check_numbers(name, sigma=range_sigma, weight=weight, range_m=range_m, bearing_rad=bearing_rad)
    check_numbers(name, sigma=bearing_sigma, weight=weight)
    if range_m <= 0.0:
        raise ValueError(f"{name}: range_m: expected a number above zero, got {range_m}")
    if abs(bearing_rad) > MOST_BEARING_RAD:
        raise ValueError(f"{name}: bearing_rad: expected radians, got {bearing_rad}: degrees?")
    sigmas = np.array([bearing_sigma, range_sigma]) / np.sqrt(weight)
    return gtsam.BearingRangeFactor2D(
        pose, landmark, gtsam.Rot2(bearing_rad), range_m, gtsam.noiseModel.Diagonal.Sigmas(sigmas)
    )
