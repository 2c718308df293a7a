"""Acoustic range from a transducer on the vehicle to a beacon whose place may be in doubt."""

from __future__ import annotations

from typing import NamedTuple

import gtsam
import numpy as np

from factors.checks import check_numbers, checked_array
from factors.so3 import Array, cross, times

CLOSEST_M = 1e-3
"""Nearer than this a range has no direction; the Jacobian stays finite."""


class RangeResidual(NamedTuple):
    """Residuals of ranges and their Jacobian blocks; leading axes broadcast."""

    error: Array
    """(...) m, predicted minus measured."""
    error_D_rotation: Array
    """(..., 3) with respect to ``phi`` in ``R_nb @ Exp(phi)``."""
    error_D_position: Array
    """(..., 3) with respect to a shift along the body axes."""
    error_D_beacon_n: Array
    """(..., 3)"""


def range_residual(
    R_nb: Array, p_n: Array, *, lever_arm_b: Array, beacon_n: Array, range_m: Array
) -> RangeResidual:
    """Return residuals of ranges with Jacobians of state and beacon.

    With the line of sight from the beacon to the transducer ``d``::

        d = p_n + R_nb lever - beacon_n,    error = |d| - range

    Sound is taken to run straight, at the speed that the range was made with.

    Parameters
    ----------
    R_nb : (..., 3, 3) rotation, body to navigation.
    p_n : (..., 3) position of the body origin, m.
    lever_arm_b : (3,) body origin to transducer, m.
    beacon_n : (..., 3) m
    range_m : (...) measured, m.
    """
    sight_n = p_n + times(R_nb, lever_arm_b) - beacon_n
    distance = np.linalg.norm(sight_n, axis=-1)
    along_n = sight_n / np.maximum(distance, CLOSEST_M)[..., None]
    along_b = times(np.swapaxes(R_nb, -1, -2), along_n)
    return RangeResidual(
        error=distance - range_m,
        error_D_rotation=cross(lever_arm_b, along_b),
        error_D_position=along_b,
        error_D_beacon_n=-along_n,
    )


def beacon_range_factor(
    pose: int,
    *,
    sigma: float,
    range_m: float,
    lever_arm_b: Array,
    beacon_n: Array,
    weight: float = 1.0,
) -> gtsam.CustomFactor:
    """Wrap :func:`range_residual` as a factor on a ``Pose3``, of a beacon whose place is known.

    For one whose place is a variable take GTSAM's ``RangeFactorWithTransform3D``.

    Parameters
    ----------
    pose : key.
    sigma : nominal standard deviation of the range, m.
    range_m, lever_arm_b, beacon_n : as in :func:`range_residual`, for one range.
    weight : similarity weight; the effective variance is ``sigma^2 / weight``.

    Raises
    ------
    ValueError
        If a number is not finite, or ``sigma`` or ``weight`` is not above zero.
    """
    name = "beacon_range_factor"
    check_numbers(name, sigma=sigma, weight=weight, range_m=range_m)
    lever = checked_array(name, "lever_arm_b", lever_arm_b, (3,))
    place = checked_array(name, "beacon_n", beacon_n, (3,))
    measured = np.array(range_m, dtype=float)

    def evaluate(
        this: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Array] | None
    ) -> Array:
        at = values.atPose3(this.keys()[0])
        R_nb, p_n = at.rotation().matrix(), at.translation()
        if jacobians is None:
            return np.atleast_1d(np.linalg.norm(p_n + R_nb @ lever - place) - measured)
        found = range_residual(R_nb, p_n, lever_arm_b=lever, beacon_n=place, range_m=measured)
        jacobians[0] = np.hstack([found.error_D_rotation, found.error_D_position])[None, :]
        return np.atleast_1d(found.error)

    noise = gtsam.noiseModel.Isotropic.Sigma(1, sigma / np.sqrt(weight))
    return gtsam.CustomFactor(noise, [pose], evaluate)
