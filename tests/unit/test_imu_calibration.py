"""Errors of the inertial sensors as a user states, asks for and gets them."""

from __future__ import annotations

import tomllib
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tomli_w

from ssm_graph.base.errors import ConfigError
from ssm_graph.base.frames import R_FRD, BodyAxes
from ssm_graph.engine.error_state import STATE_DIM
from ssm_graph.evaluation import evaluate
from ssm_graph.filters.navigation.named import filter_problems
from ssm_graph.io.mission_folder.folder import calibration_toml, read_mission, write_mission
from ssm_graph.io.mission_folder.vehicle import read_vehicle, vehicle_of
from ssm_graph.io.raw_log.rows import messages_of
from ssm_graph.live.estimator import ONLINE, FixedLagSmoother
from ssm_graph.mission.estimate import Calibration, Determined, Estimate, Status
from ssm_graph.mission.navigation import Health
from ssm_graph.mission.problem import build_problem
from ssm_graph.sensors.imu_calibration import (
    DEG_PER_H_PER_G,
    MRAD,
    PPM,
    VALUES,
    ImuCalibration,
)
from ssm_graph.simulation import CALM, GnssSettings, Grade
from ssm_graph.smoothers.batch import SmootherConfig, SsmSmoother
from ssm_graph.smoothers.faults.search import FaultSearch
from ssm_graph.smoothers.fixed_lag import FixedLagConfig, run_fixed_lag, solve_fixed_lag
from tests import mission_fixture
from tests.helpers import simulated
from tests.imu_errors_fixture import SIGMAS, Distorted, asking, distorted, read_with, turning

SIXTH = -0.4
"""Gyros that read 0.6 of the turn"""
STATED = ImuCalibration(
    gyro_scale_error=np.array([1e-3, -2e-3, 3e-3]),
    gyro_misalignment=1e-3 * np.arange(1.0, 7.0),
    gyro_g_sensitivity=DEG_PER_H_PER_G * np.arange(1.0, 10.0),
    accel_scale_error=np.array([-1e-3, 2e-3, 5e-4]),
    accel_misalignment=-1e-3 * np.arange(1.0, 7.0),
    gyro_scale_sigma=1e-4,
    accel_misalignment_sigma=2e-3,
)


def found(estimate: Estimate) -> Calibration:
    """Return the calibration of an estimate that has one."""
    assert estimate.calibration is not None
    return estimate.calibration


@cache
def mems() -> tuple[Distorted, Estimate]:
    """Return a mission of MEMS with large errors, and the answer that finds them."""
    off = distorted(Grade.MEMS, 3, gnss=GnssSettings(windows=((0.0, 1e9),)))
    return off, SsmSmoother().solve(build_problem(asking(off.mission, SIGMAS[Grade.MEMS])))


def test_errors_are_found_within_their_sigmas() -> None:
    """All of the 27 within three and a half sigmas, those of the turns in green."""
    off, estimate = mems()
    assert estimate.status is Status.CONVERGED, estimate.reason
    values = {value.label: value for value in found(estimate).values}
    off_by = np.array([v.value for v in values.values()]) - off.errors
    sigma = np.array([v.sigma for v in values.values()])
    assert np.abs(off_by / sigma).max() < 3.5
    assert values["gyro_scale_z_ppm"].determined is Determined.GREEN
    assert values["accel_scale_z_ppm"].determined is Determined.GREEN
    assert values["gyro_g_sensitivity_xx_deg_per_h_per_g"].determined is not Determined.GREEN


def test_a_straight_run_leaves_them_at_their_priors_in_red() -> None:
    """What nothing turns and nothing pushes cannot be seen; scale of the vertical force can."""
    sim = simulated(duration_s=60.0, grade=Grade.TACTICAL, waves=CALM, imu_rate_hz=50.0)
    estimate = SsmSmoother().solve(build_problem(asking(sim.mission, SIGMAS[Grade.TACTICAL])))
    for value in found(estimate).values:
        if value.label == "accel_scale_z_ppm":
            continue
        if value.variable in ("gyro_scale", "accel_scale"):
            assert value.determined is Determined.RED, value.label
            assert abs(value.value) < 0.2 * value.prior_sigma, value.label
    (note,) = [note for note in estimate.notes if note.startswith("not determined")]
    assert "gyro_scale_z_ppm" in note


