"""Ranges, headings and standstill: Jacobians, closed forms, and GTSAM's own where it has one."""

from __future__ import annotations

import math
from collections.abc import Callable

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import L, X

from factors.beacon_range import range_residual
from factors.compass_heading import CompassErrors, heading_residual
from factors.standstill import standstill_residual
from ssm_graph.base.frozen import Array
from ssm_graph.engine.states import States
from ssm_graph.graph.aids.aid import Aid
from ssm_graph.graph.measurements import Measurements, aids_of
from ssm_graph.mission.problem import Problem, build_problem
from tests.aids_fixture import with_every_aid
from tests.helpers import rotation, true_states

ATTITUDES = {
    "random": rotation([0.3, -1.1, 0.8]),
    "near identity": rotation([1e-6, -2e-6, 1e-6]),
    "near pi": rotation([0.02, -0.03, math.pi - 1e-3]),
}
P_N = np.array([10.0, -20.0, -3.0])
LEVER, BEACON = np.array([0.4, -0.7, 1.1]), np.array([110.0, 30.0, -60.0])
EAST, NORTH = np.eye(3)[0], np.eye(3)[1]
IRON = CompassErrors(np.array(0.1), np.array([0.2, -0.1]), np.array([-0.05, 0.08]))


def slopes(error: Callable[[Array], Array], size: int = 3, step: float = 1e-5) -> Array:
    """Return the derivative (size,) of a scalar error at zero by central differences."""
    moved = [error(d) - error(-d) for d in step * np.eye(size)]
    return np.array(moved) / (2.0 * step)


def range_error(R: Array, p: Array, beacon: Array) -> Array:
    """Return the error of a range of 100 m."""
    return range_residual(R, p, lever_arm_b=LEVER, beacon_n=beacon, range_m=np.array(100.0)).error


@pytest.mark.parametrize("R_nb", ATTITUDES.values(), ids=ATTITUDES)
def test_jacobians_of_a_range(R_nb: Array) -> None:
    """Every block, and those of GTSAM's range from a sensor on the body."""
    at = range_residual(R_nb, P_N, lever_arm_b=LEVER, beacon_n=BEACON, range_m=np.array(100.0))
    moves: list[tuple[Array, Callable[[Array], Array]]] = [
        (at.error_D_rotation, lambda d: range_error(R_nb @ rotation(d), P_N, BEACON)),
        (at.error_D_position, lambda d: range_error(R_nb, P_N + R_nb @ d, BEACON)),
        (at.error_D_beacon_n, lambda d: range_error(R_nb, P_N, BEACON + d)),
    ]
    for block, moved in moves:
        np.testing.assert_allclose(block, slopes(moved), atol=1e-8)
    sensor = gtsam.Pose3(gtsam.Rot3(), LEVER)
    unit = gtsam.noiseModel.Unit.Create(1)
    factor = gtsam.RangeFactorWithTransform3D(X(0), L(0), 100.0, unit, sensor)
    values = gtsam.Values()
    values.insert(X(0), gtsam.Pose3(gtsam.Rot3(R_nb), P_N))
    values.insert(L(0), BEACON)
    jacobian, b = factor.linearize(values).jacobian()
    blocks = [at.error_D_rotation, at.error_D_position, at.error_D_beacon_n]
    np.testing.assert_allclose(at.error, -b[0], atol=1e-10)
    np.testing.assert_allclose(np.concatenate(blocks), jacobian[0], atol=1e-12)


def test_a_range_of_nothing_stays_finite() -> None:
    """At the beacon itself there is no direction, and no NaN either."""
    at = range_residual(
        np.eye(3), np.zeros(3), lever_arm_b=np.zeros(3), beacon_n=np.zeros(3), range_m=np.zeros(())
    )
    assert at.error == 0.0
    assert all(np.all(np.isfinite(block)) for block in at)


def heading_error(R: Array, errors: CompassErrors = IRON) -> Array:
    """Return the error of a heading of one radian."""
    return heading_residual(
        R, east_n=EAST, north_n=NORTH, errors=errors, heading=np.array(1.0)
    ).error


