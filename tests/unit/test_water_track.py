"""Pings off the water: a current beside the states, in the smoother alone."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from ssm_graph.base.errors import ConfigError, DataError
from ssm_graph.base.frozen import Array
from ssm_graph.engine.states import States
from ssm_graph.evaluation.errors import evaluate
from ssm_graph.filters.navigation.filter import Grouping, run_filter
from ssm_graph.filters.navigation.named import filter_geodetic, filter_problems
from ssm_graph.filters.rules.kalman import KalmanUpdate
from ssm_graph.graph.first_values import first_values
from ssm_graph.graph.gtsam_graph import gtsam_graph
from ssm_graph.graph.linearize import GraphLinearizer
from ssm_graph.io.raw_log.rows import messages_of
from ssm_graph.mission.calibration import CURRENT, CURRENT_UP
from ssm_graph.mission.estimate import Estimate, Status
from ssm_graph.mission.mission import Mission
from ssm_graph.mission.problem import build_problem, with_dvl, without_water_track
from ssm_graph.mission.start.alignment import align
from ssm_graph.sensors.compass import HeadingErrors
from ssm_graph.sensors.current import CurrentModel
from ssm_graph.sensors.dvl import DvlMount, Ping
from ssm_graph.simulation import (
    AidSettings,
    CompassSettings,
    CurrentSettings,
    DvlSettings,
    Fault,
    GnssSettings,
    Loss,
    OutlierKind,
    Outliers,
    SimulatedMission,
    UsblSettings,
    WaterTrack,
    default_mount,
)
from ssm_graph.smoothers.batch import SmootherConfig, SsmSmoother
from ssm_graph.smoothers.faults.search import FaultSearch
from ssm_graph.smoothers.fixed_lag import FixedLagConfig, solve_fixed_lag
from ssm_graph.smoothers.settings import WARM_KERNEL
from tests.helpers import simulated, true_states, without_beams
from tests.water_fixture import current_errors, in_current, without_water


def smoothed(mission: Mission, **settings: Any) -> Estimate:
    """Return the smoother's answer."""
    return SsmSmoother(SmootherConfig(**settings)).solve(build_problem(mission))


def errors_of(estimate: Estimate, sim: SimulatedMission) -> tuple[float, float]:
    """Return horizontal and velocity rms, m and m/s."""
    metrics = evaluate(estimate.trajectory, sim.truth_at(estimate.trajectory.time_s))
    return metrics.rmse_horizontal_m, metrics.rmse_velocity_m_per_s


def doubted(mount: DvlMount) -> DvlMount:
    """Return the mount with every calibration asked for but the clock, seen through noisy rates."""
    return replace(
        mount,
        misalignment_sigma=0.01,
        scale_sigma=0.01,
        scale_walk_density=1e-4,
        beam_scale_sigma=0.003,
        lever_arm_sigma=0.1,
    )


@pytest.mark.parametrize("calibrates", [False, True], ids=["current", "and calibrations"])
def test_rows_are_the_change_of_the_errors(calibrates: bool) -> None:
    """Columns of states, current and calibrations of mixed pings against differences."""
    mount = doubted(default_mount()) if calibrates else default_mount()
    sim = in_current(
        duration_s=60.0,
        losses=(),
        water_track=WaterTrack(every=2, beams=(0, 1, 3)),
        dvl=DvlSettings(mount=mount),
    )
    problem = build_problem(sim.mission)
    rng = np.random.default_rng(1)
    extras = problem.extras
    states = true_states(problem, sim)._replace(
        walks=0.1 * rng.normal(size=(problem.n_keyframes, extras.n_walks)),
        constants=1e-3 * rng.normal(size=extras.n_constants),
    )
    linearizer = GraphLinearizer(problem)
    linearizer.follow(states)
    rows = linearizer.beam_rows(states)
    assert 0 < problem.beams.is_water.sum() < len(rows.error)
    for column in range(extras.width):
        numeric = _difference(linearizer, states, column)
        # A metre turns the axes of the level, and so the current, by 1e-7 rad: left out.
        scale = max(float(np.abs(numeric).max()), 1e-2)
        np.testing.assert_allclose(rows.jacobian[:, column] / scale, numeric / scale, atol=2e-5)
    current = rows.jacobian[:, extras.columns(CURRENT)]
    assert not current[~problem.beams.is_water].any()
    assert np.all(np.abs(current[problem.beams.is_water]).max(axis=1) > 0.0)


