"""Mean and covariance of the first keyframe of a stated start."""

from __future__ import annotations

import numpy as np

from ssm_graph.base.earth import LocalFrame
from ssm_graph.base.frames import R_lb_from_roll_pitch_heading, phi_D_roll_pitch_heading
from ssm_graph.base.frozen import Array
from ssm_graph.engine.error_state import POSITION, ROTATION, STATE_DIM, VELOCITY, InitialMoments
from ssm_graph.mission.mission import InitialState


def initial_moments(start: InitialState, frame: LocalFrame, *, bias_sigma: Array) -> InitialMoments:
    """Turn an initial state in geodetic terms into the first keyframe's mean and covariance.

    Parameters
    ----------
    start : initial state with sigmas along east, north, up and of roll, pitch, heading.
    frame : navigation frame.
    bias_sigma : (6,) turn-on bias sigmas, accelerometer then gyro.
    """
    p_n = frame.p_n_from_geodetic(start.lat, start.lon, start.height)
    R_nl = frame.R_nl_at(p_n)
    R_lb = R_lb_from_roll_pitch_heading(start.roll, start.pitch, start.heading)
    R_nb = R_nl @ R_lb
    J = phi_D_roll_pitch_heading(start.roll, start.pitch)
    covariance = np.zeros((STATE_DIM, STATE_DIM))
    covariance[ROTATION, ROTATION] = J @ np.diag(start.attitude_sigma**2) @ J.T
    covariance[POSITION, POSITION] = R_lb.T @ np.diag(start.position_sigma_enu**2) @ R_lb
    covariance[VELOCITY, VELOCITY] = R_nl @ np.diag(start.velocity_sigma_enu**2) @ R_nl.T
    covariance[9:, 9:] = np.diag(bias_sigma**2)
    return InitialMoments(R_nb, p_n, R_nl @ start.velocity_enu, np.zeros(6), covariance)
