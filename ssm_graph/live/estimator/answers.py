"""Answers as users know them: the newest state, what was found beside it, the settled states."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ssm_graph.base.earth import LocalFrame
from ssm_graph.engine.extras import Extras
from ssm_graph.graph.measurements import aid_table
from ssm_graph.live.estimator.guard import Guarded
from ssm_graph.live.estimator.tail import Newest
from ssm_graph.live.estimator.watch import Watch, verdict
from ssm_graph.mission.answer import trajectory_at
from ssm_graph.mission.estimate import (
    AidTable,
    BeamTable,
    CurrentTrack,
    Found,
    ProtectionTrack,
    Trajectory,
)
from ssm_graph.mission.navigation import Navigation
from ssm_graph.smoothers.track import Stretch, calibration_of_last, current_along
from ssm_graph.smoothers.window import Window


def answer(
    newest: Newest,
    watch: Watch,
    guarded: Guarded,
    frame: LocalFrame,
    *,
    latest_s: float,
    shift_s: float,
    latency_s: float,
) -> Navigation:
    """Return the state at the last inertial sample, judged by what is remembered of its past.

    ``latest_s`` is the newest time of any message, s; ``shift_s`` how far the vehicle's clock is
    behind that of the states; ``latency_s`` what the last update cost.
    """
    told = verdict(
        watch,
        guarded,
        now_s=latest_s,
        imu_s=newest.time_s,
        covariance=newest.covariance,
    )
    time_s, covariance = np.array([newest.time_s]), newest.covariance[None]
    at = trajectory_at(frame, time_s, newest.states, covariance, n_beams=np.zeros(1))
    return Navigation(
        time_s=newest.time_s - shift_s,
        lat=float(at.lat[0]),
        lon=float(at.lon[0]),
        height=float(at.height[0]),
        **told._asdict(),
        latency_s=latency_s,
        velocity_enu=at.velocity_enu[0],
        roll_pitch_heading=at.roll_pitch_heading[0],
        position_sigma_enu=np.sqrt(np.diagonal(at.position_cov_enu[0])),
        velocity_sigma_enu=at.velocity_sigma_enu[0],
        attitude_sigma=at.attitude_sigma[0],
        gyro_bias=at.gyro_bias[0],
        accel_bias=at.accel_bias[0],
        beam_weights=np.array(watch.beam_weights),
        protection_m=guarded.protection.horizontal,
        protection_up_m=guarded.protection.up,
        innovation_ratios=guarded.ratios,
    )


def found_by(window: Window, *, begun_s: float) -> Found:
    """Return what is known beside the state of the vehicle, as the newest keyframe carries it.

    ``begun_s`` is when the estimator began.
    """
    extras, newest = window.sensors.extras, window.newest
    span_s = float(newest.time_s[0]) - begun_s
    return Found(calibration_of_last(extras, newest, span_s=span_s), current_along(extras, newest))


class Delayed(NamedTuple):
    """Some successive keyframes: rows for ``trajectory.csv`` and ``beams.csv``."""

    trajectory: Trajectory
    beams: BeamTable
    current: CurrentTrack | None
    """Beside the trajectory; None of a vehicle without one."""
    aids: AidTable | None
    """What became of the aids' measurements; None if there were none."""
    protection: ProtectionTrack


def delayed_of(
    stretch: Stretch,
    protection: ProtectionTrack,
    frame: LocalFrame,
    extras: Extras,
    *,
    shift_s: float,
) -> Delayed:
    """Return a stretch on the vehicle's clock, which is ``shift_s`` behind ours.

    ``extras`` are what each keyframe of it carries beside the error state.
    """
    time_s = stretch.time_s - shift_s
    return Delayed(
        trajectory_at(frame, time_s, stretch.states, stretch.covariance, n_beams=stretch.n_beams),
        BeamTable(
            time_s=np.repeat(time_s, stretch.n_beams.astype(int)),
            beam=(stretch.beam + 1).astype(np.float64),
            innovation=stretch.innovation,
            mahalanobis_sq=stretch.mahalanobis_sq,
            weight=stretch.weight,
        ),
        current_along(extras, stretch._replace(time_s=time_s)),
        aid_table([one._replace(time_s=one.time_s - shift_s) for one in stretch.aids.values()]),
        replace(protection, time_s=time_s),
    )
