"""The geodetic filter: mechanisation, error dynamics, rows, and what it does with beams."""

from __future__ import annotations

import dataclasses
from functools import cache

import numpy as np
import pytest

from factors import so3
from factors.similarity import GaussianKernel
from ssm_graph.base.earth import EARTH_RATE
from ssm_graph.base.errors import ConfigError, DataError
from ssm_graph.base.frozen import Array
from ssm_graph.engine.states import States
from ssm_graph.filters.geodetic.filter import (
    GeodeticConfig,
    GeodeticHistory,
    run_geodetic,
    to_navigation,
)
from ssm_graph.filters.geodetic.measurements import aid_rows, beam_rows, places_of
from ssm_graph.filters.geodetic.mechanisation import (
    DP,
    ERROR_DIM,
    NABLA,
    Feedback,
    GeodeticState,
    Samples,
    Track,
    advance,
    feed_back,
    initial_moments,
    noise_densities,
    propagate,
)
from ssm_graph.filters.navigation.named import filter_geodetic
from ssm_graph.filters.side_by_side import side_by_side
from ssm_graph.imu.preintegration import INTEGRATION_DENSITY, imu_params
from ssm_graph.mission.answer import trajectory_from_states
from ssm_graph.mission.estimate import Status
from ssm_graph.mission.mission import Mission
from ssm_graph.mission.problem import Problem, build_problem, start_of
from ssm_graph.simulation import (
    GnssSettings,
    Grade,
    OutlierKind,
    Outliers,
    SimulatedMission,
    SurveyRoute,
    Waves,
)
from tests.helpers import simulated, state_errors, true_states, without_beams

STEP = np.array([1e-5] * 3 + [1e-3] * 3 + [1e-6, 1e-6, 1.0] + [1e-6] * 3 + [1e-3] * 3)
"""Size of each error for differences."""


@cache
def survey(seed: int = 3, **changes: float) -> SimulatedMission:
    """Return 30 s in waves with GNSS, outliers and dropouts."""
    return simulated(
        seed=seed,
        grade=Grade.TACTICAL,
        gnss=GnssSettings(windows=((0.0, 60.0),)),
        outliers=Outliers(OutlierKind.SPARSE, rate=0.2),
        dropout_rate=0.1,
        **changes,
    )


@cache
def survey_problem() -> Problem:
    """Return the problem of :func:`survey`."""
    return build_problem(survey().mission)


def filtered(*missions: Mission, config: GeodeticConfig | None = None) -> GeodeticHistory:
    """Filter missions side by side."""
    problems = [build_problem(mission) for mission in missions]
    return run_geodetic(problems, [mission.imu for mission in missions], config)


def a_state() -> GeodeticState:
    """Return one state in motion, far from any special direction."""
    return GeodeticState(
        lat=np.array([0.8]),
        lon=np.array([2.2]),
        height=np.array([-30.0]),
        velocity_enu=np.array([[1.3, -0.9, 0.2]]),
        R_lb=so3.exp(np.array([[2.0, -1.5, 0.4]])),
        gyro_bias=np.zeros((1, 3)),
        accel_bias=np.zeros((1, 3)),
    )


def an_interval(state: GeodeticState, *, gyro: Array, accel: Array) -> Track:
    """Mechanise a second of turning and swaying at 20 Hz, with constant sensor errors."""
    t = np.linspace(0.0, 1.0, 20)[None, :, None]
    gyro_b = np.array([0.1, -0.05, 0.2]) * np.cos(t) + gyro
    accel_b = np.array([0.5, 0.3, -9.7]) + 0.4 * np.sin(2.0 * t) + accel
    return advance(state, Samples(np.full((1, 20), 0.05), gyro_b, accel_b))


def difference(computed: GeodeticState, true: GeodeticState) -> Array:
    """Return attitude, velocity and position errors (9,), computed minus true."""
    phi = -so3.log(computed.R_lb @ np.swapaxes(true.R_lb, 1, 2))
    place = [getattr(computed, n) - getattr(true, n) for n in ("lat", "lon", "height")]
    return np.concatenate(
        [phi[0], (computed.velocity_enu - true.velocity_enu)[0], np.concatenate(place)]
    )


