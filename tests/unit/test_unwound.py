"""Circles that nobody saw: the shorter way between two headings."""

from __future__ import annotations

import numpy as np
import pytest

from factors import so3
from ssm_graph.base.frozen import Array
from ssm_graph.base.stepwise import finished
from ssm_graph.engine.states import States
from ssm_graph.graph.linearize import GraphLinearizer
from ssm_graph.imu.preintegration import Unseen
from ssm_graph.mission.problem import build_problem
from ssm_graph.smoothers.unwound import shorter, unwound_steps
from tests.helpers import simulated, state_errors, true_states, with_imu

TIME_S = np.arange(13.0)
SEEN = Unseen()


def led_along(heading: Array) -> States:
    """Return states that go ahead at 1.5 m/s along headings (K,), rad."""
    R_nb = so3.exp(heading[:, None] * np.array([0.0, 0.0, 1.0]))
    v_n = 1.5 * R_nb[:, :, 0]
    way = 0.5 * (v_n[:-1] + v_n[1:]) * np.diff(TIME_S)[:, None]
    p_n = np.concatenate([np.zeros((1, 3)), np.cumsum(way, axis=0)])
    return States.of(R_nb, p_n, v_n, np.zeros((len(heading), 6)))


def seen_but(*intervals: int) -> list[Unseen]:
    """Return what is not seen of intervals, a gap in some."""
    return [Unseen(1.0) if k in intervals else SEEN for k in range(len(TIME_S) - 1)]


@pytest.mark.parametrize("turns", [2.0 * np.pi + 0.3, -2.0 * np.pi + 0.3, 1.2 * np.pi])
def test_an_unseen_turn_goes_the_shorter_way(turns: float) -> None:
    """It is as long as by the headings at its ends, and the vehicle goes ahead all the while."""
    around = np.interp(TIME_S, [3.0, 9.0], [0.0, turns])
    states = shorter(led_along(around), seen_but(*range(3, 9)), TIME_S)
    least = np.remainder(turns + np.pi, 2.0 * np.pi) - np.pi
    expected = led_along(np.interp(TIME_S, [3.0, 9.0], [0.0, least]))
    for name in ("R_nb", "v_n", "p_n"):
        np.testing.assert_allclose(getattr(states, name), getattr(expected, name), atol=1e-9)


def test_a_turn_that_was_seen_stays() -> None:
    """Whole circles, too, and half of one that was not."""
    circle = led_along(np.interp(TIME_S, [3.0, 9.0], [0.0, 2.0 * np.pi]))
    assert shorter(circle, seen_but(), TIME_S) is circle
    half = led_along(np.interp(TIME_S, [3.0, 9.0], [0.0, 3.0]))
    assert shorter(half, seen_but(*range(3, 9)), TIME_S) is half


def test_an_answer_that_went_round_comes_back_if_that_costs_less() -> None:
    """Over 8 s without inertial data, from a whole circle; what went no circle is left alone."""
    sim = simulated(duration_s=30.0, seed=3)
    imu = sim.mission.imu
    kept = (imu.time_s < 12.0) | (imu.time_s > 20.0)
    rows = {name: getattr(imu, name)[kept] for name in ("time_s", "gyro_b", "accel_b")}
    problem = build_problem(with_imu(sim.mission, **rows))
    linearizer, truth = GraphLinearizer(problem), true_states(problem, sim)
    linearizer.follow(truth)
    weights = np.ones(len(problem.beams.speed)), np.ones(len(linearizer.weighted))
    assert finished(unwound_steps(linearizer, truth, *weights)) is truth
    around = np.interp(problem.keyframe_s, [12.0, 20.0], [0.0, 2.0 * np.pi])
    turn = so3.exp(around[:, None] * np.array([0.0, 0.0, 1.0]))
    v_n = np.einsum("kij,kj->ki", truth.R_nb @ turn @ truth.R_nb.mT, truth.v_n)
    wound = truth._replace(R_nb=truth.R_nb @ turn, v_n=v_n)
    back = finished(unwound_steps(linearizer, wound, *weights))
    assert np.abs(state_errors(back, truth)[:, :3]).max() < 0.3
    assert np.abs(state_errors(wound, truth)[:, :3]).max() > 2.0
