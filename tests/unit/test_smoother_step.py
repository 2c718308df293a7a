"""The Gauss-Newton step: taken whole, halved where it raises the cost, or not at all."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from ssm_graph.graph.states import States, states_from_arrays

from ssm_graph.base.frozen import Array
from ssm_graph.graph.linearize import GraphLinearizer
from ssm_graph.mission.problem import build_problem
from ssm_graph.smoothers.passes import descend
from tests.helpers import simulated, state_errors, true_states


@cache
def off_the_minimum() -> tuple[GraphLinearizer, States, tuple[Array, Array], Array, float]:
    """Return a graph, states centimetres off, the step back, weights and the cost there."""
    sim = simulated(duration_s=10.0)
    problem = build_problem(sim.mission)
    truth = true_states(problem, sim)
    linearizer = GraphLinearizer(problem)
    shifted = truth.v_n + np.array([0.02, -0.03, 0.01])
    states = states_from_arrays(truth.R_nb, truth.p_n, shifted, truth.bias)
    linearizer.follow(states)
    rows = linearizer.beam_rows(states)
    weights = np.ones(len(rows.error))
    step = linearizer.solve(states, rows, weights)
    return linearizer, states, step.delta, weights, linearizer.cost(states, rows, weights)


def scaled(delta: tuple[Array, Array], scale: float) -> tuple[Array, Array]:
    """Return a step of another length."""
    return scale * delta[0], scale * delta[1]


def same(a: States, b: States) -> bool:
    """Tell whether two states are equal to rounding."""
    return bool(np.abs(state_errors(a, b)).max() < 1e-9)


def test_a_good_step_is_taken_whole() -> None:
    """And is what the linear solution says."""
    linearizer, states, delta, weights, cost = off_the_minimum()
    moved, rows, update = descend(linearizer, states, delta, weights, cost)
    expected, step = linearizer.retract(states, delta)
    assert same(moved, expected)
    np.testing.assert_array_equal(update, step)
    np.testing.assert_array_equal(rows.error, linearizer.beam_rows(moved).error)
    assert linearizer.cost(moved, rows, weights) < cost


@pytest.mark.parametrize(("overshoot", "taken"), [(1.5, 1.5), (3.0, 1.5), (7.0, 1.75)])
def test_a_step_too_long_is_halved(overshoot: float, taken: float) -> None:
    """Beyond twice the way to the minimum the cost rises; what is judged is the step wanted."""
    linearizer, states, delta, weights, cost = off_the_minimum()
    moved, _, update = descend(linearizer, states, scaled(delta, overshoot), weights, cost)
    assert same(moved, linearizer.retract(states, delta, scale=taken)[0])
    _, wanted = linearizer.retract(states, delta, scale=overshoot)
    np.testing.assert_allclose(update, wanted, rtol=1e-12)


def test_a_step_uphill_is_not_taken_nor_taken_for_settled() -> None:
    """The states stay, and the update remains as large as it was."""
    linearizer, states, delta, weights, cost = off_the_minimum()
    moved, rows, update = descend(linearizer, states, scaled(delta, -100.0), weights, cost)
    assert same(moved, states)
    np.testing.assert_array_equal(rows.error, linearizer.beam_rows(states).error)
    expected = linearizer.retract(states, delta, scale=-100.0)[1]
    np.testing.assert_allclose(update, expected, rtol=1e-9, atol=1e-12)
