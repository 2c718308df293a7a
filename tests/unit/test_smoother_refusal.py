"""Input that no smoother can use ends as our own error or a plainly marked status."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from ssm_graph.base.errors import DataError
from ssm_graph.base.frozen import Array
from ssm_graph.mission.mission import Mission
from ssm_graph.mission.problem import build_problem
from ssm_graph.sensors.imu import ImuNoise
from ssm_graph.simulation import GnssSettings
from ssm_graph.smoothers.batch import SsmSmoother
from tests.helpers import outcome, simulated, with_imu, with_initial

MISSION = simulated(duration_s=10.0, gnss=GnssSettings(windows=((0.0, 9.0),))).mission

UP_9_8 = np.array([0.0, 0.0, 9.8])

Change = Callable[[Mission], Mission]


def spoilt(array: Array, value: float) -> Array:
    """Return a copy with one value changed in its middle."""
    changed = array.copy()
    changed.flat[changed.size // 2] = value
    return changed


def part(name: str, field: str, change: Callable[[Any], Any]) -> Change:
    """Return a change of one field of one part of a mission."""

    def apply(mission: Mission) -> Mission:
        whole = getattr(mission, name)
        changed = dataclasses.replace(whole, **{field: change(getattr(whole, field))})
        return dataclasses.replace(mission, **{name: changed})

    return apply


def bad_mount(mission: Mission) -> Mission:
    """Return the mission with a lever arm that is not a number."""
    mount = dataclasses.replace(mission.dvl.mount, lever_arm_b=np.array([np.nan, 0.0, 0.0]))
    return dataclasses.replace(mission, dvl=dataclasses.replace(mission.dvl, mount=mount))


UNUSABLE: dict[str, Change] = {
    "gyro NaN": part("imu", "gyro_b", lambda a: spoilt(a, np.nan)),
    "gyro inf": part("imu", "gyro_b", lambda a: spoilt(a, np.inf)),
    "accelerometer NaN": part("imu", "accel_b", lambda a: spoilt(a, np.nan)),
    "accelerometer inf": part("imu", "accel_b", lambda a: spoilt(a, np.inf)),
    "IMU time NaN": part("imu", "time_s", lambda a: spoilt(a, np.nan)),
    "no IMU noise": lambda m: with_imu(m, noise=ImuNoise(0.0, 0.0, 0.0, 0.0)),
    "beam speed inf": part("dvl", "speed", lambda a: spoilt(a, np.inf)),
    "beam sigma 0": part("dvl", "sigma", lambda a: spoilt(a, 0.0)),
    "beam sigma negative": part("dvl", "sigma", lambda a: -a),
    "beam sigma NaN": part("dvl", "sigma", lambda a: spoilt(a, np.nan)),
    "ping time NaN": part("dvl", "time_s", lambda a: spoilt(a, np.nan)),
    "lever arm NaN": bad_mount,
    "depth NaN": part("depth", "depth", lambda a: spoilt(a, np.nan)),
    "depth sigma 0": part("depth", "sigma", lambda _: 0.0),
    "fix NaN": part("gnss", "lat", lambda a: spoilt(a, np.nan)),
    "fix sigma 0": part("gnss", "sigma_enu", lambda a: spoilt(a, 0.0)),
    "heading NaN": part("initial", "heading", lambda _: np.nan),
    "start sigma 0": part("initial", "attitude_sigma", lambda a: 0.0 * a),
    "start sigma negative": part("initial", "position_sigma_enu", lambda a: -a),
    "start velocity NaN": part("initial", "velocity_enu", lambda a: spoilt(a, np.nan)),
}


@pytest.mark.parametrize("change", UNUSABLE.values(), ids=UNUSABLE)
def test_what_is_no_number_is_refused_by_name(change: Change) -> None:
    """Before it reaches GTSAM, which would not notice."""
    with pytest.raises(DataError):
        build_problem(change(MISSION))


def test_missing_beams_may_have_any_sigma() -> None:
    """Where there is no speed, its sigma is not looked at."""
    speed, sigma = MISSION.dvl.speed.copy(), MISSION.dvl.sigma.copy()
    speed[4], sigma[4] = np.nan, np.nan
    dvl = dataclasses.replace(MISSION.dvl, speed=speed, sigma=sigma)
    estimate = SsmSmoother().solve(build_problem(dataclasses.replace(MISSION, dvl=dvl)))
    assert estimate.status.is_good


ABSURD: dict[str, Change] = {
    "accelerometers 1e9 too large": part("imu", "accel_b", lambda a: 1e9 * a),
    "accelerometers in g": part("imu", "accel_b", lambda a: a / 9.8),
    "accelerometers of opposite sign": part("imu", "accel_b", lambda a: -a),
    "no gravity in the accelerometers": part("imu", "accel_b", lambda a: a + UP_9_8),
    "gyros 1e6 too large": part("imu", "gyro_b", lambda a: 1e6 * a),
    "gyros in degrees": part("imu", "gyro_b", np.degrees),
    "beams 1e8 too fast": part("dvl", "speed", lambda a: 1e8 * a),
    "beams in mm/s": part("dvl", "speed", lambda a: 1e3 * a),
    "beams of opposite sign": part("dvl", "speed", lambda a: -a),
    "fixes 11 km away": part("gnss", "lat", lambda a: a + 1.7e-3),
    "depth in mm": part("depth", "depth", lambda a: 1e3 * a),
    "start at 10 km/s": lambda m: with_initial(m, velocity_enu=np.array([1e4, 0.0, 0.0])),
}


@pytest.mark.parametrize("change", ABSURD.values(), ids=ABSURD)
def test_absurd_numbers_never_end_well(change: Change) -> None:
    """A SolverError, or a status that is not good with a reason; no other exception."""
    status, reason = outcome(build_problem(change(MISSION)))
    assert not status.is_good
    assert any(text in reason for text in ("contradict", "miss the answer", "check", "look for"))
