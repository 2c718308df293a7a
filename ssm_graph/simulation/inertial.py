"""Inertial sensors: four grades with data-sheet values, how each starts, and what it reads."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from types import MappingProxyType
from typing import Final, NamedTuple

import numpy as np
from numpy.polynomial.legendre import leggauss

from ssm_graph.base.earth import R_el_from_lat_lon, ecef_from_geodetic, geodetic_from_ecef
from ssm_graph.base.frozen import Array
from ssm_graph.base.progress import told
from ssm_graph.mission.mission import InitialState, Reference
from ssm_graph.sensors.imu import ImuNoise
from ssm_graph.simulation.randomness import Streams
from ssm_graph.simulation.trajectory import Trajectory

MICRO_G = 9.80665e-6
PER_HOUR = 1.0 / 3600.0
_PER_ROOT_HOUR = 1.0 / 60.0


class Grade(Enum):
    """Quality of the inertial sensors; the text says what stands behind it."""

    NAVIGATION = "ring laser or fibre-optic gyros, 0.01 deg/h"
    TACTICAL = "small fibre-optic or quartz gyros, 1 deg/h"
    INDUSTRIAL = "good MEMS, 10 deg/h"
    MEMS = "consumer MEMS, 100 deg/h"


@dataclass(frozen=True, slots=True)
class StartSigmas:
    """Standard deviations of the initial state."""

    position: float
    """Each of east, north, up, m."""
    velocity: float
    """Each of east, north, up, m/s."""
    roll_pitch: float
    """rad"""
    heading: float
    """rad"""


_DATA_SHEETS: Final[Mapping[Grade, tuple[float, ...]]] = {
    Grade.NAVIGATION: (0.01, 0.002, 0.001, 50.0, 5.0, 5.0),
    Grade.TACTICAL: (1.0, 0.05, 0.3, 500.0, 50.0, 50.0),
    Grade.INDUSTRIAL: (10.0, 0.15, 3.0, 2000.0, 80.0, 200.0),
    Grade.MEMS: (100.0, 0.4, 30.0, 5000.0, 150.0, 1000.0),
}
"""Gyro bias in deg/h, its white noise in deg/sqrt(h), walk of the bias in deg/h/sqrt(h); bias of
the accelerometer in ug, its white noise in ug/sqrt(Hz), walk of the bias in ug/sqrt(h)."""


def _noise(sheet: tuple[float, ...]) -> ImuNoise:
    """Return the densities in SI units; the one place of this package with other units."""
    gyro_bias, gyro_noise, gyro_walk, accel_bias, accel_noise, accel_walk = sheet
    return ImuNoise(
        gyro_density=math.radians(gyro_noise) * _PER_ROOT_HOUR,
        accel_density=accel_noise * MICRO_G,
        gyro_bias_sigma=math.radians(gyro_bias) * PER_HOUR,
        accel_bias_sigma=accel_bias * MICRO_G,
        gyro_bias_density=math.radians(gyro_walk) * PER_HOUR * _PER_ROOT_HOUR,
        accel_bias_density=accel_walk * MICRO_G * _PER_ROOT_HOUR,
    )


IMU_NOISE: Final[Mapping[Grade, ImuNoise]] = MappingProxyType(
    {grade: _noise(sheet) for grade, sheet in _DATA_SHEETS.items()}
)
"""Noise of each grade."""

START_SIGMAS: Final[Mapping[Grade, StartSigmas]] = MappingProxyType(
    {
        Grade.NAVIGATION: StartSigmas(0.1, 0.05, math.radians(0.06), math.radians(0.3)),
        Grade.TACTICAL: StartSigmas(0.3, 0.05, math.radians(0.1), math.radians(0.5)),
        Grade.INDUSTRIAL: StartSigmas(0.5, 0.1, math.radians(0.3), math.radians(1.0)),
        Grade.MEMS: StartSigmas(1.0, 0.1, math.radians(0.5), math.radians(2.0)),
    }
)
"""How well each grade knows its initial state."""


def initial_state(
    truth: Reference, sigmas: StartSigmas, *, rng: np.random.Generator | None
) -> InitialState:
    """Return the first row of ``truth`` with errors drawn from ``sigmas``; None draws no errors.

    Position and velocity errors are along east, north, up; attitude errors add to roll, pitch and
    heading.
    """
    unit = np.zeros(9) if rng is None else rng.standard_normal(9)
    position_sigma = np.full(3, sigmas.position)
    velocity_sigma = np.full(3, sigmas.velocity)
    attitude_sigma = np.array([sigmas.roll_pitch, sigmas.roll_pitch, sigmas.heading])
    lat, lon, height = truth.lat[0], truth.lon[0], truth.height[0]
    if rng is not None:
        offset_e = R_el_from_lat_lon(lat, lon) @ (position_sigma * unit[:3])
        lat, lon, height = geodetic_from_ecef(ecef_from_geodetic(lat, lon, height) + offset_e)
    roll, pitch, heading = truth.roll_pitch_heading[0] + attitude_sigma * unit[6:]
    return InitialState(
        time_s=float(truth.time_s[0]),
        lat=float(lat),
        lon=float(lon),
        height=float(height),
        roll=float(roll),
        pitch=float(pitch),
        heading=float(heading % (2.0 * math.pi)),
        velocity_enu=truth.velocity_enu[0] + velocity_sigma * unit[3:6],
        position_sigma_enu=position_sigma,
        velocity_sigma_enu=velocity_sigma,
        attitude_sigma=attitude_sigma,
    )


N_NODES = 3
"""Nodes of the Gauss-Legendre quadrature per sample. Its error for a sine of frequency ``w`` is
``(w dt)^6 / 2e6`` of the amplitude: 1e-18 for 6 s waves at 100 Hz, 1e-12 at 10 Hz."""
_CHUNK = 2048
"""Samples evaluated at once: the working set stays in the processor's cache."""


