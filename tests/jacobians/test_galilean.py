"""Guard for the GTSAM version: the inertial and position factors that the graph is built from."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from gtsam.symbol_shorthand import B, V, X

from ssm_graph.base.frozen import Array
from ssm_graph.engine.marginal_prior import prior_at_start
from ssm_graph.engine.states import States
from ssm_graph.graph.gtsam_graph import (
    aid_graph,
    gtsam_values,
    inertial_graph,
    prior_graph,
)
from ssm_graph.mission.problem import build_problem, start_of
from ssm_graph.simulation import GnssSettings, Grade
from tests.helpers import assert_jacobians_match, rotation, simulated, true_states

TURNS = {
    "as simulated": np.zeros(3),
    "upside down": np.array([np.pi - 1e-7, 0.0, 0.0]),
    "any": np.array([0.7, -1.2, 2.0]),
}


def disturbed(states: States, turn: Array, *, seed: int) -> States:
    """Return states some sigmas off, all turned the same way, with biases."""
    rng = np.random.default_rng(seed)
    n = len(states.p_n)
    R_nb = states.R_nb @ rotation(turn) @ rotation(0.05 * rng.normal(size=(n, 3)))
    return States.of(
        R_nb,
        states.p_n + rng.normal(size=(n, 3)),
        states.v_n + 0.3 * rng.normal(size=(n, 3)),
        rng.normal(size=(n, 6)) * np.repeat([0.05, 5e-4], 3),
    )


@pytest.mark.parametrize("turn", TURNS.values(), ids=TURNS)
def test_inertial_factor_jacobians(turn: Array) -> None:
    """GTSAM's Galilean factor, Earth rate and gravity set, against central differences."""
    sim = simulated(duration_s=4.0, grade=Grade.MEMS)
    problem = build_problem(sim.mission)
    states = disturbed(true_states(problem, sim), turn, seed=1)
    graph = inertial_graph(problem, states)
    for k in range(graph.size()):
        assert_jacobians_match(graph.at(k), gtsam_values(states), rtol=2e-6)


@pytest.mark.parametrize("turn", TURNS.values(), ids=TURNS)
def test_prior_gnss_and_depth_jacobians(turn: Array) -> None:
    """GTSAM's own unary factors, lever arms included."""
    sim = simulated(duration_s=4.0, gnss=GnssSettings(windows=((0.0, 1e9),)))
    problem = build_problem(sim.mission)
    states = disturbed(true_states(problem, sim), turn, seed=2)
    for kept in (replace(problem, depths=None), replace(problem, fixes=None)):
        graph = aid_graph(kept, states)
        assert graph.size() >= 4
        for k in range(graph.size()):
            assert_jacobians_match(graph.at(k), gtsam_values(states))
    # The prior on the rotation is logarithmic: near its mean, where it is used.
    near = disturbed(true_states(problem, sim), np.zeros(3), seed=3)
    prior = prior_graph(problem)
    assert prior.size() == 4
    for k in range(4):
        assert_jacobians_match(prior.at(k), gtsam_values(near), rtol=1e-5)


def test_marginal_prior_is_the_prior_graph_and_its_derivative_is_exact() -> None:
    """Half its squared length is the cost of GTSAM's four factors, and falls as it says."""
    sim = simulated(duration_s=2.0)
    problem = build_problem(sim.mission)
    prior, graph = prior_at_start(start_of(problem)), prior_graph(problem)
    states = disturbed(true_states(problem, sim), np.array([0.1, -0.2, 0.3]), seed=3)
    cost = 0.5 * float(np.sum(prior.whitened(states) ** 2))
    assert cost == pytest.approx(graph.error(gtsam_values(states)), rel=1e-9)
    rows = prior.rows(states)
    A, b = rows[:, :-1], rows[:, -1]
    assert 0.5 * float(b @ b) == pytest.approx(cost, rel=1e-12)
    gradient = -A.T @ b
    linear = graph.linearize(gtsam_values(states)).gradientAtZero()
    expected = np.concatenate([linear.at(key) for key in (X(0), V(0), B(0))])
    np.testing.assert_allclose(gradient, expected, rtol=1e-6, atol=1e-6)