def off_by(state: GeodeticState, X: Array) -> GeodeticState:
    """Return the state with errors ``X`` (15,) in it; biases are those still in the readings."""
    return feed_back(state, -X[None], np.eye(ERROR_DIM)[None], Feedback.PAPER)[0]


def test_perfect_sensors_stay_on_the_truth() -> None:
    """A minute in waves, nothing but inertial data: a millimetre."""
    sim = simulated(
        route=SurveyRoute(line_m=40.0),
        waves=Waves(),
        duration_s=60.0,
        perfect_sensors=True,
        draw_initial_errors=False,
        depth=None,
    )
    mission = without_beams(sim.mission)
    problem = build_problem(mission)
    states = to_navigation(problem, run_geodetic([problem], [mission.imu]), 0)
    truth = true_states(problem, sim)
    np.testing.assert_allclose(states.p_n, truth.p_n, atol=1e-3)
    np.testing.assert_allclose(states.v_n, truth.v_n, atol=5e-5)
    np.testing.assert_allclose(states.R_nb, truth.R_nb, atol=2e-6)


@pytest.mark.parametrize("axis", range(ERROR_DIM))
def test_error_dynamics_are_those_of_the_mechanisation(axis: int) -> None:
    """Errors carried by ``F`` against the difference of two mechanised seconds."""
    state, X = a_state(), STEP * np.eye(ERROR_DIM)[axis]
    zero = np.zeros(3)
    true = an_interval(state, gyro=zero, accel=zero)
    ends = [
        an_interval(off_by(state, sign * X), gyro=sign * X[9:12], accel=sign * X[12:])
        for sign in (1.0, -1.0)
    ]
    numeric = 0.5 * (difference(ends[0].end, true.end) - difference(ends[1].end, true.end))
    carried, _ = propagate(X[None], np.zeros((1, 15, 15)), true, np.zeros((1, 15)))
    # Gravity's change with latitude is left out of F: 5e-8 m/s^2 for 6 m.
    limit = np.array([1e-10] * 3 + [1e-7] * 3 + [2e-13, 2e-13, 1e-6]) + 1e-3 * np.abs(numeric)
    assert np.all(np.abs(carried[0, :9] - numeric) < limit)
    np.testing.assert_array_equal(carried[0, 9:], X[9:])


def test_process_noise_is_that_of_many_small_steps() -> None:
    """Simpson's rule over pieces against noise added in pieces of a hundredth."""
    track = an_interval(a_state(), gyro=np.zeros(3), accel=np.zeros(3))
    density = noise_densities([survey().mission.imu.noise], a_state())
    _, P = propagate(np.zeros((1, 15)), np.zeros((1, 15, 15)), track, density)
    t, F = np.linspace(0.0, 1.0, 201), _constant_force_F(track)
    middles = 0.5 * (t[1:] + t[:-1])
    expected = sum(
        (Phi * density) @ Phi.T * 0.005
        for Phi in (np.eye(15) + F * s + F @ F * s**2 / 2.0 for s in middles)
    )
    scale = np.sqrt(np.diag(P[0]))
    np.testing.assert_allclose(
        P[0] / np.outer(scale, scale), expected / np.outer(scale, scale), atol=0.02
    )


def _constant_force_F(track: Track) -> Array:
    """Return the leading terms of ``F`` at the middle of an interval."""
    state = track.middle
    R_lb = state.R_lb[0] @ track.turned[0, 10]
    F = np.zeros((15, 15))
    F[0:3, 9:12], F[3:6, 12:15] = -R_lb, R_lb
    F[3:6, 0:3] = so3.skew(track.gained[0].sum(axis=0))
    F[6, 4], F[7, 3], F[8, 5] = 1.0 / 6.37e6, 1.0 / (6.39e6 * np.cos(0.8)), 1.0
    return F


def test_noise_has_the_floors_of_the_graph() -> None:
    """The same densities as the preintegrated factors', walkless biases included."""
    mission = survey().mission
    noise = dataclasses.replace(mission.imu.noise, gyro_bias_density=0.0, accel_bias_density=0.0)
    params = imu_params(noise, g_n=np.array([0.0, 0.0, -9.8]), frame=mission.frame)
    density = noise_densities([noise], a_state())[0]
    assert density[9] == pytest.approx(params.getBiasOmegaCovariance()[0, 0])
    assert density[12] == pytest.approx(params.getBiasAccCovariance()[0, 0])
    assert density[0] == pytest.approx(params.getGyroscopeCovariance()[0, 0])
    assert density[3] == pytest.approx(params.getAccelerometerCovariance()[0, 0])
    assert density[8] == pytest.approx(INTEGRATION_DENSITY**2)
    assert np.sqrt(density[6]) * 6.37e6 == pytest.approx(INTEGRATION_DENSITY, rel=5e-3)


