"""The linearised graph against GTSAM's and against its cost, with extra variables and without."""

from __future__ import annotations

from functools import cache
from typing import Any

import gtsam
import numpy as np
import pytest

from ssm_graph.base.errors import ConfigError
from ssm_graph.base.frozen import Array
from ssm_graph.engine.error_state import STATE_DIM
from ssm_graph.engine.extras import Extra, Extras
from ssm_graph.engine.states import States
from ssm_graph.graph.gtsam_graph import chain_ordering, gtsam_graph, gtsam_values
from ssm_graph.graph.linearize import GraphLinearizer
from ssm_graph.mission.problem import Problem, build_problem
from ssm_graph.sensors.drift import Drift
from ssm_graph.sensors.standstill import Standstill
from ssm_graph.simulation import (
    AidSettings,
    CompassSettings,
    GnssSettings,
    Grade,
    RangingSettings,
    UsblSettings,
)
from tests.aids_fixture import KNOWN
from tests.calibration_cases import as_stated, asking
from tests.calibration_fixture import miscalibrated
from tests.helpers import drifting, simulated, true_states


@cache
def problems() -> tuple[Problem, Problem, States]:
    """Return a problem with all calibrations, the same with none, and states a little off."""
    sim = miscalibrated(duration_s=30.0)
    wide = asking(sim.mission, beam_scale_sigma=0.01, scale_walk_density=1e-4)
    wide = drifting(wide, Drift(0.01, 20.0, 0.5), Drift(0.5, 60.0, 0.5))
    problem, plain = build_problem(wide), build_problem(as_stated(sim.mission))
    truth = true_states(problem, sim)
    rng = np.random.default_rng(0)
    off = 0.02 * rng.normal(size=truth.v_n.shape)
    states = States.of(
        truth.R_nb,
        truth.p_n + off,
        truth.v_n - off,
        truth.bias,
        1e-3 * rng.normal(size=(problem.n_keyframes, problem.extras.n_walks)),
        0.01 * rng.normal(size=problem.extras.n_constants),
    )
    return problem, plain, states


def with_small_priors(problem: Problem, sigma: float) -> Problem:
    """Return the problem with all extra variables as good as known."""
    blocks = tuple(
        Extra(block.name, block.labels, np.full_like(block.sigma, sigma), unit=block.unit)
        for block in problem.extras.blocks
    )
    changed = {name: getattr(problem, name) for name in problem.__slots__ if name != "extras"}
    return Problem(**changed, extras=Extras(blocks))


def dense(graph: gtsam.NonlinearFactorGraph, states: States) -> tuple[Array, Array]:
    """Return step (K, 15) and covariance (K, 15, 15) of a graph of GTSAM's, by NumPy.

    Columns are scaled to unit length, and ``J'J`` is inverted through the QR of ``J``: the normal
    equations themselves would lose half of the digits.
    """
    n = len(states.p_n)
    J, b = graph.linearize(gtsam_values(states)).jacobian(chain_ordering(n))
    scale = 1.0 / np.linalg.norm(J, axis=0)
    Q, R = np.linalg.qr(J * scale)
    R_inv = np.linalg.inv(R) * scale[:, None]
    blocks = R_inv.reshape(n, STATE_DIM, -1)
    return (R_inv @ (Q.T @ b)).reshape(n, STATE_DIM), blocks @ np.swapaxes(blocks, 1, 2)


@pytest.mark.parametrize("grade", Grade, ids=lambda grade: grade.name)
def test_it_is_gtsams_graph(grade: Grade, monkeypatch: pytest.MonkeyPatch) -> None:
    """Step, covariance and cost are those of GTSAM's factors and one in Python for each beam.

    Up to the gradient of gravity, which those do not know.
    """
    monkeypatch.setattr(
        "ssm_graph.graph.inertial_rows.gravity_gradient", lambda _: np.zeros((3, 3))
    )
    gnss = GnssSettings(windows=((0.0, 9.0),))
    sim = simulated(duration_s=8.0, gnss=gnss, dropout_rate=0.2, grade=grade)
    problem = build_problem(sim.mission)
    truth, rng = true_states(problem, sim), np.random.default_rng(3)
    size = np.repeat([1e-5, 1e-3, 1e-3, 1e-5, 1e-8], 3)
    states = truth.moved(size * rng.normal(size=(problem.n_keyframes, STATE_DIM)))
    weights = rng.uniform(0.01, 1.1, len(problem.beams.speed))
    linearizer = GraphLinearizer(problem)
    linearizer.follow(states)
    of_aids = rng.uniform(0.01, 1.1, len(linearizer.weighted))
    rows = linearizer.beam_rows(states)
    found = linearizer.solve(states, rows, weights, of_aids)
    graph = gtsam_graph(problem, states, weights, of_aids)
    step, P = dense(graph, states)
    sigma = np.sqrt(np.diagonal(P, axis1=1, axis2=2))
    scale = sigma[:, :, None] * sigma[:, None, :]
    np.testing.assert_allclose(found.covariance(STATE_DIM) / scale, P / scale, rtol=0.0, atol=1e-8)
    np.testing.assert_allclose(found.step / sigma, step / sigma, rtol=0.0, atol=1e-7)
    cost = linearizer.cost(states, rows, weights, of_aids)
    assert cost == pytest.approx(graph.error(gtsam_values(states)), rel=1e-9)


