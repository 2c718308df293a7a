"""The process in NumPy against GTSAM's own prediction and linearisation."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import B, V, X

import ssm_graph.filters.navigation.filter as process_module
from ssm_graph.base.frozen import Array
from ssm_graph.engine.error_state import POSITION, VELOCITY
from ssm_graph.engine.states import NavigationStates, local_D_deviation
from ssm_graph.filters.navigation.filter import Process
from ssm_graph.imu.preintegration import gtsam_gravity
from ssm_graph.mission.problem import Problem, build_problem
from ssm_graph.simulation import Grade
from tests.helpers import simulated

POSE = gtsam.Pose3(gtsam.Rot3.Expmap(np.array([0.3, 0.2, 1.0])), np.array([900.0, 50.0, -20.0]))
VELOCITY_N = np.array([1.0, 2.0, 0.1])
NO_BIAS = np.zeros(6)
LARGE_BIAS = np.array([0.05, -0.1, 0.02, 0.01, -0.02, 0.005])

# Columns of a linearised inertial factor that belong to its first and its second keyframe.
I_COLUMNS = np.r_[0:9, 18:24]
J_COLUMNS = np.r_[9:18, 24:30]


def states_of(bias: Array) -> NavigationStates:
    """Return one run's states."""
    R_nb, p_n = POSE.rotation().matrix(), POSE.translation()
    return NavigationStates(R_nb[None], p_n[None], VELOCITY_N[None], bias[None])


def gtsam_step(problem: Problem, k: int, bias: Array) -> tuple[gtsam.NavState, Array, Array]:
    """Return prediction, transition and process covariance from GTSAM's factor."""
    span = problem.keyframe_s[k + 1] - problem.keyframe_s[k]
    middle = POSE.translation() + 0.5 * span * VELOCITY_N
    g_n = np.tile(gtsam_gravity(problem.frame, middle), (problem.n_keyframes - 1, 1))
    measured = problem.chain.measured(g_n)[k]
    begin = gtsam.imuBias.ConstantBias(bias[:3], bias[3:])
    end = measured.predict(gtsam.NavState(POSE, VELOCITY_N), begin)
    values = gtsam.Values()
    for i, pose, velocity in ((0, POSE, VELOCITY_N), (1, end.pose(), end.velocity())):
        values.insert(X(i), pose3=pose)
        values.insert(V(i), velocity)
        values.insert(B(i), constant_bias=begin)
    factor = gtsam.GalileanCombinedImuFactor(X(0), V(0), X(1), V(1), B(0), B(1), measured)
    whitened, _ = factor.linearize(values).jacobian()
    root_Q = np.linalg.inv(whitened[:, J_COLUMNS])
    return end, -root_Q @ whitened[:, I_COLUMNS], root_Q @ root_Q.T


