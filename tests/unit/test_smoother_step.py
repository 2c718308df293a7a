"""The Gauss-Newton step: taken whole, halved where it raises the cost, or not at all."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from factors import so3
from ssm_graph.base.frozen import Array
from ssm_graph.base.stepwise import finished
from ssm_graph.engine.chain import ChainSolution
from ssm_graph.engine.error_state import POSITION, ROTATION, VELOCITY
from ssm_graph.engine.states import States
from ssm_graph.graph.linearize import GraphLinearizer
from ssm_graph.mission.problem import build_problem
from ssm_graph.smoothers import descent
from ssm_graph.smoothers.descent import descend_steps
from tests.helpers import simulated, state_errors, true_states


@cache
def off_the_minimum() -> tuple[GraphLinearizer, States, ChainSolution, Array, float]:
    """Return a graph, states centimetres off, the step back, weights and the cost there."""
    sim = simulated(duration_s=10.0)
    problem = build_problem(sim.mission)
    truth = true_states(problem, sim)
    linearizer = GraphLinearizer(problem)
    shifted = truth.v_n + np.array([0.02, -0.03, 0.01])
    states = States.of(truth.R_nb, truth.p_n, shifted, truth.bias)
    linearizer.follow(states)
    rows = linearizer.beam_rows(states)
    weights = np.ones(len(rows.error))
    step = linearizer.solve(states, rows, weights)
    return linearizer, states, step, weights, linearizer.cost(states, rows, weights)


def scaled(step: ChainSolution, scale: float) -> ChainSolution:
    """Return a step of another length."""
    return step._replace(step=scale * step.step, constants_step=scale * step.constants_step)


def same(a: States, b: States) -> bool:
    """Tell whether two states are equal to rounding."""
    return bool(np.abs(state_errors(a, b)).max() < 1e-9)


def test_a_good_step_is_taken_whole() -> None:
    """And is what the linear solution says."""
    linearizer, states, step, weights, cost = off_the_minimum()
    moved, rows = finished(descend_steps(linearizer, states, step, weights, cost))
    assert same(moved, states.moved(step.step))
    np.testing.assert_array_equal(rows.error, linearizer.beam_rows(moved).error)
    assert linearizer.cost(moved, rows, weights) < cost


@pytest.fixture
def without_ahead(monkeypatch: pytest.MonkeyPatch) -> None:
    """Take no further whole steps."""
    monkeypatch.setattr(descent, "MAX_AHEAD", 0)


@pytest.mark.usefixtures("without_ahead")
@pytest.mark.parametrize(("overshoot", "taken"), [(1.5, 1.5), (3.0, 1.5), (7.0, 1.75)])
def test_a_step_too_long_is_halved(overshoot: float, taken: float) -> None:
    """Beyond twice the way to the minimum the cost rises."""
    linearizer, states, step, weights, cost = off_the_minimum()
    moved, _ = finished(descend_steps(linearizer, states, scaled(step, overshoot), weights, cost))
    assert same(moved, states.moved(taken * step.step))


@pytest.mark.usefixtures("without_ahead")
def test_a_step_uphill_is_not_taken() -> None:
    """The states stay."""
    linearizer, states, step, weights, cost = off_the_minimum()
    moved, rows = finished(descend_steps(linearizer, states, scaled(step, -100.0), weights, cost))
    assert same(moved, states)
    np.testing.assert_array_equal(rows.error, linearizer.beam_rows(states).error)


def turned(states: States, phi_n: Array) -> Array:
    """Return the errors (K, 15) that turn a whole trajectory about the origin, to first order."""
    step = np.zeros((len(states.p_n), 15))
    step[:, ROTATION] = states.R_nb.mT @ phi_n
    step[:, POSITION] = np.einsum("kji,kj->ki", states.R_nb, np.cross(phi_n, states.p_n))
    step[:, VELOCITY] = np.cross(phi_n, states.v_n)
    return step


def test_a_turn_by_much_is_reached_by_whole_steps() -> None:
    """From a heading 40 degrees off, where beams and inertial data fit but the start does not."""
    linearizer, first, step, weights, cost = off_the_minimum()
    least, rows = finished(descend_steps(linearizer, first, step, weights, cost))
    far = turned(least, np.array([0.0, 0.0, np.radians(40.0)]))
    states = least.moved(far, swings=True)
    rows = linearizer.beam_rows(states)
    step, cost = linearizer.solve(states, rows, weights), linearizer.cost(states, rows, weights)
    straight = states.moved(step.step)
    assert linearizer.cost(straight, linearizer.beam_rows(straight), weights) > cost
    moved, _ = finished(descend_steps(linearizer, states, step, weights, cost))
    assert np.abs(state_errors(moved, least)[:, 2]).max() < np.radians(1.0)


def test_what_states_carry_turns_along() -> None:
    """A turn of all states about the vertical leaves body velocities, and is one to first order."""
    _, states, _, _, _ = off_the_minimum()
    phi_n = np.array([0.0, 0.0, 1.2])
    step = turned(states, phi_n)
    swung, turn = states.moved(step, swings=True), so3.exp(phi_n)
    np.testing.assert_allclose(swung.R_nb, turn @ states.R_nb, atol=1e-12)
    np.testing.assert_allclose(swung.p_n, states.p_n @ turn.T, atol=1e-12)
    np.testing.assert_allclose(swung.v_n, states.v_n @ turn.T, atol=1e-12)
    small = 1e-4 * np.random.default_rng(0).standard_normal(step.shape)
    apart = state_errors(states.moved(small, swings=True), states.moved(small))
    assert np.abs(apart).max() < 1e-6 * max(np.abs(states.p_n).max(), 1.0)
