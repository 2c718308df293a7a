"""Depth in the graph: readings between keyframes, carried to the next one along the track."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ssm_graph.base.earth import LocalFrame
from ssm_graph.base.frozen import Array
from ssm_graph.engine.states import States
from ssm_graph.mission.aids import Depths
from ssm_graph.mission.heights import height_track, mean_rises


class DepthTargets(NamedTuple):
    """Where the depth readings of D keyframes put the sensor."""

    keyframe: NDArray[np.intp]
    """(D,)"""
    target_n: Array
    """(D, 3) m; only its component along the vertical counts"""
    up_n: Array
    """(D, 3) local vertical"""
    root_information: Array
    """(D,) 1/m, of the mean of the readings"""


def depth_targets(
    depths: Depths, states: States, frame: LocalFrame, keyframe_s: Array
) -> DepthTargets:
    """Return the mean of each keyframe's readings, carried to it along the track of ``states``.

    Two things make the target depend on the states, and both change little between iterations:
    the ellipsoid curves away from the frame's horizontal plane, and a reading between keyframes is
    carried to the next one along the estimated track.
    """
    track = height_track(
        frame,
        R_nb=states.R_nb,
        p_n=states.p_n,
        v_n=states.v_n,
        gyro_b=depths.gyro_b,
        lever_arm_b=depths.lever_arm_b,
    )
    rise = mean_rises(track, keyframe_s, reading_keyframe=depths.keyframe, reading_s=depths.time_s)
    count = np.bincount(depths.keyframe, minlength=len(rise))
    total = np.bincount(depths.keyframe, weights=-depths.depth, minlength=len(rise))
    too_low = total / np.maximum(count, 1) + rise - track.height
    target_n = track.sensor_n + track.up_n * too_low[:, None]
    read = np.flatnonzero(count)
    root_information = np.sqrt(count[read]) / depths.sigma
    return DepthTargets(read, target_n[read], track.up_n[read], root_information)
