"""QR solution and marginals against dense algebra, and the clique order that they rest on."""

from __future__ import annotations

import dataclasses

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import B, V, X

from factors.similarity import LogKernel
from ssm_graph.data import Array
from ssm_graph.errors import SolverError
from ssm_graph.graph.first_values import first_values
from ssm_graph.graph.keys import chain_ordering
from ssm_graph.graph.linearize import GraphLinearizer
from ssm_graph.graph.solve import marginal_covariances, solve_linear
from ssm_graph.problem.error_state import STATE_DIM
from ssm_graph.problem.problem import Problem, build_problem
from ssm_graph.simulation import GnssSettings, Grade
from tests.helpers import simulated, without_beams

GNSS = GnssSettings(windows=((0.0, 1e9),))


def linear_graph(problem: Problem) -> gtsam.GaussianFactorGraph:
    """Return the linear graph at the first values, with their weights."""
    first = first_values(problem, kernel=LogKernel())
    linearizer = GraphLinearizer(problem)
    linearizer.follow(first.states)
    rows = linearizer.beam_rows(first.states)
    return linearizer.linearize(first.states, rows, first.weights)


def dense(linear: gtsam.GaussianFactorGraph, n_keyframes: int) -> tuple[Array, Array]:
    """Return solution (K, 15) and covariance (15 K, 15 K) by NumPy.

    Columns are scaled to unit length, and ``J'J`` is inverted through the QR of ``J``: the normal
    equations themselves would lose half of the digits.
    """
    J, b = linear.jacobian(chain_ordering(n_keyframes))
    scale = 1.0 / np.linalg.norm(J, axis=0)
    Q, R = np.linalg.qr(J * scale)
    R_inv = np.linalg.inv(R) * scale[:, None]
    return (R_inv @ (Q.T @ b)).reshape(-1, STATE_DIM), R_inv @ R_inv.T


def problem_of(n_keyframes: int, *, case: str, grade: Grade = Grade.TACTICAL) -> Problem:
    """Return a mission of few keyframes with all or only some aids."""
    sim = simulated(
        duration_s=float(n_keyframes - 1),
        grade=grade,
        gnss=GNSS if case == "all" else None,
        depth=None if case == "no depth" else simulated().config.depth,
        dropout_rate=0.5 if case == "few beams" else 0.0,
    )
    mission = without_beams(sim.mission) if case == "no beams" else sim.mission
    problem = build_problem(mission)
    assert problem.n_keyframes == n_keyframes
    return problem


@pytest.mark.parametrize("case", ["all", "few beams", "no beams", "no depth"])
@pytest.mark.parametrize("n_keyframes", [2, 3, 6])
def test_equals_dense_algebra(n_keyframes: int, case: str) -> None:
    """Solution and every keyframe's covariance, whatever is measured where."""
    problem = problem_of(n_keyframes, case=case)
    linear = linear_graph(problem)
    solution = solve_linear(linear, chain_ordering(n_keyframes), n_keyframes=n_keyframes)
    step, covariance = dense(linear, n_keyframes)
    marginals = marginal_covariances(solution)
    for k in range(n_keyframes):
        block = slice(STATE_DIM * k, STATE_DIM * (k + 1))
        expected = covariance[block, block]
        sigma = np.sqrt(np.diagonal(expected))
        np.testing.assert_allclose(
            marginals[k] / np.outer(sigma, sigma),
            expected / np.outer(sigma, sigma),
            rtol=0.0,
            atol=1e-8,
        )
        got = np.concatenate([solution.delta.at(symbol(k)) for symbol in (X, V, B)])
        np.testing.assert_allclose(got / sigma, step[k] / sigma, rtol=0.0, atol=1e-8)


