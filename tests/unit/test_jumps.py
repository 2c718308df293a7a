"""Jumps of a gyro's bias that the data do not exclude yet."""

from __future__ import annotations

import numpy as np
import pytest

from ssm_graph.base.frozen import Array
from ssm_graph.engine.error_state import GYRO_BIAS
from ssm_graph.live.estimator.jumps import AXES, JUMP, SIZE, SPACING_S, TIMES, Jumps

N, M, STEPS, AXIS = 15, 4, 12, 2


def _system(rng: np.random.Generator) -> tuple[Array, Array]:
    """Return a transition (N, N) and a Jacobian (M, N)."""
    F = np.eye(N) + 0.05 * rng.standard_normal((N, N))
    return F, rng.standard_normal((M, N))


def _gain(P: Array, H: Array) -> tuple[Array, Array]:
    S = H @ P @ H.T + np.eye(M)
    solved: Array = np.asarray(np.linalg.inv(S), np.float64)
    return np.asarray(P @ H.T @ solved, np.float64), solved


def test_size_is_that_of_a_filter_with_the_jump_in_its_state() -> None:
    """The column and its two sums are the augmented filter, whatever it is told."""
    rng = np.random.default_rng(7)
    x, P = np.zeros(N), np.eye(N) * 1e-2
    both, Q = np.zeros(N + 1), np.eye(N) * 1e-4
    P_both = np.zeros((N + 1, N + 1))
    P_both[:N, :N], P_both[N, N] = P, JUMP**2
    onto = np.eye(N + 1)
    onto[GYRO_BIAS.start + AXIS, N] = 1.0
    both, P_both = onto @ both, onto @ P_both @ onto.T
    jumps = Jumps.none(N).with_next(0.0)
    for _ in range(STEPS):
        F, H = _system(rng)
        z = rng.standard_normal(M)
        x, P = F @ x, F @ P @ F.T + Q
        F_both, H_both = np.eye(N + 1), np.column_stack([H, np.zeros(M)])
        F_both[:N, :N] = F
        both, P_both = F_both @ both, F_both @ P_both @ F_both.T
        P_both[:N, :N] += Q
        jumps = jumps._replace(moved=jumps.moved @ F.T)
        K, solved = _gain(P, H)
        jumps = jumps.updated(H, solved, solved @ (z - H @ x), K)
        x, P = x + K @ (z - H @ x), P - K @ H @ P
        K, _ = _gain(P_both, H_both)
        both, P_both = both + K @ (z - H_both @ both), P_both - K @ H_both @ P_both
    variance = 1.0 / (jumps.information[AXIS] + JUMP**-2)
    assert variance == pytest.approx(P_both[N, N], rel=1e-6)
    assert variance * jumps.score[AXIS] == pytest.approx(both[N], rel=1e-6)
    moved = variance * jumps.score[AXIS] * jumps.moved[AXIS]
    np.testing.assert_allclose(x + moved, both[:N], atol=1e-9)


def test_excluded_jumps_add_nothing_and_certain_ones_what_they_moved() -> None:
    """Between these lies what cannot be told."""
    jumps = Jumps.none(N).with_next(0.0)
    excluded = jumps._replace(information=np.full(AXES * TIMES, 1e16))
    assert np.trace(excluded.unexcluded(N)) < 1e-12
    information, score = np.zeros((2, AXES * TIMES))
    information[AXIS], score[AXIS] = 1e8, 1e8 * JUMP
    found = jumps._replace(information=information, score=score).unexcluded(N)
    at = GYRO_BIAS.start + AXIS
    assert found[at, at] == pytest.approx(JUMP**2, rel=0.1)
    assert found[at - 1, at - 1] < 1e-3 * JUMP**2


def test_chance_adds_nothing_where_the_data_say_much() -> None:
    """Two sigmas of a size that is known to a hundredth; weakly seen they may be one."""
    jumps, information = Jumps.none(N).with_next(0.0), np.zeros(AXES * TIMES)
    for seen, is_added in ((1e4, False), (10.0, True)):
        information[AXIS] = seen / SIZE**2
        noise = jumps._replace(information=information, score=3.0 * np.sqrt(information))
        adds = noise._replace(score=noise.score * (1.0 if is_added else 2.0 / 3.0)).unexcluded(N)
        assert (np.trace(adds) > 0.0) == is_added


def test_times_are_spaced_and_the_oldest_makes_room() -> None:
    """As many as there is room for."""
    jumps = Jumps.none(N)
    for time_s in np.arange(0.0, 2.0 * TIMES * SPACING_S, 0.25 * SPACING_S).tolist():
        jumps = jumps.with_next(time_s)
    np.testing.assert_allclose(np.diff(np.sort(jumps.begun_s)), SPACING_S)
    assert jumps.begun_s.min() == TIMES * SPACING_S