def test_it_is_gtsams_graph_with_further_aids(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every kind of them, each measurement with a weight of its own."""
    monkeypatch.setattr(
        "ssm_graph.graph.inertial_rows.gravity_gradient", lambda _: np.zeros((3, 3))
    )
    aids = AidSettings(
        usbl=UsblSettings(interval_s=2.1),
        ranging=RangingSettings((KNOWN,), interval_s=1.3),
        compass=CompassSettings(declination=0.1),
        standstills=(Standstill(4.0, 6.5),),
    )
    sim = simulated(duration_s=8.0, grade=Grade.TACTICAL, aids=aids)
    problem = build_problem(sim.mission)
    truth, rng = true_states(problem, sim), np.random.default_rng(4)
    size = np.repeat([1e-3, 1e-2, 0.3, 1e-5, 1e-8], 3)
    states = truth.moved(size * rng.normal(size=(problem.n_keyframes, STATE_DIM)))
    linearizer = GraphLinearizer(problem)
    weights = rng.uniform(0.01, 1.1, len(problem.beams.speed))
    aid_weights = rng.uniform(0.01, 1.1, len(linearizer.weighted))
    assert len(linearizer.weighted.all) == 5
    linearizer.follow(states)
    rows = linearizer.beam_rows(states)
    found = linearizer.solve(states, rows, weights, aid_weights)
    graph = gtsam_graph(problem, states, weights, aid_weights)
    step, P = dense(graph, states)
    sigma = np.sqrt(np.diagonal(P, axis1=1, axis2=2))
    scale = sigma[:, :, None] * sigma[:, None, :]
    np.testing.assert_allclose(found.covariance(STATE_DIM) / scale, P / scale, rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(found.step / sigma, step / sigma, rtol=0.0, atol=1e-9)
    cost = linearizer.cost(states, rows, weights, aid_weights)
    assert cost == pytest.approx(graph.error(gtsam_values(states)), rel=1e-9)


def test_gtsams_graph_has_no_calibration() -> None:
    """It says which variables are in the way."""
    problem, _, states = problems()
    with pytest.raises(ConfigError, match="estimates dvl_scale"):
        gtsam_graph(problem, states)


def test_with_everything_known_it_is_the_graph_without() -> None:
    """Step, covariance, cost and misfit are those of the keyframes alone."""
    problem, plain, states = problems()
    known = with_small_priors(problem, 1e-7)
    states = states._replace(
        walks=np.zeros((known.n_keyframes, 0)), constants=np.zeros(known.extras.n_constants)
    )
    weights = np.random.default_rng(1).uniform(0.1, 1.0, size=len(plain.beams.speed))
    found: list[tuple[Any, ...]] = []
    for of, at in ((known, states), (plain, states._replace(constants=np.zeros(0)))):
        linearizer = GraphLinearizer(of)
        linearizer.follow(at)
        rows = linearizer.beam_rows(at)
        step = linearizer.solve(at, rows, weights)
        cost = linearizer.cost(at, rows, weights)
        variance = step.variance(plain.beams.keyframe, rows.jacobian)
        found.append(
            (step.covariance(STATE_DIM), cost, variance, linearizer.inertial_misfit(at), step.step)
        )
    (P, cost, variance, misfit, update), (P_2, cost_2, variance_2, misfit_2, update_2) = found
    sigma = np.sqrt(np.diagonal(P_2, axis1=1, axis2=2))
    scale = sigma[:, :, None] * sigma[:, None, :]
    np.testing.assert_allclose(P / scale, P_2 / scale, atol=1e-6)
    np.testing.assert_allclose(update / sigma, update_2 / sigma, atol=1e-4)
    np.testing.assert_allclose(variance, variance_2, rtol=1e-6)
    assert cost == pytest.approx(cost_2, rel=1e-9)
    assert misfit.sum_sq == pytest.approx(misfit_2.sum_sq, rel=1e-9)
    assert misfit[1:] == misfit_2[1:]


def along(linearizer: GraphLinearizer, states: States, direction: Array) -> tuple[float, float]:
    """Return slope and curvature of the cost along a direction of all variables."""
    problem = linearizer.problem
    n = problem.extras.state_dim
    end = n * problem.n_keyframes
    delta = (direction[:end].reshape(-1, n), direction[end:])
    weights = np.ones(len(problem.beams.speed))

    def cost(scale: float) -> float:
        moved = states.moved(scale * delta[0], scale * delta[1])
        return linearizer.cost(moved, linearizer.beam_rows(moved), weights)

    ends = cost(1.0), cost(0.0), cost(-1.0)
    return 0.5 * (ends[0] - ends[2]), ends[0] - 2.0 * ends[1] + ends[2]


def test_the_linear_graph_is_the_derivative_of_the_cost() -> None:
    """Where its step comes to nothing the cost has no slope, along any kind of variable.

    A wrong Jacobian would settle elsewhere. That of the DVL's clock takes the acceleration as the
    mean over the ping window, and settles within a hundredth of a sigma.
    """
    problem, _, states = problems()
    linearizer = GraphLinearizer(problem)
    linearizer.follow(states)
    moved, weights = states, np.ones(len(problem.beams.speed))
    for _ in range(6):
        step = linearizer.solve(moved, linearizer.beam_rows(moved), weights)
        moved = moved.moved(step.step, step.constants_step)
    P = step.constants_cov
    labels = [label for block in problem.extras.blocks for label in block.labels]
    for i, label in enumerate(labels[problem.extras.n_walks :]):
        direction = np.zeros(len(step.sigma))
        direction[len(direction) - len(P) + i] = 0.1 * np.sqrt(P[i, i])
        slope, curvature = along(linearizer, moved, direction)
        allowed = 1e-2 if label == "dvl_time_offset_s" else 1e-4
        assert abs(slope) < allowed * np.sqrt(curvature), label
    n = problem.extras.state_dim
    walks = [(5, n - 1), (29, n - 1), (0, n - 1), (7, n - 2), (8, n - 4), (9, n - 6), (4, n - 7)]
    for k, j in [(3, 0), (10, 7), (20, 12), *walks]:
        direction = np.zeros(len(step.sigma))
        direction[n * k + j] = 0.1 * step.sigma[n * k + j]
        slope, curvature = along(linearizer, moved, direction)
        assert abs(slope) < 1e-3 * np.sqrt(curvature)


def test_walks_forget_and_grow() -> None:
    """A Gauss-Markov walk comes to its stationary sigma, a random walk grows with the root."""
    sigma = np.ones(2)
    extras = Extras(
        (
            Extra("fix", ("fix",), np.ones(1)),
            Extra("slow", ("a", "b"), sigma, walk_density=0.1),
            Extra("current", ("e", "n"), sigma, walk_density=0.2, correlation_s=50.0),
        )
    )
    assert (extras.n_walks, extras.n_constants, extras.width) == (4, 1, 20)
    assert extras.columns("slow") == slice(15, 17)
    assert extras.columns("fix") == slice(19, 20)
    factor, grown = extras.transitions(np.array([1.0, 100.0, 1e6]))
    np.testing.assert_allclose(factor[:, :2], 1.0)
    np.testing.assert_allclose(grown[:, 0], 0.1 * np.sqrt([1.0, 100.0, 1e6]))
    np.testing.assert_allclose(factor[:, 2], np.exp(-np.array([1.0, 100.0, 1e6]) / 50.0))
    np.testing.assert_allclose(grown[-1, 2], 0.2 * np.sqrt(25.0))
    np.testing.assert_allclose(grown[0, 2], 0.2, rtol=0.02)


def test_values_are_found_by_name() -> None:
    """Walks for every row, constants for all, a default for what there is not."""
    extras = Extras(
        (Extra("arm", ("x", "y"), np.ones(2)), Extra("w", ("w",), np.ones(1), walk_density=1.0))
    )
    walks, constants = np.array([[1.0], [2.0]]), np.array([3.0, 4.0])
    zero = np.zeros(1)
    np.testing.assert_array_equal(extras.value("w", walks, constants, default=zero), walks)
    np.testing.assert_array_equal(extras.value("arm", walks, constants, default=zero), [3, 4])
    assert extras.value("other", walks, constants, default=zero) is zero
    assert "other" not in extras
    assert not Extras()
