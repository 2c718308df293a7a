"""Measurements and inertial data of a window as whitened rows: ``A d = b``, ``b`` the last column.

The inertial rows are those of GTSAM's factors; beams, depth and GNSS are linearised in bulk.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, V, X
from numpy.typing import NDArray

from factors.depth_height import height_residual
from factors.dvl_beam import beam_residual
from ssm_graph.data import Array
from ssm_graph.earth import LocalFrame
from ssm_graph.graph.aids import positions
from ssm_graph.graph.beam_rows import BeamRows, rows_of_beams
from ssm_graph.graph.extended_rows import ExtendedBeams, RowStates
from ssm_graph.graph.inertial_rows import carried_covariance, pair_rows
from ssm_graph.imu.preintegration import gravity_gradient, gtsam_gravity
from ssm_graph.problem.aids import Fixes
from ssm_graph.problem.calibration import DEPTH_OFFSET
from ssm_graph.problem.error_state import GYRO_BIAS, POSITION, ROTATION, STATE_DIM, VELOCITY
from ssm_graph.problem.extras import Extras
from ssm_graph.problem.heights import height_track, mean_rises
from ssm_graph.problem.problem import NO_EXTRAS, Beams
from ssm_graph.problem.states import AugmentedStates
from ssm_graph.smoothers.keyframe import BeamSpeeds, Keyframe, Sensors, Way

_SEEN_BY_BEAMS = np.r_[ROTATION, VELOCITY, GYRO_BIAS]
_KEYS = tuple((X(i), V(i), B(i)) for i in (0, 1))


class InertialRows:
    """GTSAM's inertial factors, linearised one by one.

    They go from even to odd keyframes and back, so that each state enters GTSAM's values once.
    """

    def __init__(self, frame: LocalFrame, extras: Extras = NO_EXTRAS) -> None:
        """Take the frame, and the extra variables that states carry; all of them walk."""
        self._frame, self._extras = frame, extras
        self._gradient = gravity_gradient(frame)
        self._values = gtsam.Values()
        for pose, velocity, bias in _KEYS:
            self._values.insert(pose, pose3=gtsam.Pose3())
            self._values.insert(velocity, np.zeros(3))
            self._values.insert(bias, constant_bias=gtsam.imuBias.ConstantBias())

    def predict(self, keyframe: Keyframe, last: AugmentedStates) -> AugmentedStates:
        """Return the state (1, ...) of a new keyframe from that of the last one."""
        way = _way(keyframe)
        R_nb, p_n, v_n, bias, _ = (column[0] for column in last)
        middle = p_n + 0.5 * way.measured.deltaTij() * v_n
        way.params.n_gravity = gtsam_gravity(self._frame, middle)
        predicted = way.measured.predict(
            gtsam.NavState(gtsam.Rot3(R_nb), p_n, v_n),
            gtsam.imuBias.ConstantBias(bias[:3], bias[3:]),
        )
        extra = last.extra
        if self._extras:
            extra = extra * self._transition([keyframe])[0]
        return AugmentedStates(
            predicted.attitude().matrix()[None],
            predicted.position()[None],
            predicted.velocity()[None],
            last.bias,
            extra,
        )

    def carry(
        self,
        keyframe: Keyframe,
        last: AugmentedStates,
        predicted: AugmentedStates,
        covariance: Array,
    ) -> Array:
        """Return the covariance (n, n) at a predicted keyframe from that of the last one."""
        (pair,) = self._pairs([keyframe], last.followed_by(predicted))
        carried = carried_covariance(pair, covariance)
        if self._extras:
            (factor,), (sigma,) = self._transition([keyframe])
            carried[STATE_DIM:] *= factor[:, None]
            carried[:, STATE_DIM:] *= factor
            carried[STATE_DIM:, STATE_DIM:] += np.diag(sigma**2)
        return carried

    def set_gravity(self, ends: Sequence[Keyframe], states: AugmentedStates) -> None:
        """Let gravity of the intervals before ``ends`` follow the states (1 + len(ends), ...)."""
        gravity = gtsam_gravity(self._frame, 0.5 * (states.p_n[:-1] + states.p_n[1:]))
        for keyframe, g_n in zip(ends, gravity, strict=True):
            _way(keyframe).params.n_gravity = g_n

    def rows(self, ends: Sequence[Keyframe], states: AugmentedStates) -> list[Array]:
        """Return the rows (n, 2 n + 1) of the intervals before ``ends``, successive keyframes.

        ``states`` are those of ``ends``, and of the keyframe before the first.
        """
        pairs = self._pairs(ends, states)
        return self._with_walks(pairs, ends, states.extra) if self._extras else pairs

    def _with_walks(
        self, pairs: Sequence[Array], ends: Sequence[Keyframe], extra: Array
    ) -> list[Array]:
        """Return inertial rows (15, 31) with the columns and the rows of the walks."""
        n = self._extras.width
        begin, end, b = np.split(np.array(pairs), [STATE_DIM, 2 * STATE_DIM], axis=2)
        wide = np.zeros((len(pairs), n, 2 * n + 1))
        wide[:, :STATE_DIM, :STATE_DIM], wide[:, :STATE_DIM, -1] = begin, b[..., 0]
        wide[:, :STATE_DIM, n : n + STATE_DIM] = end
        factor, sigma = self._transition(ends)
        own = np.arange(STATE_DIM, n)
        wide[:, own, own], wide[:, own, n + own] = -factor / sigma, 1.0 / sigma
        wide[:, own, -1] = (factor * extra[:-1] - extra[1:]) / sigma
        return list(wide)

    def _transition(self, ends: Sequence[Keyframe]) -> tuple[Array, Array]:
        """Return factors and sigmas (I, E) of the walks over the intervals before ``ends``."""
        span_s = np.array([_way(keyframe).measured.deltaTij() for keyframe in ends])
        return self._extras.transitions(span_s)

    def _pairs(self, ends: Sequence[Keyframe], states: AugmentedStates) -> list[Array]:
        """Return the rows (15, 31) of the inertial factors alone."""
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


def seen_by_beams(sensors: Sensors) -> NDArray[np.intp]:
    """Return the components of the state that a beam may depend on."""
    return np.concatenate([_SEEN_BY_BEAMS, np.arange(STATE_DIM, sensors.state_dim)])


def beam_rows(sensors: Sensors, beams: BeamSpeeds, states: AugmentedStates) -> BeamRows:
    """Return errors (M,) in m/s and Jacobians (M, n) of beams, each with its own state."""
    if sensors.extras:
        return _extended_rows(sensors, beams, states)
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


def _extended_rows(sensors: Sensors, beams: BeamSpeeds, states: AugmentedStates) -> BeamRows:
    count = len(beams.speed)
    table = Beams(
        keyframe=np.arange(count),
        beam=beams.beam.astype(np.intp),
        speed=beams.speed,
        sigma=beams.sigma,
        gyro_b=beams.gyro_b,
        beam_b=beams.beam_b,
        lever_arm_b=sensors.dvl_arm_b,
        R_bd=sensors.R_bd,
        ping=np.zeros(count, np.intp),
        is_water=np.zeros(count, np.bool_),
    )
    extended = ExtendedBeams(table, sensors.extras, sensors.frame)
    at = _row_states(states)
    return extended.rows(at, extended.prepare(at.walks, at.constants, at.bias))


def _row_states(states: AugmentedStates) -> RowStates:
    """Return the states as rows take them; gravity, which none here asks for, is left out."""
    return RowStates(*states, constants=np.zeros(0), g_n=np.zeros(3))


def no_rows(sensors: Sensors) -> Array:
    """Return the rows (0, n + 1) of a keyframe without a measurement."""
    return np.zeros((0, sensors.state_dim + 1))


def fix_rows(
    sensors: Sensors, keyframes: Sequence[Keyframe], states: AugmentedStates
) -> list[Array]:
    """Return the whitened rows (m, n + 1) of GNSS at each keyframe."""
    return [
        _fix_rows(sensors, keyframe, states.take(np.s_[i : i + 1]))
        if len(keyframe.fix_n)
        else no_rows(sensors)
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
    sensors: Sensors, keyframes: Sequence[Keyframe], states: AugmentedStates, *, first_rise: float
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
    states: AugmentedStates,
    targets: DepthTargets,
) -> list[Array]:
    """Return the whitened rows (m, n + 1) of depth at each keyframe: one, or none."""
    count, extras = np.array([len(keyframe.depth) for keyframe in keyframes]), sensors.extras
    offset = extras.value(DEPTH_OFFSET, states.extra, np.zeros(0), default=np.zeros(1))
    residual = height_residual(
        states.R_nb,
        states.p_n,
        lever_arm_b=sensors.depth_arm_b,
        offset=offset[..., 0],
        up_n=targets.up_n,
        target_n=targets.sensor_n,
    )
    rows = np.zeros((len(keyframes), sensors.state_dim + 1))
    rows[:, ROTATION] = residual.error_D_rotation
    rows[:, POSITION] = residual.error_D_position
    if DEPTH_OFFSET in extras:
        rows[:, extras.columns(DEPTH_OFFSET)] = residual.error_D_offset[:, None]
    rows[:, -1] = -residual.error
    rows *= (np.sqrt(count) / sensors.depth_sigma)[:, None]
    none = no_rows(sensors)
    return [rows[i : i + 1] if n else none for i, n in enumerate(count.tolist())]


def speed_rows(
    sensors: Sensors, keyframes: Sequence[Keyframe], states: AugmentedStates
) -> list[Array]:
    """Return three whitened rows (3, n + 1) for any vehicle's velocity where it is asked for."""
    return [
        _speed_rows(sensors, keyframe.speed_sigma, states.v_n[i])
        if np.isfinite(keyframe.speed_sigma)
        else no_rows(sensors)
        for i, keyframe in enumerate(keyframes)
    ]


def _speed_rows(sensors: Sensors, sigma: float, v_n: Array) -> Array:
    rows = np.zeros((3, sensors.state_dim + 1))
    rows[:, VELOCITY] = np.eye(3)
    rows[:, -1] = -v_n
    return rows / sigma


def _fix_rows(sensors: Sensors, keyframe: Keyframe, state: AugmentedStates) -> Array:
    n_fixes = len(keyframe.fix_n)
    fixes = Fixes(
        keyframe=np.zeros(n_fixes, np.intp),
        position_n=keyframe.fix_n,
        covariance_n=keyframe.fix_cov_n,
        gyro_b=np.broadcast_to(keyframe.gyro_b, (n_fixes, 3)),
        lever_arm_b=sensors.gnss_arm_b,
    )
    at = _row_states(state.take(np.zeros(n_fixes, np.intp)))
    error, jacobian = positions.fix_rows(fixes, sensors.extras, at, np.s_[:])
    rows = np.concatenate([jacobian, -error[..., None]], axis=-1)
    whitened = np.linalg.solve(np.linalg.cholesky(keyframe.fix_cov_n), rows)
    return np.asarray(whitened.reshape(-1, sensors.state_dim + 1))