def test_gyros_that_read_six_tenths_of_the_turn() -> None:
    """With a prior as wide they are found, and the search for faults blames no beam."""
    sim = turning(grade=Grade.MEMS, duration_s=80.0, imu_rate_hz=20.0)
    errors = np.zeros(27)
    errors[:3] = SIXTH
    off = read_with(sim.mission, errors)
    wide = replace(off, imu=replace(off.imu, calibration=ImuCalibration(gyro_scale_sigma=0.5)))
    smoother = SsmSmoother(SmootherConfig(fault_search=FaultSearch()))
    right, estimate = (smoother.solve(build_problem(m)) for m in (sim.mission, wide))
    assert estimate.status is Status.CONVERGED, estimate.reason
    assert len(estimate.iterations) < 20
    assert not any("is off" in note for note in estimate.notes)
    turned = next(v for v in found(estimate).values if v.label == "gyro_scale_z_ppm")
    assert abs(turned.value - SIXTH) < 3.0 * turned.sigma < 0.02
    assert sim.mission.reference is not None
    rms = [
        evaluate(answer.trajectory, sim.mission.reference).rmse_horizontal_m
        for answer in (right, estimate)
    ]
    assert rms[1] < 1.2 * rms[0] + 0.1


@pytest.mark.slow
def test_a_window_of_the_whole_mission_is_the_batch() -> None:
    """Values, sigmas and track, to a twentieth of a sigma."""
    off = distorted(Grade.MEMS, 5, duration_s=40.0)
    problem = build_problem(asking(off.mission, SIGMAS[Grade.MEMS]))
    batch = SsmSmoother().solve(problem)
    config = FixedLagConfig(
        1e3, max_iterations=20, tolerance=1e-4, relinearise_sigmas=1e-3, reweigh=1e-3
    )
    whole = solve_fixed_lag(problem, config).delayed
    for own, other in zip(found(whole).values, found(batch).values, strict=True):
        assert own.label == other.label
        assert abs(own.value - other.value) < 0.05 * other.sigma, own.label
        assert abs(own.sigma - other.sigma) < 0.05 * other.sigma, own.label
    off_enu = whole.trajectory.velocity_enu - batch.trajectory.velocity_enu
    assert np.all(np.abs(off_enu) < 0.05 * batch.trajectory.velocity_sigma_enu)


@pytest.mark.slow
def test_the_live_estimator_finds_what_fixed_lag_finds() -> None:
    """With a stated part, which it takes off; its newest state is led on without either."""
    off = distorted(Grade.MEMS, 3, duration_s=40.0)
    mission = asking(off.mission, SIGMAS[Grade.MEMS])
    stated = replace(mission.imu.calibration, gyro_scale_error=off.errors[:3])
    mission = replace(mission, imu=replace(mission.imu, calibration=stated))
    config = replace(ONLINE, lag_s=8.0)
    smoother = FixedLagSmoother(vehicle_of(mission), config)
    for message in messages_of(mission):
        smoother.push(message)
    assert smoother.status()[0] is Health.GOOD
    calibration = smoother.found().calibration
    assert calibration is not None
    assert smoother._course is not None
    live = smoother._course.newest.window.newest
    offline = run_fixed_lag(build_problem(mission), config).newest
    (k,) = np.flatnonzero(np.abs(offline.time_s - live.time_s[0]) < 1e-3)
    sigma = np.sqrt(np.diag(live.covariance[0]))[STATE_DIM:]
    off_by = offline.states.walks[k] - live.states.walks[0]
    assert np.abs(off_by / sigma).max() < 0.05
    left = np.array([v.value / v.sigma for v in calibration.values if v.variable == "gyro_scale"])
    assert np.abs(left).max() < 3.0
    newest = smoother.newest()
    assert newest is not None
    truth = off.sim.truth_at(np.array([newest.time_s]))
    speed = np.linalg.norm(newest.velocity_enu - truth.velocity_enu[0])
    assert speed < 4.0 * np.linalg.norm(newest.velocity_sigma_enu)


def test_filters_say_that_they_take_them_as_stated() -> None:
    """Their answer is that of a mission that does not ask, to the last bit."""
    sim = turning(duration_s=10.0)
    asked, plain = (
        build_problem(asking(sim.mission, SIGMAS[Grade.MEMS])),
        build_problem(sim.mission),
    )
    (of_asked,), (of_plain,) = (filter_problems([p], "ssm-log") for p in (asked, plain))
    (note,) = [note for note in of_asked.notes if "calibrate" in note]
    assert "gyro_scale" in note
    np.testing.assert_array_equal(
        of_asked.trajectory.velocity_enu, of_plain.trajectory.velocity_enu
    )


