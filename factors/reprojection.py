"""A point of a map seen by a camera, in normalised coordinates: any lens, undistorted before."""

from __future__ import annotations

from typing import NamedTuple

import gtsam
import numpy as np

from factors.checks import check_numbers, checked_array
from factors.so3 import Array, skew, times

NEAREST = 1e-6
"""Depth (map units) at which a point nearer, or behind, is taken to lie; it has no image."""


class ReprojectionResidual(NamedTuple):
    """Residuals of points and their Jacobian blocks; leading axes broadcast."""

    error: Array
    """(..., 2) normalised coordinates, predicted minus measured"""
    error_D_pose: Array
    """(..., 2, 6) with respect to rotation ``R_mc @ Exp(phi)`` and a shift along camera axes"""
    error_D_point: Array
    """(..., 2, 3)"""


def reprojection_residual(
    R_mc: Array, p_m: Array, point_m: Array, *, seen: Array
) -> ReprojectionResidual:
    """Return residuals of seen points, with Jacobians of the camera's pose and the point.

    With the point in camera axes ``x = R' (X - p)``::

        error = (x_1 / x_3, x_2 / x_3) - seen

    Parameters
    ----------
    R_mc : (..., 3, 3) rotation, camera (x right, y down, z ahead) to map.
    p_m : (..., 3) place of the camera, map units.
    point_m : (..., 3) map units.
    seen : (..., 2) undistorted normalised coordinates.
    """
    R_cm = np.swapaxes(R_mc, -1, -2)
    x = times(R_cm, point_m - p_m)
    depth = np.maximum(x[..., 2], NEAREST)
    image = x[..., :2] / depth[..., None]
    by_x = np.zeros((*image.shape, 3))
    by_x[..., 0, 0] = by_x[..., 1, 1] = 1.0 / depth
    by_x[..., 2] = -image / depth[..., None]
    # x(phi, shift) = Exp(-phi) x - shift to first order: dx = [x]_x phi - shift.
    pose = np.concatenate([by_x @ skew(x), -by_x], axis=-1)
    return ReprojectionResidual(image - seen, pose, by_x @ R_cm)


def reprojection_factor(
    pose: int, point: int, *, sigma: float, seen: Array, weight: float = 1.0
) -> gtsam.CustomFactor:
    """Wrap :func:`reprojection_residual` as a factor on a ``Pose3`` and a point (3,).

    Parameters
    ----------
    sigma : of a normalised coordinate: pixels over the focal length.
    seen : (2,) undistorted normalised coordinates.
    weight : similarity weight; the effective variance is ``sigma^2 / weight``.

    Raises
    ------
    ValueError
        If a number is not finite, or ``sigma`` or ``weight`` is not above zero.
    """
    name = "reprojection_factor"
    check_numbers(name, sigma=sigma, weight=weight)
    measured = checked_array(name, "seen", seen, (2,))

    def evaluate(
        this: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Array] | None
    ) -> Array:
        at, place = values.atPose3(this.keys()[0]), values.atPoint3(this.keys()[1])
        found = reprojection_residual(
            at.rotation().matrix(), at.translation(), place, seen=measured
        )
        if jacobians is not None:
            jacobians[0], jacobians[1] = found.error_D_pose, found.error_D_point
        return np.asarray(found.error)

    noise = gtsam.noiseModel.Isotropic.Sigma(2, sigma / np.sqrt(weight))
    return gtsam.CustomFactor(noise, [pose, point], evaluate)
