"""The factors of a mission: zero at the truth over the curved Earth."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import B, V, X

from ssm_graph.base.earth import radii_of_curvature
from ssm_graph.base.frozen import Array
from ssm_graph.engine.error_state import STATE_DIM
from ssm_graph.engine.states import States
from ssm_graph.graph.gtsam_graph import (
    aid_graph,
    chain_ordering,
    gtsam_values,
    prior_graph,
)
from ssm_graph.mission.problem import Problem, build_problem, start_of
from ssm_graph.simulation import (
    CALM,
    DepthProfile,
    DepthSettings,
    GnssSettings,
    SimulatedMission,
    TransitRoute,
    Waves,
)
from tests.helpers import simulated, state_errors, true_states, with_initial

ARM = (3.0, -2.0, 1.5)


@cache
def far_transit(
    *, depth_hz: float, waves: Waves = CALM
) -> tuple[SimulatedMission, Problem, States]:
    """Return 10 km in 1000 s with long lever arms, perfect sensors; down by 30 m half way."""
    sim = simulated(
        duration_s=1000.0,
        imu_rate_hz=10.0,
        route=TransitRoute(speed=10.0, depth=DepthProfile(10.0, 40.0, mid_s=500.0, tau_s=100.0)),
        waves=waves,
        perfect_sensors=True,
        draw_initial_errors=False,
        depth=DepthSettings(rate_hz=depth_hz, lever_arm_b=ARM),
        gnss=GnssSettings(rate_hz=0.2, lever_arm_b=ARM, windows=((0.0, 1e9),)),
    )
    problem = build_problem(sim.mission)
    return sim, problem, true_states(problem, sim)


def errors_of(graph: gtsam.NonlinearFactorGraph, states: States) -> Array:
    """Return unwhitened errors, one row a factor."""
    rows, values = [], gtsam_values(states)
    for k in range(graph.size()):
        factor = graph.at(k)
        assert isinstance(factor, gtsam.NoiseModelFactor)
        rows.append(factor.unwhitenedError(values))
    return np.array(rows)


def depth_graph(problem: Problem, states: States) -> gtsam.NonlinearFactorGraph:
    """Return the factors of depth alone."""
    return aid_graph(replace(problem, fixes=None), states)


def depth_errors(problem: Problem, states: States) -> Array:
    """Return what depth misses at the states, m."""
    assert problem.depths is not None
    return errors_of(depth_graph(problem, states), states)[:, 2]


def test_gnss_is_zero_at_the_truth_10_km_away() -> None:
    """Antenna off by its lever arm, positions by the ellipsoid: rounding of 6e6 m is left."""
    _, problem, states = far_transit(depth_hz=1.0, waves=Waves())
    assert np.linalg.norm(states.p_n[-1]) > 9900.0
    errors = errors_of(aid_graph(replace(problem, depths=None), states), states)
    assert len(errors) == 200
    assert np.abs(errors).max() < 2e-8


def test_depth_is_zero_at_the_truth_10_km_away() -> None:
    """Readings at the keyframes: the ellipsoid falls away by 7.8 m over these 10 km."""
    _, problem, states = far_transit(depth_hz=1.0, waves=Waves())
    assert states.p_n[-1, 2] < -40.0 - 7.5
    assert np.abs(depth_errors(problem, states)).max() < 2e-8


def test_depth_between_keyframes_is_carried_along_the_track() -> None:
    """Three readings a second: each is compared with the height at its own time."""
    _, problem, states = far_transit(depth_hz=3.0)
    assert np.abs(depth_errors(problem, states)).max() < 1e-6


def test_depth_carried_to_the_next_keyframe_in_waves() -> None:
    """A cubic over 1 s misses 0.3 m of heave at 6.5 s by 0.4 mm; 3 m of arm make it 0.8 mm.

    The first interval begins where the inertial data do: the arm's rate there is of half a sample
    later, which makes it 1.3 mm.
    """
    _, problem, states = far_transit(depth_hz=3.0, waves=Waves())
    errors = np.abs(depth_errors(problem, states))
    assert errors[1:].max() < 1e-3
    assert errors[0] < 2e-3


def test_depth_counts_the_height_error_and_its_readings() -> None:
    """A state 0.2 m too high misses by 0.2 m; n readings weigh n times one."""
    _, problem, truth = far_transit(depth_hz=3.0)
    raised = truth.p_n + np.array([0.0, 0.0, 0.2])
    states = States.of(truth.R_nb, raised, truth.v_n, truth.bias)
    np.testing.assert_allclose(depth_errors(problem, states), 0.2, atol=1e-5)
    assert problem.depths is not None
    graph, values = depth_graph(problem, states), gtsam_values(states)
    counts = np.bincount(problem.depths.keyframe, minlength=problem.n_keyframes)
    costs = [graph.at(k).error(values) for k in range(graph.size())]
    expected = 0.5 * counts[counts > 0] * (0.2 / problem.depths.sigma) ** 2
    np.testing.assert_allclose(costs, expected, rtol=2e-4)


def test_depth_says_nothing_of_the_local_level() -> None:
    """GTSAM's position factor is used along the vertical at the vehicle alone."""
    _, problem, truth = far_transit(depth_hz=1.0)
    assert problem.depths is not None
    graph = depth_graph(problem, truth)
    level = np.array([5.0, -9.0, 0.0])
    shifted = truth.p_n + problem.frame.R_nl_at(truth.p_n) @ level
    aside = States.of(truth.R_nb, shifted, truth.v_n, truth.bias)
    assert graph.error(gtsam_values(aside)) < 1e-9


