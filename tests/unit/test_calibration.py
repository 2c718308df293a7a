"""Instruments calibrated by the smoother: found, said how well, and left alone where unseen."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from ssm_graph.evaluation.errors import evaluate
from ssm_graph.filters.navigation.named import filter_problems
from ssm_graph.io.mission_folder.vehicle import vehicle_of
from ssm_graph.io.raw_log.rows import messages_of
from ssm_graph.live.estimator.buffers import Buffers
from ssm_graph.live.estimator.smoother import FixedLagSmoother
from ssm_graph.mission.estimate import Calibration, Determined, Estimate, Status
from ssm_graph.mission.problem import build_problem
from ssm_graph.sensors.depth import DepthReading
from ssm_graph.sensors.gnss import Fix
from ssm_graph.simulation import (
    CALM,
    DepthProfile,
    DepthSettings,
    DvlSettings,
    GnssSettings,
    Grade,
    StartSigmas,
    TransitRoute,
)
from ssm_graph.smoothers.batch import SsmSmoother
from ssm_graph.smoothers.fixed_lag import FixedLagConfig, solve_fixed_lag
from tests.calibration_cases import AIDS, DVL, as_stated, asking
from tests.calibration_fixture import miscalibrated


@cache
def two_minutes() -> Estimate:
    """Return two minutes of turns with everything miscalibrated, calibrated."""
    return SsmSmoother().solve(build_problem(asking(miscalibrated().mission)))


def found(estimate: Estimate) -> Calibration:
    """Return the calibration of an estimate that has one."""
    assert estimate.calibration is not None
    return estimate.calibration


def test_all_errors_are_found_together() -> None:
    """Within four of their own sigmas, most of them determined by the data."""
    estimate = two_minutes()
    assert estimate.status is Status.CONVERGED
    calibration = found(estimate)
    assert {value.variable for value in calibration.values} == {*DVL, *AIDS}
    for variable, truth in (DVL | AIDS).items():
        own = [value for value in calibration.values if value.variable == variable]
        sigma = np.array([value.sigma for value in own])
        assert np.all(np.abs(calibration.of(variable) - truth) < 4.0 * sigma), variable
    colours = {value.label: value.determined for value in calibration.values}
    for label in ("dvl_scale_error", "dvl_mounting_z_deg", "dvl_time_offset_s", "depth_offset_m"):
        assert colours[label] in (Determined.GREEN, Determined.AMBER), label
    sigmas = np.sqrt(np.diag(calibration.covariance))
    np.testing.assert_allclose(sigmas, [value.sigma for value in calibration.values])


def test_it_saves_the_track() -> None:
    """Left alone, errors that large are no outliers: the track is lost; calibrated it is not."""
    sim = miscalibrated()
    reference = sim.mission.reference
    assert reference is not None
    calibrated = evaluate(two_minutes().trajectory, reference)
    stated = SsmSmoother().solve(build_problem(as_stated(sim.mission)))
    assert calibrated.rmse_horizontal_m < 0.1
    assert evaluate(stated.trajectory, reference).rmse_horizontal_m > 0.2
    assert stated.calibration is None


def test_a_scale_that_drifts_is_followed() -> None:
    """A random walk of the scale follows what a constant cannot."""
    sim = miscalibrated(
        duration_s=300.0,
        dvl=DvlSettings(scale_error=-0.02, scale_drift_per_h=0.6),
        depth=DepthSettings(),
        gnss=GnssSettings(sigma_horizontal=0.05, sigma_vertical=0.1),
    )
    mission = as_stated(sim.mission)
    mount = replace(mission.dvl.mount, scale_sigma=0.03, scale_walk_density=0.1 / 60.0)
    problem = build_problem(replace(mission, dvl=replace(mission.dvl, mount=mount)))
    calibration = found(SsmSmoother().solve(problem))
    true_scale = -0.02 + 0.6 * problem.keyframe_s / 3600.0
    assert calibration.walks.shape == (problem.n_keyframes, 1)
    assert np.abs(calibration.walks[:, 0] - true_scale).max() < 0.015
    (value,) = calibration.values
    assert abs(value.value - 0.03) < 4.0 * value.sigma
    assert value.prior_sigma == pytest.approx(np.hypot(0.03, 0.1 * np.sqrt(300.0 / 3600.0)))


def test_a_prior_that_is_contradicted_is_said() -> None:
    """A scale 3 % off with a prior of 0.1 % is no calibration any more."""
    mission = asking(miscalibrated().mission, scale_sigma=1e-3)
    estimate = SsmSmoother().solve(build_problem(mission))
    assert estimate.status is Status.SUSPECT
    assert "dvl_scale" in estimate.reason


def test_filters_and_fixed_lag_say_what_they_do_not_calibrate() -> None:
    """Filters take everything as stated, fixed lag what only motion shows; a note names it."""
    sim = miscalibrated(duration_s=6.0, grade=Grade.NAVIGATION)
    asked, stated = (build_problem(change(sim.mission)) for change in (asking, as_stated))
    for problem, n_notes in ((asked, 1), (stated, 0)):
        (filtered,) = filter_problems([problem], "ekf")
        lagged = solve_fixed_lag(problem, FixedLagConfig(lag_s=5.0)).delayed
        for estimate in (filtered, lagged):
            notes = [note for note in estimate.notes if "calibrate" in note]
            assert len(notes) == n_notes
            assert all("dvl_time_offset" in note for note in notes)
        assert all("dvl_mounting" in note for note in filtered.notes if "calibrate" in note)
        assert not any("dvl_mounting" in note for note in lagged.notes if "calibrate" in note)
        assert filtered.calibration is None
        assert (lagged.calibration is None) == (problem is stated)


def test_the_live_estimator_says_so_too_and_takes_known_offsets_off() -> None:
    """One event when it begins, of what only motion shows.

    Fixes and depths go in without what is known of their errors.
    """
    sim = miscalibrated(duration_s=8.0)
    vehicle = vehicle_of(asking(sim.mission))
    depth, gnss = vehicle.depth, vehicle.gnss
    assert depth is not None
    late = replace(gnss.calibration, time_offset_s=0.2)
    vehicle = replace(
        vehicle,
        depth=replace(depth, calibration=replace(depth.calibration, offset=0.4)),
        gnss=replace(gnss, calibration=late),
    )
    smoother = FixedLagSmoother(vehicle)
    for message in messages_of(sim.mission):
        smoother.push(message)
    (event,) = [e for e in smoother.take_events() if e.kind == "not_calibrated"]
    assert "dvl_time_offset" in event.text
    assert "dvl_scale" not in event.text
    buffers = Buffers(vehicle)
    fix, reading = Fix(1.2, 0.5, 0.5, 0.0, (1.0, 1.0, 1.0)), DepthReading(1.0, 2.4)
    assert buffers.time_of(fix) == pytest.approx(1.0)
    assert buffers.time_of(reading) == 1.0
    assert buffers.add(reading)
    depth = buffers.logs_between(0.0, 2.0).depth
    assert depth is not None
    np.testing.assert_allclose(depth.true_depth, [2.0])


@pytest.mark.parametrize("with_gnss", [True, False])
def test_a_straight_run_in_a_calm_invents_nothing(with_gnss: bool) -> None:
    """Without motion clock and lever arm stay at their priors, however noisy the sensors are."""
    start = StartSigmas(position=0.3, velocity=0.5, roll_pitch=2e-3, heading=0.01)
    sim = miscalibrated(
        duration_s=240.0,
        grade=Grade.MEMS,
        start_sigmas=start,
        route=TransitRoute(speed=1.5, depth=DepthProfile(0.3, 0.3)),
        waves=CALM,
        gnss=GnssSettings(windows=((0.0, 1e9),)) if with_gnss else None,
        depth=DepthSettings(),
    )
    estimate = SsmSmoother().solve(build_problem(asking(sim.mission, DVL)))
    calibration = found(estimate)
    unseen = ["dvl_time_offset_s", *(f"dvl_lever_arm_{axis}_m" for axis in "xyz")]
    if not with_gnss:
        unseen.append("dvl_scale_error")
    values = {value.label: value for value in calibration.values}
    for label in unseen:
        assert values[label].determined is Determined.RED, label
        assert any("not determined" in note and label in note for note in estimate.notes)
    scale = values["dvl_scale_error"]
    assert (scale.determined is Determined.GREEN) == with_gnss
    for variable, truth in DVL.items():
        sigma = np.array([v.sigma for v in calibration.values if v.variable == variable])
        assert np.all(np.abs(calibration.of(variable) - truth) < 3.0 * sigma), variable


def test_each_beam_has_a_scale_of_its_own() -> None:
    """Within four sigmas, far better than the prior."""
    errors = (0.02, -0.01, 0.0, 0.015)
    sim = miscalibrated(
        dvl=DvlSettings(beam_scale_errors=errors),
        depth=DepthSettings(),
        gnss=GnssSettings(sigma_horizontal=0.05, sigma_vertical=0.1),
    )
    mission = asking(sim.mission, (), beam_scale_sigma=0.03)
    calibration = found(SsmSmoother().solve(build_problem(mission)))
    assert [value.label for value in calibration.values] == [
        f"dvl_beam{beam}_scale_error" for beam in (1, 2, 3, 4)
    ]
    sigma = np.array([value.sigma for value in calibration.values])
    assert np.all(np.abs(calibration.of("dvl_beam_scale") - errors) < 4.0 * sigma)
    assert sigma.max() < 0.01
