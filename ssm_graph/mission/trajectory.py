"""From keyframe states in the navigation frame to a trajectory in geodetic terms."""

from __future__ import annotations

import numpy as np

from factors.inertial import MovingState
from ssm_graph.base.earth import LocalFrame
from ssm_graph.base.frames import phi_D_roll_pitch_heading, roll_pitch_heading_from_R_lb
from ssm_graph.base.frozen import Array
from ssm_graph.engine.error_state import POSITION, ROTATION, VELOCITY
from ssm_graph.mission.estimate import Trajectory
from ssm_graph.mission.problem import Problem


def trajectory_from_states(problem: Problem, states: MovingState, covariance: Array) -> Trajectory:
    """Express states and their covariances (K, 15, 15) along east, north, up at the vehicle."""
    n_beams = np.bincount(problem.beams.keyframe, minlength=problem.n_keyframes).astype(float)
    return trajectory_at(problem.frame, problem.keyframe_s, states, covariance, n_beams=n_beams)


def trajectory_at(
    frame: LocalFrame,
    time_s: Array,
    states: MovingState,
    covariance: Array,
    *,
    n_beams: Array,
) -> Trajectory:
    """Express states at any times (K,), with the beam speeds used at each, as a trajectory."""
    lat, lon, height = frame.geodetic_from_p_n(states.p_n)
    R_ln = np.swapaxes(frame.R_nl_at(states.p_n), 1, 2)
    R_lb = R_ln @ states.R_nb
    roll, pitch, heading = roll_pitch_heading_from_R_lb(R_lb)
    rph_D_phi = np.asarray(np.linalg.inv(phi_D_roll_pitch_heading(roll, pitch)), float)
    return Trajectory(
        time_s=time_s,
        lat=lat,
        lon=lon,
        height=height,
        velocity_enu=np.einsum("kij,kj->ki", R_ln, states.v_n),
        roll_pitch_heading=np.stack([roll, pitch, heading], axis=-1),
        gyro_bias=states.bias[:, 3:],
        accel_bias=states.bias[:, :3],
        position_cov_enu=_turned(R_lb, covariance[:, POSITION, POSITION]),
        velocity_sigma_enu=_sigmas(_turned(R_ln, covariance[:, VELOCITY, VELOCITY])),
        attitude_sigma=_sigmas(_turned(rph_D_phi, covariance[:, ROTATION, ROTATION])),
        n_beams=n_beams,
    )


def _turned(J: Array, covariance: Array) -> Array:
    return np.asarray(J @ covariance @ np.swapaxes(J, 1, 2))


def _sigmas(covariance: Array) -> Array:
    """Return standard deviations; a variance that a lost filter let become negative is no limit."""
    variance = np.diagonal(covariance, axis1=1, axis2=2)
    return np.sqrt(np.where(variance < 0.0, np.inf, variance))
