"""Rows of beams: as stated, through the water, and with an instrument that is to be calibrated.

Each row is as wide as the problem's extra variables ask for, see :mod:`ssm_graph.engine.extras`.
Columns of variables that there are not are left out, and the values of those are zero.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from factors.dvl_beam import beam_residual
from factors.dvl_calibration import (
    Back,
    CalibratedResidual,
    Instrument,
    Motion,
    calibrated_beam_residual,
    led_back,
    no_way_back,
    turned_instrument,
)
from factors.imu_errors import ACCEL, GYRO, SIZE, matrices
from factors.so3 import times
from factors.water_track import ThroughWater, through_water
from ssm_graph.base.earth import LocalFrame
from ssm_graph.base.frozen import Array
from ssm_graph.engine.error_state import ACCEL_BIAS, GYRO_BIAS, ROTATION, STATE_DIM, VELOCITY
from ssm_graph.engine.extras import Extras
from ssm_graph.graph.aids.aid import RowStates
from ssm_graph.mission.calibration import (
    CURRENT,
    CURRENT_UP,
    DVL_BEAM_SCALE,
    DVL_DRIFT,
    DVL_LEVER_ARM,
    DVL_MOUNTING,
    DVL_SCALE,
    DVL_TIME_OFFSET,
)
from ssm_graph.mission.imu_variables import columns_of_errors, imu_errors
from ssm_graph.mission.problem import Beams

LEAST_SHARE = 0.5
"""With less motion than noise in what the IMU reads, clock and lever arm cannot be seen."""


class BeamRows(NamedTuple):
    """Linearised beams, one row each, not whitened."""

    error: Array
    """(M,) m/s, predicted minus measured."""
    jacobian: Array
    """(M, 15) with respect to the keyframe's error state, (M, E) if there are extra variables."""


def linearize_beams(
    beams: Beams, *, rows: slice = np.s_[:], R_nb: Array, v_n: Array, bias: Array, omega_ie_n: Array
) -> BeamRows:
    """Linearise the beams of ``rows`` at states given for each row, or one for all."""
    residual = beam_residual(
        R_nb,
        v_n,
        bias[..., 3:],
        speed=beams.speed[rows],
        gyro_b=beams.gyro_b[rows],
        beam_b=beams.beam_b[rows],
        lever_arm_b=beams.lever_arm_b,
        omega_ie_n=omega_ie_n,
    )
    jacobian = np.zeros((len(residual.error), STATE_DIM))
    jacobian[:, ROTATION] = residual.error_D_rotation
    jacobian[:, VELOCITY] = residual.error_D_velocity_n
    jacobian[:, GYRO_BIAS] = residual.error_D_gyro_bias
    return BeamRows(residual.error, jacobian)


class WaterRows:
    """Beams of a problem, some of which may be off the water."""

    def __init__(self, beams: Beams, extras: Extras, frame: LocalFrame) -> None:
        self._is_water, self._extras, self._frame = beams.is_water, extras, frame
        self._has_current = CURRENT in extras

    def relative(self, v_n: Array, *, p_n: Array, walks: Array, rows: slice) -> ThroughWater | None:
        """Return velocities relative to what reflects each beam; None for all off the ground.

        Parameters
        ----------
        v_n, p_n : (M, 3) m/s and m, of each row, or (3,) of all.
        walks : (M, s) or (s,), extra variables of their keyframes.
        rows : which rows those are.
        """
        is_water = self._is_water[rows]
        if not (self._has_current and is_water.any()):
            return None
        R_nl = np.zeros((len(is_water), 3, 3))
        R_nl[is_water] = self._frame.R_nl_at(p_n if p_n.ndim == 1 else p_n[is_water])
        return through_water(v_n, self._current(walks), R_nl=R_nl, is_water=is_water)

    def fill(self, jacobian: Array, error_D_velocity_n: Array, relative: ThroughWater) -> None:
        """Write the columns of the current into rows (M, E) with those of the velocity (M, 3)."""
        block = (error_D_velocity_n[:, None, :] @ relative.v_D_current)[:, 0]
        jacobian[:, self._extras.columns(CURRENT)] = block[:, :2]
        if CURRENT_UP in self._extras:
            jacobian[:, self._extras.columns(CURRENT_UP)] = block[:, 2:]

    def _current(self, walks: Array) -> Array:
        """Return the current (..., 3) along east, north, up, m/s."""
        nothing = np.zeros(0)
        level = self._extras.value(CURRENT, walks, nothing, default=nothing)
        still = np.zeros((*level.shape[:-1], 1))
        return np.concatenate(
            [level, self._extras.value(CURRENT_UP, walks, nothing, default=still)], axis=-1
        )


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
    errors: tuple[Array, Array]
    """Of the inertial sensors, see :func:`ssm_graph.mission.imu_variables.imu_errors`"""
    constants: Array
    """(C,)"""
    read: Motion | None
    """(P, ...) what these read, as it is; None as ``back``"""


