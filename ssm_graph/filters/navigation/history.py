"""What a filter leaves behind, keyframe by keyframe, and the estimates made of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ssm_graph.base.frozen import Array
from ssm_graph.engine.error_state import STATE_DIM
from ssm_graph.engine.states import NavigationStates
from ssm_graph.mission.estimate import Estimate
from ssm_graph.mission.problem import Problem
from ssm_graph.mission.recursive import RecursiveBeams, recursive_estimate
from ssm_graph.sensors.dvl import N_BEAMS


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

    def lose(self, k: int, is_lost: NDArray[np.bool_]) -> None:
        """Forget the states of runs that have run away."""
        for array in (self.R_nb, self.p_n, self.v_n, self.bias, self.covariance):
            array[k, is_lost] = np.nan

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
    """(K, B, 4) m/s, measured minus predicted before the update; NaN without a beam."""
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
    """Return the estimate of every run; ``states`` are the posterior or smoothed ones.

    Smoothed states have innovations of their own; squared lengths and weights stay the filter's.
    """
    estimates, is_smoothed = [], states is not history.posterior
    for run, problem in enumerate(problems):
        at = problem.beams.keyframe, run, problem.beams.beam
        estimates.append(
            recursive_estimate(
                problem,
                NavigationStates(
                    *(getattr(states, name)[:, run] for name in NavigationStates._fields)
                ),
                states.covariance[:, run],
                RecursiveBeams(
                    None if is_smoothed else history.innovation[at],
                    history.mahalanobis_sq[at],
                    history.weight[at],
                ),
                history.n_iterations[:, run],
                method=method,
                kernel=kernel,
                wall_s=wall_s,
            )
        )
    return estimates
