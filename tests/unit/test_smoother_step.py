"""The Gauss-Newton step: taken whole, halved where it raises the cost, or not at all."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from ssm_graph.base.frozen import Array
from ssm_graph.base.stepwise import finished
from ssm_graph.engine.chain import ChainSolution
from ssm_graph.engine.states import States
from ssm_graph.graph.linearize import GraphLinearizer
from ssm_graph.mission.problem import build_problem
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


@pytest.mark.parametrize(("overshoot", "taken"), [(1.5, 1.5), (3.0, 1.5), (7.0, 1.75)])
def test_a_step_too_long_is_halved(overshoot: float, taken: float) -> None:
    """Beyond twice the way to the minimum the cost rises."""
    linearizer, states, step, weights, cost = off_the_minimum()
    moved, _ = finished(descend_steps(linearizer, states, scaled(step, overshoot), weights, cost))
    assert same(moved, states.moved(taken * step.step))


def test_a_step_uphill_is_not_taken() -> None:
    """The states stay."""
    linearizer, states, step, weights, cost = off_the_minimum()
    moved, rows = finished(descend_steps(linearizer, states, scaled(step, -100.0), weights, cost))
    assert same(moved, states)
    np.testing.assert_array_equal(rows.error, linearizer.beam_rows(states).error)