def _difference(linearizer: GraphLinearizer, states: States, column: int) -> Array:
    """Return how the errors change with one variable, of all keyframes where it has one of each."""
    extras, n = linearizer.problem.extras, linearizer.problem.n_keyframes
    ends = []
    for step in (1e-5, -1e-5):
        delta, constants = np.zeros((n, extras.state_dim)), np.zeros(extras.n_constants)
        if column < extras.state_dim:
            delta[:, column] = step
        else:
            constants[column - extras.state_dim] = step
        moved = states.moved(delta, constants)
        ends.append(linearizer.beam_rows(moved).error)
    return np.asarray((ends[0] - ends[1]) / 2e-5)


def test_errors_vanish_at_the_truth() -> None:
    """With perfect sensors, and the true current in the walks, the speeds are met."""
    sim = in_current(perfect_sensors=True, draw_initial_errors=False, duration_s=120.0)
    problem = build_problem(sim.mission)
    truth = sim.current.at(problem.keyframe_s)
    states = true_states(problem, sim)._replace(walks=truth)
    linearizer = GraphLinearizer(problem)
    linearizer.follow(states)
    error = linearizer.beam_rows(states).error
    # The IMU's mean rate over a ping is not that at its middle, least of all at the end.
    assert np.abs(error)[:-4].max() < 1e-4
    still = linearizer.beam_rows(states._replace(walks=np.zeros_like(truth))).error
    is_water = problem.beams.is_water
    assert np.abs(still)[is_water].max() > 0.1
    np.testing.assert_array_equal(still[~is_water], error[~is_water])


@cache
def dry_loss() -> Estimate:
    """Return the answer of a run with a loss without its pings off the water."""
    return smoothed(without_water(in_current(seed=2)).mission)


def test_a_bottom_loss_is_bridged() -> None:
    """With the water better than without, and the current is found within its sigmas."""
    sim = in_current(seed=2)
    wet, dry = smoothed(sim.mission), dry_loss()
    assert wet.status is dry.status is Status.CONVERGED
    (horizontal, velocity), (horizontal_dry, velocity_dry) = (errors_of(e, sim) for e in (wet, dry))
    assert velocity < 0.7 * velocity_dry
    assert horizontal < horizontal_dry
    assert wet.current is not None
    assert dry.current is None
    errors = current_errors(wet, sim)
    assert np.abs(errors / wet.current.sigma_enu).max() < 4.5
    lost = (wet.current.time_s > 60.0) & (wet.current.time_s < 240.0)
    assert np.sqrt(np.mean(errors[lost, :2] ** 2)) < 0.05


@pytest.mark.parametrize("beams", [(1,), (0, 2), (0, 1, 3)], ids=len)
def test_few_beams_still_help(beams: tuple[int, ...]) -> None:
    """One to three beams off the water are better than none."""
    sim = in_current(seed=2, water_track=WaterTrack(beams=beams))
    np.testing.assert_array_equal(
        sim.mission.dvl.of_ground().speed, in_current(seed=2).mission.dvl.of_ground().speed
    )
    wet = smoothed(sim.mission)
    assert wet.status is Status.CONVERGED
    assert errors_of(wet, sim)[1] < errors_of(dry_loss(), sim)[1]
    assert int(wet.trajectory.n_beams[120]) == len(beams)


def test_a_level_current_has_no_vertical_component() -> None:
    """Zero is not estimated."""
    sim = in_current(current=CurrentSettings(sigma=0.3, stated=CurrentModel(vertical_sigma=0.0)))
    problem = build_problem(sim.mission)
    assert CURRENT in problem.extras
    assert CURRENT_UP not in problem.extras
    estimate = SsmSmoother().solve(problem)
    assert estimate.current is not None
    assert not estimate.current.velocity_enu[:, 2].any()
    assert not estimate.current.sigma_enu[:, 2].any()


def test_without_pings_off_the_water_nothing_changes() -> None:
    """A current that is stated, but not measured, adds no variable and moves no digit."""
    mission = simulated(outliers=Outliers(OutlierKind.SPARSE)).mission
    stated = replace(
        mission,
        current=CurrentModel(),
        dvl=replace(mission.dvl, water_track=np.zeros(len(mission.dvl.time_s))),
    )
    problem = build_problem(stated)
    assert not problem.extras
    assert without_water_track(problem) is problem
    a, b = smoothed(mission), smoothed(stated)
    np.testing.assert_array_equal(a.trajectory.lat, b.trajectory.lat)
    np.testing.assert_array_equal(a.trajectory.position_cov_enu, b.trajectory.position_cov_enu)
    np.testing.assert_array_equal(a.beams.weight, b.beams.weight)
    assert a.notes == b.notes
    assert b.current is None