def test_prior_is_zero_at_the_initial_state_and_has_its_sigmas() -> None:
    """Far off the frame's origin: one sigma of each axis costs one half, two sigmas two."""
    sim = simulated(duration_s=2.0, route=TransitRoute(speed=10.0))
    truth = sim.truth_at([1000.0])
    lat, lon = float(truth.lat[0]), float(truth.lon[0])
    mission = with_initial(
        sim.mission,
        lat=lat,
        lon=lon,
        height=-40.0,
        roll=0.2,
        pitch=-0.1,
        heading=1.0,
        position_sigma_enu=np.array([0.1, 0.2, 0.4]),
        velocity_sigma_enu=np.array([0.01, 0.02, 0.04]),
        attitude_sigma=np.array([0.001, 0.002, 0.004]),
    )
    start = mission.initial
    assert start is not None
    prior = prior_graph(build_problem(mission))
    meridian, prime_vertical = radii_of_curvature(lat)
    parallel = float(prime_vertical) * np.cos(lat)
    for change, half_chi_sq in (
        ({}, 0.0),
        ({"roll": 0.201}, 0.5),
        ({"pitch": -0.102}, 0.5),
        ({"heading": 1.004}, 0.5),
        ({"lon": lon + 0.1 / parallel}, 0.5),
        ({"lat": lat - 0.2 / float(meridian)}, 0.5),
        ({"height": -40.8}, 2.0),
        ({"velocity_enu": start.velocity_enu + np.array([0.01, 0.0, 0.0])}, 0.5),
        ({"velocity_enu": start.velocity_enu - np.array([0.0, 0.04, 0.0])}, 2.0),
    ):
        other = start_of(build_problem(with_initial(mission, **change)))
        columns = (other.R_nb, other.p_n, other.v_n, other.bias)
        values = gtsam_values(States.of(*(column[None] for column in columns)))
        assert prior.error(values) == pytest.approx(half_chi_sq, rel=0.01, abs=1e-9)


def test_ordering_goes_keyframe_by_keyframe() -> None:
    """Pose, velocity, bias, in time."""
    ordering = chain_ordering(2)
    keys = [ordering.at(i) for i in range(ordering.size())]
    assert keys == [X(0), V(0), B(0), X(1), V(1), B(1)]


def test_arrays_and_values_move_together() -> None:
    """A step taken on both sides leaves them saying the same."""
    sim = simulated(duration_s=8.0)
    states = true_states(build_problem(sim.mission), sim)
    n = len(states.p_n)
    rng = np.random.default_rng(5)
    step = 0.1 * rng.normal(size=(n, STATE_DIM))
    moved = states.moved(step)
    delta = gtsam.VectorValues()
    for k, own in enumerate(step):
        delta.insert(X(k), own[:6])
        delta.insert(V(k), own[6:9])
        delta.insert(B(k), own[9:])
    assert gtsam_values(moved).equals(gtsam_values(states).retract(delta), 1e-12)
    errors = state_errors(states, moved)
    np.testing.assert_allclose(errors[:, 6:], step[:, 6:], atol=1e-13)
    np.testing.assert_allclose(errors[:, :3], step[:, :3], atol=1e-12)


@pytest.mark.parametrize("n_keyframes", [9, 11, 101])
def test_states_keep_their_order(n_keyframes: int) -> None:
    """Keys sort as numbers, not as text: keyframe 10 comes after 9."""
    p_n = np.arange(3.0 * n_keyframes).reshape(-1, 3)
    identity = np.tile(np.eye(3), (n_keyframes, 1, 1))
    states = States.of(identity, p_n, -p_n, np.hstack([p_n, p_n]))
    moved = states.moved(np.zeros((n_keyframes, STATE_DIM)))
    np.testing.assert_array_equal(moved.p_n, p_n)
    np.testing.assert_array_equal(moved.R_nb, identity)
