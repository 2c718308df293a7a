"""Speed along one DVL beam: residual, Jacobians, and the factor for anyone's own graph."""

from __future__ import annotations

from typing import Any, NamedTuple

import gtsam
import numpy as np

from factors.checks import check_numbers, checked_array
from factors.so3 import Array, cross, times


class BeamResidual(NamedTuple):
    """Residuals of DVL beams and their Jacobian blocks; leading axes broadcast (pings, beams)."""

    error: Array
    """(...) m/s, predicted minus measured."""
    error_D_rotation: Array
    """(..., 3) with respect to ``phi`` in ``R_nb @ Exp(phi)``, m/s/rad."""
    error_D_velocity_n: Array
    """(..., 3)"""
    error_D_gyro_bias: Array
    """(..., 3) m"""


def beam_error(
    R_nb: Array,
    v_n: Array,
    gyro_bias: Array,
    *,
    speed: Array,
    gyro_b: Array,
    beam_b: Array,
    lever_arm_b: Array,
    omega_ie_n: Array,
) -> Array:
    """Return predicted minus measured speed along DVL beams, m/s; see :func:`beam_residual`."""
    return _predict(
        R_nb, v_n, gyro_b - gyro_bias, speed, beam_b, cross(lever_arm_b, beam_b), omega_ie_n
    )[0]


def _predict(
    R_nb: Array,
    v_n: Array,
    omega_ib_b: Array,
    speed: Array,
    beam_b: Array,
    arm_b: Array,
    omega_ie_n: Array,
) -> tuple[Array, Array, Array]:
    """Return the error, and velocity and Earth rate in body axes.

    ``beam . (rate x lever) = (lever x beam) . rate``, and ``arm_b`` is that ``lever x beam``.
    """
    v_b, omega_ie_b = _to_body(R_nb, v_n), _to_body(R_nb, omega_ie_n)
    error = (beam_b * v_b + arm_b * (omega_ib_b - omega_ie_b)).sum(axis=-1) - speed
    return np.asarray(error), v_b, omega_ie_b


def beam_residual(
    R_nb: Array,
    v_n: Array,
    gyro_bias: Array,
    *,
    speed: Array,
    gyro_b: Array,
    beam_b: Array,
    lever_arm_b: Array,
    omega_ie_n: Array,
) -> BeamResidual:
    """Return residuals of DVL beams with their Jacobians.

    With the rate of the body relative to the Earth, ``omega_eb_b = gyro_b - gyro_bias -
    R_nb' omega_ie_n``, and the unit beam direction ``beam_b``::

        error = beam_b . (R_nb' v_n + omega_eb_b x lever_arm_b) - speed

    A speed is positive when the instrument moves along the beam, away from its transducer.

    Parameters
    ----------
    R_nb : (..., 3, 3) rotation, body to navigation.
    v_n : (..., 3) velocity of the body origin over ground, m/s.
    gyro_bias, gyro_b : (..., 3) gyro bias and gyro reading at the ping, rad/s.
    speed : (...) measured beam speed, m/s.
    beam_b : (..., 3) unit vector, body axes.
    lever_arm_b : (3,) body origin to DVL, body axes, m.
    omega_ie_n : (3,) Earth rate, rad/s.

    References
    ----------
    .. [1] Xu et al., "Combined navigation robust filtering method based on statistical similarity
       measurement", 2021, eqs. (19) to (22), there for all four beams at once.
    """
    arm_b = cross(lever_arm_b, beam_b)
    error, v_b, omega_ie_b = _predict(
        R_nb, v_n, gyro_b - gyro_bias, speed, beam_b, arm_b, omega_ie_n
    )
    shape = (*np.shape(error), 3)
    return BeamResidual(
        error=error,
        error_D_rotation=cross(beam_b, v_b) - cross(arm_b, omega_ie_b),
        error_D_velocity_n=np.broadcast_to(times(R_nb, beam_b), shape),
        error_D_gyro_bias=np.broadcast_to(-arm_b, shape),
    )


def _to_body(R_nb: Array, vector_n: Array) -> Array:
    """Return ``R_nb' vector_n`` with broadcasting."""
    return np.asarray((vector_n[..., None, :] @ R_nb)[..., 0, :])


def dvl_beam_factor(
    pose: int,
    velocity: int,
    bias: int,
    *,
    sigma: float,
    speed: float,
    gyro_b: Array,
    beam_b: Array,
    lever_arm_b: Array,
    omega_ie_n: Array,
    weight: float = 1.0,
    loss: gtsam.noiseModel.mEstimator.Base | None = None,
) -> gtsam.CustomFactor:
    """Wrap :func:`beam_residual` as a factor on ``(Pose3, velocity, ConstantBias)``.

    Parameters
    ----------
    pose, velocity, bias : keys.
    sigma : nominal standard deviation of the speed, m/s.
    speed, gyro_b, beam_b, lever_arm_b, omega_ie_n : as in :func:`beam_residual`, for one beam.
    weight : similarity weight; the effective variance is ``sigma^2 / weight``.
    loss : an M-estimator of GTSAM, for graphs whose optimiser shall do the reweighting.

    Raises
    ------
    ValueError
        If a number is not finite, or ``sigma`` or ``weight`` is not above zero.
    """
    measured = checked_beam(
        "dvl_beam_factor",
        {"gyro_b": gyro_b, "beam_b": beam_b, "lever_arm_b": lever_arm_b, "omega_ie_n": omega_ie_n},
        speed=speed,
        sigma=sigma,
        weight=weight,
    )

    def evaluate(
        this: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Array] | None
    ) -> Array:
        keys = this.keys()
        R_nb = values.atPose3(keys[0]).rotation().matrix()
        v_n = values.atVector(keys[1])
        gyro_bias = values.atConstantBias(keys[2]).gyroscope()
        if jacobians is None:
            return np.atleast_1d(beam_error(R_nb, v_n, gyro_bias, **measured))
        residual = beam_residual(R_nb, v_n, gyro_bias, **measured)
        for i, block in enumerate(beam_blocks(residual)):  # GTSAM's list takes no slices
            jacobians[i] = block
        return np.atleast_1d(residual.error)

    noise: gtsam.noiseModel.Base = gtsam.noiseModel.Isotropic.Sigma(1, sigma / np.sqrt(weight))
    if loss is not None:
        noise = gtsam.noiseModel.Robust.Create(loss, noise)
    return gtsam.CustomFactor(noise, [pose, velocity, bias], evaluate)


def beam_blocks(residual: BeamResidual) -> list[Array]:
    """Return the Jacobians of one beam in GTSAM's tangent spaces: pose, velocity, bias.

    ``Pose3``: [rotation, translation]; ``ConstantBias``: [accelerometer, gyroscope].
    """
    nothing = np.zeros(3)
    return [
        np.hstack([residual.error_D_rotation, nothing])[None, :],
        residual.error_D_velocity_n[None, :].copy(),
        np.hstack([nothing, residual.error_D_gyro_bias])[None, :],
    ]


def checked_beam(
    factor: str, vectors: dict[str, Array], *, speed: float, sigma: float, weight: float
) -> dict[str, Any]:
    """Return copies of what a factor measures, or raise: a wrong shape would crash the process."""
    check_numbers(factor, sigma=sigma, weight=weight, speed=speed)
    frozen = {name: checked_array(factor, name, value, (3,)) for name, value in vectors.items()}
    return {"speed": np.float64(speed), **frozen}