class CalibratedBeams:
    """Beam speeds of a problem whose DVL is to be calibrated, or tracks the water at times."""

    def __init__(self, beams: Beams, extras: Extras, frame: LocalFrame) -> None:
        self._beams, self._extras, self._omega_ie_n = beams, extras, frame.omega_ie_n
        self._water = WaterRows(beams, extras, frame)
        self._ping_keyframe = beams.keyframe[np.flatnonzero(np.diff(beams.ping, prepend=-1))]
        self._columns = columns_of_errors(extras)
        self._share = {DVL_TIME_OFFSET: 1.0, DVL_LEVER_ARM: 1.0}

    def judge(self, at: RowStates, bias: Array) -> None:
        """Find how much of what the IMU reads at the pings is motion, to calibrate no further.

        Clock and lever arm are seen through acceleration and rate as they are measured. Without
        motion that is noise, and a regression on noise invents an answer: of an offset ``x`` only
        ``share x`` is to be expected in the speeds. The share is that of motion in the squared
        derivative; noise is what three successive readings do not have in common with a line.

        Parameters
        ----------
        at : states of all beams.
        bias : (K, 6) of the keyframes.
        """
        if self._beams.motion is None:
            return
        prepared = self.prepare(at.walks, at.constants, bias)
        _, late_s = self.instrument_of(at.walks, at.constants)
        parts, ratio = self._beams.motion.in_thirds(float(late_s))
        whole = self._beams.motion.at(float(late_s))
        of_ping = bias[self._ping_keyframe]
        at, _ = self._relative(at, np.s_[:])
        found = [
            self._residual(at, prepared._replace(back=led_back(motion, of_ping, late_s)))
            for motion in (whole, *parts)
        ]
        for name, derivatives in (
            (DVL_TIME_OFFSET, [residual.error_D_time_offset for residual in found]),
            (DVL_LEVER_ARM, [residual.error_D_lever_arm_b for residual in found]),
        ):
            self._share[name] = _share_of_motion(*derivatives, ratio=ratio)

    def prepare(self, walks: Array, constants: Array, bias: Array) -> PreparedBeams:
        """Return what beams share; ``bias`` is (K, 6) of the keyframes, or (6,) of all."""
        beams, extras = self._beams, self._extras
        mounting, late_s = self.instrument_of(walks, constants)
        back, read, motion = None, None, beams.motion
        errors = imu_errors(extras, np.zeros(extras.n_walks), constants)
        if DVL_TIME_OFFSET in extras and motion is not None:
            of_ping = bias if bias.ndim == 1 else bias[self._ping_keyframe]
            read = motion.at(float(late_s))
            back = led_back(_taken_off(errors[0], read), of_ping, late_s)
        instrument = turned_instrument(
            mounting, beams.beam_b, R_bd=beams.R_bd, lever_arm_b=beams.lever_arm_b
        )
        of_all = bias if bias.ndim == 1 else None
        return PreparedBeams(instrument, back, mounting, late_s, of_all, errors, constants, read)

    def instrument_of(self, walks: Array, constants: Array) -> tuple[Array, Array]:
        """Return mounting (3,) and time offset (): what it takes long to prepare for.

        Of walks (M, s) that each row has of its own, both have as many rows.
        """
        mounting = self._value(DVL_MOUNTING, walks, constants, 3)
        late_s = self._value(DVL_TIME_OFFSET, walks, constants, 1)[..., 0]
        return mounting, self._share[DVL_TIME_OFFSET] * late_s

    def rows(self, at: RowStates, prepared: PreparedBeams, rows: slice = np.s_[:]) -> BeamRows:
        """Linearise beams at their states.

        Where they are prepared for other values of mounting, clock and biases, what these differ
        counts to first order.
        """
        beams, extras = self._beams, self._extras
        at, through = self._relative(at, rows)
        residual = self._residual(at, prepared, rows)
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
                jacobian[:, extras.columns(name)] = self._share.get(name, 1.0) * block
        if DVL_BEAM_SCALE in extras:
            first = extras.columns(DVL_BEAM_SCALE).start
            jacobian[np.arange(len(jacobian)), first + beams.beam[rows]] = residual.error_D_scale
        if through is not None:
            self._water.fill(jacobian, residual.error_D_velocity_n, through)
        if len(self._columns):
            jacobian[:, self._columns] = self._by_errors(residual, at, prepared, rows)
        error = residual.error
        if DVL_DRIFT in extras:
            # In instrument axes, and on top of what is read: no scale, no lever arm.
            beam_d = beams.beam_b[rows] @ beams.R_bd
            jacobian[:, extras.columns(DVL_DRIFT)] = beam_d
            drift_d = self._value(DVL_DRIFT, at.walks, at.constants, 3)
            error = error + np.sum(beam_d * drift_d, axis=-1)
        if prepared.bias is None:
            return BeamRows(error, jacobian)
        return BeamRows(error + jacobian @ self._since(at, prepared), jacobian)

    def _relative(self, at: RowStates, rows: slice) -> tuple[RowStates, ThroughWater | None]:
        """Return the states with velocities relative to what reflects each beam."""
        through = self._water.relative(at.v_n, p_n=at.p_n, walks=at.walks, rows=rows)
        return at if through is None else at._replace(v_n=through.v_n), through

    def _residual(
        self, at: RowStates, prepared: PreparedBeams, rows: slice = np.s_[:]
    ) -> CalibratedResidual:
        beams = self._beams
        if prepared.back is None:
            gyro_b = beams.gyro_b[rows]
            if len(self._columns):
                errors, _ = self._errors_at(at, prepared)
                gyro_b = gyro_b - times(matrices(errors)[0], gyro_b)
            back = no_way_back(gyro_b)
        else:
            back = _of_pings(prepared.back, beams.ping[rows])
        lever = self._share[DVL_LEVER_ARM] * self._value(DVL_LEVER_ARM, at.walks, at.constants, 3)
        instrument = prepared.instrument
        return calibrated_beam_residual(
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

    def _errors_at(self, at: RowStates, prepared: PreparedBeams) -> tuple[Array, Array]:
        """Return the errors of the inertial sensors, (M, 27) or (27,), and their slope."""
        if prepared.bias is not None:
            return prepared.errors
        return imu_errors(self._extras, at.walks, at.constants)

    def _by_errors(
        self, residual: CalibratedResidual, at: RowStates, prepared: PreparedBeams, rows: slice
    ) -> Array:
        """Return derivatives (M, E) by errors of the inertial sensors: biases that are known.

        What gyros read of the force, 1e-5 m/s at a lever arm of 1 m, is left out.
        """
        gyro_b, n_rows = self._beams.gyro_b[rows], len(residual.error)
        found = np.zeros((n_rows, SIZE))
        if prepared.read is not None:
            ping = self._beams.ping[rows]
            gyro_b, accel_b = prepared.read.gyro_b[ping], prepared.read.accel_b[ping]
            block = residual.error_D_accel_bias[..., None] * accel_b[:, None]
            found[:, ACCEL] = block.reshape(n_rows, 9)
        found[:, GYRO] = (residual.error_D_gyro_bias[..., None] * gyro_b[:, None]).reshape(-1, 9)
        _, slope = self._errors_at(at, prepared)
        return np.asarray((found[:, None] @ slope)[:, 0])

    def _since(self, at: RowStates, prepared: PreparedBeams) -> Array:
        """Return how far the variables (E,) are from what the beams are prepared for."""
        extras, since = self._extras, np.zeros(self._extras.width)
        assert prepared.bias is not None
        since[STATE_DIM - 6 : STATE_DIM] = at.bias - prepared.bias
        moved_on = np.concatenate([at.walks, at.constants - prepared.constants])
        since[self._columns] = moved_on[self._columns - STATE_DIM]
        mounting, late_s = self.instrument_of(at.walks, at.constants)
        if DVL_MOUNTING in extras:
            since[extras.columns(DVL_MOUNTING)] = mounting - prepared.mounting
        if DVL_TIME_OFFSET in extras and self._share[DVL_TIME_OFFSET] > 0.0:
            moved = (late_s - prepared.time_offset) / self._share[DVL_TIME_OFFSET]
            since[extras.columns(DVL_TIME_OFFSET)] = moved
        return since

    def _scale(self, at: RowStates, beam: NDArray[np.intp]) -> Array:
        scale = self._value(DVL_SCALE, at.walks, at.constants, 1)[..., 0]
        if DVL_BEAM_SCALE not in self._extras:
            return scale
        of_beams = self._value(DVL_BEAM_SCALE, at.walks, at.constants, 1)
        own = of_beams[beam] if of_beams.ndim == 1 else of_beams[np.arange(len(beam)), beam]
        return np.asarray(scale + own)

    def _value(self, name: str, walks: Array, constants: Array, size: int) -> Array:
        return self._extras.value(name, walks, constants, default=np.zeros(size))


def _share_of_motion(
    whole: Array, first: Array, second: Array, third: Array, *, ratio: float
) -> float:
    """Return how much of the squares of ``whole`` is motion, 0 if it is little or there is none.

    ``first``, ``second`` and ``third`` are the same in three successive parts of the ping, with
    ``ratio`` times the variance of noise in each.
    """
    if whole.size == 0:
        return 0.0
    noise = float(np.mean((first - 2.0 * second + third) ** 2)) / (6.0 * ratio)
    power = float(np.mean(whole**2))
    share = 1.0 - noise / power if power > 0.0 else 0.0
    return share if share > LEAST_SHARE else 0.0


def _taken_off(errors: Array, read: Motion) -> Motion:
    """Return what was read about pings without errors (27,) of the sensors, but of the force."""
    if not errors.any():
        return read
    W, A, _ = matrices(errors)
    of_gyro = (W, A, W, A, W)
    columns = (own - own @ M.T for own, M in zip(read, of_gyro, strict=True))
    return Motion(*columns)


def _of_pings(back: Back, ping: NDArray[np.intp]) -> Back:
    """Return the way back of each row, or once for all rows of one ping, from that of all pings."""
    if len(ping) and ping[0] == ping[-1]:
        ping = ping[0]
    return Back(
        time_offset=back.time_offset,
        R_back=back.R_back[ping],
        J_back=back.J_back[ping],
        gain_b=back.gain_b[ping],
        motion=Motion(*(column[ping] for column in back.motion)),
    )