def test_a_current_that_nobody_stated_is_assumed_and_said() -> None:
    """The default model, with a note; none where it is stated."""
    sim = in_current()
    assumed = build_problem(replace(sim.mission, current=None))
    assert [block.sigma.tolist() for block in assumed.extras.blocks] == [[0.5, 0.5], [0.02]]
    assert any("state it in [current]" in note for note in assumed.notes)
    assert not any("[current]" in note for note in build_problem(sim.mission).notes)
    # Pings off the water without a speed do not ask for a current.
    assert not build_problem(without_beams(sim.mission)).extras


@pytest.mark.slow
def test_a_window_bridges_a_loss_like_the_batch() -> None:
    """As long as the mission, it is the batch; a shorter one is as far off as its sigmas say."""
    sim = in_current(duration_s=60.0, losses=(Loss(15.0, 45.0),))
    problem = build_problem(sim.mission)
    config = FixedLagConfig(
        1e3, max_iterations=15, tolerance=1e-3, relinearise_sigmas=1e-3, reweigh=1e-3
    )
    batch, whole = SsmSmoother().solve(problem), solve_fixed_lag(problem, config).delayed
    assert batch.current is not None
    assert whole.current is not None
    off = np.abs(whole.current.velocity_enu - batch.current.velocity_enu)
    assert np.all(off < 0.02 * batch.current.sigma_enu)
    np.testing.assert_allclose(whole.current.sigma_enu, batch.current.sigma_enu, rtol=0.01)
    off = np.abs(whole.trajectory.velocity_enu - batch.trajectory.velocity_enu)
    assert np.all(off < 0.02 * batch.trajectory.velocity_sigma_enu)
    for lagged in solve_fixed_lag(problem, replace(config, lag_s=20.0)):
        assert lagged.current is not None
        assert np.all(np.abs(current_errors(lagged, sim)) < 4.0 * lagged.current.sigma_enu)
        assert lagged.current.sigma_enu[-1, 0] < 0.1
        assert not any("off the water" in note for note in lagged.notes)


def test_filters_leave_the_water_out() -> None:
    """Their answers are those without such pings, and a note says so."""
    sim = in_current(duration_s=60.0, losses=(Loss(20.0, 50.0),))
    problem, dry = build_problem(sim.mission), build_problem(without_water(sim).mission)
    imu = [sim.mission.imu]
    for wet_answer, dry_answer in (
        (filter_problems([problem], "ssm-log")[0], filter_problems([dry], "ssm-log")[0]),
        (filter_geodetic([problem], imu)[0], filter_geodetic([dry], imu)[0]),
    ):
        np.testing.assert_allclose(
            wet_answer.trajectory.lat, dry_answer.trajectory.lat, rtol=0.0, atol=1e-12
        )
        np.testing.assert_array_equal(wet_answer.trajectory.n_beams, dry_answer.trajectory.n_beams)
        assert sum("30 pings off the water are left out" in note for note in wet_answer.notes) == 1
        assert not any("off the water" in note for note in dry_answer.notes)
    with pytest.raises(ConfigError, match="has no current"):
        run_filter([problem], KalmanUpdate(), grouping=Grouping.PER_BEAM)


def test_a_replay_sends_the_pings_off_the_water_marked() -> None:
    """In their places among the others."""
    mission = in_current().mission
    pings = [message for message in messages_of(mission) if isinstance(message, Ping)]
    assert [ping.is_water for ping in pings] == mission.dvl.is_water.tolist()
    assert sum(ping.is_water for ping in pings) == 180


def test_alignment_does_not_take_the_water_for_the_ground() -> None:
    """A start amid pings off the water is that without them."""
    sim = in_current(duration_s=120.0, gnss=GnssSettings(windows=((0.0, 120.0),)))
    blind = replace(sim.mission, initial=None)
    dry = replace(blind, dvl=blind.dvl.of_ground())
    for found, expected in zip(align(blind).candidates, align(dry).candidates, strict=True):
        assert found.heading == expected.heading
        np.testing.assert_array_equal(found.velocity_enu, expected.velocity_enu)