def test_beam_prediction_is_the_motion_of_the_instrument() -> None:
    """``z = u . (velocity + rate relative to the Earth x lever arm)``, written out."""
    problem = survey_problem()
    grid, state = side_by_side([problem]).beams, a_state()
    k = int(problem.beams.keyframe[0])
    rows = beam_rows(grid, k, state)
    R_bl = state.R_lb[0].T
    omega_ie_l = EARTH_RATE * np.array([0.0, np.cos(0.8), np.sin(0.8)])
    for i in np.flatnonzero(problem.beams.keyframe == k):
        rate_b = problem.beams.gyro_b[i] - R_bl @ omega_ie_l
        velocity_b = R_bl @ state.velocity_enu[0] + np.cross(rate_b, problem.beams.lever_arm_b)
        expected = problem.beams.beam_b[i] @ velocity_b - problem.beams.speed[i]
        assert rows.Z[0, problem.beams.beam[i]] == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize("axis", range(12))
def test_rows_are_the_derivatives_of_what_they_measure(axis: int) -> None:
    """``H`` of beams, depth and fix against differences of ``Z``, the gyro drift included."""
    problem = survey_problem()
    measured, state = side_by_side([problem]), a_state()
    places = places_of(measured.fixes, [problem.frame])
    k = int(problem.beams.keyframe[0])
    # Metres are those about the state: a fix belongs near it.
    places.place[k] = state.lat[0], state.lon[0], state.height[0]
    X, no_X = STEP * np.eye(ERROR_DIM)[axis], np.zeros((1, ERROR_DIM))
    Zs = []
    for sign in (1.0, -1.0):
        off = off_by(state, sign * X)
        drifted = measured.beams._replace(gyro_b=measured.beams.gyro_b + sign * X[9:12])
        nominal = aid_rows(measured, places, k, off, None, no_X)
        assert nominal is not None
        Zs.append(np.concatenate([beam_rows(drifted, k, off).Z[0], nominal.Z[0]]))
    rows = beam_rows(measured.beams, k, state)
    nominal = aid_rows(measured, places, k, state, None, no_X)
    assert nominal is not None
    H = np.concatenate([rows.H[0], nominal.H[0]])
    assert H.shape == (8, ERROR_DIM)
    np.testing.assert_allclose(H @ X, 0.5 * (Zs[0] - Zs[1]), rtol=1e-5, atol=1e-8)


def test_depths_are_compared_at_their_own_times() -> None:
    """A reading half way through a dive agrees with the track there, not with its end."""
    problem = survey_problem()
    assert problem.depths is not None
    k = int(problem.depths.keyframe[4])
    ours = np.flatnonzero(problem.depths.keyframe == k)
    track = an_interval(a_state(), gyro=np.zeros(3), accel=np.zeros(3))
    measured = side_by_side([problem])
    lever_up = track.turned[0] @ problem.depths.lever_arm_b @ track.middle.R_lb[0, 2]
    before_s = problem.keyframe_s[k] - problem.depths.time_s[ours]
    at_reading = np.interp(1.0 - before_s, track.elapsed_s[0], track.height[0] + lever_up)
    measured.depths.depth[k, 0, : len(ours)] = -at_reading
    places = places_of(measured.fixes, [problem.frame])
    places.place[:] = np.nan
    rows = aid_rows(measured, places, k, track.end, track, np.zeros((1, ERROR_DIM)))
    assert rows is not None
    np.testing.assert_allclose(rows.Z, 0.0, atol=1e-9)
    assert rows.sigma[0, 0] == pytest.approx(problem.depths.sigma / np.sqrt(len(ours)))