def test_what_is_not_asked_for_costs_nothing() -> None:
    """No variable, no column, no raw data kept, and the very readings."""
    mission = turning(duration_s=5.0).mission
    problem = build_problem(mission)
    assert not problem.extras
    assert problem.chain.source is None
    assert problem.chain.intervals.delta_D_errors.size == 0
    assert mission.imu.calibrated is mission.imu


def test_what_is_known_is_taken_off_the_readings() -> None:
    """A mission that states its errors is smoothed as one that has none; the log stays as it is."""
    sim = turning(duration_s=20.0, grade=Grade.TACTICAL)
    errors = np.concatenate([getattr(STATED, name) for name in VALUES])
    off = read_with(sim.mission, errors)
    stated = replace(off, imu=replace(off.imu, calibration=replace(STATED, **NO_SIGMAS)))
    np.testing.assert_allclose(stated.imu.calibrated.gyro_b, sim.mission.imu.gyro_b, atol=1e-12)
    np.testing.assert_allclose(stated.imu.calibrated.accel_b, sim.mission.imu.accel_b, atol=1e-12)
    again = stated.imu.calibrated
    assert again.calibrated is again
    ours, plain = (SsmSmoother().solve(build_problem(m)) for m in (stated, sim.mission))
    np.testing.assert_allclose(
        ours.trajectory.velocity_enu, plain.trajectory.velocity_enu, atol=1e-8
    )


LATE_S = 0.015


def test_a_known_delay_is_taken_off_the_stamps(tmp_path: Path) -> None:
    """Late by a sample and a half and said to be so: the answers are those of stamps on time."""
    mission = turning(duration_s=10.0, imu_rate_hz=100.0).mission
    imu, late = mission.imu, ImuCalibration(time_offset_s=LATE_S)
    stamps: dict[str, Any] = {"start_s": imu.start_s + LATE_S, "time_s": imu.time_s + LATE_S}
    write_mission(tmp_path, replace(mission, imu=replace(imu, calibration=late, **stamps)))
    off = read_mission(tmp_path)
    assert off.imu.calibration.time_offset_s == LATE_S
    np.testing.assert_allclose(off.imu.time_s, imu.time_s + LATE_S, rtol=0.0, atol=1e-9)
    falsely = replace(mission, imu=replace(imu, calibration=late))
    right, ours, wrong = (
        SsmSmoother().solve(build_problem(m)).trajectory for m in (mission, off, falsely)
    )
    np.testing.assert_allclose(ours.roll_pitch_heading, right.roll_pitch_heading, atol=1e-7)
    np.testing.assert_allclose(ours.velocity_enu, right.velocity_enu, atol=1e-6)
    turned = wrong.roll_pitch_heading[:9] - right.roll_pitch_heading[:9]
    assert np.abs(turned).max() > 1e-4
    answers = []
    for one in (mission, off):
        estimator = FixedLagSmoother(vehicle_of(one))
        for message in sorted(messages_of(one), key=lambda message: message.time_s):
            estimator.push(message)
        assert estimator.counts == {}
        answer = estimator.newest()
        assert answer is not None
        answers.append(answer)
    assert answers[1].time_s == pytest.approx(answers[0].time_s, abs=1e-9)
    attitudes = [a.roll_pitch_heading for a in answers]
    np.testing.assert_allclose(attitudes[1], attitudes[0], rtol=0.0, atol=1e-5)


def test_a_delay_in_milliseconds_is_refused(tmp_path: Path) -> None:
    """Named with its limits."""
    write_mission(tmp_path, mission_fixture.make_mission())
    path = tmp_path / "mission.toml"
    settings = tomllib.loads(path.read_text())
    settings["imu"]["time_offset_s"] = 5.0
    path.write_text(tomli_w.dumps(settings))
    with pytest.raises(ConfigError, match=r"\[imu\] time_offset_s: expected a number from -1 to 1"):
        read_mission(tmp_path)


NO_SIGMAS: dict[str, Any] = {"gyro_scale_sigma": 0.0, "accel_misalignment_sigma": 0.0}


