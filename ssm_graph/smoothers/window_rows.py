"""Measurements and inertial data of a window as whitened rows: ``A d = b``, ``b`` the last column.

The inertial rows are those of GTSAM's factors; beams, depth and GNSS are linearised in bulk.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, V, X

from factors.dvl_beam import beam_residual
from factors.so3 import cross
from ssm_graph.data import Array
from ssm_graph.earth import LocalFrame
from ssm_graph.graph.beam_rows import BeamRows, rows_of_beams
from ssm_graph.graph.inertial_rows import carried_covariance, pair_rows
from ssm_graph.imu.preintegration import gravity_gradient, gtsam_gravity
from ssm_graph.problem.error_state import GYRO_BIAS, POSITION, ROTATION, STATE_DIM, VELOCITY
from ssm_graph.problem.heights import height_track, mean_rises
from ssm_graph.problem.states import NavigationStates
from ssm_graph.smoothers.keyframe import BeamSpeeds, Keyframe, Sensors, Way

SEEN_BY_BEAMS = np.r_[ROTATION, VELOCITY, GYRO_BIAS]
"""Components of the error state that a beam depends on."""
NO_ROWS = np.zeros((0, STATE_DIM + 1))
"""Of a keyframe without a measurement."""
_KEYS = tuple((X(i), V(i), B(i)) for i in (0, 1))


class InertialRows:
    """GTSAM's inertial factors, linearised one by one.

    They go from even to odd keyframes and back, so that each state enters GTSAM's values once.
    """

    def __init__(self, frame: LocalFrame) -> None:
        self._frame = frame
        self._gradient = gravity_gradient(frame)
        self._values = gtsam.Values()
        for pose, velocity, bias in _KEYS:
            self._values.insert(pose, pose3=gtsam.Pose3())
            self._values.insert(velocity, np.zeros(3))
            self._values.insert(bias, constant_bias=gtsam.imuBias.ConstantBias())

    def predict(self, keyframe: Keyframe, last: NavigationStates) -> NavigationStates:
        """Return the state (1, ...) of a new keyframe from that of the last one."""
        way = _way(keyframe)
        R_nb, p_n, v_n, bias = (column[0] for column in last)
        middle = p_n + 0.5 * way.measured.deltaTij() * v_n
        way.params.n_gravity = gtsam_gravity(self._frame, middle)
        predicted = way.measured.predict(
            gtsam.NavState(gtsam.Rot3(R_nb), p_n, v_n),
            gtsam.imuBias.ConstantBias(bias[:3], bias[3:]),
        )
        return NavigationStates(
            predicted.attitude().matrix()[None],
            predicted.position()[None],
            predicted.velocity()[None],
            last.bias,
        )

    def carry(
        self,
        keyframe: Keyframe,
        last: NavigationStates,
        predicted: NavigationStates,
        covariance: Array,
    ) -> Array:
        """Return the covariance (15, 15) at a predicted keyframe from that of the last one."""
        (pair,) = self.rows([keyframe], last.followed_by(predicted))
        return carried_covariance(pair, covariance)

    def set_gravity(self, ends: Sequence[Keyframe], states: NavigationStates) -> None:
        """Let gravity of the intervals before ``ends`` follow the states (1 + len(ends), ...)."""
        gravity = gtsam_gravity(self._frame, 0.5 * (states.p_n[:-1] + states.p_n[1:]))
        for keyframe, g_n in zip(ends, gravity, strict=True):
            _way(keyframe).params.n_gravity = g_n

    def rows(self, ends: Sequence[Keyframe], states: NavigationStates) -> list[Array]:
        """Return the rows (15, 31) of the intervals before ``ends``, successive keyframes.

        ``states`` are those of ``ends``, and of the keyframe before the first.
        """
        poses = np.tile(np.eye(4), (len(ends) + 1, 1, 1))
        poses[:, :3, :3], poses[:, :3, 3] = states.R_nb, states.p_n
        self._put(0, poses[0], states.v_n[0], states.bias[0])
        rows = []
        for i, keyframe in enumerate(ends, start=1):
            (x_i, v_i, b_i), (x_j, v_j, b_j) = _KEYS[(i - 1) % 2], _KEYS[i % 2]
            self._put(i % 2, poses[i], states.v_n[i], states.bias[i])
            factor = gtsam.GalileanCombinedImuFactor(
                x_i, v_i, x_j, v_j, b_i, b_j, _way(keyframe).measured
            )
            rows.append(
                pair_rows(
                    factor,
                    self._values,
                    self._gradient,
                    R_begin=states.R_nb[i - 1],
                    R_end=states.R_nb[i],
                    span_s=float(_way(keyframe).measured.deltaTij()),
                )
            )
        return rows

    def _put(self, which: int, pose: Array, v_n: Array, bias: Array) -> None:
        x, v, b = _KEYS[which]
        self._values.update(x, pose3=gtsam.Pose3(pose))
        self._values.update(v, v_n)
        self._values.update(b, constant_bias=gtsam.imuBias.ConstantBias(bias[:3], bias[3:]))


def _way(keyframe: Keyframe) -> Way:
    assert keyframe.way is not None  # only the first of all has none, and nothing leads to it
    return keyframe.way


def beam_rows(sensors: Sensors, beams: BeamSpeeds, states: NavigationStates) -> BeamRows:
    """Return errors (M,) in m/s and Jacobians (M, 15) of beams, each with its own state."""
    residual = beam_residual(
        states.R_nb,
        states.v_n,
        states.bias[:, 3:],
        speed=beams.speed,
        gyro_b=beams.gyro_b,
        beam_b=beams.beam_b,
        lever_arm_b=sensors.dvl_arm_b,
        omega_ie_n=sensors.frame.omega_ie_n,
    )
    return rows_of_beams(residual)


def fix_rows(
    sensors: Sensors, keyframes: Sequence[Keyframe], states: NavigationStates
) -> list[Array]:
    """Return the whitened rows (m, 16) of GNSS at each keyframe."""
    return [
        _fix_rows(sensors, keyframe, states, i) if len(keyframe.fix_n) else NO_ROWS
        for i, keyframe in enumerate(keyframes)
    ]


class DepthTargets(NamedTuple):
    """Where the depth sensor should be at K keyframes, seen along the local vertical only."""

    up_n: Array
    """(K, 3)"""
    sensor_n: Array
    """(K, 3) m"""
    rise: Array
    """(K,) m, how much higher the sensor is than it was, on average, when it was read"""

    def take(self, keyframes: slice) -> DepthTargets:
        """Return those of some keyframes."""
        return DepthTargets(*(column[keyframes] for column in self))

    def followed_by(self, other: DepthTargets) -> DepthTargets:
        """Return these, then the others."""
        return DepthTargets(*(np.concatenate(pair) for pair in zip(self, other, strict=True)))


def depth_targets(
    sensors: Sensors, keyframes: Sequence[Keyframe], states: NavigationStates, *, first_rise: float
) -> DepthTargets:
    """Return where the mean of each keyframe's readings, carried to it along the track, leads.

    The rise at the first keyframe has to be told.
    """
    count = np.array([len(keyframe.depth) for keyframe in keyframes])
    if not count.any():
        nowhere = np.zeros((len(keyframes), 3))
        return DepthTargets(nowhere, nowhere, np.append(first_rise, nowhere[1:, 0]))
    track = height_track(
        sensors.frame,
        R_nb=states.R_nb,
        p_n=states.p_n,
        v_n=states.v_n,
        gyro_b=np.array([keyframe.gyro_b for keyframe in keyframes]),
        lever_arm_b=sensors.depth_arm_b,
    )
    rise = mean_rises(
        track,
        np.array([keyframe.time_s for keyframe in keyframes]),
        reading_keyframe=np.repeat(np.arange(len(keyframes)), count),
        reading_s=np.concatenate([keyframe.depth_s for keyframe in keyframes]),
    )
    rise[0] = first_rise
    mean = np.array([keyframe.depth.sum() for keyframe in keyframes]) / np.maximum(count, 1)
    too_low = rise - mean - track.height
    return DepthTargets(track.up_n, track.sensor_n + track.up_n * too_low[:, None], rise)


def depth_rows(
    sensors: Sensors,
    keyframes: Sequence[Keyframe],
    states: NavigationStates,
    targets: DepthTargets,
) -> list[Array]:
    """Return the whitened rows (m, 16) of depth at each keyframe: one, or none."""
    count = np.array([len(keyframe.depth) for keyframe in keyframes])
    arm_n = states.R_nb @ sensors.depth_arm_b
    up_b = (targets.up_n[:, None, :] @ states.R_nb)[:, 0]
    rows = np.zeros((len(keyframes), STATE_DIM + 1))
    rows[:, ROTATION] = cross(sensors.depth_arm_b, up_b)
    rows[:, POSITION] = up_b
    rows[:, STATE_DIM] = ((targets.sensor_n - states.p_n - arm_n) * targets.up_n).sum(axis=1)
    rows *= (np.sqrt(count) / sensors.depth_sigma)[:, None]
    return [rows[i : i + 1] if n else NO_ROWS for i, n in enumerate(count.tolist())]


def speed_rows(keyframes: Sequence[Keyframe], states: NavigationStates) -> list[Array]:
    """Return three whitened rows (3, 16) for any vehicle's velocity where it is asked for."""
    return [
        _speed_rows(keyframe.speed_sigma, states.v_n[i])
        if np.isfinite(keyframe.speed_sigma)
        else NO_ROWS
        for i, keyframe in enumerate(keyframes)
    ]


def _speed_rows(sigma: float, v_n: Array) -> Array:
    rows = np.zeros((3, STATE_DIM + 1))
    rows[:, VELOCITY] = np.eye(3)
    rows[:, STATE_DIM] = -v_n
    return rows / sigma


def _fix_rows(sensors: Sensors, keyframe: Keyframe, states: NavigationStates, i: int) -> Array:
    R_nb, arm_b = states.R_nb[i], sensors.gnss_arm_b
    rows = np.zeros((len(keyframe.fix_n), 3, STATE_DIM + 1))
    rows[..., ROTATION] = cross(arm_b, R_nb)
    rows[..., POSITION] = R_nb
    rows[..., STATE_DIM] = keyframe.fix_n - states.p_n[i] - R_nb @ arm_b
    whitened = np.linalg.solve(np.linalg.cholesky(keyframe.fix_cov_n), rows)
    return np.asarray(whitened.reshape(-1, STATE_DIM + 1))
