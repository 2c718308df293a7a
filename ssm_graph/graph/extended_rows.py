"""Rows of measurements that depend on more than their keyframe's error state.

Each row is as wide as the problem's extra variables ask for, see :mod:`ssm_graph.problem.extras`.
Columns of variables that there are not are left out, and the values of those are zero.
"""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from factors.depth_height import height_residual
from factors.dvl_calibration import (
    Back,
    Instrument,
    Motion,
    calibrated_beam_residual,
    led_back,
    no_way_back,
    turned_instrument,
)
from factors.gnss_position import fix_residual
from ssm_graph.data import N_BEAMS, Array
from ssm_graph.graph.depth import DepthTargets, depth_targets
from ssm_graph.graph.interfaces import BeamRows
from ssm_graph.graph.states import States
from ssm_graph.problem.calibration import (
    DEPTH_OFFSET,
    DVL_BEAM_SCALE,
    DVL_LEVER_ARM,
    DVL_MOUNTING,
    DVL_SCALE,
    DVL_TIME_OFFSET,
    GNSS_LEVER_ARM,
    GNSS_TIME_OFFSET,
)
from ssm_graph.problem.error_state import (
    ACCEL_BIAS,
    GYRO_BIAS,
    POSITION,
    ROTATION,
    STATE_DIM,
    VELOCITY,
)
from ssm_graph.problem.extras import Extras
from ssm_graph.problem.problem import Beams, Depths, Fixes, Problem

Rows = slice | NDArray[np.intp]


class RowStates(NamedTuple):
    """The state of each row's own keyframe, or one for all rows."""

    R_nb: Array
    p_n: Array
    v_n: Array
    bias: Array
    walks: Array
    constants: Array
    """(C,) the same for all"""
    g_n: Array
    """Gravity, m/s^2; a clock in doubt asks for it"""


def states_of(states: States, keyframe: NDArray[np.intp], *, g_n: Array) -> RowStates:
    """Return the states of rows from those of all keyframes, ``g_n`` (K, 3) with them."""
    columns = (states.R_nb, states.p_n, states.v_n, states.bias, states.walks, g_n)
    R_nb, p_n, v_n, bias, walks, gravity = (column[keyframe] for column in columns)
    return RowStates(R_nb, p_n, v_n, bias, walks, states.constants, gravity)


class PreparedBeams(NamedTuple):
    """What all beams of a problem share, made for one set of calibrations and biases."""

    instrument: Instrument
    """(M, ...)"""
    back: Back | None
    """(P, ...) of the pings; None where the clock is not in doubt"""
    mounting: Array
    time_offset: Array
    bias: Array | None
    """(6,) of all pings; None where each has that of its keyframe"""


