"""Depth readings and position fixes of a mission, at their keyframes."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ssm_graph.base.earth import LocalFrame
from ssm_graph.base.frozen import Array, ReadOnlyArrays
from ssm_graph.mission.mission import Mission
from ssm_graph.mission.ping_motion import mean_gyro
from ssm_graph.mission.timeline import Indices, Timeline
from ssm_graph.sensors.acoustic import UsblLog
from ssm_graph.sensors.gnss import GnssLog


@dataclass(frozen=True, slots=True, eq=False)
class Depths(ReadOnlyArrays):
    """Depth readings, each assigned to the first keyframe at or after it, as on the vehicle."""

    keyframe: NDArray[np.intp]
    """(M,)"""
    time_s: Array
    """(M,) s"""
    depth: Array
    """(M,) m, positive down"""
    gyro_b: Array
    """(K, 3) rad/s, at the keyframes: it moves the lever arm"""
    sigma: float
    """m"""
    lever_arm_b: Array
    """(3,) m"""


@dataclass(frozen=True, slots=True, eq=False)
class Fixes(ReadOnlyArrays):
    """Position fixes at their keyframes, in the navigation frame."""

    keyframe: NDArray[np.intp]
    """(M,)"""
    position_n: Array
    """(M, 3) m"""
    covariance_n: Array
    """(M, 3, 3) m^2"""
    gyro_b: Array
    """(M, 3) rad/s, at the fixes: with a clock in doubt it moves the antenna"""
    lever_arm_b: Array
    """(3,) m"""
    white_share: float = 1.0
    """Of the sigmas, what is white where their drift is a variable"""


def depths_of(mission: Mission, timeline: Timeline) -> Depths | None:
    """Return the depth readings of a mission, None for one without a sensor."""
    log = mission.depth
    if log is None:
        return None
    keyframe_s = timeline.keyframe_s
    used = (log.time_s >= keyframe_s[0]) & (log.time_s <= keyframe_s[-1])
    return Depths(
        keyframe=np.searchsorted(keyframe_s, log.time_s[used]),
        time_s=log.time_s[used],
        depth=log.true_depth[used],
        gyro_b=mean_gyro(mission.imu, keyframe_s),
        sigma=log.sigma,
        lever_arm_b=log.lever_arm_b,
    )


def fix_covariance_n(frame: LocalFrame, position_n: Array, sigma_enu: Array) -> Array:
    """Return the covariances (F, 3, 3) of fixes in ``n`` from their sigmas (F, 3), m^2."""
    R_nl = frame.R_nl_at(position_n)
    covariance_l = sigma_enu[:, :, None] ** 2 * np.eye(3)
    return np.asarray(R_nl @ covariance_l @ np.swapaxes(R_nl, 1, 2))


def fixes_of(mission: Mission, log: GnssLog, timeline: Timeline) -> Fixes:
    """Return the GNSS fixes that a timeline uses."""
    fixes = fixes_at(
        mission, log, timeline.fix, time_s=log.valid_s[timeline.fix], keyframe=timeline.fix_keyframe
    )
    return replace(fixes, white_share=log.calibration.drift.white_share)


def fixes_at(
    mission: Mission, log: GnssLog | UsblLog, rows: Indices, *, time_s: Array, keyframe: Indices
) -> Fixes:
    """Return some rows (F,) of a log of positions, valid at times (F,), at keyframes (F,)."""
    frame = mission.frame
    place_n = frame.p_n_from_geodetic(log.lat[rows], log.lon[rows], log.height[rows])
    place_n = place_n.reshape(len(rows), 3)
    return Fixes(
        keyframe=keyframe,
        position_n=place_n,
        covariance_n=fix_covariance_n(frame, place_n, log.sigma_enu[rows]),
        gyro_b=mean_gyro(mission.imu, time_s),
        lever_arm_b=log.lever_arm_b,
    )
