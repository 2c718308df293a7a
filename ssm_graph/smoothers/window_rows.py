"""Measurements of a window as whitened rows: ``A d = b``, ``b`` the last column; in bulk."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from factors.depth_height import height_residual
from factors.dvl_beam import beam_residual
from ssm_graph.base.frozen import Array
from ssm_graph.engine.error_state import GYRO_BIAS, POSITION, ROTATION, STATE_DIM, VELOCITY
from ssm_graph.engine.states import AugmentedStates
from ssm_graph.graph.aids import positions
from ssm_graph.graph.augmented_rows import AugmentedBeams, RowStates
from ssm_graph.graph.beam_rows import BeamRows, rows_of_beams
from ssm_graph.mission.aids import Fixes
from ssm_graph.mission.calibration import DEPTH_OFFSET
from ssm_graph.mission.heights import height_track, mean_rises
from ssm_graph.mission.problem import Beams
from ssm_graph.sensors.dvl import N_BEAMS
from ssm_graph.smoothers.keyframe import BeamSpeeds, Keyframe, Sensors

_SEEN_BY_BEAMS = np.r_[ROTATION, VELOCITY, GYRO_BIAS]


def seen_by_beams(sensors: Sensors) -> NDArray[np.intp]:
    """Return the components of the state that a beam may depend on."""
    return np.concatenate([_SEEN_BY_BEAMS, np.arange(STATE_DIM, sensors.state_dim)])


def beam_rows(sensors: Sensors, beams: BeamSpeeds, states: AugmentedStates) -> BeamRows:
    """Return errors (M,) in m/s and Jacobians (M, n) of beams, each with its own state."""
    if sensors.extras:
        return _augmented_rows(sensors, beams, states)
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


def _augmented_rows(sensors: Sensors, beams: BeamSpeeds, states: AugmentedStates) -> BeamRows:
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
        is_water=beams.is_water > 0.0,
        n_beams=N_BEAMS,
    )
    extended = AugmentedBeams(table, sensors.extras, sensors.frame)
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