def test_start_is_that_of_the_graph() -> None:
    """State and covariance of the first keyframe, in the package's own terms."""
    sim = simulated()
    problem = build_problem(sim.mission)
    history = run_geodetic([problem], [sim.mission.imu])
    states = to_navigation(problem, history, 0)
    expected = start_of(problem)
    np.testing.assert_allclose(states.R_nb[0], expected.R_nb, atol=1e-14)
    np.testing.assert_allclose(states.p_n[0], expected.p_n, atol=1e-8)
    np.testing.assert_allclose(states.v_n[0], expected.v_n, atol=1e-14)
    scale = np.sqrt(np.diag(expected.covariance))
    np.testing.assert_allclose(
        states.covariance[0] / np.outer(scale, scale),
        expected.covariance / np.outer(scale, scale),
        atol=1e-4,
    )


def test_runs_side_by_side_are_those_alone() -> None:
    """To rounding: no run looks at another, each stops iterating at its own time."""
    missions = [survey(seed).mission for seed in (3, 4)]
    together = filtered(*missions)
    for run, mission in enumerate(missions):
        alone = filtered(mission)
        for name in ("lat", "height", "velocity_enu", "R_lb", "gyro_bias", "weight", "iterations"):
            np.testing.assert_allclose(
                getattr(together, name)[run], getattr(alone, name)[0], rtol=1e-11, atol=1e-13
            )


def test_outliers_lose_their_weight_each_beam_for_itself() -> None:
    """Bad beams count for nothing; the good ones of the same ping count as ever."""
    sim = survey()
    problem = build_problem(sim.mission)
    history = filtered(sim.mission)
    ping = np.searchsorted(
        sim.mission.dvl.time_s, problem.keyframe_s[problem.beams.keyframe] - 0.01
    )
    bad = sim.is_outlier[ping, problem.beams.beam]
    weight = history.weight[0][problem.beams.keyframe, problem.beams.beam]
    later = problem.keyframe_s[problem.beams.keyframe] > 5.0
    assert bad[later].sum() >= 3
    assert weight[bad & later].max() < 0.05
    assert np.median(weight[~bad]) > 0.9
    assert np.all(np.isfinite(history.innovation) == np.isfinite(history.weight))


def test_absent_beams_are_absent() -> None:
    """NaN exactly where the DVL was silent; a mission without any beam still gets its track."""
    mission = survey().mission
    problem = build_problem(mission)
    history = filtered(mission, without_beams(mission))
    present = np.zeros(history.weight.shape[1:], bool)
    present[problem.beams.keyframe, problem.beams.beam] = True
    np.testing.assert_array_equal(np.isfinite(history.weight[0]), present)
    assert np.isnan(history.weight[1]).all()
    assert not history.iterations[1].any()
    assert np.isfinite(history.lat).all()


def test_gaussian_kernel_is_the_kalman_filter() -> None:
    """Weights 1, settled at once."""
    history = filtered(survey().mission, config=GeodeticConfig(kernel=GaussianKernel()))
    assert np.nanmin(history.weight) == np.nanmax(history.weight) == 1.0
    assert history.iterations.max() == 2


def test_covariances_are_covariances() -> None:
    """Symmetric and positive, and fit to become a trajectory."""
    problem = survey_problem()
    history = filtered(survey().mission)
    states = to_navigation(problem, history, 0)
    for covariance in (history.covariance[0], states.covariance):
        sigma = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
        correlation = covariance / (sigma[:, :, None] * sigma[:, None, :])
        np.testing.assert_allclose(correlation, np.swapaxes(correlation, 1, 2), atol=1e-9)
        assert np.linalg.eigvalsh(correlation).min() > 1e-9
    trajectory = trajectory_from_states(problem, states, states.covariance)
    np.testing.assert_allclose(trajectory.lat, history.lat[0], atol=1e-14)
    np.testing.assert_allclose(trajectory.velocity_enu, history.velocity_enu[0], atol=1e-12)


def test_errors_are_within_their_sigmas() -> None:
    """Half a minute with outliers: no state further than five sigma from the truth."""
    sim = survey()
    problem = build_problem(sim.mission)
    states = to_navigation(problem, filtered(sim.mission), 0)
    sigma = np.sqrt(np.diagonal(states.covariance, axis1=1, axis2=2))
    own = States.of(*states[:4])
    assert np.abs(state_errors(own, true_states(problem, sim)) / sigma).max() < 5.0