@pytest.mark.parametrize("grade", Grade, ids=lambda grade: grade.name)
def test_equals_dense_algebra_at_every_grade(grade: Grade) -> None:
    """The navigation grade's chain, too, whose information spans many orders."""
    problem = problem_of(6, case="all", grade=grade)
    linear = linear_graph(problem)
    marginals = marginal_covariances(solve_linear(linear, chain_ordering(6), n_keyframes=6))
    _, covariance = dense(linear, 6)
    expected = np.array([covariance[15 * k : 15 * k + 15, 15 * k : 15 * k + 15] for k in range(6)])
    sigma = np.sqrt(np.diagonal(expected, axis1=1, axis2=2))
    scale = sigma[:, :, None] * sigma[:, None, :]
    np.testing.assert_allclose(marginals / scale, expected / scale, rtol=0.0, atol=1e-8)


@pytest.mark.parametrize("n_keyframes", [2, 3, 10, 30])
def test_rows_rebuild_the_information(n_keyframes: int) -> None:
    """R and S of every keyframe, put in their places, have the ``R'R`` of the whole graph.

    That holds only if each clique was taken for the right keyframe, its separator in the right
    order: a guard for GTSAM's clique order.
    """
    problem = problem_of(n_keyframes, case="few beams")
    linear = linear_graph(problem)
    solution = solve_linear(linear, chain_ordering(n_keyframes), n_keyframes=n_keyframes)
    whole = np.zeros((STATE_DIM * n_keyframes,) * 2)
    for k in range(n_keyframes):
        rows = slice(STATE_DIM * k, STATE_DIM * (k + 1))
        whole[rows, rows] = solution.R[k]
        assert np.all(np.tril(solution.R[k], -1) == 0.0)
        if k + 1 < n_keyframes:
            whole[rows, STATE_DIM * (k + 1) : STATE_DIM * (k + 2)] = solution.S[k]
    np.testing.assert_array_equal(solution.S[-1], 0.0)
    J, _ = linear.jacobian(chain_ordering(n_keyframes))
    scale = 1.0 / np.linalg.norm(J, axis=0)
    information = (J * scale).T @ (J * scale)
    np.testing.assert_allclose((whole * scale).T @ (whole * scale), information, atol=1e-12)


def test_ordering_goes_keyframe_by_keyframe() -> None:
    """Pose, velocity, bias, in time."""
    ordering = chain_ordering(2)
    keys = [ordering.at(i) for i in range(ordering.size())]
    assert keys == [X(0), V(0), B(0), X(1), V(1), B(1)]


def test_an_undetermined_graph_is_a_solver_error() -> None:
    """Without a prior nothing holds the chain: no bare GTSAM or NumPy error, no numbers."""
    problem = problem_of(4, case="no depth")
    linearizer = GraphLinearizer(problem)
    first = first_values(problem, kernel=LogKernel())
    linear = linearizer.inertial.linearize(first.states.values)
    with pytest.raises(SolverError):
        solve_linear(linear, chain_ordering(4), n_keyframes=4)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_non_finite_rows_are_a_solver_error(bad: float) -> None:
    """A NaN in one beam's row never comes out as a solution."""
    problem = problem_of(4, case="all")
    first = first_values(problem, kernel=LogKernel())
    linearizer = GraphLinearizer(problem)
    linearizer.follow(first.states)
    rows = linearizer.beam_rows(first.states)
    error = rows.error.copy()
    error[3] = bad
    linear = linearizer.linearize(first.states, rows._replace(error=error), first.weights)
    with pytest.raises(SolverError):
        solve_linear(linear, chain_ordering(4), n_keyframes=4)


def test_marginals_do_not_change_the_solution() -> None:
    """The recursion works on copies."""
    problem = problem_of(5, case="all")
    solution = solve_linear(linear_graph(problem), chain_ordering(5), n_keyframes=5)
    before = dataclasses.make_dataclass("Copy", ["R", "S"])(solution.R.copy(), solution.S.copy())
    marginal_covariances(solution)
    np.testing.assert_array_equal(solution.R, before.R)
    np.testing.assert_array_equal(solution.S, before.S)
