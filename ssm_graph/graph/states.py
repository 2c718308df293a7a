"""Keyframe states, once as arrays for bulk work and once as GTSAM values."""

from __future__ import annotations

from typing import NamedTuple

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, V, X

from ssm_graph.base.frozen import Array
from ssm_graph.engine.error_state import STATE_DIM

_NO_CONSTANTS = np.zeros(0)
_NO_CONSTANTS.setflags(write=False)


class States(NamedTuple):
    """States of all keyframes; the arrays and the GTSAM values say the same."""

    values: gtsam.Values
    R_nb: Array
    """(K, 3, 3)"""
    p_n: Array
    """(K, 3) m"""
    v_n: Array
    """(K, 3) m/s"""
    bias: Array
    """(K, 6) accelerometer m/s^2, gyro rad/s"""
    walks: Array
    """(K, s) extra variables that walk, zero where they are as stated"""
    constants: Array
    """(C,) extra variables that do not"""


def states_from_arrays(
    R_nb: Array,
    p_n: Array,
    v_n: Array,
    bias: Array,
    walks: Array | None = None,
    constants: Array = _NO_CONSTANTS,
) -> States:
    """Return the states of K keyframes as both, without extra variables that are left out."""
    values = gtsam.Values()
    poses = np.tile(np.eye(4), (len(p_n), 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = R_nb, p_n
    # Keywords spare GTSAM the search through 46 overloads: 12 instead of 28 us for a bias.
    for k, (pose, velocity, accel, gyro) in enumerate(
        zip(poses, v_n, bias[:, :3], bias[:, 3:], strict=True)
    ):
        values.insert(X(k), pose3=gtsam.Pose3(pose))
        values.insert(V(k), velocity)
        values.insert(B(k), constant_bias=gtsam.imuBias.ConstantBias(accel, gyro))
    if walks is None:
        walks = np.zeros((len(p_n), 0))
    return States(values, R_nb, p_n, v_n, bias, walks, constants)


def retract(states: States, step: Array, constants_step: Array = _NO_CONSTANTS) -> States:
    """Return the states moved by a step of keyframes and walks (K, 15 + s), and of constants (C,).

    The pose moves as GTSAM retracts it.
    """
    move = gtsam.VectorValues()
    for k, own in enumerate(step):
        move.insert(X(k), own[:6])
        move.insert(V(k), own[6:9])
        move.insert(B(k), own[9:STATE_DIM])
    values = states.values.retract(move)
    poses = gtsam.utilities.extractPose3(values)
    return States(
        values,
        poses[:, :9].reshape(-1, 3, 3),
        poses[:, 9:],
        states.v_n + step[:, 6:9],
        states.bias + step[:, 9:STATE_DIM],
        states.walks + step[:, STATE_DIM:],
        states.constants + constants_step,
    )
