"""Rows of position fixes, GNSS or acoustic."""

from __future__ import annotations

import numpy as np

from factors.gnss_position import fix_residual
from ssm_graph.base.frozen import Array
from ssm_graph.engine.error_state import POSITION, ROTATION, VELOCITY
from ssm_graph.engine.extras import Extras
from ssm_graph.graph.augmented_rows import Rows, RowStates
from ssm_graph.mission.aids import Fixes
from ssm_graph.mission.calibration import GNSS_DRIFT, GNSS_LEVER_ARM, GNSS_TIME_OFFSET


def fix_rows(
    fixes: Fixes, extras: Extras, at: RowStates, rows: Rows | int, *, of_gnss: bool = True
) -> tuple[Array, Array]:
    """Return errors (F, 3), m, and Jacobians (F, 3, width) of fixes, not whitened.

    Only those of GNSS depend on what is unknown of its antenna and clock, and drift.
    """
    extras_of_gnss = extras if of_gnss else Extras()
    nothing = np.zeros(3)
    late_s = extras_of_gnss.value(GNSS_TIME_OFFSET, at.walks, at.constants, default=nothing)[..., 0]
    lever = extras_of_gnss.value(GNSS_LEVER_ARM, at.walks, at.constants, default=nothing)
    residual = fix_residual(
        at.R_nb,
        at.p_n,
        at.v_n,
        lever_arm_b=fixes.lever_arm_b + lever,
        time_offset=late_s,
        omega_b=fixes.gyro_b[rows] - at.bias[..., 3:],
        position_n=fixes.position_n[rows],
    )
    jacobian = np.zeros((*residual.error.shape, extras.width))
    jacobian[..., ROTATION] = residual.error_D_rotation
    jacobian[..., POSITION] = residual.error_D_position
    jacobian[..., VELOCITY] = residual.error_D_velocity_n
    if GNSS_LEVER_ARM in extras_of_gnss:
        jacobian[..., extras.columns(GNSS_LEVER_ARM)] = residual.error_D_lever_arm_b
    if GNSS_TIME_OFFSET in extras_of_gnss:
        jacobian[..., extras.columns(GNSS_TIME_OFFSET)] = residual.error_D_time_offset[..., None]
    error = residual.error
    if GNSS_DRIFT in extras_of_gnss:
        jacobian[..., extras.columns(GNSS_DRIFT)] = np.eye(3)
        error = error + extras.value(GNSS_DRIFT, at.walks, at.constants, default=nothing)
    return error, jacobian
