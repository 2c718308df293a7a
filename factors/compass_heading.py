"""Heading from a compass with its own errors: offset, walk, and what iron makes of it."""

from __future__ import annotations

from typing import NamedTuple

import gtsam
import numpy as np

from factors.checks import check_numbers, checked_array
from factors.so3 import Array

STEEPEST = 1e-2
"""Cosine of a pitch at which a heading has no meaning any more; the Jacobian stays finite."""


class CompassErrors(NamedTuple):
    """What a compass reads too large, rad; leading axes broadcast."""

    offset: Array
    """(...) constant and walk together."""
    one_cycle: Array
    """(..., 2) times sine and cosine of the heading: hard iron."""
    two_cycle: Array
    """(..., 2) times sine and cosine of twice the heading: soft iron."""


class HeadingResidual(NamedTuple):
    """Residuals of headings and their Jacobian blocks; leading axes broadcast.

    That of the offset is 1.
    """

    error: Array
    """(...) rad in [-pi, pi], predicted minus measured."""
    error_D_rotation: Array
    """(..., 3) with respect to ``phi`` in ``R_nb @ Exp(phi)``."""
    error_D_one_cycle: Array
    """(..., 2)"""
    error_D_two_cycle: Array
    """(..., 2)"""


def heading_residual(
    R_nb: Array, *, east_n: Array, north_n: Array, errors: CompassErrors, heading: Array
) -> HeadingResidual:
    """Return residuals of compass headings with Jacobians of attitude and errors.

    With the forward axis ``f = R_nb e_x`` and the local directions east and north::

        psi = atan2(f . east, f . north)
        error = psi + offset + a sin psi + b cos psi + c sin 2 psi + d cos 2 psi - heading

    Parameters
    ----------
    R_nb : (..., 3, 3) rotation, body to navigation.
    east_n, north_n : (..., 3) local directions at the vehicle.
    errors : of the compass.
    heading : (...) measured, clockwise from north, rad.
    """
    forward_n = R_nb[..., 0]
    east, north = np.sum(forward_n * east_n, axis=-1), np.sum(forward_n * north_n, axis=-1)
    psi = np.arctan2(east, north)
    once = np.stack([np.sin(psi), np.cos(psi)], axis=-1)
    twice = np.stack([np.sin(2.0 * psi), np.cos(2.0 * psi)], axis=-1)
    read = psi + errors.offset
    read = read + np.sum(errors.one_cycle * once + errors.two_cycle * twice, axis=-1)
    error = _error(read, heading)
    slope = 1.0 + np.sum(errors.one_cycle * _derivative(once), axis=-1)
    slope = slope + 2.0 * np.sum(errors.two_cycle * _derivative(twice), axis=-1)
    level_sq = np.maximum(east**2 + north**2, STEEPEST**2)
    gradient_n = north[..., None] * east_n - east[..., None] * north_n
    gradient_b = np.sum(R_nb * gradient_n[..., :, None], axis=-2)
    # The forward axis moves by R_nb (phi x e_x): gradient . (phi x e_x) = phi . (e_x x gradient).
    psi_D_rotation = np.stack(
        [np.zeros_like(psi), -gradient_b[..., 2] / level_sq, gradient_b[..., 1] / level_sq], axis=-1
    )
    return HeadingResidual(
        error=error,
        error_D_rotation=slope[..., None] * psi_D_rotation,
        error_D_one_cycle=once,
        error_D_two_cycle=twice,
    )


def _derivative(sine_cosine: Array) -> Array:
    """Return cosine and minus sine (..., 2)."""
    return np.stack([sine_cosine[..., 1], -sine_cosine[..., 0]], axis=-1)


def heading_factor(
    pose: int,
    *,
    sigma: float,
    heading: float,
    east_n: Array,
    north_n: Array,
    R_back: Array | None = None,
    weight: float = 1.0,
) -> gtsam.CustomFactor:
    """Wrap :func:`heading_residual` as a factor on a ``Pose3``, of a compass without errors.

    Parameters
    ----------
    pose : key.
    sigma : nominal standard deviation of a reading, rad.
    heading, east_n, north_n : as in :func:`heading_residual`, for one reading.
    R_back : (3, 3) body axes at the reading to those at the pose; they are the same when left out.
    weight : similarity weight; the effective variance is ``sigma^2 / weight``.

    Raises
    ------
    ValueError
        If a number is not finite, or ``sigma`` or ``weight`` is not above zero.
    """
    name = "heading_factor"
    check_numbers(name, sigma=sigma, weight=weight, heading=heading)
    back = checked_array(name, "R_back", np.eye(3) if R_back is None else R_back, (3, 3))
    east, north = (
        checked_array(name, axis, value, (3,))
        for axis, value in (("east_n", east_n), ("north_n", north_n))
    )
    none = CompassErrors(np.zeros(()), np.zeros(2), np.zeros(2))
    read = np.array(heading, dtype=float)

    def evaluate(
        this: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Array] | None
    ) -> Array:
        R_nb = values.atPose3(this.keys()[0]).rotation().matrix() @ back
        if jacobians is None:
            return np.atleast_1d(_error(np.arctan2(R_nb[:, 0] @ east, R_nb[:, 0] @ north), read))
        found = heading_residual(R_nb, east_n=east, north_n=north, errors=none, heading=read)
        jacobians[0] = np.hstack([back @ found.error_D_rotation, np.zeros(3)])[None, :]
        return np.atleast_1d(found.error)

    noise = gtsam.noiseModel.Isotropic.Sigma(1, sigma / np.sqrt(weight))
    return gtsam.CustomFactor(noise, [pose], evaluate)


def _error(predicted: Array, read: Array) -> Array:
    """Return the difference of two headings in [-pi, pi]."""
    return np.asarray(np.remainder(predicted - read + np.pi, 2.0 * np.pi) - np.pi)
