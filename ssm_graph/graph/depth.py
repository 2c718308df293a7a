"""Depth in the graph: readings between keyframes, carried to the next one along the track."""

from __future__ import annotations

import gtsam
import numpy as np
from gtsam.symbol_shorthand import X

from ssm_graph.data import Array
from ssm_graph.earth import LocalFrame
from ssm_graph.graph.states import States
from ssm_graph.problem.heights import height_track, mean_rises
from ssm_graph.problem.problem import Depths


def depth_graph(
    depths: Depths,
    states: States,
    frame: LocalFrame,
    keyframe_s: Array,
) -> gtsam.NonlinearFactorGraph:
    """Return depth as GTSAM position factors that count along the local vertical only.

    Two things make the target depend on the states, and both change little between iterations:
    the ellipsoid curves away from the frame's horizontal plane, and a reading between keyframes is
    carried to the next one along the estimated track. Readings of one keyframe are averaged.
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
    root_information = np.zeros((len(count), 3, 3))
    root_information[:, 0] = track.up_n * (np.sqrt(count) / depths.sigma)[:, None]
    graph = gtsam.NonlinearFactorGraph()
    for k in np.flatnonzero(count).tolist():
        noise = gtsam.noiseModel.Gaussian.SqrtInformation(root_information[k], False)
        graph.add(gtsam.GPSFactorArm(X(k), target_n[k], depths.lever_arm_b, noise))
    return graph
