"""A point that stays where it is, seen by a sonar or a camera in range and direction."""

from __future__ import annotations

from typing import NamedTuple

import gtsam
import numpy as np

from factors.checks import check_numbers, checked_array
from factors.so3 import Array, skew, times

CLOSEST_M = 1e-3
"""Nearer than this a sight has no direction; the Jacobian stays finite."""


class SightResidual(NamedTuple):
    """Residuals of sightings and their Jacobian blocks; leading axes broadcast."""

    error: Array
    """(..., 3) range [m], to starboard and upwards of the measured direction [rad]; predicted minus
    measured."""
    error_D_rotation: Array
    """(..., 3, 3) with respect to ``phi`` in ``R_nb @ Exp(phi)``."""
    error_D_position: Array
    """(..., 3, 3) with respect to a shift along the body axes."""
    error_D_place_n: Array
    """(..., 3, 3)"""


def direction_axes(bearing: Array, elevation: Array) -> Array:
    """Return the axes (..., 3, 3) of a direction, one a row: along it, to starboard, upwards.

    The instrument's axes are x forward, y to starboard, z down; ``bearing`` (...) is positive to
    starboard and ``elevation`` (...) above the plane of x and y, rad.
    """
    cb, sb, ce, se = np.cos(bearing), np.sin(bearing), np.cos(elevation), np.sin(elevation)
    along = np.stack([ce * cb, ce * sb, -se], axis=-1)
    starboard = np.stack([-sb, cb, np.zeros_like(cb)], axis=-1)
    upwards = np.stack([-se * cb, -se * sb, -ce], axis=-1)
    return np.stack([along, starboard, upwards], axis=-2)


def sight_residual(
    R_nb: Array,
    p_n: Array,
    *,
    lever_arm_b: Array,
    axes_b: Array,
    range_m: Array,
    place_n: Array,
) -> SightResidual:
    """Return residuals of sightings with Jacobians of the state and of the place.

    With the line of sight ``s = R_nb' (place_n - p_n) - lever``, in the axes ``(u, v, w)`` of the
    measured direction::

        error = (|s| - range,  atan2(v's, u's),  atan2(w's, u's))

    Angles across the direction have no pole, as bearings have at the zenith.

    Parameters
    ----------
    R_nb : (..., 3, 3) rotation, body to navigation.
    p_n : (..., 3) position of the body origin, m.
    lever_arm_b : (3,) body origin to instrument, m.
    axes_b : (..., 3, 3) `direction_axes` in body axes, one a row.
    range_m : (...) measured, m.
    place_n : (..., 3) of the point, m.
    """
    R_bn = np.swapaxes(R_nb, -1, -2)
    from_body = times(R_bn, place_n - p_n)
    seen = times(axes_b, from_body - lever_arm_b)
    distance = np.maximum(np.linalg.norm(seen, axis=-1), CLOSEST_M)
    ahead = seen[..., 0]
    by_seen = np.zeros((*seen.shape, 3))
    by_seen[..., 0, :] = seen / distance[..., None]
    error = np.empty_like(seen)
    error[..., 0] = np.linalg.norm(seen, axis=-1) - range_m
    for i in (1, 2):
        across = seen[..., i]
        square = np.maximum(ahead**2 + across**2, CLOSEST_M**2)
        error[..., i] = np.arctan2(across, ahead)
        by_seen[..., i, 0], by_seen[..., i, i] = -across / square, ahead / square
    by_sight = by_seen @ axes_b
    return SightResidual(
        error=error,
        error_D_rotation=by_sight @ skew(from_body),
        error_D_position=-by_sight,
        error_D_place_n=by_sight @ R_bn,
    )


def place_of_sighting(
    R_nb: Array, p_n: Array, *, lever_arm_b: Array, axes_b: Array, range_m: Array
) -> Array:
    """Return where sightings put their points, (..., 3), m; arguments as of `sight_residual`."""
    return np.asarray(p_n + times(R_nb, lever_arm_b + range_m[..., None] * axes_b[..., 0, :]))


def feature_sighting_factor(
    pose: int,
    point: int,
    *,
    sigma: Array,
    range_m: float,
    bearing: float,
    elevation: float,
    lever_arm_b: Array,
    weight: float = 1.0,
) -> gtsam.CustomFactor:
    """Wrap :func:`sight_residual` as a factor on a ``Pose3`` and a ``Point3``.

    Parameters
    ----------
    pose, point : keys.
    sigma : (3,) nominal standard deviations of range [m] and of both angles [rad].
    range_m, bearing, elevation : measured, m and rad, in body axes; see `direction_axes`.
    lever_arm_b : (3,) body origin to instrument, m.
    weight : similarity weight; the effective variances are ``sigma^2 / weight``.

    Raises
    ------
    ValueError
        If a number is not finite, or a sigma or ``weight`` is not above zero.
    """
    name = "feature_sighting_factor"
    sigmas = checked_array(name, "sigma", sigma, (3,))
    check_numbers(
        name,
        sigma=float(sigmas.min()),
        weight=weight,
        range_m=range_m,
        bearing=bearing,
        elevation=elevation,
    )
    lever = checked_array(name, "lever_arm_b", lever_arm_b, (3,))
    axes, measured = direction_axes(np.array(bearing), np.array(elevation)), np.array(range_m)

    def evaluate(
        this: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Array] | None
    ) -> Array:
        at = values.atPose3(this.keys()[0])
        found = sight_residual(
            at.rotation().matrix(),
            at.translation(),
            lever_arm_b=lever,
            axes_b=axes,
            range_m=measured,
            place_n=values.atPoint3(this.keys()[1]),
        )
        if jacobians is not None:
            jacobians[0] = np.hstack([found.error_D_rotation, found.error_D_position])
            jacobians[1] = found.error_D_place_n
        return found.error

    noise = gtsam.noiseModel.Diagonal.Sigmas(sigmas / np.sqrt(weight))
    return gtsam.CustomFactor(noise, [pose, point], evaluate)
