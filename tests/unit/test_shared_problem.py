"""A problem is a value: estimators that share one do not hear of each other."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import cache

import numpy as np

from ssm_graph.base.frozen import Array
from ssm_graph.engine.states import States
from ssm_graph.graph.gtsam_graph import gtsam_graph, gtsam_values
from ssm_graph.graph.linearize import GraphLinearizer
from ssm_graph.mission.problem import Problem, build_problem
from ssm_graph.simulation import TransitRoute
from ssm_graph.smoothers.batch import SmootherConfig, SsmSmoother, warm_start
from ssm_graph.smoothers.fixed_lag import FixedLagConfig, run_fixed_lag
from tests.helpers import simulated


@cache
def two_hypotheses() -> tuple[Problem, Problem]:
    """Return 600 m to somewhere, and the same run with a start that heads elsewhere."""
    sim = simulated(duration_s=60.0, imu_rate_hz=20.0, route=TransitRoute(speed=10.0))
    problem = build_problem(sim.mission)
    other = replace(problem, start=replace(problem.start, heading=problem.start.heading + 1.0))
    assert other.chain is problem.chain
    return problem, other


def answers(problem: Problem) -> list[Array]:
    """Return what batch and window find."""
    smoother = SsmSmoother(SmootherConfig(max_iterations=4))
    estimate = smoother.solve(problem, first=warm_start(problem))
    run = run_fixed_lag(problem, FixedLagConfig(lag_s=3.0, max_iterations=4))
    return [
        estimate.trajectory.position_cov_enu,
        estimate.trajectory.velocity_enu,
        estimate.beams.mahalanobis_sq,
        run.newest.states.p_n,
        run.newest.covariance,
    ]


def assert_same(found: list[Array], expected: list[Array]) -> None:
    """Check that all is the same to the last bit."""
    for mine, other in zip(found, expected, strict=True):
        np.testing.assert_array_equal(mine, other)


def test_estimators_in_turn_and_side_by_side_leave_each_other_alone() -> None:
    """To the last bit: alone, after the other, and in two threads at once."""
    problem, other = two_hypotheses()
    alone = answers(problem)
    elsewhere = answers(other)
    assert np.abs(alone[3] - elsewhere[3]).max() > 100.0
    assert_same(answers(problem), alone)
    with ThreadPoolExecutor(2) as threads:
        together = list(threads.map(answers, (problem, other)))
    assert_same(together[0], alone)
    assert_same(together[1], elsewhere)


def test_a_graph_handed_out_stays_as_it_was_made() -> None:
    """Its error, and the rows of the inertial data, after another track of the same problem."""
    problem, _ = two_hypotheses()
    states = warm_start(problem).states
    linearizer, graph = GraphLinearizer(problem), gtsam_graph(problem, states)
    linearizer.follow(states)
    rows, error = linearizer.inertial_rows(states), graph.error(gtsam_values(states))
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    far = States.of(states.R_nb, 10.0 * states.p_n @ turn.T, states.v_n, states.bias)
    elsewhere = GraphLinearizer(problem)
    elsewhere.follow(far)
    elsewhere.inertial_rows(far)
    gtsam_graph(problem, far)
    np.testing.assert_array_equal(linearizer.inertial_rows(states), rows)
    assert graph.error(gtsam_values(states)) == error
