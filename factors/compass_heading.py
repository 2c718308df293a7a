"""Heading from a compass with its own errors: offset, walk, and what iron makes of it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

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
    error = np.remainder(read - heading + np.pi, 2.0 * np.pi) - np.pi
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
