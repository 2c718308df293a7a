"""How inertial data follow errors of their sensors: every derivative against differences."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from factors import so3
from factors.imu_errors import NONE, SIZE, of_readings, put_on, taken_off
from factors.inertial import Intervals, predict, whitened_error, whitened_rows
from ssm_graph.base.frozen import Array
from ssm_graph.base.stepwise import finished
from ssm_graph.engine.error_state import STATE_DIM
from ssm_graph.engine.states import NavigationStates, States
from ssm_graph.graph.linearize import GraphLinearizer
from ssm_graph.imu.preintegration import (
    InertialChain,
    following_errors_steps,
    gravity_gradient,
    preintegrate,
)
from ssm_graph.mission.imu_variables import columns_of_errors
from ssm_graph.mission.problem import Problem, build_problem
from ssm_graph.simulation import Grade
from tests.helpers import simulated, true_states
from tests.imu_errors_fixture import SIGMAS, asking, turning

G_N = np.array([0.01, -0.02, -9.79])
UNIT = np.repeat([1.0, 1.0, 0.01], 9)
"""Errors of one size: what gyros read of 10 m/s^2 against what they read of 0.1 rad/s."""


def some_errors(size: float, seed: int = 0) -> Array:
    """Return errors (27,) of about a size."""
    return size * UNIT * np.random.default_rng(seed).normal(size=SIZE)


def following(errors: Array) -> InertialChain:
    """Return increments of some seconds that follow errors, about errors and biases not zero."""
    sim = simulated(duration_s=4.0, imu_rate_hz=100.0, grade=Grade.MEMS)
    imu, bias = sim.mission.imu, np.array([0.1, -0.05, 0.07, 0.01, 0.02, -0.015])
    gyro_b, accel_b = taken_off(errors, imu.gyro_b, imu.accel_b)
    chain = preintegrate(
        replace(imu, gyro_b=gyro_b, accel_b=accel_b),
        np.array([0.5, 0.7, 1.0, 2.0, 3.0]),
        frame=sim.mission.frame,
        rate_hz=20.0,
        bias=bias,
    )
    intervals = finished(following_errors_steps(chain.intervals, chain.samples, errors, bias))
    return replace(chain, intervals=intervals)


def test_increments_follow_errors() -> None:
    """GTSAM's increments of the merged samples with errors a little larger and smaller."""
    errors = some_errors(0.05)
    chain = following(errors)
    made, samples = chain.intervals, chain.samples
    read = put_on(errors, samples.gyro_b, samples.accel_b)
    step = 1e-4
    for column in range(SIZE):
        ends = []
        for sign in (step, -step):
            moved = errors.copy()
            moved[column] += sign * UNIT[column]
            gyro_b, accel_b = taken_off(moved, *read)
            again = replace(chain, samples=samples._replace(gyro_b=gyro_b, accel_b=accel_b))
            measured = again.measured(np.zeros((len(made.span_s), 3)))
            ends.append(
                (
                    np.array([m.deltaRij().matrix() for m in measured]),
                    np.array([(m.deltaPij(), m.deltaVij()) for m in measured]),
                )
            )
        (R_up, pv_up), (R_down, pv_down) = ends
        R = made.delta_R
        turned = so3.log(R.mT @ R_up) - so3.log(R.mT @ R_down)
        shifted = ((pv_up - pv_down) @ R).reshape(-1, 6)
        slope = np.hstack([turned, shifted]) / (2.0 * step)
        expected = made.delta_D_errors[:, :, column] * UNIT[column]
        scale = np.abs(expected).max()
        np.testing.assert_allclose(slope / scale, expected / scale, rtol=0.0, atol=1e-6)


def ends_of(made: Intervals, seed: int) -> tuple[NavigationStates, NavigationStates]:
    """Return states at both ends of intervals, the second off where the data lead to."""
    rng, n = np.random.default_rng(seed), len(made.span_s)
    begin = NavigationStates(
        so3.exp(rng.normal(size=(n, 3))),
        100.0 * rng.normal(size=(n, 3)),
        rng.normal(size=(n, 3)),
        rng.normal(size=(n, 6)) * np.repeat([0.1, 0.01], 3),
    )
    g_n, gradient = np.tile(G_N, (n, 1)), np.zeros((3, 3))
    led = predict(made, begin, g_n=g_n, gradient=gradient).state
    return begin, NavigationStates(*led).moved(0.1 * rng.normal(size=(n, 15)))


