"""The newest state as its users know it: geodetic, with sigmas and a verdict."""

from __future__ import annotations

import numpy as np

from ssm_graph.base.earth import LocalFrame
from ssm_graph.live.estimator.tail import Newest
from ssm_graph.live.estimator.watch import Watch, verdict
from ssm_graph.mission.answer import trajectory_at
from ssm_graph.mission.navigation import Navigation


def answer(
    newest: Newest,
    watch: Watch,
    frame: LocalFrame,
    *,
    latest_s: float,
    shift_s: float,
    latency_s: float,
) -> Navigation:
    """Return the newest answer, judged.

    Parameters
    ----------
    newest : state at the last inertial sample.
    watch : what is remembered of its past.
    frame : navigation frame.
    latest_s : newest time of any message, s.
    shift_s : how far the vehicle's clock is behind that of the states, s.
    latency_s : what the last update cost, s.
    """
    told = verdict(watch, now_s=latest_s, imu_s=newest.time_s, covariance=newest.covariance)
    at = trajectory_at(
        frame,
        np.array([newest.time_s]),
        newest.states,
        newest.covariance[None],
        n_beams=np.zeros(1),
    )
    return Navigation(
        time_s=newest.time_s - shift_s,
        lat=float(at.lat[0]),
        lon=float(at.lon[0]),
        height=float(at.height[0]),
        health=told.health,
        reason=told.reason,
        confidence=told.confidence,
        bottom_lock=told.bottom_lock,
        since_aid_s=told.since_aid_s,
        latency_s=latency_s,
        velocity_enu=at.velocity_enu[0],
        roll_pitch_heading=at.roll_pitch_heading[0],
        position_sigma_enu=np.sqrt(np.diagonal(at.position_cov_enu[0])),
        velocity_sigma_enu=at.velocity_sigma_enu[0],
        attitude_sigma=at.attitude_sigma[0],
        gyro_bias=at.gyro_bias[0],
        accel_bias=at.accel_bias[0],
        beam_weights=np.array(watch.beam_weights),
    )
