"""Simulated missions whose inertial sensors have scale errors, misalignments and g-sensitivity."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from ssm_graph.base.frames import MATRIX_PLACES
from ssm_graph.base.frozen import Array
from ssm_graph.mission.mission import Mission
from ssm_graph.sensors.imu_calibration import DEG_PER_H_PER_G, MRAD, PPM, ImuCalibration
from ssm_graph.simulation import DepthProfile, Grade, SimulatedMission, SurveyRoute
from tests.helpers import simulated

NAMES: Final = (
    "gyro_scale",
    "gyro_misalignment",
    "gyro_g_sensitivity",
    "accel_scale",
    "accel_misalignment",
)
SIGMAS: Final = {
    Grade.NAVIGATION: (50 * PPM, 0.1 * MRAD, 0.002 * DEG_PER_H_PER_G, 100 * PPM, 0.1 * MRAD),
    Grade.TACTICAL: (300 * PPM, 0.5 * MRAD, 1.0 * DEG_PER_H_PER_G, 300 * PPM, 0.5 * MRAD),
    Grade.MEMS: (1e4 * PPM, 10.0 * MRAD, 100.0 * DEG_PER_H_PER_G, 1e4 * PPM, 5.0 * MRAD),
}
"""Of each component, in the order of the names."""
SIZES: Final = (3, 6, 9, 3, 6)


@dataclass(frozen=True)
class Distorted:
    """A mission whose inertial sensors are off, and by how much."""

    sim: SimulatedMission
    mission: Mission
    """What is read"""
    errors: Array
    """(27,) in the order of the names"""


def turning(**changes: Any) -> SimulatedMission:
    """Return short legs at the surface, whose turns show what gyros read."""
    route = SurveyRoute(line_m=40.0, depth=DepthProfile(0.3, 0.3))
    return simulated(**({"duration_s": 120.0, "imu_rate_hz": 50.0, "route": route} | changes))


def read_with(mission: Mission, errors: Array) -> Mission:
    """Return the mission whose sensors read with errors (27,) in the order of the names."""
    scale, beside, by_force, accel_scale, accel_beside = np.split(errors, np.cumsum(SIZES)[:-1])
    gyro, accel = np.zeros((2, 9))
    for matrix, parts in ((gyro, (scale, beside)), (accel, (accel_scale, accel_beside))):
        for part in parts:
            matrix[MATRIX_PLACES[len(part)]] = part
    imu = mission.imu
    force, rate = imu.accel_b, imu.gyro_b
    read = rate + rate @ gyro.reshape(3, 3).T + force @ by_force.reshape(3, 3).T
    return replace(
        mission,
        imu=replace(imu, gyro_b=read, accel_b=force + force @ accel.reshape(3, 3).T),
    )


def distorted(grade: Grade, seed: int, **changes: Any) -> Distorted:
    """Return a mission of a grade with errors as large as its sigmas."""
    sim = turning(grade=grade, seed=seed, **changes)
    sigma = np.repeat(SIGMAS[grade], SIZES)
    errors = sigma * np.random.default_rng([16, seed]).normal(size=27)
    return Distorted(sim, read_with(sim.mission, errors), errors)


def asking(mission: Mission, sigmas: tuple[float, ...]) -> Mission:
    """Return the mission with these prior sigmas, in the order of the names."""
    named: dict[str, Any] = {
        f"{name}_sigma": sigma for name, sigma in zip(NAMES, sigmas, strict=True)
    }
    return replace(mission, imu=replace(mission.imu, calibration=ImuCalibration(**named)))