def test_rows_follow_errors_that_differ_from_those_taken_off() -> None:
    """Whitened, the noise that they are counted in as well."""
    made = following(some_errors(0.05)).intervals
    begin, end = ends_of(made, 1)
    g_n = np.tile(G_N, (len(made.span_s), 1))
    errors = some_errors(0.05) + some_errors(0.01, seed=2)
    rows = whitened_rows(made, begin, end, g_n=g_n, gradient=np.zeros((3, 3)), errors=errors)
    assert rows.shape[2] == 31 + SIZE
    for column in range(SIZE):
        step = np.zeros(SIZE)
        step[column] = 1e-5 * UNIT[column]
        up, down = (
            whitened_error(made, begin, end, g_n=g_n, errors=errors + s * step) for s in (1, -1)
        )
        slope = (up - down) / (2.0 * step[column])
        expected = rows[:, :, 30 + column]
        scale = np.abs(expected).max()
        np.testing.assert_allclose(slope / scale, expected / scale, rtol=0.0, atol=2e-6)
    error = whitened_error(made, begin, end, g_n=g_n, errors=errors)
    np.testing.assert_allclose(error, -rows[:, :, -1], rtol=1e-9, atol=1e-9)


def test_the_prediction_follows_errors_as_its_rows_do() -> None:
    """Transition and noise with errors that differ from those taken off."""
    made = following(some_errors(0.05)).intervals
    begin, _ = ends_of(made, 1)
    g_n, gradient = np.tile(G_N, (len(made.span_s), 1)), np.zeros((3, 3))
    errors = some_errors(0.05) + some_errors(0.01, seed=2)
    ahead = predict(made, begin, g_n=g_n, gradient=gradient, errors=errors)
    end = NavigationStates(*ahead.state)
    rows = whitened_rows(made, begin, end, g_n=g_n, gradient=gradient, errors=errors)
    noisy = made.as_noisy_as(errors)
    scale = np.abs(rows).max(axis=(0, 2), keepdims=True)
    np.testing.assert_allclose(ahead.rows(noisy) / scale, rows / scale, atol=1e-10)
    A_j = rows[:, :, 15:30]
    solved = np.linalg.solve(A_j, -np.concatenate([rows[:, :, :15], rows[:, :, 30:-1]], axis=2))
    np.testing.assert_allclose(ahead.transition, solved, rtol=0.0, atol=1e-8)
    inverse = np.linalg.inv(A_j)
    noise = inverse @ inverse.mT
    sigma = np.sqrt(np.diagonal(noise, axis1=1, axis2=2))
    unit = sigma[:, :, None] * sigma[:, None]
    np.testing.assert_allclose(ahead.noise(noisy) / unit, noise / unit, atol=1e-8)


def test_errors_taken_off_are_errors_no_more() -> None:
    """Intervals without errors predict what those that follow them predict."""
    made = following(some_errors(0.05)).intervals
    begin, end = ends_of(made, 1)
    g_n, errors = np.tile(G_N, (len(made.span_s), 1)), some_errors(0.04, seed=3)
    plain = made.without_errors(errors)
    assert plain.errors.shape[1] == 0
    at_bias = begin._replace(bias=made.bias)
    np.testing.assert_allclose(
        whitened_error(plain, at_bias, end, g_n=g_n),
        whitened_error(made, at_bias, end, g_n=g_n, errors=errors),
        rtol=1e-9,
        atol=1e-9,
    )


def test_what_is_stated_is_a_share_of_what_is_true() -> None:
    """Readings made with stated errors are right once those of the readings are taken off."""
    rng = np.random.default_rng(4)
    rate, force, stated = rng.normal(size=(5, 3)), 9.8 * rng.normal(size=(5, 3)), some_errors(0.2)
    S_g, S_a, S_f = stated.reshape(3, 3, 3)
    gyro_b, accel_b = rate + rate @ S_g.T + force @ S_f.T, force + force @ S_a.T
    errors, slope = of_readings(stated)
    right = taken_off(errors, gyro_b, accel_b)
    np.testing.assert_allclose(right, (rate, force), atol=1e-12)
    np.testing.assert_allclose(put_on(errors, *right), (gyro_b, accel_b), atol=1e-12)
    for column in range(SIZE):
        step = np.zeros(SIZE)
        step[column] = 1e-6
        found = (of_readings(stated + step)[0] - of_readings(stated - step)[0]) / 2e-6
        np.testing.assert_allclose(found, slope[:, column], atol=1e-8)
    both, slopes = of_readings(np.array([stated, 2.0 * stated]))
    np.testing.assert_allclose(both[0], errors)
    np.testing.assert_allclose(slopes[0], slope)


