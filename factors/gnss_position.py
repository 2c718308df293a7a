"""Position fix of an antenna whose place and clock are not quite what is written about them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from factors.so3 import Array, cross, times


class FixResidual(NamedTuple):
    """Residuals of fixes and their Jacobian blocks; leading axes broadcast."""

    error: Array
    """(..., 3) m, predicted minus measured, along ``n``."""
    error_D_rotation: Array
    """(..., 3, 3) with respect to ``phi`` in ``R_nb @ Exp(phi)``."""
    error_D_position: Array
    """(..., 3, 3) with respect to a shift along the body axes."""
    error_D_velocity_n: Array
    """(..., 3, 3)"""
    error_D_lever_arm_b: Array
    """(..., 3, 3)"""
    error_D_time_offset: Array
    """(..., 3)"""


def fix_residual(
    R_nb: Array,
    p_n: Array,
    v_n: Array,
    *,
    lever_arm_b: Array,
    time_offset: Array,
    omega_b: Array,
    position_n: Array,
) -> FixResidual:
    """Return residuals of position fixes with Jacobians of state and calibration.

    With the time offset ``tau``, positive when stamps are late::

        error = p_n + R_nb lever - tau (v_n + R_nb (omega_b x lever)) - position_n

    The acceleration within ``tau`` is left out: 1 cm at 0.3 s and 0.2 m/s^2.

    Parameters
    ----------
    R_nb : (..., 3, 3) rotation, body to navigation.
    p_n, v_n : (..., 3) position and velocity of the body origin, m and m/s.
    lever_arm_b : (3,) body origin to antenna with its error, m.
    time_offset : (...) tau, s, of each fix, or () of all.
    omega_b : (..., 3) body rate, rad/s: it moves the antenna about.
    position_n : (..., 3) the fix, m.
    """
    late_s = np.asarray(time_offset)[..., None]
    late = late_s * cross(omega_b, lever_arm_b)
    arm = lever_arm_b - late
    swing_n = times(R_nb, cross(omega_b, lever_arm_b))
    n_fixes = np.shape(p_n)[:-1]
    identity = np.broadcast_to(np.eye(3), (*n_fixes, 3, 3))
    # Column i of [omega x] is omega x e_i.
    turned = np.swapaxes(cross(omega_b[..., None, :], identity), -1, -2)
    return FixResidual(
        error=p_n + times(R_nb, arm) - late_s * v_n - position_n,
        error_D_rotation=cross(arm[..., None, :], R_nb),
        error_D_position=R_nb,
        error_D_velocity_n=-late_s[..., None] * identity,
        error_D_lever_arm_b=R_nb @ (identity - late_s[..., None] * turned),
        error_D_time_offset=-(v_n + swing_n),
    )
