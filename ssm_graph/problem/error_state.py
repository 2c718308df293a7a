"""The error state of a keyframe, and its mean and covariance at the start."""

from __future__ import annotations

from enum import Enum
from typing import NamedTuple

import numpy as np

from ssm_graph.data import Array, InitialState
from ssm_graph.earth import LocalFrame
from ssm_graph.frames import R_lb_from_roll_pitch_heading, phi_D_roll_pitch_heading

STATE_DIM = 15
"""Error state of a keyframe: rotation 3, position 3 (both body axes), velocity 3 (navigation
axes), accelerometer bias 3, gyro bias 3."""
ROTATION, POSITION, VELOCITY = slice(0, 3), slice(3, 6), slice(6, 9)
ACCEL_BIAS, GYRO_BIAS = slice(9, 12), slice(12, 15)

NO_EXTRA = np.zeros(0)
NO_EXTRA.setflags(write=False)


class Linearised(Enum):
    """Where the measurements of a keyframe are linearised."""

    EACH_PASS = "at each pass anew: Gauss-Newton"
    ONCE = "at the prediction: a linear error state, as in closed-loop inertial filters"


class InitialMoments(NamedTuple):
    """Mean and covariance of the first keyframe."""

    R_nb: Array
    p_n: Array
    v_n: Array
    bias: Array
    covariance: Array
    """(15 + E, 15 + E) in the order of the error state, then of the extra variables."""
    extra: Array = NO_EXTRA
    """(E,) extra variables that are carried in the state."""


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