def off_truth(problem: Problem, states: States) -> States:
    """Return states near these, with extra variables of the size of their sigmas."""
    rng = np.random.default_rng(5)
    moved = states.moved(1e-3 * rng.normal(size=(problem.n_keyframes, STATE_DIM)))
    sigma = problem.extras.sigma
    return moved._replace(constants=sigma * rng.normal(size=len(sigma)))


@pytest.mark.parametrize("with_clock", [False, True], ids=["on time", "late"])
def test_graph_rows_follow_the_variables(with_clock: bool) -> None:
    """All rows of inertial data and beams, the gyro reading at a lever arm included."""
    sim = turning(duration_s=6.0, grade=Grade.MEMS)
    mission = asking(sim.mission, SIGMAS[Grade.MEMS])
    late_s = 0.05 if with_clock else 0.0
    arm = np.array([0.5, -0.4, 0.7])
    mount = replace(mission.dvl.mount, lever_arm_b=arm, time_offset_sigma_s=late_s)
    mission = replace(mission, dvl=replace(mission.dvl, mount=mount))
    problem = build_problem(mission)
    states = off_truth(problem, true_states(problem, sim))
    own = columns_of_errors(problem.extras) - STATE_DIM
    assert len(own) == SIZE
    linearizer = GraphLinearizer(problem)
    found: dict[str, list[Array]] = {"inertial": [], "beams": []}
    for column in own:
        step = np.zeros(problem.extras.n_constants)
        step[column] = 1e-2 * problem.extras.sigma[column]
        up, down = (states._replace(constants=states.constants + s * step) for s in (1, -1))
        inertial = [linearizer.inertial_rows(end)[:, :, -1] for end in (down, up)]
        beams = [linearizer.beam_rows(end).error for end in (up, down)]
        for name, ends in (("inertial", inertial), ("beams", beams)):
            found[name].append((ends[0] - ends[1]) / (2.0 * step[column]))
    rows = linearizer.inertial_rows(states)[:, :, 2 * STATE_DIM + own]
    slopes = np.stack(found["inertial"], axis=-1)
    scale = np.abs(rows).max(axis=(0, 1))
    np.testing.assert_allclose(slopes / scale, rows / scale, rtol=0.0, atol=1e-5)
    seen = linearizer.beam_rows(states).jacobian[:, STATE_DIM + own]
    slopes = np.stack(found["beams"], axis=-1)
    # A late ping is led back as if rate and force were those at the ping.
    atol = 1e-2 if with_clock else 1e-6
    names = np.repeat([block.name[:5] for block in problem.extras.blocks], lengths(problem))[own]
    for sensor in ("gyro_", "accel"):
        of_sensor = names == sensor
        scale = max(np.abs(seen[:, of_sensor]).max(), 1e-3)
        np.testing.assert_allclose(
            slopes[:, of_sensor] / scale, seen[:, of_sensor] / scale, rtol=0.0, atol=atol
        )


def lengths(problem: Problem) -> list[int]:
    """Return how many components each variable has."""
    return [len(block.sigma) for block in problem.extras.blocks]


def test_gradient_of_gravity_is_still_there() -> None:
    """The columns of the error states are those of intervals that follow no errors."""
    made = following(NONE).intervals
    begin, end = ends_of(made, 1)
    g_n = np.tile(G_N, (len(made.span_s), 1))
    gradient = gravity_gradient(simulated(duration_s=4.0).mission.frame)
    rows = whitened_rows(made, begin, end, g_n=g_n, gradient=gradient)
    plain = whitened_rows(made.without_errors(NONE), begin, end, g_n=g_n, gradient=gradient)
    np.testing.assert_allclose(rows[:, :, :30], plain[:, :, :30], rtol=1e-12, atol=1e-9)