class ImuErrors(NamedTuple):
    """Errors of the gyros or of the accelerometers."""

    bias: Array
    """(N, 3) turn-on bias and its walk, as added to each sample."""
    noise: Array
    """(N, 3) white noise of each averaged sample."""


def averaged_imu(
    trajectory: Trajectory,
    *,
    rate_hz: float,
    n_samples: int,
    n_nodes: int = N_NODES,
    late_s: float = 0.0,
) -> tuple[Array, Array]:
    """Return the true mean body rate and specific force over each sample.

    Sample ``k`` covers ``(k, k + 1] / rate_hz``. Both are averages of vectors in body axes as the
    body turns, which is what a strapped-down triad reports; the estimators have to undo coning
    and sculling themselves. All of it happened ``late_s`` before.

    Returns
    -------
    gyro_b : (n_samples, 3) rad/s relative to inertial space.
    accel_b : (n_samples, 3) m/s^2 specific force.
    """
    nodes, weights = leggauss(n_nodes)
    fractions, weights = 0.5 * (nodes + 1.0), 0.5 * weights
    gyro_b, accel_b = np.empty((n_samples, 3)), np.empty((n_samples, 3))
    for begin in told(range(0, n_samples, _CHUNK), -(-n_samples // _CHUNK)):
        end = min(begin + _CHUNK, n_samples)
        time_s = (np.arange(begin, end) + fractions[:, None]) / rate_hz - late_s
        motion = trajectory.at(time_s)
        np.einsum("q,qki->ki", weights, motion.omega_ib_b(), out=gyro_b[begin:end])
        np.einsum("q,qki->ki", weights, motion.specific_force_b(), out=accel_b[begin:end])
    return gyro_b, accel_b


def imu_errors(
    noise: ImuNoise, *, rate_hz: float, n_samples: int, streams: Streams
) -> tuple[ImuErrors, ImuErrors]:
    """Draw the errors of the gyros and of the accelerometers.

    A mean over ``dt`` of white noise of density ``q`` has the standard deviation ``q / sqrt(dt)``;
    a bias walks by ``q sqrt(dt)`` per sample.
    """
    gyro = _triad_errors(
        (noise.gyro_bias_sigma, noise.gyro_density, noise.gyro_bias_density),
        (streams.gyro_bias, streams.gyro_noise, streams.gyro_walk),
        rate_hz,
        n_samples,
    )
    accel = _triad_errors(
        (noise.accel_bias_sigma, noise.accel_density, noise.accel_bias_density),
        (streams.accel_bias, streams.accel_noise, streams.accel_walk),
        rate_hz,
        n_samples,
    )
    return gyro, accel


def _triad_errors(
    sigmas: tuple[float, float, float],
    rngs: tuple[np.random.Generator, np.random.Generator, np.random.Generator],
    rate_hz: float,
    n_samples: int,
) -> ImuErrors:
    """Draw turn-on bias, white noise and bias walk of three axes, each from its own stream."""
    bias_sigma, density, walk_density = sigmas
    bias_rng, noise_rng, walk_rng = rngs
    walk = walk_density / np.sqrt(rate_hz) * walk_rng.standard_normal((n_samples, 3))
    bias = bias_sigma * bias_rng.standard_normal(3) + np.cumsum(walk, axis=0)
    noise = density * np.sqrt(rate_hz) * noise_rng.standard_normal((n_samples, 3))
    return ImuErrors(bias, noise)
