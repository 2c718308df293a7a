"""A vehicle that stays where it is: its velocity over ground is zero."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from factors.so3 import Array


class StandstillResidual(NamedTuple):
    """Residuals of standstill and their Jacobian block; leading axes broadcast."""

    error: Array
    """(..., 3) m/s, predicted minus zero."""
    error_D_velocity_n: Array
    """(..., 3, 3)"""


def standstill_residual(v_n: Array) -> StandstillResidual:
    """Return ``error = v_n - 0`` for velocities (..., 3) over ground, m/s."""
    return StandstillResidual(v_n, np.broadcast_to(np.eye(3), (*v_n.shape, 3)))
