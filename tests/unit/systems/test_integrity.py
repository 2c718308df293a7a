"""The set of a vehicle's bounds: truth inside, lies told, findings joined, files written."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ssm_graph import Estimate, Mission, SmootherConfig, smooth
from ssm_graph.base.errors import ConfigError, DataError
from ssm_graph.mission.fault import Treatment
from ssm_graph.simulation import Fault, FaultShape, Sensor, SimulatedMission, with_faults
from ssm_graph.systems.sensor_network.integrity import (
    Agreement,
    check_integrity,
    holds_truth,
    write_integrity,
)
from ssm_graph.systems.sensor_network.witness import Witness, WitnessBounds, witness
from tests.witness_fixture import a_survey

END_S = 80.0


@pytest.fixture(scope="module")
def simulated() -> SimulatedMission:
    """Return a survey with fixes and depth, without faults."""
    return a_survey(seed=21, end_s=END_S)


@pytest.fixture(scope="module")
def answer(simulated: SimulatedMission) -> Estimate:
    """Return the smoother's answer without faults."""
    return smooth(simulated.mission, SmootherConfig())


def of(mission: Mission, bounds: WitnessBounds | None = None) -> Witness:
    """Return the witness of a mission from its own start."""
    assert mission.initial is not None
    return witness(mission, mission.initial, bounds)


def broken(sim: SimulatedMission, **fault: object) -> Mission:
    """Return the mission with a fault."""
    one = Fault(**fault)  # type: ignore[arg-type]
    return with_faults(sim.mission, [one], truth=sim.truth_at).mission


def test_the_truth_is_inside_and_fixes_hold_the_set(simulated: SimulatedMission) -> None:
    """With five sigma of everything as bounds; without fixes the set grows with the way."""
    mission = simulated.mission
    w = of(mission)
    assert holds_truth(mission, w, simulated.truth_at(w.time_s)).all()
    assert not w.alarms
    alone = replace(mission, gnss=None)
    free = of(alone)
    assert holds_truth(alone, free, simulated.truth_at(free.time_s)).all()
    assert np.all(np.diff(free.half_widths[:, 0]) > 0.0)
    assert free.half_widths[-1, 0] > 1.5 * w.half_widths[-1, 0]
    assert w.half_widths[-1, 0] < 3.5


def test_stamps_that_are_late_as_stated_change_nothing(simulated: SimulatedMission) -> None:
    """The set is that of stamps on time, to the end of the inertial data."""
    mission, imu = simulated.mission, simulated.mission.imu
    known = replace(imu.calibration, time_offset_s=0.5)
    imu = replace(imu, start_s=imu.start_s + 0.5, time_s=imu.time_s + 0.5, calibration=known)
    w, late = of(mission), of(replace(mission, imu=imu))
    np.testing.assert_allclose(late.time_s, w.time_s, atol=1e-9)
    np.testing.assert_allclose(late.half_widths, w.half_widths, rtol=1e-6)


def test_bounds_that_are_too_small_are_noticed(simulated: SimulatedMission) -> None:
    """A tenth of a sigma is no bound: readings miss the set at once."""
    w = of(simulated.mission, WitnessBounds(sigmas=0.1, velocity_m_per_s=1e-4, speed_share=1e-4))
    assert w.alarms or w.n_left_out > 100


@pytest.mark.parametrize(
    ("fault", "sensor"),
    [
        (
            {"sensor": Sensor.GNSS, "shape": FaultShape.CONSTANT, "size": (9.0, 0.0, 0.0)},
            "GNSS",
        ),
        ({"sensor": Sensor.DEPTH, "shape": FaultShape.CONSTANT, "size": 3.0}, "depth"),
        ({"shape": FaultShape.ZERO}, "DVL"),
    ],
)
def test_lies_beyond_the_bounds_are_told(
    simulated: SimulatedMission, fault: dict[str, object], sensor: str
) -> None:
    """Which sensor missed, from when on; before it there is no alarm."""
    w = of(broken(simulated, start_s=35.0, end_s=70.0, **fault))
    assert w.alarms[0].sensor == sensor
    assert 35.0 < w.alarms[0].time_s <= 51.0
    assert "is false" in w.alarms[0].sentence