@pytest.mark.parametrize("bias", [NO_BIAS, LARGE_BIAS], ids=["no bias", "large bias"])
@pytest.mark.parametrize("k", [0, 3])
def test_prediction_is_that_of_gtsam(bias: Array, k: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """State, transition and process noise to rounding, 900 m from the origin.

    Up to the gradient of gravity, which GTSAM's factor does not know.
    """
    monkeypatch.setattr(process_module, "gravity_gradient", lambda _: np.zeros((3, 3)))
    problem = build_problem(simulated(duration_s=5.0, grade=Grade.INDUSTRIAL).mission)
    process = Process([problem.chain.intervals], problem.frame)
    prediction = process.predict(k, states_of(bias))
    end, F, Q = gtsam_step(problem, k, bias)
    states = prediction.states
    np.testing.assert_allclose(states.R_nb[0], end.attitude().matrix(), rtol=0.0, atol=2e-15)
    np.testing.assert_allclose(states.p_n[0], end.position(), rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(states.v_n[0], end.velocity(), rtol=0.0, atol=2e-14)
    np.testing.assert_array_equal(states.bias[0], bias)
    np.testing.assert_allclose(prediction.transition[0], F, rtol=0.0, atol=2e-14)
    sigma = np.sqrt(np.diag(Q))
    error = (prediction.process_cov[0] - Q) / np.outer(sigma, sigma)
    np.testing.assert_allclose(error, 0.0, rtol=0.0, atol=1e-13)


def test_transition_knows_that_gravity_changes() -> None:
    """A kilometre to each side, by differences of the prediction itself."""
    problem = build_problem(simulated(duration_s=5.0, grade=Grade.INDUSTRIAL).mission)
    process = Process([problem.chain.intervals], problem.frame)
    begin = states_of(NO_BIAS)
    at = process.predict(0, begin)
    moves = 1000.0 * np.eye(15)[POSITION]
    found = np.empty((15, 3))
    for axis, move in enumerate(moves):
        ends = [process.predict(0, begin.moved(s * move[None])).states for s in (1.0, -1.0)]
        plus, minus = (at.states.deviation_of(end)[0] for end in ends)
        found[:, axis] = (plus - minus) / 2000.0
    # Velocity in a second: 3e-6 of a metre per second for each metre.
    np.testing.assert_allclose(at.transition[0][:, POSITION], found, rtol=0.0, atol=2e-9)
    assert np.linalg.norm(found[VELOCITY]) > 3e-6


def test_runs_side_by_side_are_runs_alone() -> None:
    """Three seeds at once, bit by bit what each gives alone."""
    problems = [build_problem(simulated(duration_s=3.0, seed=seed).mission) for seed in range(3)]
    intervals = [problem.chain.intervals for problem in problems]
    alone = states_of(LARGE_BIAS)
    together = NavigationStates(*(np.repeat(column, 3, axis=0) for column in alone))
    many = Process(intervals, problems[0].frame).predict(1, together)
    for run, own in enumerate(intervals):
        single = Process([own], problems[run].frame).predict(1, alone)
        np.testing.assert_allclose(many.states.p_n[run], single.states.p_n[0], rtol=1e-15)
        np.testing.assert_allclose(many.transition[run], single.transition[0], atol=1e-14)


def test_moves_are_gtsams() -> None:
    """``moved`` is the retraction of the graph's states."""
    states = states_of(LARGE_BIAS)
    step = np.random.default_rng(0).normal(size=(1, 15)) * np.repeat([0.3, 5.0, 1.0, 0.1, 0.01], 3)
    moved = states.moved(step)
    pose = POSE.retract(step[0, :6])
    np.testing.assert_allclose(moved.R_nb[0], pose.rotation().matrix(), rtol=0.0, atol=1e-15)
    np.testing.assert_allclose(moved.p_n[0], pose.translation(), rtol=0.0, atol=1e-12)


def test_deviations_lead_where_they_came_from() -> None:
    """``displaced`` is the inverse of ``deviation_of``; position does not bend with attitude."""
    states = states_of(LARGE_BIAS)
    xi = np.random.default_rng(1).normal(size=(1, 15)) * np.repeat([0.3, 5.0, 1.0, 0.1, 0.01], 3)
    there = states.displaced(xi)
    np.testing.assert_allclose(states.deviation_of(there), xi, rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(there.p_n[0], states.p_n[0] + states.R_nb[0] @ xi[0, 3:6])


def test_transport_is_the_derivative_of_the_local_error() -> None:
    """A small change of the deviation moves the state by the Jacobian times it."""
    states = states_of(NO_BIAS)
    rng = np.random.default_rng(3)
    xi = rng.normal(size=(1, 15)) * np.repeat([0.4, 3.0, 1.0, 0.1, 0.01], 3)
    change = 1e-6 * rng.normal(size=(1, 15))
    seen = states.displaced(xi - change).deviation_of(states.displaced(xi + change))
    predicted = 2.0 * change
    predicted[:, :6] = (local_D_deviation(xi) @ predicted[:, :6, None])[..., 0]
    np.testing.assert_allclose(seen, predicted, rtol=0.0, atol=1e-11)