class ExtendedBeams:
    """Beam speeds of a problem whose DVL is to be calibrated."""

    def __init__(self, beams: Beams, extras: Extras, omega_ie_n: Array) -> None:
        self._beams, self._extras, self._omega_ie_n = beams, extras, omega_ie_n
        self._ping_keyframe = beams.keyframe[np.flatnonzero(np.diff(beams.ping, prepend=-1))]

    def prepare(self, walks: Array, constants: Array, bias: Array) -> PreparedBeams:
        """Return what beams share; ``bias`` is (K, 6) of the keyframes, or (6,) of all."""
        beams, extras = self._beams, self._extras
        mounting, late_s = self.instrument_of(walks, constants)
        back, motion = None, beams.motion
        if DVL_TIME_OFFSET in extras and motion is not None:
            of_ping = bias if bias.ndim == 1 else bias[self._ping_keyframe]
            back = led_back(motion.at(float(late_s)), of_ping, late_s)
        instrument = turned_instrument(
            mounting, beams.beam_b, R_bd=beams.R_bd, lever_arm_b=beams.lever_arm_b
        )
        return PreparedBeams(instrument, back, mounting, late_s, bias if bias.ndim == 1 else None)

    def instrument_of(self, walks: Array, constants: Array) -> tuple[Array, Array]:
        """Return mounting (3,) and time offset (): what it takes long to prepare for."""
        mounting = self._value(DVL_MOUNTING, walks, constants, 3)
        return mounting, self._value(DVL_TIME_OFFSET, walks, constants, 1)[0]

    def rows(self, at: RowStates, prepared: PreparedBeams, rows: Rows = np.s_[:]) -> BeamRows:
        """Linearise beams at their states.

        Where they are prepared for other values of mounting, clock and biases, what these differ
        counts to first order.
        """
        beams, extras = self._beams, self._extras
        back = no_way_back(beams.gyro_b[rows])
        if prepared.back is not None:
            back = _of_pings(prepared.back, beams.ping[rows])
        lever = self._value(DVL_LEVER_ARM, at.walks, at.constants, 3)
        instrument = prepared.instrument
        residual = calibrated_beam_residual(
            at.R_nb,
            at.v_n,
            at.bias if prepared.bias is None else prepared.bias,
            instrument=instrument._replace(
                beam_b=instrument.beam_b[rows], lever_arm_b=instrument.lever_arm_b + lever
            ),
            scale=self._scale(at, beams.beam[rows]),
            back=back,
            speed=beams.speed[rows],
            omega_ie_n=self._omega_ie_n,
            g_n=at.g_n,
        )
        jacobian = np.zeros((len(residual.error), extras.width))
        jacobian[:, ROTATION] = residual.error_D_rotation
        jacobian[:, VELOCITY] = residual.error_D_velocity_n
        jacobian[:, ACCEL_BIAS] = residual.error_D_accel_bias
        jacobian[:, GYRO_BIAS] = residual.error_D_gyro_bias
        for name, block in (
            (DVL_SCALE, residual.error_D_scale[:, None]),
            (DVL_MOUNTING, residual.error_D_mounting),
            (DVL_LEVER_ARM, residual.error_D_lever_arm_b),
            (DVL_TIME_OFFSET, residual.error_D_time_offset[:, None]),
        ):
            if name in extras:
                jacobian[:, extras.columns(name)] = block
        if DVL_BEAM_SCALE in extras:
            first = extras.columns(DVL_BEAM_SCALE).start
            jacobian[np.arange(len(jacobian)), first + beams.beam[rows]] = residual.error_D_scale
        if prepared.bias is None:
            return BeamRows(residual.error, jacobian)
        return BeamRows(residual.error + jacobian @ self._since(at, prepared), jacobian)

    def _since(self, at: RowStates, prepared: PreparedBeams) -> Array:
        """Return how far the variables (E,) are from what the beams are prepared for."""
        extras, since = self._extras, np.zeros(self._extras.width)
        assert prepared.bias is not None
        since[STATE_DIM - 6 : STATE_DIM] = at.bias - prepared.bias
        mounting, late_s = self.instrument_of(at.walks, at.constants)
        if DVL_MOUNTING in extras:
            since[extras.columns(DVL_MOUNTING)] = mounting - prepared.mounting
        if DVL_TIME_OFFSET in extras:
            since[extras.columns(DVL_TIME_OFFSET)] = late_s - prepared.time_offset
        return since

    def _scale(self, at: RowStates, beam: NDArray[np.intp]) -> Array:
        scale = self._value(DVL_SCALE, at.walks, at.constants, 1)[..., 0]
        return scale + self._value(DVL_BEAM_SCALE, at.walks, at.constants, N_BEAMS)[beam]

    def _value(self, name: str, walks: Array, constants: Array, size: int) -> Array:
        return self._extras.value(name, walks, constants, default=np.zeros(size))


def _of_pings(back: Back, ping: NDArray[np.intp]) -> Back:
    """Return the way back of each row from that of all pings."""
    return Back(
        time_offset=back.time_offset,
        R_back=back.R_back[ping],
        J_back=back.J_back[ping],
        gain_b=back.gain_b[ping],
        motion=Motion(*(column[ping] for column in back.motion)),
    )


class AidRows(NamedTuple):
    """Whitened rows of an aid, ``A d = b`` with ``b`` minus the error."""

    keyframe: NDArray[np.intp]
    """(M,)"""
    error: Array
    """(M,)"""
    jacobian: Array
    """(M, width)"""


