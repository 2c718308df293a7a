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

from factors import so3
from factors.dvl_beam import beam_error
from factors.so3 import Array, cross, times


class Motion(NamedTuple):
    """What the inertial sensors read before and at a ping."""

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


class Back(NamedTuple):
    """How the state at a ping follows from that at its keyframe; leading axes broadcast."""

    time_offset: Array
    """(...) s; positive when stamps are late: the ping is so much before the keyframe."""
    R_back: Array
    """(..., 3, 3) body at the ping to body at the keyframe."""
    J_back: Array
    """(..., 3, 3) its turn with respect to that of the gyro bias."""
    gain_b: Array
    """(..., 3) m/s, by specific force, along the body axes at the keyframe."""
    motion: Motion


class Instrument(NamedTuple):
    """A DVL as it is mounted, its error taken in."""

    beam_b: Array
    """(..., 3) beam direction, body axes; longer than one by a known scale error."""
    turn_D_mounting: Array
    """(3, 3), or (..., 3, 3) for errors of their own: how it turns in the body with the mounting
    error."""
    lever_arm_b: Array
    """(3,) m, body origin to DVL."""


def led_back(motion: Motion, bias: Array, time_offset: Array) -> Back:
    """Return the way back from keyframe to ping for a time offset and the biases at hand.

    ::

        R_nb(t - tau) = R_nb Exp(-(turn_b - tau gyro_bias))
        v_n(t - tau)  = v_n - R_nb (gain_b - tau accel_bias) - tau g_n

    The turn of the Earth within ``tau`` is left out: 1e-5 m/s at 0.1 s and 1.5 m/s.

    Parameters
    ----------
    motion : inertial readings of the pings (...) for this offset.
    bias : (..., 6) accelerometer bias, m/s^2, and gyro bias, rad/s.
    time_offset : tau, s.
    """
    tau = np.asarray(time_offset)[..., None]
    turn = motion.turn_b - tau * bias[..., 3:]
    gain = motion.gain_b - tau * bias[..., :3]
    return Back(time_offset, so3.exp(-turn), so3.left_jacobian(-turn), gain, motion)


def no_way_back(gyro_b: Array) -> Back:
    """Return that of a ping at its keyframe, with the gyro reading (..., 3) there."""
    still, same = np.zeros(3), np.eye(3)
    return Back(np.zeros(()), same, same, still, Motion(still, still, gyro_b, still, still))


def turned_instrument(
    mounting: Array, beam_b: Array, *, R_bd: Array, lever_arm_b: Array
) -> Instrument:
    """Return the instrument with its mounting error: ``beam_b' = R_bd Exp(mounting) R_bd' beam_b``.

    Parameters
    ----------
    mounting : (3,) rotation vector, instrument axes, rad: truly ``R_bd Exp(mounting)``; or
        (..., 3), one for each beam direction.
    beam_b : (..., 3) beam directions as stated, body axes.
    R_bd : (3, 3) mounting as stated, instrument to body.
    lever_arm_b : (3,) m, with its error.
    """
    mounting_b = times(R_bd, mounting)
    beam = times(so3.exp(mounting_b), beam_b)
    return Instrument(beam, so3.left_jacobian(mounting_b) @ R_bd, lever_arm_b)


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
    instrument: Instrument,
    scale: Array,
    back: Back,
    speed: Array,
    omega_ie_n: Array,
    g_n: Array,
) -> CalibratedResidual:
    """Return residuals of DVL beams with Jacobians of state and calibration.

    With all states at the ping, see :func:`led_back`, and the instrument as it is mounted::

        error = (1 + scale) beam_b . (R_nb' v_n + omega_eb_b x lever_arm_b) - speed

    Parameters
    ----------
    R_nb : (..., 3, 3) rotation, body to navigation, at the keyframe.
    v_n : (..., 3) velocity of the body origin over ground, m/s, at the keyframe.
    bias : (..., 6) accelerometer bias, m/s^2, and gyro bias, rad/s.
    instrument : from :func:`turned_instrument`.
    scale : (...) speeds are read ``1 + scale`` too large.
    back : from :func:`led_back` for these biases.
    speed : (...) measured beam speed, m/s, positive when the instrument moves along the beam.
    omega_ie_n : (3,) Earth rate, rad/s.
    g_n : (..., 3) gravity, m/s^2; it counts only with a time offset.
    """
    beam, turn_D_mounting, lever = instrument
    tau, R_back, J_back, gain, motion = back
    tau = np.asarray(tau)[..., None]
    R_then = R_nb @ R_back
    v_then = v_n - times(R_nb, gain) - tau * g_n
    R_then_T = R_then.mT
    omega_ib = motion.gyro_b - bias[..., 3:]
    omega_ie_b = times(R_then_T, omega_ie_n)
    v_b, omega_eb = times(R_then_T, v_then), omega_ib - omega_ie_b
    swing_b = cross(omega_eb, lever)
    predicted = (beam * (v_b + swing_b)).sum(axis=-1)
    # All products of the beam at once: a single one costs as much as four.
    factors = np.empty((4, *predicted.shape, 3))
    factors[0], factors[1], factors[2], factors[3] = v_b, swing_b, omega_eb, -lever
    beam_x_v, beam_x_swing, beam_x_omega, arm = cross(beam, factors)
    # With respect to the attitude then: of the velocity, and of the Earth rate in omega_eb.
    D_phi = beam_x_v - cross(arm, omega_ie_b)
    D_v_b = times(R_back, beam)
    D_phi_now = times(R_back, D_phi)
    a_then_b = motion.accel_b + times(R_then_T, g_n - times(R_nb, bias[..., :3]))
    D_late = -(D_phi * omega_ib + beam * a_then_b + arm * motion.gyro_rate_b).sum(axis=-1)
    gain_1 = np.asarray(1.0 + scale)
    gain_3 = gain_1[..., None]
    return CalibratedResidual(
        error=gain_1 * predicted - speed,
        error_D_rotation=gain_3 * (D_phi_now + cross(D_v_b, gain)),
        error_D_velocity_n=gain_3 * times(R_nb, D_v_b),
        error_D_accel_bias=gain_3 * tau * D_v_b,
        error_D_gyro_bias=gain_3 * (tau * times(J_back, D_phi) - arm),
        error_D_mounting=gain_3 * times(turn_D_mounting.mT, beam_x_v + beam_x_swing),
        error_D_scale=predicted,
        error_D_lever_arm_b=gain_3 * beam_x_omega,
        error_D_time_offset=gain_1 * D_late,
    )


