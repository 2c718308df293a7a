"""Range along a beam to a seabed whose heights a map knows."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import gtsam
import numpy as np

from factors.checks import check_numbers, checked_array
from factors.so3 import Array, cross, times

Seabed = Callable[[Array], tuple[float, Array]]
"""Takes a point (3,) in navigation axes, m; returns how high it is above the seabed under it, m,
and how that grows (3,) with the point."""


class TerrainResidual(NamedTuple):
    """Residuals of ranges and their Jacobian blocks; leading axes broadcast."""

    error: Array
    """(...) m, the end of the beam above the mapped seabed."""
    error_D_rotation: Array
    """(..., 3) with respect to ``phi`` in ``R_nb @ Exp(phi)``."""
    error_D_position: Array
    """(..., 3) with respect to a shift along the body axes."""
    error_D_bias: Array
    """(...) with respect to a map whose seabed truly lies higher by so much, m."""


def beam_ends(R_nb: Array, p_n: Array, *, end_b: Array) -> Array:
    """Return where beams end (..., 3), m; ``end_b`` (..., 3) is the same from the body origin."""
    return np.asarray(p_n + times(R_nb, end_b))


def terrain_residual(
    R_nb: Array, *, end_b: Array, above: Array, above_D_point: Array, bias: Array
) -> TerrainResidual:
    """Return residuals of beam ends against a map, with Jacobians of state and bias.

    A range puts the point of the seabed that it met to ``e``; the map says how high the seabed is
    under it, and so how high ``e`` is above the map (positive) or below::

        e = p_n + R_nb (lever + range u),    error = above(e) - bias

    Parameters
    ----------
    R_nb : (..., 3, 3) rotation, body to navigation.
    end_b : (..., 3) lever arm and range along the beam, body axes, m.
    above : (...) height of ``e`` above the mapped seabed, m.
    above_D_point : (..., 3) its derivative with respect to ``e``: the vertical less the slope.
    bias : (...) by how much the seabed is higher than the map, m.
    """
    along_b = times(np.swapaxes(R_nb, -1, -2), above_D_point)
    return TerrainResidual(
        error=np.asarray(above - bias),
        error_D_rotation=cross(end_b, along_b),
        error_D_position=along_b,
        error_D_bias=-np.ones(np.shape(above)),
    )


def terrain_range_factor(
    pose: int, *, sigma: float, end_b: Array, seabed: Seabed, weight: float = 1.0
) -> gtsam.CustomFactor:
    """Wrap :func:`terrain_residual` as a factor on a ``Pose3``, of a map without bias.

    Parameters
    ----------
    pose : key.
    sigma : nominal standard deviation of the height, m: of the range and of the map.
    end_b : (3,) lever arm and range along the beam, body axes, m.
    seabed : the map.
    weight : similarity weight; the effective variance is ``sigma^2 / weight``.

    Raises
    ------
    ValueError
        If a number is not finite, or ``sigma`` or ``weight`` is not above zero.
    """
    name = "terrain_range_factor"
    check_numbers(name, sigma=sigma, weight=weight)
    end = checked_array(name, "end_b", end_b, (3,))

    def evaluate(
        this: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Array] | None
    ) -> Array:
        at = values.atPose3(this.keys()[0])
        R_nb = at.rotation().matrix()
        above, grows = seabed(beam_ends(R_nb, at.translation(), end_b=end))
        found = terrain_residual(
            R_nb, end_b=end, above=np.array(above), above_D_point=grows, bias=np.array(0.0)
        )
        if jacobians is not None:
            jacobians[0] = np.hstack([found.error_D_rotation, found.error_D_position])[None, :]
        return np.atleast_1d(found.error)

    noise = gtsam.noiseModel.Isotropic.Sigma(1, sigma / np.sqrt(weight))
    return gtsam.CustomFactor(noise, [pose], evaluate)