class Aid(Protocol):
    """A kind of measurement beside the beams: it counts in full, without a weight."""

    name: str
    dim: int
    """Rows of one measurement"""

    def follow(self, states: States) -> None:
        """Let what is only slowly a function of the states follow them."""

    def rows(self, states: States) -> AidRows:
        """Linearise at ``states``."""


class DepthAid:
    """Depth, with an offset where one is asked for."""

    name = "depth"
    dim = 1

    def __init__(self, problem: Problem, depths: Depths) -> None:
        self._problem, self._depths = problem, depths
        self._targets: DepthTargets | None = None

    def follow(self, states: States) -> None:
        """Lead the readings along the track of ``states``."""
        problem = self._problem
        self._targets = depth_targets(self._depths, states, problem.frame, problem.keyframe_s)

    def rows(self, states: States) -> AidRows:
        """Return one row for each keyframe with a reading; to be called after :meth:`follow`."""
        assert self._targets is not None
        extras, (k, target_n, up_n, root) = self._problem.extras, self._targets
        offset = extras.value(DEPTH_OFFSET, states.walks[k], states.constants, default=np.zeros(1))[
            ..., 0
        ]
        residual = height_residual(
            states.R_nb[k],
            states.p_n[k],
            lever_arm_b=self._depths.lever_arm_b,
            offset=offset,
            up_n=up_n,
            target_n=target_n,
        )
        jacobian = np.zeros((len(k), extras.width))
        jacobian[:, ROTATION] = residual.error_D_rotation
        jacobian[:, POSITION] = residual.error_D_position
        if DEPTH_OFFSET in extras:
            jacobian[:, extras.columns(DEPTH_OFFSET)] = residual.error_D_offset[:, None]
        return AidRows(k, residual.error * root, jacobian * root[:, None])


class GnssAid:
    """Position fixes, with lever arm and clock in doubt where that is asked for."""

    name = "GNSS"
    dim = 3

    def __init__(self, problem: Problem, fixes: Fixes) -> None:
        self._extras, self._fixes = problem.extras, fixes
        self._whiten = np.linalg.inv(np.linalg.cholesky(fixes.covariance_n))

    def follow(self, states: States) -> None:
        """Do nothing: a fix is where it is."""

    def rows(self, states: States) -> AidRows:
        """Return three rows for each fix."""
        keyframe = self._fixes.keyframe
        at = states_of(states, keyframe, g_n=states.p_n)
        error, jacobian = fix_rows(self._fixes, self._extras, at, np.s_[:])
        return AidRows(
            np.repeat(keyframe, 3),
            (self._whiten @ error[..., None])[..., 0].ravel(),
            (self._whiten @ jacobian).reshape(-1, self._extras.width),
        )


def fix_rows(fixes: Fixes, extras: Extras, at: RowStates, rows: Rows | int) -> tuple[Array, Array]:
    """Return errors (F, 3), m, and Jacobians (F, 3, width) of fixes, not whitened."""
    nothing = np.zeros(3)
    late_s = extras.value(GNSS_TIME_OFFSET, at.walks, at.constants, default=nothing)[..., 0]
    lever = extras.value(GNSS_LEVER_ARM, at.walks, at.constants, default=nothing)
    residual = fix_residual(
        at.R_nb,
        at.p_n,
        at.v_n,
        lever_arm_b=fixes.lever_arm_b + lever,
        time_offset=late_s,
        omega_b=fixes.gyro_b[rows] - at.bias[..., 3:],
        position_n=fixes.position_n[rows],
    )
    jacobian = np.zeros((*residual.error.shape, extras.width))
    jacobian[..., ROTATION] = residual.error_D_rotation
    jacobian[..., POSITION] = residual.error_D_position
    jacobian[..., VELOCITY] = residual.error_D_velocity_n
    if GNSS_LEVER_ARM in extras:
        jacobian[..., extras.columns(GNSS_LEVER_ARM)] = residual.error_D_lever_arm_b
    if GNSS_TIME_OFFSET in extras:
        jacobian[..., extras.columns(GNSS_TIME_OFFSET)] = residual.error_D_time_offset[..., None]
    return residual.error, jacobian
