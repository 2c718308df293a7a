"""Height of a depth sensor whose zero is not quite where it is written to be."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from factors.so3 import Array, cross, times


class HeightResidual(NamedTuple):
    """Residuals of heights and their Jacobian blocks; leading axes broadcast."""

    error: Array
    """(...) m, predicted minus measured height."""
    error_D_rotation: Array
    """(..., 3) with respect to ``phi`` in ``R_nb @ Exp(phi)``."""
    error_D_position: Array
    """(..., 3) with respect to a shift along the body axes."""
    error_D_offset: Array
    """(...)"""


def height_residual(
    R_nb: Array, p_n: Array, *, lever_arm_b: Array, offset: Array, up_n: Array, target_n: Array
) -> HeightResidual:
    """Return residuals of depth readings along the local vertical, with Jacobians.

    ``target_n`` is where the reading puts the sensor; an ``offset`` above zero means that depths
    are read too large, so that the sensor is truly higher by as much::

        error = up_n . (p_n + R_nb lever_arm_b - target_n) - offset

    Parameters
    ----------
    R_nb : (..., 3, 3) rotation, body to navigation.
    p_n : (..., 3) position of the body origin, m.
    lever_arm_b : (3,) body origin to sensor, m.
    offset : () m.
    up_n : (..., 3) local vertical.
    target_n : (..., 3) m; only its component along ``up_n`` counts.
    """
    arm_n = times(R_nb, lever_arm_b)
    up_b = np.asarray((up_n[..., None, :] @ R_nb)[..., 0, :])
    error = (up_n * (p_n + arm_n - target_n)).sum(axis=-1) - offset
    return HeightResidual(
        error=np.asarray(error),
        error_D_rotation=cross(lever_arm_b, up_b),
        error_D_position=up_b,
        error_D_offset=-np.ones(np.shape(error)),
    )
