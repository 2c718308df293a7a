"""Four grades of inertial sensors with typical data-sheet values, and how well each one starts."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from types import MappingProxyType
from typing import Final

import numpy as np

from ssm_graph.base.earth import R_el_from_lat_lon, ecef_from_geodetic, geodetic_from_ecef
from ssm_graph.mission.mission import InitialState, Reference
from ssm_graph.sensors.imu import ImuNoise

_MICRO_G = 9.80665e-6
_PER_HOUR = 1.0 / 3600.0
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
        accel_density=accel_noise * _MICRO_G,
        gyro_bias_sigma=math.radians(gyro_bias) * _PER_HOUR,
        accel_bias_sigma=accel_bias * _MICRO_G,
        gyro_bias_density=math.radians(gyro_walk) * _PER_HOUR * _PER_ROOT_HOUR,
        accel_bias_density=accel_walk * _MICRO_G * _PER_ROOT_HOUR,
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