def calibrated_beam_error(
    R_nb: Array,
    v_n: Array,
    bias: Array,
    *,
    instrument: Instrument,
    scale: Array,
    back: Back,
    speed: Array,
    omega_ie_n: Array,
    g_n: Array,
) -> Array:
    """Return predicted minus measured speed, m/s; see :func:`calibrated_beam_residual`."""
    R_then = R_nb @ back.R_back
    predicted = beam_error(
        R_then,
        v_n - times(R_nb, back.gain_b) - np.asarray(back.time_offset)[..., None] * g_n,
        bias[..., 3:],
        speed=np.zeros_like(speed),
        gyro_b=back.motion.gyro_b,
        beam_b=instrument.beam_b,
        lever_arm_b=instrument.lever_arm_b,
        omega_ie_n=omega_ie_n,
    )
    return np.asarray((1.0 + scale) * predicted - speed)


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
    beam_b: Array,
    R_bd: Array,
    lever_arm_b: Array,
    omega_ie_n: Array,
    g_n: Array,
) -> gtsam.CustomFactor:
    """Wrap :func:`calibrated_beam_residual` as a factor for anyone's own graph.

    Parameters
    ----------
    state : keys of ``Pose3``, velocity and ``ConstantBias``.
    mounting, scale, lever_arm, time_offset : keys of vectors of 3, 1, 3 and 1.
    motion : the inertial readings of the ping for a time offset.
    sigma : standard deviation of the speed, m/s.
    speed, omega_ie_n, g_n : as in :func:`calibrated_beam_residual`, for one beam.
    beam_b, R_bd, lever_arm_b : as stated.
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
            "instrument": turned_instrument(
                mounting_at, beam_b, R_bd=R_bd, lever_arm_b=lever_arm_b + arm_at
            ),
            "scale": scale_at[0],
            "back": led_back(motion(float(late[0])), at[2], late[0]),
            "speed": np.float64(speed),
            "omega_ie_n": omega_ie_n,
            "g_n": g_n,
        }
        if jacobians is None:
            return np.atleast_1d(calibrated_beam_error(*at, **how))
        residual = calibrated_beam_residual(*at, **how)
        for i, block in enumerate(_blocks(residual)):
            jacobians[i] = block
        return np.atleast_1d(residual.error)

    keys = [*state, mounting, scale, lever_arm, time_offset]
    return gtsam.CustomFactor(gtsam.noiseModel.Isotropic.Sigma(1, sigma), keys, evaluate)


def _blocks(residual: CalibratedResidual) -> list[Array]:
    """Return the Jacobians of one beam in GTSAM's tangent spaces, in the order of the keys.

    ``Pose3``: [rotation, translation]; ``ConstantBias``: [accelerometer, gyroscope].
    """
    biases = np.hstack([residual.error_D_accel_bias, residual.error_D_gyro_bias])
    pose = np.hstack([residual.error_D_rotation, np.zeros(3)])
    blocks = [pose, residual.error_D_velocity_n, biases, *residual[5:]]
    return [np.reshape(block, (1, -1)).copy() for block in blocks]
