"""Acoustic range from a transducer on the vehicle to a beacon whose place may be in doubt."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from factors.so3 import cross, times

Array = NDArray[np.float64]

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
