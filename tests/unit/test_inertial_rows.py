"""Inertial rows: gravity changes with position, and Gauss-Newton has to know."""

from __future__ import annotations

import numpy as np
import pytest

from factors.inertial import whitened_error, whitened_rows
from ssm_graph.base.frozen import Array
from ssm_graph.engine.error_state import POSITION, STATE_DIM
from ssm_graph.engine.states import States
from ssm_graph.imu.preintegration import gravity_between, gravity_gradient
from ssm_graph.mission.estimate import Status
from ssm_graph.mission.problem import Problem, build_problem
from ssm_graph.simulation import Grade
from ssm_graph.smoothers.batch import SsmSmoother
from tests.helpers import (
    estimated_states,
    rotation,
    simulated,
    state_errors,
    true_states,
    with_initial,
)


def turned() -> tuple[Problem, States]:
    """Return a short mission and its states, all axes of the body askew."""
    sim = simulated(duration_s=3.0, grade=Grade.NAVIGATION)
    problem = build_problem(sim.mission)
    truth = true_states(problem, sim)
    return problem, truth._replace(R_nb=truth.R_nb @ rotation(np.array([0.4, -0.7, 1.1])))


@pytest.mark.parametrize("end", [0, 1], ids=["begin", "end"])
def test_rows_follow_gravity(end: int) -> None:
    """Differences over a kilometre, gravity led after the states, against the columns.

    What gravity does alone, so that the turn of the Earth meanwhile, 5e-5 of it, is seen.
    """
    problem, states = turned()
    frame, intervals = problem.frame, problem.chain.intervals
    here = (states.take(np.s_[:-1]), states.take(np.s_[1:]))
    g_n, gradient = gravity_between(frame, states.p_n), gravity_gradient(frame)
    with_it, without = (
        whitened_rows(intervals, *here, g_n=g_n, gradient=of)[1]
        for of in (gradient, np.zeros((3, 3)))
    )
    columns = with_it - without

    def by_gravity(step: Array) -> Array:
        moved = states.moved(step)
        there = (moved.take(np.s_[:-1]), moved.take(np.s_[1:]))
        middle_n = 0.5 * (moved.p_n - states.p_n)[:-1] + 0.5 * (moved.p_n - states.p_n)[1:]
        led_n = g_n + middle_n @ gradient.T
        led, kept = (whitened_error(intervals, *there, g_n=g)[1] for g in (led_n, g_n))
        return np.asarray(led - kept)

    for axis in range(3):
        step = np.zeros((problem.n_keyframes, STATE_DIM))
        step[1 + end, POSITION.start + axis] = 1000.0
        slope = (by_gravity(step) - by_gravity(-step)) / 2000.0
        expected = columns[:, STATE_DIM * end + POSITION.start + axis]
        scale = np.abs(expected).max()
        np.testing.assert_allclose(slope / scale, expected / scale, rtol=0.0, atol=1e-7)


@pytest.mark.parametrize("grade", [Grade.NAVIGATION, Grade.MEMS], ids=lambda grade: grade.name)
def test_a_start_known_to_ten_kilometres_settles(grade: Grade) -> None:
    """Beams alone: the answer comes in a few passes and is within its sigmas of the truth."""
    sim = simulated(duration_s=120.0, grade=grade, depth=None)
    mission = with_initial(sim.mission, position_sigma_enu=np.full(3, 1e4))
    problem = build_problem(mission)
    estimate = SsmSmoother().solve(problem)
    assert estimate.status is Status.CONVERGED
    assert len(estimate.iterations) < 15
    truth = true_states(problem, sim)
    errors = state_errors(estimated_states(problem, estimate.trajectory), truth)
    assert np.abs(errors[:, 6:9]).max() < 0.05
    assert np.linalg.norm(errors[:, 3:6], axis=1).max() < 3e4
