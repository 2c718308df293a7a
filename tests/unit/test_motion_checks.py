"""What sensors tell of each other: late stamps, biases at rest, silence where all is well."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ssm_graph.io.mission_folder.motion import check_motion
from ssm_graph.mission.mission import Mission
from ssm_graph.simulation import CALM, Grade, HoverRoute, scenario_config, simulate

LABELS = {name: f"{name}.csv" for name in ("imu", "dvl", "depth", "gnss")}


@pytest.fixture(scope="module")
def waves() -> Mission:
    """Return four minutes in waves of 0.3 m."""
    return simulate(scenario_config("survey", duration_s=240.0)).mission


@pytest.fixture(scope="module")
def rest() -> Mission:
    """Return a minute on the spot, without waves."""
    route = HoverRoute(sway_m=0.0, yaw=0.0)
    config = scenario_config(
        "hover", route=route, waves=CALM, grade=Grade.MEMS, duration_s=60.0, seed=1
    )
    return simulate(config).mission


@pytest.mark.parametrize("late_s", [0.4, -0.3])
def test_a_dvl_that_is_late_is_noted(waves: Mission, late_s: float) -> None:
    """The vertical motion of both sensors says by how much, and what to set."""
    dvl = waves.dvl
    late = replace(waves, dvl=replace(dvl, time_s=dvl.time_s + late_s))
    (note,) = check_motion(late, LABELS)
    assert "time_offset_s" in note
    word = "earlier" if late_s > 0.0 else "later"
    said = float(note.split(f" s {word}")[0].split()[-1])
    assert said == pytest.approx(abs(late_s), abs=0.1)
    stated = replace(late.dvl, mount=replace(dvl.mount, time_offset_s=late_s))
    assert check_motion(replace(late, dvl=stated), LABELS) == []


def test_a_bias_at_rest_is_noted(rest: Mission) -> None:
    """Still by accelerometer and DVL, and yet the gyros turn: about any axis, gravity's too."""
    assert check_motion(rest, LABELS) == []
    gyro_b = rest.imu.gyro_b + np.array([0.0, 0.0, 0.05])
    notes = check_motion(replace(rest, imu=replace(rest.imu, gyro_b=gyro_b)), LABELS)
    assert len(notes) == 1
    assert "lies still for 10 s" in notes[0]
    assert "a bias, or a steady turn on the spot" in notes[0]


def test_a_level_bias_is_seen_under_way(waves: Mission) -> None:
    """The vehicle does not tilt as the gyros say; nothing is said of a sound mission."""
    assert check_motion(waves, LABELS) == []
    gyro_b = waves.imu.gyro_b + np.array([0.01, -0.02, 0.0])
    (note,) = check_motion(replace(waves, imu=replace(waves.imu, gyro_b=gyro_b)), LABELS)
    x, y, z = (float(word) for word in note.split(" deg/h")[0].split("turn by ")[1].split(", "))
    np.testing.assert_allclose(np.radians([x, y]) / 3600.0, [0.01, -0.02], atol=1e-3)
    assert abs(np.radians(z) / 3600.0) < 1e-3


def test_turns_in_a_gap_are_no_bias(waves: Mission) -> None:
    """Nobody saw them."""
    imu = waves.imu
    kept = (imu.time_s < 50.0) | (imu.time_s > 55.0)
    rows = {name: getattr(imu, name)[kept] for name in ("time_s", "gyro_b", "accel_b")}
    assert check_motion(replace(waves, imu=replace(imu, **rows)), LABELS) == []


def test_turns_under_way_are_no_bias_of_good_gyros() -> None:
    """What draws a vehicle inwards turns with it: as much as 40 to 70 deg/h, and none is said."""
    config = scenario_config("demo", duration_s=1800.0, grade=Grade.NAVIGATION, imu_rate_hz=50.0)
    mission = simulate(config).mission
    assert check_motion(mission, LABELS) == []
    gyro_b = mission.imu.gyro_b + np.radians([0.0, 120.0, 0.0]) / 3600.0
    (note,) = check_motion(replace(mission, imu=replace(mission.imu, gyro_b=gyro_b)), LABELS)
    _, y, _ = (float(word) for word in note.split(" deg/h")[0].split("turn by ")[1].split(", "))
    assert y == pytest.approx(120.0, abs=8.0)
