"""Speed along one beam of a DVL that tracks the water: relative to a current, a variable itself.

A ping off the water reads as one off the ground does, of the velocity relative to the water. So
the residuals of :mod:`factors.dvl_beam` and :mod:`factors.dvl_calibration` hold with that velocity,
whatever else they depend on, and what they say of the velocity they say of minus the current.
"""

from __future__ import annotations

from typing import NamedTuple

import gtsam
import numpy as np
from numpy.typing import NDArray

from factors.checks import checked_array
from factors.dvl_beam import beam_blocks, beam_error, beam_residual, checked_beam
from factors.so3 import Array, times

IS_WATER = np.array(True)


class ThroughWater(NamedTuple):
    """Velocity relative to what beams are reflected by; leading axes broadcast."""

    v_n: Array
    """(..., 3) m/s, navigation axes"""
    v_D_current: Array
    """(..., 3, 3) with respect to the current; zero where the ground reflects."""


def through_water(
    v_n: Array, current_l: Array, *, R_nl: Array, is_water: NDArray[np.bool_]
) -> ThroughWater:
    """Return ``v_n - R_nl current_l`` for beams off the water, ``v_n`` for those off the ground.

    Parameters
    ----------
    v_n : (..., 3) velocity of the body origin over ground, m/s.
    current_l : (..., 3) velocity of the water over ground along east, north, up, m/s.
    R_nl : (..., 3, 3) east, north, up at the vehicle to navigation axes.
    is_water : (...) whether the water reflects.
    """
    v_D_current = np.where(is_water[..., None, None], -R_nl, 0.0)
    return ThroughWater(v_n + times(v_D_current, current_l), v_D_current)


def water_beam_factor(
    pose: int,
    velocity: int,
    bias: int,
    current: int,
    *,
    sigma: float,
    speed: float,
    gyro_b: Array,
    beam_b: Array,
    lever_arm_b: Array,
    omega_ie_n: Array,
    R_nl: Array,
    weight: float = 1.0,
) -> gtsam.CustomFactor:
    """Return one beam off the water as a factor for anyone's own graph.

    Parameters
    ----------
    pose, velocity, bias : keys of ``Pose3``, velocity and ``ConstantBias``.
    current : key of the current, a vector of 3 along east, north, up, m/s.
    sigma : nominal standard deviation of the speed, m/s.
    speed, gyro_b, beam_b, lever_arm_b, omega_ie_n : as in :func:`factors.dvl_beam.beam_residual`,
        for one beam.
    R_nl : as in :func:`through_water`.
    weight : similarity weight; the effective variance is ``sigma^2 / weight``.

    Raises
    ------
    ValueError
        If a number is not finite, or ``sigma`` or ``weight`` is not above zero.
    """
    axes = checked_array("water_beam_factor", "R_nl", R_nl, (3, 3))
    measured = checked_beam(
        "water_beam_factor",
        {"gyro_b": gyro_b, "beam_b": beam_b, "lever_arm_b": lever_arm_b, "omega_ie_n": omega_ie_n},
        speed=speed,
        sigma=sigma,
        weight=weight,
    )

    def evaluate(
        this: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Array] | None
    ) -> Array:
        pose_at, velocity_at, bias_at, current_at = this.keys()
        R_nb = values.atPose3(pose_at).rotation().matrix()
        gyro_bias = values.atConstantBias(bias_at).gyroscope()
        v_n, v_D_current = through_water(
            values.atVector(velocity_at), values.atVector(current_at), R_nl=axes, is_water=IS_WATER
        )
        if jacobians is None:
            return np.atleast_1d(beam_error(R_nb, v_n, gyro_bias, **measured))
        residual = beam_residual(R_nb, v_n, gyro_bias, **measured)
        for i, block in enumerate(beam_blocks(residual)):  # GTSAM's list takes no slices
            jacobians[i] = block
        jacobians[3] = (residual.error_D_velocity_n @ v_D_current)[None]
        return np.atleast_1d(residual.error)

    noise = gtsam.noiseModel.Isotropic.Sigma(1, sigma / np.sqrt(weight))
    return gtsam.CustomFactor(noise, [pose, velocity, bias, current], evaluate)