@pytest.mark.slow
def test_the_first_pass_goes_through_a_long_loss() -> None:
    """It ends near the answer though one beam of every other ping is wrong, and doubts nothing."""
    sim = in_current(
        seed=4,
        duration_s=400.0,
        losses=(Loss(60.0, 360.0),),
        outliers=Outliers(OutlierKind.SPARSE, rate=0.5),
    )
    problem = build_problem(sim.mission)
    first = first_values(problem, kernel=WARM_KERNEL)
    assert first.n_doubts == 0
    truth = sim.truth_at(problem.keyframe_s)
    assert np.abs(first.states.v_n - truth.velocity_enu).max() < 0.3
    estimate = SsmSmoother().solve(problem)
    assert estimate.status is Status.CONVERGED, estimate.reason
    assert np.mean(estimate.beams.weight < 0.05) == pytest.approx(0.125, abs=0.01)


def test_a_current_that_jumps_is_met_by_a_new_current() -> None:
    """A front: the first pass lets the current go and keeps the velocity."""
    sim = in_current(seed=3)
    dvl = sim.mission.dvl
    jump = dvl.mount.beams_b @ np.array([1.6, 0.0, 0.0])
    late = dvl.is_water & (dvl.time_s > 150.0)
    speed = np.where(late[:, None], dvl.speed - jump, dvl.speed)
    problem = build_problem(replace(sim.mission, dvl=replace(dvl, speed=speed)))
    first = first_values(problem, kernel=WARM_KERNEL)
    assert first.n_doubts > 0
    truth = sim.truth_at(problem.keyframe_s)
    assert np.abs(first.states.v_n - truth.velocity_enu).max() < 0.3


@pytest.mark.slow
def test_the_fault_search_tells_a_beam_from_the_current() -> None:
    """A beam off for minutes is found among pings off the water; a current is nobody's fault."""
    fault = Fault(beams=(2,), start_s=90.0, end_s=210.0, offset_m_per_s=0.3)
    for faults, n_found in (((), 0), ((fault,), 1)):
        sim = in_current(seed=5, faults=faults)
        estimate = smoothed(sim.mission, fault_search=FaultSearch())
        assert len(estimate.faults) == n_found, estimate.notes
    (found,) = estimate.faults
    assert found.sensor == "DVL beam 3"
    assert abs(found.begin_s - 90.0) < 2.0
    assert abs(found.end_s - 210.0) < 2.0


@pytest.mark.slow
def test_current_and_further_aids_go_together() -> None:
    """Walks and constants of both kinds in one problem, with the search for faults over it."""
    compass = CompassSettings(
        errors=HeadingErrors(offset_sigma=0.05, walk_sigma=0.02, correlation_s=100.0)
    )
    aids = AidSettings(usbl=UsblSettings(interval_s=5.0), compass=compass)
    sim = in_current(seed=6, aids=aids)
    problem = build_problem(sim.mission)
    assert problem.extras.n_walks > 3
    assert problem.extras.n_constants > 0
    estimate = SsmSmoother(SmootherConfig(fault_search=FaultSearch())).solve(problem)
    assert estimate.status is Status.CONVERGED, estimate.reason
    assert estimate.current is not None
    assert np.abs(current_errors(estimate, sim) / estimate.current.sigma_enu).max() < 4.5
    assert not estimate.faults


def test_a_current_beyond_its_sigma_is_said() -> None:
    """Ten sigmas of current make the answer suspect."""
    sim = in_current(
        current=CurrentSettings(steady_enu=(0.5, 0.0, 0.0), stated=CurrentModel(sigma=0.03))
    )
    estimate = smoothed(sim.mission)
    assert estimate.status is Status.SUSPECT
    assert "current" in estimate.reason
    assert "[current]" in estimate.reason


def test_what_has_no_current_refuses() -> None:
    """GTSAM's own graph, and another log with water on a problem without."""
    sim = in_current()
    problem = build_problem(sim.mission)
    states = first_values(problem, kernel=WARM_KERNEL).states
    with pytest.raises(ConfigError, match="current"):
        gtsam_graph(problem, states)
    dry = build_problem(sim.with_known_current())
    with pytest.raises(DataError, match="whose current it does not have"):
        with_dvl(dry, sim.mission)
    assert len(with_dvl(problem, sim.mission).beams.speed) == len(problem.beams.speed)


@pytest.mark.parametrize("field", ["sigma", "correlation_s"])
def test_a_current_of_no_size_is_refused(field: str) -> None:
    """Missions made in Python come without the reader's checks."""
    sim = in_current(duration_s=30.0)
    mission = replace(sim.mission, current=replace(CurrentModel(), **{field: 0.0}))
    with pytest.raises(DataError, match=f"current.{field}, row 0: expected a finite number above"):
        build_problem(mission)