@pytest.mark.parametrize("R_nb", ATTITUDES.values(), ids=ATTITUDES)
def test_jacobians_of_a_heading(R_nb: Array) -> None:
    """Attitude and iron; the offset adds to the error as it is."""
    at = heading_residual(R_nb, east_n=EAST, north_n=NORTH, errors=IRON, heading=np.array(1.0))
    moves: list[tuple[Array, int, Callable[[Array], Array]]] = [
        (at.error_D_rotation, 3, lambda d: heading_error(R_nb @ rotation(d))),
        (
            at.error_D_one_cycle,
            2,
            lambda d: heading_error(R_nb, IRON._replace(one_cycle=IRON.one_cycle + d)),
        ),
        (
            at.error_D_two_cycle,
            2,
            lambda d: heading_error(R_nb, IRON._replace(two_cycle=IRON.two_cycle + d)),
        ),
    ]
    for block, size, moved in moves:
        np.testing.assert_allclose(block, slopes(moved, size), atol=1e-8)
    further = heading_error(R_nb, IRON._replace(offset=IRON.offset + 0.01))
    assert further - at.error == pytest.approx(0.01)


@pytest.mark.parametrize("degrees", [-179.9, -60.0, 0.0, 33.0, 179.9])
def test_a_heading_is_clockwise_from_north(degrees: float) -> None:
    """A vehicle that is level and heads so reads so; the error does not care for full turns."""
    psi = math.radians(degrees)
    level = np.array(
        [
            [math.sin(psi), math.cos(psi), 0.0],
            [math.cos(psi), -math.sin(psi), 0.0],
            [0.0, 0.0, -1.0],
        ]
    )
    none = CompassErrors(np.zeros(()), np.zeros(2), np.zeros(2))
    for read in (psi, psi + 2.0 * math.pi):
        residual = heading_residual(
            level, east_n=EAST, north_n=NORTH, errors=none, heading=np.array(read)
        )
        assert residual.error == pytest.approx(0.0, abs=1e-12)
    # A turn to starboard, about the down axis, adds to the heading.
    np.testing.assert_allclose(residual.error_D_rotation, [0.0, 0.0, 1.0], atol=1e-12)


def test_a_heading_straight_up_stays_finite() -> None:
    """There is none, and no NaN either."""
    up = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]]) * -1.0
    residual = heading_residual(up, east_n=EAST, north_n=NORTH, errors=IRON, heading=np.array(1.0))
    assert all(np.all(np.isfinite(block)) for block in residual)


def test_standing_still_is_a_velocity_of_zero() -> None:
    """Error and Jacobian are those of a prior on the velocity."""
    v_n = np.array([[0.1, -0.2, 0.3], [0.0, 0.0, 0.0]])
    residual = standstill_residual(v_n)
    np.testing.assert_array_equal(residual.error, v_n)
    np.testing.assert_array_equal(residual.error_D_velocity_n, [np.eye(3)] * 2)


def off_the_truth() -> tuple[Problem, States]:
    """Return a problem with every aid, and states somewhat off the truth."""
    sim = with_every_aid(seed=5)
    problem = build_problem(sim.mission)
    states = true_states(problem, sim)
    rng = np.random.default_rng(0)
    extras = problem.extras
    states = states._replace(walks=np.zeros((problem.n_keyframes, extras.n_walks)))
    states = states._replace(constants=np.zeros(extras.n_constants))
    scale = np.array([0.02] * 3 + [1.0] * 3 + [0.1] * 3 + [1e-3] * 6 + [0.01] * extras.n_walks)
    step = rng.standard_normal((problem.n_keyframes, len(scale))) * scale
    return problem, states.moved(step, 0.3 * extras.sigma[extras.n_walks :])


@pytest.mark.parametrize("name", ["USBL", "range", "heading", "standstill", "depth"])
def test_rows_are_the_derivative_of_the_errors(name: str) -> None:
    """Along states, walks and constants, of every measurement of every aid."""
    problem, states = off_the_truth()
    aids = Measurements(aids_of(problem), problem.extras)
    aid = next(aid for aid in aids.all if aid.name == name)
    jacobian = aid.measured(aids.at_keyframes(aid, states)).jacobian
    extras, h = problem.extras, 1e-3 if name == "depth" else 1e-5  # heights round to 1e-9 m
    for column in range(extras.width):
        errors = [_moved_error(aids, aid, states, column, sign * h) for sign in (1.0, -1.0)]
        slope = (errors[0] - errors[1]) / (2.0 * h)
        np.testing.assert_allclose(jacobian[..., column], slope, atol=2e-5, err_msg=str(column))


def _moved_error(aids: Measurements, aid: Aid, states: States, column: int, by: float) -> Array:
    """Return the errors with one variable moved at all keyframes."""
    state_dim = 15 + states.walks.shape[1]
    step, constants = np.zeros((len(states.p_n), state_dim)), np.zeros_like(states.constants)
    if column < state_dim:
        step[:, column] = by
    else:
        constants[column - state_dim] = by
    moved = states.moved(step, constants)
    return aid.measured(aids.at_keyframes(aid, moved)).error