def test_feedback_leaves_what_it_says() -> None:
    """The paper's keeps biases as errors, the complete one keeps none; the sum is the same."""
    X = STEP[None].copy()
    state, P = initial_moments([survey().mission.initial], [np.ones(6)])  # type: ignore[list-item]
    paper, X_paper, P_paper = feed_back(state, X, P, Feedback.PAPER)
    complete, X_complete, P_complete = feed_back(state, X, P, Feedback.COMPLETE)
    np.testing.assert_array_equal(X_paper[:, 9:], X[:, 9:])
    assert not X_paper[:, :9].any()
    assert not X_complete.any()
    np.testing.assert_array_equal(complete.accel_bias, X[:, NABLA])
    np.testing.assert_array_equal(complete.R_lb, paper.R_lb)
    assert complete.height[0] == state.height[0] - X[0, DP][2]
    assert P_paper is P
    np.testing.assert_allclose(P_complete, np.swapaxes(P_complete, 1, 2), rtol=1e-12)


def test_the_letter_agrees_with_the_complete_loop_at_navigation_grade() -> None:
    """Good sensors: what the paper leaves out is a small part of a sigma."""
    mission = simulated(seed=2).mission
    paper, complete = (
        filtered(mission, config=GeodeticConfig(feedback=feedback)) for feedback in Feedback
    )
    sigma = np.sqrt(np.diagonal(complete.covariance[0, :, 3:6, 3:6], axis1=1, axis2=2))
    apart = np.abs(paper.velocity_enu - complete.velocity_enu)[0] / sigma
    assert 0.0 < apart.max() < 0.2


def test_unequal_runs_are_refused() -> None:
    """The caller runs them one by one."""
    missions = survey().mission, simulated(duration_s=20.0).mission
    with pytest.raises(ConfigError, match="run 1 has another number of keyframes"):
        filtered(*missions)
    with pytest.raises(ConfigError, match="expected one or more runs"):
        run_geodetic([], [])


def test_two_pings_at_one_keyframe_are_refused() -> None:
    """They would overwrite each other."""
    problem: Problem = survey_problem()
    same = dataclasses.replace(problem.beams, keyframe=np.ones_like(problem.beams.keyframe))
    with pytest.raises(DataError, match=r"two pings within a millisecond at 1\.000 s"):
        side_by_side([dataclasses.replace(problem, beams=same)])


def test_fixes_of_one_keyframe_are_one() -> None:
    """Two of the same place, each with twice the variance: what one fix says."""
    problem: Problem = survey_problem()
    fixes = problem.fixes
    assert fixes is not None
    both = fixes.take(np.repeat(np.arange(len(fixes)), 2))
    both = dataclasses.replace(both, covariance_n=2.0 * both.covariance_n)
    twice = dataclasses.replace(problem, fixes=both)
    one, other = (side_by_side([p]).fixes for p in (problem, twice))
    np.testing.assert_allclose(other.position_n, one.position_n, rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(other.root_information, one.root_information, rtol=1e-9, atol=1e-12)
    place = places_of(other, [problem.frame]).place[fixes.keyframe, 0]
    expected = np.stack(problem.frame.geodetic_from_p_n(fixes.position_n), axis=-1)
    np.testing.assert_allclose(place, expected, rtol=0.0, atol=1e-9)


def test_a_run_that_ran_away_says_so() -> None:
    """Beam speeds beyond all reason: the status says it, and the run beside is as it was."""
    mission = survey().mission
    problem = survey_problem()
    speed = problem.beams.speed.copy()
    speed[:] = 1e6
    lost = dataclasses.replace(problem, beams=dataclasses.replace(problem.beams, speed=speed))
    alone, _ = filter_geodetic([problem, problem], [mission.imu] * 2)
    beside, away = filter_geodetic([problem, lost], [mission.imu] * 2)
    assert away.status in {Status.DIVERGED, Status.SUSPECT}
    assert beside.status is Status.CONVERGED, beside.reason
    np.testing.assert_array_equal(beside.trajectory.lat, alone.trajectory.lat)


@pytest.mark.parametrize("wrong", [{"tolerance": 0.0}, {"max_iterations": 0}])
def test_settings_are_checked(wrong: dict[str, int]) -> None:
    """Refused with a sentence."""
    with pytest.raises(ConfigError, match="expected"):
        GeodeticConfig(**wrong)  # type: ignore[arg-type]