@pytest.mark.parametrize("axes", list(BodyAxes))
def test_lines_of_the_estimate_are_a_mission_in_its_axes(tmp_path: Path, axes: BodyAxes) -> None:
    """Put in place, with the tables in those axes, they take off what was read in these."""
    off, estimate = mems()
    lines = tomllib.loads(calibration_toml(off.mission, found(estimate), axes=axes))
    keys = lines["imu"]
    assert "gyro_scale_error_ppm" in keys
    write_mission(tmp_path, mission_fixture.make_mission())
    path = tmp_path / "mission.toml"
    settings = tomllib.loads(path.read_text())
    settings["imu"] |= keys
    settings["frames"]["body"] = axes.value
    path.write_text(tomli_w.dumps(settings))
    calibration: Any = read_vehicle(path).imu_calibration
    values = found(estimate)
    np.testing.assert_allclose(
        calibration.gyro_scale_error, values.of("gyro_scale"), rtol=1e-5, atol=1e-9
    )
    np.testing.assert_allclose(
        calibration.gyro_misalignment, values.of("gyro_misalignment"), rtol=1e-5, atol=1e-9
    )


@pytest.mark.parametrize("axes", list(BodyAxes))
def test_a_matrix_is_in_the_axes_of_the_file(tmp_path: Path, axes: BodyAxes) -> None:
    """A stated misalignment of axes FLU or RFU does to their vectors what it says."""
    write_mission(tmp_path, mission_fixture.make_mission())
    path = tmp_path / "mission.toml"
    settings = tomllib.loads(path.read_text())
    settings["frames"]["body"] = axes.value
    settings["imu"]["gyro_scale_error_ppm"] = [1e4, 2e4, 3e4]
    settings["imu"]["gyro_misalignment_mrad"] = [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]
    path.write_text(tomli_w.dumps(settings))
    calibration = read_vehicle(path).imu_calibration
    matrix = np.array([[0.01, 0.001, 0.002], [0.003, 0.02, 0.004], [0.005, 0.006, 0.03]])
    rate = np.array([[0.1, -0.2, 0.3]])
    read = rate + rate @ matrix.T
    right, _ = calibration.taken_off(read @ R_FRD[axes], np.zeros((1, 3)))
    np.testing.assert_allclose(right, rate @ R_FRD[axes], atol=1e-12)


def test_keys_are_read_as_they_are_written(tmp_path: Path) -> None:
    """Every value and every sigma, for a mission and for a vehicle; none are written for none."""
    plain = mission_fixture.make_mission()
    mission = replace(plain, imu=replace(plain.imu, calibration=STATED))
    write_mission(tmp_path / "stated", mission)
    write_mission(tmp_path / "plain", plain)
    read = read_mission(tmp_path / "stated").imu
    for name, value in vars_of(STATED).items():
        np.testing.assert_allclose(getattr(read.calibration, name), value, rtol=1e-12)
    np.testing.assert_allclose(read.gyro_b, plain.imu.gyro_b, atol=1e-12)
    keys = tomllib.loads((tmp_path / "stated" / "mission.toml").read_text())["imu"]
    assert keys["gyro_misalignment_mrad"] == pytest.approx(list(range(1, 7)))
    assert keys["gyro_scale_sigma_ppm"] == pytest.approx(100.0)
    assert "gyro_misalignment_sigma_mrad" not in keys
    text = (tmp_path / "plain" / "mission.toml").read_text()
    assert "scale_error_ppm" not in text
    assert "mrad" not in text


def vars_of(calibration: ImuCalibration) -> dict[str, Any]:
    """Return the fields of a value with slots."""
    return {name: getattr(calibration, name) for name in ImuCalibration.__slots__}


def test_a_percentage_in_the_place_of_ppm_is_told(tmp_path: Path) -> None:
    """Wrong sizes and ranges name key, expectation and unit."""
    write_mission(tmp_path, mission_fixture.make_mission())
    path = tmp_path / "mission.toml"
    settings = tomllib.loads(path.read_text())
    settings["imu"]["gyro_scale_error_ppm"] = [-1e6, 0.0, 0.0]
    path.write_text(tomli_w.dumps(settings))
    with pytest.raises(ConfigError, match=r"gyro_scale_error_ppm.*1 % is 10000"):
        read_mission(tmp_path)


def test_units() -> None:
    """Of data sheets: 1 mrad, 1 ppm, and 1 deg/h/g as 4.94e-7 rad/s per m/s^2."""
    assert (PPM, MRAD) == (1e-6, 1e-3)
    assert pytest.approx(4.9437e-7, rel=1e-4) == DEG_PER_H_PER_G
