"""Speed along one beam of a DVL that is not quite what is written about it.

What may be off: the mounting, the scale, the lever arm, and the clock. Each is a variable of its
own, and each is zero for the instrument as stated; the residual is then that of
:mod:`factors.dvl_beam`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import gtsam
import numpy as np
from numpy.typing import NDArray

from factors import so3
from factors.dvl_beam import beam_error, beam_residual
from factors.so3 import cross

Array = NDArray[np.float64]


class Miscalibration(NamedTuple):
    """How an instrument differs from what is stated; leading axes broadcast with the beams."""

    mounting: Array
    """(..., 3) rotation vector, instrument axes, rad: truly ``R_bd Exp(mounting)``."""
    scale: Array
    """(...) speeds are read ``1 + scale`` too large."""
    lever_arm_b: Array
    """(..., 3) m, to be added to the stated lever arm."""
    time_offset: Array
    """(...) s; positive when stamps are late: the speed belongs to so much before the keyframe."""


class Motion(NamedTuple):
    """What the inertial sensors read before and at the ping; zeros where no clock is in doubt."""

    turn_b: Array
    """(..., 3) rad, rotation from the ping to the keyframe, by the gyros."""
    gain_b: Array
    """(..., 3) m/s, velocity change from the ping to the keyframe by specific force, along the
    body axes at the keyframe."""
    gyro_b: Array
    """(..., 3) rad/s, at the ping."""
    accel_b: Array
    """(..., 3) m/s^2, at the ping."""
    gyro_rate_b: Array
    """(..., 3) rad/s^2, at the ping."""


class CalibratedResidual(NamedTuple):
    """Residuals of DVL beams and their Jacobian blocks; leading axes broadcast."""

    error: Array
    """(...) m/s, predicted minus measured."""
    error_D_rotation: Array
    """(..., 3) with respect to ``phi`` in ``R_nb @ Exp(phi)``."""
    error_D_velocity_n: Array
    """(..., 3)"""
    error_D_accel_bias: Array
    """(..., 3)"""
    error_D_gyro_bias: Array
    """(..., 3)"""
    error_D_mounting: Array
    """(..., 3)"""
    error_D_scale: Array
    """(...)"""
    error_D_lever_arm_b: Array
    """(..., 3)"""
    error_D_time_offset: Array
    """(...)"""


def calibrated_beam_residual(
    R_nb: Array,
    v_n: Array,
    bias: Array,
    *,
    off: Miscalibration,
    motion: Motion,
    speed: Array,
    beam_b: Array,
    R_bd: Array,
    lever_arm_b: Array,
    omega_ie_n: Array,
    g_n: Array,
) -> CalibratedResidual:
    """Return residuals of DVL beams with Jacobians of state and calibration.

    With the time offset ``tau``, the state at the ping follows from that at the keyframe by what
    the inertial sensors read in between::

        R_nb(t - tau) = R_nb Exp(-(turn_b - tau gyro_bias))
        v_n(t - tau)  = v_n - R_nb (gain_b - tau accel_bias) - tau g_n

    and with ``beam_b' = R_bd Exp(mounting) R_bd' beam_b`` and the lever arm with its error::

        error = (1 + scale) beam_b' . (R_nb' v_n + omega_eb_b x lever') - speed,  all at t - tau

    The turn of the Earth within ``tau`` is left out: 1e-5 m/s at 0.1 s and 1.5 m/s.

    Parameters
    ----------
    R_nb : (..., 3, 3) rotation, body to navigation, at the keyframe.
    v_n : (..., 3) velocity of the body origin over ground, m/s, at the keyframe.
    bias : (..., 6) accelerometer bias, m/s^2, and gyro bias, rad/s.
    off : the calibration.
    motion : inertial readings before and at the ping, for the ``tau`` of ``off``.
    speed : (...) measured beam speed, m/s, positive when the instrument moves along the beam.
    beam_b : (..., 3) beam direction as stated, body axes; longer than one by a known scale error.
    R_bd : (3, 3) mounting as stated, instrument to body.
    lever_arm_b : (3,) body origin to DVL as stated, m.
    omega_ie_n : (3,) Earth rate, rad/s.
    g_n : (..., 3) gravity, m/s^2; it counts only with a time offset.
    """
    then = _state_then(R_nb, v_n, bias, off.time_offset, motion, g_n)
    lever = lever_arm_b + off.lever_arm_b
    mounting_b = off.mounting @ R_bd.T
    beam = _times(so3.exp(mounting_b), beam_b)
    at_ping = beam_residual(
        then.R_nb,
        then.v_n,
        bias[..., 3:],
        speed=np.zeros_like(speed),
        gyro_b=motion.gyro_b,
        beam_b=beam,
        lever_arm_b=lever,
        omega_ie_n=omega_ie_n,
    )
    D_phi, D_v = at_ping.error_D_rotation, at_ping.error_D_velocity_n
    D_gyro_bias = at_ping.error_D_gyro_bias
    omega_eb = then.omega_b - _times(_T(then.R_nb), omega_ie_n)
    at_instrument = _times(_T(then.R_nb), then.v_n) + cross(omega_eb, lever)
    D_gain = _times(_T(R_nb), D_v)
    D_late = (D_gyro_bias * motion.gyro_rate_b - D_phi * then.omega_b - D_v * then.a_n).sum(axis=-1)
    turned_back = so3.left_jacobian_times(-then.turn, D_phi)
    tau = np.asarray(off.time_offset)[..., None]
    gain_1 = np.asarray(1.0 + off.scale)
    gain_3 = gain_1[..., None]
    D_mounting_b = _times(_T(so3.left_jacobian(mounting_b)), cross(beam, at_instrument))
    return CalibratedResidual(
        error=gain_1 * at_ping.error - speed,
        error_D_rotation=gain_3 * (_times(then.R_back, D_phi) + cross(D_gain, then.gain)),
        error_D_velocity_n=gain_3 * D_v,
        error_D_accel_bias=gain_3 * tau * D_gain,
        error_D_gyro_bias=gain_3 * (D_gyro_bias + tau * turned_back),
        error_D_mounting=gain_3 * (D_mounting_b @ R_bd),
        error_D_scale=at_ping.error,
        error_D_lever_arm_b=gain_3 * cross(beam, omega_eb),
        error_D_time_offset=gain_1 * D_late,
    )


def calibrated_beam_error(
    R_nb: Array,
    v_n: Array,
    bias: Array,
    *,
    off: Miscalibration,
    motion: Motion,
    speed: Array,
    beam_b: Array,
    R_bd: Array,
    lever_arm_b: Array,
    omega_ie_n: Array,
    g_n: Array,
) -> Array:
    """Return predicted minus measured speed, m/s; see :func:`calibrated_beam_residual`."""
    then = _state_then(R_nb, v_n, bias, off.time_offset, motion, g_n)
    predicted = beam_error(
        then.R_nb,
        then.v_n,
        bias[..., 3:],
        speed=np.zeros_like(speed),
        gyro_b=motion.gyro_b,
        beam_b=_times(so3.exp(off.mounting @ R_bd.T), beam_b),
        lever_arm_b=lever_arm_b + off.lever_arm_b,
        omega_ie_n=omega_ie_n,
    )
    return np.asarray((1.0 + off.scale) * predicted - speed)


class _Then(NamedTuple):
    """The state when a ping was taken, and what leads there from its keyframe."""

    R_nb: Array
    v_n: Array
    a_n: Array
    """(..., 3) m/s^2"""
    omega_b: Array
    """(..., 3) rad/s, relative to inertial space"""
    R_back: Array
    """(..., 3, 3) body at the ping to body at the keyframe"""
    turn: Array
    """(..., 3) rad, and m/s below, less what the biases make of them"""
    gain: Array


def _state_then(
    R_nb: Array, v_n: Array, bias: Array, time_offset: Array, motion: Motion, g_n: Array
) -> _Then:
    tau = np.asarray(time_offset)[..., None]
    accel_bias, gyro_bias = bias[..., :3], bias[..., 3:]
    turn = motion.turn_b - tau * gyro_bias
    gain = motion.gain_b - tau * accel_bias
    R_back = so3.exp(-turn)
    R_then = R_nb @ R_back
    return _Then(
        R_nb=R_then,
        v_n=v_n - _times(R_nb, gain) - tau * g_n,
        a_n=_times(R_then, motion.accel_b) - _times(R_nb, accel_bias) + g_n,
        omega_b=motion.gyro_b - gyro_bias,
        R_back=R_back,
        turn=turn,
        gain=gain,
    )


def calibrated_beam_factor(
    state: tuple[int, int, int],
    *,
    mounting: int,
    scale: int,
    lever_arm: int,
    time_offset: int,
    motion: Callable[[float], Motion],
    sigma: float,
    speed: float,
    **stated: Array,
) -> gtsam.CustomFactor:
    """Wrap :func:`calibrated_beam_residual` as a factor for anyone's own graph.

    Parameters
    ----------
    state : keys of ``Pose3``, velocity and ``ConstantBias``.
    mounting, scale, lever_arm, time_offset : keys of vectors of 3, 1, 3 and 1.
    motion : the inertial readings of the ping for a time offset.
    sigma : standard deviation of the speed, m/s.
    speed : measured, m/s.
    stated : the other arguments of :func:`calibrated_beam_residual`, for one beam.
    """

    def evaluate(
        this: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Array] | None
    ) -> Array:
        pose, velocity, bias, *others = this.keys()
        mounting_at, scale_at, arm_at, late = (values.atVector(key) for key in others)
        at = (
            values.atPose3(pose).rotation().matrix(),
            values.atVector(velocity),
            values.atConstantBias(bias).vector(),
        )
        how: dict[str, Any] = {
            "off": Miscalibration(mounting_at, scale_at[0], arm_at, late[0]),
            "motion": motion(float(late[0])),
            "speed": np.float64(speed),
            **stated,
        }
        if jacobians is None:
            return np.atleast_1d(calibrated_beam_error(*at, **how))
        residual = calibrated_beam_residual(*at, **how)
        # Pose3 tangent: [rotation, translation]; ConstantBias: [accelerometer, gyroscope].
        jacobians[0] = np.hstack([residual.error_D_rotation, np.zeros(3)])[None, :]
        jacobians[1] = residual.error_D_velocity_n[None, :].copy()
        biases = [residual.error_D_accel_bias, residual.error_D_gyro_bias]
        jacobians[2] = np.hstack(biases)[None, :]
        for i, block in enumerate(residual[5:], start=3):
            jacobians[i] = np.reshape(block, (1, -1)).copy()
        return np.atleast_1d(residual.error)

    keys = [*state, mounting, scale, lever_arm, time_offset]
    return gtsam.CustomFactor(gtsam.noiseModel.Isotropic.Sigma(1, sigma), keys, evaluate)


def _times(matrix: Array, vector: Array) -> Array:
    return np.asarray((matrix @ vector[..., None])[..., 0])


def _T(matrix: Array) -> Array:
    return np.swapaxes(matrix, -1, -2)
