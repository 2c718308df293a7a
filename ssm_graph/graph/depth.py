"""Depth in the graph: readings between keyframes, carried to the next one along the track."""

from __future__ import annotations

import gtsam
import numpy as np
from gtsam.symbol_shorthand import X

from ssm_graph.data import Array
from ssm_graph.earth import LocalFrame
from ssm_graph.graph.states import States
from ssm_graph.problem.heights import HeightTrack, height_on_the_way, height_track
from ssm_graph.problem.problem import Depths


def rises(depths: Depths, states: States, frame: LocalFrame, keyframe_s: Array) -> Array:
    """Return how much higher the sensor is at each keyframe (K,) than at its readings, m, mean.

    Zero where there are none, and at the first keyframe: what came before it is not known here.
    """
    return _rises(depths, _track(depths, states, frame), keyframe_s)


def depth_graph(
    depths: Depths,
    states: States,
    frame: LocalFrame,
    keyframe_s: Array,
    *,
    first_rise: float = 0.0,
) -> gtsam.NonlinearFactorGraph:
    """Return depth as GTSAM position factors that count along the local vertical only.

    Two things make the target depend on the states, and both change little between iterations:
    the ellipsoid curves away from the frame's horizontal plane, and a reading between keyframes is
    carried to the next one along the estimated track, to the first by ``first_rise`` m. Readings
    of one keyframe are averaged.
    """
    track = _track(depths, states, frame)
    rise = _rises(depths, track, keyframe_s)
    rise[0] = first_rise
    count = np.bincount(depths.keyframe, minlength=len(rise))
    total = np.bincount(depths.keyframe, weights=-depths.depth, minlength=len(rise))
    too_low = total / np.maximum(count, 1) + rise - track.height
    target_n = track.sensor_n + track.up_n * too_low[:, None]
    root_information = np.zeros((len(count), 3, 3))
    root_information[:, 0] = track.up_n * (np.sqrt(count) / depths.sigma)[:, None]
    graph = gtsam.NonlinearFactorGraph()
    for k in np.flatnonzero(count).tolist():
        noise = gtsam.noiseModel.Gaussian.SqrtInformation(root_information[k], False)
        graph.add(gtsam.GPSFactorArm(X(k), target_n[k], depths.lever_arm_b, noise))
    return graph


def _track(depths: Depths, states: States, frame: LocalFrame) -> HeightTrack:
    return height_track(
        frame,
        R_nb=states.R_nb,
        p_n=states.p_n,
        v_n=states.v_n,
        gyro_b=depths.gyro_b,
        lever_arm_b=depths.lever_arm_b,
    )


def _rises(depths: Depths, track: HeightTrack, keyframe_s: Array) -> Array:
    between = depths.keyframe > 0
    end, time_s = depths.keyframe[between], depths.time_s[between]
    end_track = HeightTrack(*(column[end] for column in track))
    on_the_way = height_on_the_way(
        HeightTrack(*(column[end - 1] for column in track)),
        end_track,
        elapsed_s=time_s - keyframe_s[end - 1],
        span_s=keyframe_s[end] - keyframe_s[end - 1],
    )
    total = np.bincount(end, weights=end_track.height - on_the_way, minlength=len(keyframe_s))
    return np.asarray(total / np.maximum(np.bincount(end, minlength=len(keyframe_s)), 1))