def test_outlying_beams_are_left_out_without_an_alarm(simulated: SimulatedMission) -> None:
    """A beam that is 1 m/s off for a while contradicts its ping; the truth stays inside."""
    mission = broken(simulated, beams=(1,), start_s=30.0, end_s=50.0, offset_m_per_s=1.0)
    w = of(mission)
    assert w.n_left_out >= 15
    assert not w.alarms
    assert holds_truth(mission, w, simulated.truth_at(w.time_s)).all()


def test_an_answer_is_inside_or_not(
    simulated: SimulatedMission, answer: Estimate, tmp_path: Path
) -> None:
    """The smoother's is, and its error within what is told; one that is led aside is not."""
    mission, estimate = simulated.mission, answer
    found = check_integrity(mission, estimate)
    assert found.agreement is Agreement.INSIDE
    truth = simulated.truth_at(found.witness.time_s)
    p_n = mission.frame.p_n_from_geodetic(truth.lat, truth.lon, truth.height)
    assert np.all(np.linalg.norm((found.answer_n - p_n)[:, :2], axis=1) < found.radius_m)
    assert np.all(np.abs(found.answer_n - p_n)[:, 2] < found.up_m)
    aside = replace(estimate.trajectory, lat=estimate.trajectory.lat + 2e-6)  # 13 m to the north
    led = check_integrity(mission, replace(estimate, trajectory=aside))
    assert led.agreement is Agreement.OUTSIDE
    write_integrity(tmp_path, found)
    said = json.loads((tmp_path / "integrity.json").read_text())
    assert said["agreement"] == "INSIDE"
    rows = (tmp_path / "integrity.csv").read_text().splitlines()
    assert len(rows) == 1 + len(found.radius_m)


def test_alarms_that_are_close_are_one_finding(
    simulated: SimulatedMission, answer: Estimate
) -> None:
    """With those whose bound may be the false one instead."""
    mission = broken(
        simulated,
        sensor=Sensor.GNSS,
        shape=FaultShape.CONSTANT,
        start_s=35.0,
        end_s=70.0,
        size=(0.0, 9.0, 0.0),
    )
    found = check_integrity(mission, answer)
    assert found.agreement is Agreement.ALARM
    (fault,) = found.faults
    assert (fault.sensor, fault.treatment) == ("GNSS", Treatment.SAID)
    assert "DVL" in fault.rivals
    assert fault.end_s - fault.begin_s > 15.0


def test_over_a_gap_of_inertial_data_the_set_begins_anew(
    simulated: SimulatedMission, answer: Estimate
) -> None:
    """Nothing bounds what happens in it: an alarm would prove nothing."""
    imu = simulated.mission.imu
    kept = (imu.time_s < 33.7) | (imu.time_s > 38.7)
    gap = replace(imu, time_s=imu.time_s[kept], gyro_b=imu.gyro_b[kept], accel_b=imu.accel_b[kept])
    mission = replace(simulated.mission, imu=gap)
    with pytest.raises(DataError, match=r"missing from 33\.69\d to 38\.71\d s"):
        of(mission)
    found = check_integrity(mission, answer)
    assert found.agreement is Agreement.INSIDE
    assert "missing after 34 s" in found.reason
    w = found.witness
    assert not np.any((w.time_s > 33.7) & (w.time_s < 38.7))
    assert holds_truth(mission, w, simulated.truth_at(w.time_s)).all()


def test_what_cannot_be_used_is_refused(simulated: SimulatedMission) -> None:
    """No pings; bounds that are none."""
    mission = simulated.mission
    none = replace(
        mission.dvl, speed=mission.dvl.speed, water_track=np.ones(len(mission.dvl.time_s))
    )
    with pytest.raises(DataError, match="two pings off the ground"):
        of(replace(mission, dvl=none))
    with pytest.raises(ConfigError, match="sigmas: expected above 0"):
        WitnessBounds(sigmas=0.0)
    with pytest.raises(ConfigError, match="speed_share: expected 0 or more, got nan"):
        WitnessBounds(speed_share=np.nan)
