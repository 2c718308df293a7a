"""Range from an antenna on a camera to an anchor, over a map whose scale is a variable."""

from __future__ import annotations

from typing import NamedTuple

import gtsam
import numpy as np

from factors.checks import check_numbers, checked_array
from factors.so3 import Array, cross, times

CLOSEST_M = 1e-3
"""Nearer than this a range has no direction; the Jacobian stays finite."""


class ScaledRangeResidual(NamedTuple):
    """Residuals of ranges and their Jacobian blocks; leading axes broadcast."""

    error: Array
    """(...) m, predicted minus measured"""
    error_D_rotation: Array
    """(..., 3) with respect to ``phi`` in ``R_mc @ Exp(phi)``"""
    error_D_position: Array
    """(..., 3) with respect to a shift along the camera's axes, map units"""
    error_D_log_scale: Array
    """(...)"""
    error_D_anchor: Array
    """(..., 3)"""
    error_D_clock: Array
    """(...) m/s"""


def scaled_range_residual(
    R_mc: Array,
    p_m: Array,
    log_scale: Array,
    anchor_m: Array,
    bias_m: Array,
    clock_s: Array,
    *,
    range_m: Array,
    lever_arm_c: Array,
    velocity_m: Array,
) -> ScaledRangeResidual:
    """Return residuals of ranges with Jacobians; that of the bias is one.

    With ``s = exp(log_scale)``, metres a map unit, and the line from anchor to antenna ``d``::

        d = s (p + clock velocity) + R lever - anchor,    error = |d| + bias - range

    Parameters
    ----------
    R_mc : (..., 3, 3) rotation, camera to map.
    p_m : (..., 3) place of the camera, map units.
    anchor_m : (..., 3) m, map axes.
    bias_m : (...) m
    clock_s : (...) time of the measurement less its stamp.
    range_m : (...) measured, m.
    lever_arm_c : (3,) camera to antenna, camera axes, m.
    velocity_m : (..., 3) of the camera, map axes, map units/s.
    """
    s = np.exp(log_scale)[..., None]
    at = p_m + np.asarray(clock_s)[..., None] * velocity_m
    sight = s * at + times(R_mc, lever_arm_c) - anchor_m
    distance = np.linalg.norm(sight, axis=-1)
    along = sight / np.maximum(distance, CLOSEST_M)[..., None]
    along_c = times(np.swapaxes(R_mc, -1, -2), along)
    return ScaledRangeResidual(
        error=distance + bias_m - range_m,
        error_D_rotation=cross(lever_arm_c, along_c),
        error_D_position=s * along_c,
        error_D_log_scale=np.sum(along * s * at, axis=-1),
        error_D_anchor=-along,
        error_D_clock=np.sum(along * s * velocity_m, axis=-1),
    )


def scaled_range_factor(
    keys: tuple[int, int, int, int, int],
    *,
    sigma: float,
    range_m: float,
    lever_arm_c: Array,
    velocity_m: Array,
    weight: float = 1.0,
) -> gtsam.CustomFactor:
    """Wrap :func:`scaled_range_residual` for one range.

    Parameters
    ----------
    keys : of the camera's ``Pose3`` in the map, log scale (1,), anchor (3,), bias (1,), clock (1,).
    sigma : nominal standard deviation of the range, m.
    range_m, lever_arm_c, velocity_m : as in :func:`scaled_range_residual`.
    weight : similarity weight; the effective variance is ``sigma^2 / weight``.

    Raises
    ------
    ValueError
        If a number is not finite, or ``sigma`` or ``weight`` is not above zero.
    """
    name = "scaled_range_factor"
    check_numbers(name, sigma=sigma, weight=weight, range_m=range_m)
    given = {
        "range_m": np.array(range_m, dtype=float),
        "lever_arm_c": checked_array(name, "lever_arm_c", lever_arm_c, (3,)),
        "velocity_m": checked_array(name, "velocity_m", velocity_m, (3,)),
    }

    def evaluate(
        this: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Array] | None
    ) -> Array:
        pose, log_scale, anchor, bias, clock = this.keys()
        at = values.atPose3(pose)
        single = [values.atVector(key)[0] for key in (log_scale, bias, clock)]
        found = scaled_range_residual(
            at.rotation().matrix(),
            at.translation(),
            np.array(single[0]),
            values.atVector(anchor),
            np.array(single[1]),
            np.array(single[2]),
            **given,
        )
        if jacobians is not None:
            by_pose = np.hstack([found.error_D_rotation, found.error_D_position])
            jacobians[0] = by_pose[None, :]
            jacobians[1] = np.array([[found.error_D_log_scale]])
            jacobians[2] = found.error_D_anchor[None, :]
            jacobians[3] = np.ones((1, 1))
            jacobians[4] = np.array([[found.error_D_clock]])
        return np.atleast_1d(found.error)

    noise = gtsam.noiseModel.Isotropic.Sigma(1, sigma / np.sqrt(weight))
    return gtsam.CustomFactor(noise, [*keys], evaluate)
