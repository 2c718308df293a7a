"""Keyframe states, once as arrays for bulk work and once as GTSAM values."""

from __future__ import annotations

from typing import NamedTuple

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, V, X

from ssm_graph.data import Array

_NONE = np.zeros((1, 0))
_NONE.setflags(write=False)


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
    walks: Array = _NONE
    """(K, s) extra variables that walk, zero where they are as stated"""
    constants: Array = _NONE[0]
    """(C,) extra variables that do not"""


def states_from_arrays(
    R_nb: Array,
    p_n: Array,
    v_n: Array,
    bias: Array,
    walks: Array = _NONE,
    constants: Array = _NONE[0],
) -> States:
    """Return the states of K keyframes as both."""
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
    return States(values, R_nb, p_n, v_n, bias, walks, constants)


def retract(
    states: States, delta: gtsam.VectorValues, *, scale: float = 1.0
) -> tuple[States, Array]:
    """Return the states moved by ``scale * delta``, and that step as (K, 15)."""
    if scale != 1.0:
        delta = delta.scale(scale)
    values = states.values.retract(delta)
    n_keyframes = len(states.p_n)
    # VectorValues come in key order, and symbols sort as b, v, x.
    flat = delta.vector()
    bias_end, velocity_end = 6 * n_keyframes, 9 * n_keyframes
    d_bias = flat[:bias_end].reshape(-1, 6)
    d_velocity = flat[bias_end:velocity_end].reshape(-1, 3)
    d_pose = flat[velocity_end:].reshape(-1, 6)
    poses = gtsam.utilities.extractPose3(values)
    moved = States(
        values,
        poses[:, :9].reshape(-1, 3, 3),
        poses[:, 9:],
        states.v_n + d_velocity,
        states.bias + d_bias,
    )
    return moved, np.hstack([d_pose, d_velocity, d_bias])
