"""What a filter leaves behind, keyframe by keyframe, and the estimates made of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ssm_graph.data import N_BEAMS, Array
from ssm_graph.estimate import BeamTable, Estimate, Status
from ssm_graph.filters.states import NavigationStates
from ssm_graph.problem.error_state import STATE_DIM
from ssm_graph.problem.problem import Problem
from ssm_graph.problem.trajectory import trajectory_from_states

LARGEST_SPEED = 50.0
"""m/s, above which no underwater vehicle goes."""
LOW_WEIGHT = 0.1
SUSPECT_SHARE = 0.5
"""More than this share of the beams below the low weight is no outlier problem any more."""


@dataclass(slots=True, eq=False)
class StateHistory:
    """States of B runs at K keyframes with covariances in their own error states."""

    R_nb: Array
    """(K, B, 3, 3)"""
    p_n: Array
    """(K, B, 3) m"""
    v_n: Array
    """(K, B, 3) m/s"""
    bias: Array
    """(K, B, 6) accelerometer m/s^2, gyro rad/s"""
    covariance: Array
    """(K, B, 15, 15)"""

    @classmethod
    def empty(cls, n_keyframes: int, n_runs: int) -> StateHistory:
        """Return a history to be filled."""
        n = (n_keyframes, n_runs)
        shapes = ((3, 3), (3,), (3,), (6,), (STATE_DIM, STATE_DIM))
        return cls(*(np.empty((*n, *shape)) for shape in shapes))

    def put(self, k: int, states: NavigationStates, covariance: Array) -> None:
        """Keep the states of keyframe ``k``."""
        self.R_nb[k], self.p_n[k], self.v_n[k], self.bias[k] = states
        self.covariance[k] = covariance

    def at(self, k: int) -> NavigationStates:
        """Return the states of keyframe ``k``."""
        return NavigationStates(self.R_nb[k], self.p_n[k], self.v_n[k], self.bias[k])


@dataclass(slots=True, eq=False)
class FilterHistory:
    """All that a filter found out on its way."""

    posterior: StateHistory
    predicted: StateHistory
    transition: Array
    """(K - 1, B, 15, 15) of the error state from keyframe to keyframe."""
    innovation: Array
    """(K, B, 4) m/s, measured minus predicted with the posterior; NaN without a beam."""
    mahalanobis_sq: Array
    """(K, B, 4)"""
    weight: Array
    """(K, B, 4) 1 = nominal"""
    n_iterations: Array
    """(K, B)"""

    @classmethod
    def empty(cls, n_keyframes: int, n_runs: int) -> FilterHistory:
        """Return a history to be filled."""
        beams = (n_keyframes, n_runs, N_BEAMS)
        innovation, mahalanobis_sq, weight = (np.full(beams, np.nan) for _ in range(3))
        return cls(
            posterior=StateHistory.empty(n_keyframes, n_runs),
            predicted=StateHistory.empty(n_keyframes, n_runs),
            transition=np.empty((n_keyframes - 1, n_runs, STATE_DIM, STATE_DIM)),
            innovation=innovation,
            mahalanobis_sq=mahalanobis_sq,
            weight=weight,
            n_iterations=np.zeros(beams[:2]),
        )


def estimates_from_history(
    problems: Sequence[Problem],
    history: FilterHistory,
    states: StateHistory,
    *,
    method: str,
    kernel: str,
    wall_s: float,
) -> list[Estimate]:
    """Return the estimate of every run; ``states`` are the posterior or smoothed ones."""
    return [
        _estimate(problem, run, history, states, method=method, kernel=kernel, wall_s=wall_s)
        for run, problem in enumerate(problems)
    ]


def _estimate(
    problem: Problem,
    run: int,
    history: FilterHistory,
    states: StateHistory,
    *,
    method: str,
    kernel: str,
    wall_s: float,
) -> Estimate:
    own = NavigationStates(*(getattr(states, name)[:, run] for name in NavigationStates._fields))
    keyframe, beam = problem.beams.keyframe, problem.beams.beam
    weight = history.weight[keyframe, run, beam]
    status, reason = _verdict(own, states.covariance[:, run], weight, history.n_iterations[:, run])
    return Estimate(
        method=method,
        kernel=kernel,
        status=status,
        reason=reason,
        trajectory=trajectory_from_states(problem, own, states.covariance[:, run]),
        beams=BeamTable(
            time_s=problem.keyframe_s[keyframe],
            beam=(beam + 1).astype(np.float64),
            innovation=history.innovation[keyframe, run, beam],
            mahalanobis_sq=history.mahalanobis_sq[keyframe, run, beam],
            weight=weight,
        ),
        iterations=(),
        wall_s=wall_s,
        cost=np.nan,
        start=problem.start,
        notes=problem.notes,
    )


def _verdict(
    states: NavigationStates, covariance: Array, weight: Array, n_iterations: Array
) -> tuple[Status, str]:
    if not all(np.all(np.isfinite(x)) for x in (*states, covariance)):
        return Status.DIVERGED, Status.DIVERGED.value
    largest = float(np.linalg.norm(states.v_n, axis=1).max())
    if largest > LARGEST_SPEED:
        return Status.SUSPECT, f"a speed of {largest:.0f} m/s, more than any underwater vehicle's"
    share = float(np.mean(weight < LOW_WEIGHT)) if len(weight) else 0.0
    if share > SUSPECT_SHARE:
        return Status.SUSPECT, (
            f"{100.0 * share:.0f} % of the {len(weight)} beam speeds contradict the filter (weight "
            f"below {LOW_WEIGHT}): check the start, beam order, mounting and signs of the DVL"
        )
    return Status.CONVERGED, (
        f"filtered {len(n_iterations)} keyframes, {np.mean(n_iterations):.1f} iterations each, "
        f"{np.max(n_iterations):.0f} at most"
    )
