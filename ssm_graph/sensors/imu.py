"""Inertial sensors: gyro and accelerometer readings and their noise.

Like all values of :mod:`ssm_graph.sensors`: SI units, radians, body axes forward-right-down; arrays
are copied in, checked for shape and made read-only; times are seconds on one clock.
"""

from __future__ import annotations

from dataclasses import dataclass

from ssm_graph.base.frozen import Array, FrozenArrays, Vector, shaped


@dataclass(frozen=True, slots=True)
class ImuNoise:
    """Noise of the inertial sensors, as continuous-time densities."""

    gyro_density: float
    """Angular random walk, rad/s/sqrt(Hz)."""
    accel_density: float
    """Velocity random walk, m/s^2/sqrt(Hz)."""
    gyro_bias_sigma: float
    """Turn-on gyro bias, 1 sigma, rad/s."""
    accel_bias_sigma: float
    """Turn-on accelerometer bias, 1 sigma, m/s^2."""
    gyro_bias_density: float = 0.0
    """Random walk of the gyro bias, rad/s/sqrt(s)."""
    accel_bias_density: float = 0.0
    """Random walk of the accelerometer bias, m/s^2/sqrt(s)."""


@dataclass(frozen=True, slots=True, eq=False)
class ImuLog(FrozenArrays):
    """Gyro and accelerometer readings, each the mean over its interval.

    Sample ``k`` covers ``(time_s[k-1], time_s[k]]``; the first begins at ``start_s``.
    """

    start_s: float
    """Begin of the first averaging interval, s."""
    noise: ImuNoise
    time_s: Array = shaped("N")
    """(N,) end of each averaging interval, s, strictly increasing."""
    gyro_b: Array = shaped("N", 3)
    """(N, 3) body rate relative to inertial space, rad/s."""
    accel_b: Array = shaped("N", 3)
    """(N, 3) specific force, m/s^2; at rest (0, 0, -9.8)."""


@dataclass(frozen=True, slots=True)
class ImuSample:
    """One inertial sample, the mean over its interval."""

    time_s: float
    """End of the averaging interval, s on the vehicle's clock."""
    gyro_b: Vector
    """Body rate relative to inertial space, rad/s."""
    accel_b: Vector
    """Specific force, m/s^2; at rest (0, 0, -9.8)."""
