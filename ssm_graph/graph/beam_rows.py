"""Beams linearised in bulk."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from factors.dvl_beam import BeamResidual, beam_residual
from ssm_graph.base.frozen import Array
from ssm_graph.engine.error_state import GYRO_BIAS, ROTATION, STATE_DIM, VELOCITY
from ssm_graph.mission.problem import Beams


class BeamRows(NamedTuple):
    """Linearised beams, one row each, not whitened."""

    error: Array
    """(M,) m/s, predicted minus measured."""
    jacobian: Array
    """(M, 15) with respect to the keyframe's error state, (M, E) if there are extra variables."""


def linearize_beams(
    beams: Beams, *, rows: slice, R_nb: Array, v_n: Array, bias: Array, omega_ie_n: Array
) -> BeamRows:
    """Linearise the beams of ``rows`` at states given for each row, or one for all."""
    residual = beam_residual(
        R_nb,
        v_n,
        bias[..., 3:],
        speed=beams.speed[rows],
        gyro_b=beams.gyro_b[rows],
        beam_b=beams.beam_b[rows],
        lever_arm_b=beams.lever_arm_b,
        omega_ie_n=omega_ie_n,
    )
    return rows_of_beams(residual)


def rows_of_beams(residual: BeamResidual) -> BeamRows:
    """Return the residuals of M beams with Jacobians of the whole error state."""
    jacobian = np.zeros((len(residual.error), STATE_DIM))
    jacobian[:, ROTATION] = residual.error_D_rotation
    jacobian[:, VELOCITY] = residual.error_D_velocity_n
    jacobian[:, GYRO_BIAS] = residual.error_D_gyro_bias
    return BeamRows(residual.error, jacobian)
