"""The estimate of an estimator that goes keyframe by keyframe, and whether it may be believed."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from factors.dvl_beam import beam_residual
from factors.inertial import MovingState
from ssm_graph.base.frozen import Array
from ssm_graph.mission.calibration import taken_as_exact
from ssm_graph.mission.doubts import doubts_of_beams
from ssm_graph.mission.estimate import BeamTable, Estimate, Status
from ssm_graph.mission.problem import Problem
from ssm_graph.mission.trajectory import trajectory_from_states

UNSETTLED_SHARE = 0.01
"""More than this share of the keyframes at their iteration limit is said by the status."""


class RecursiveBeams(NamedTuple):
    """What became of the N beam speeds of a problem."""

    innovation: Array | None
    """(N,) m/s, measured minus predicted before the update; None for a smoother, whose innovations
    are those of its final states"""
    mahalanobis_sq: Array
    """(N,)"""
    weight: Array
    """(N,) 1 = nominal"""
    error: Array | None = None
    """(N,) m/s, predicted minus measured at the final states; None for instruments as stated"""


def recursive_estimate(
    problem: Problem,
    states: MovingState,
    covariance: Array,
    beams: RecursiveBeams,
    n_iterations: Array,
    *,
    max_iterations: int | None = None,
    method: str,
    kernel: str,
    wall_s: float,
    doubts: Sequence[str] = (),
) -> Estimate:
    """Return the estimate of one run, judged.

    Parameters
    ----------
    problem : what was estimated; its extra variables are those that were not.
    states, covariance : of its K keyframes; (K, 15, 15).
    beams : of its N beam speeds.
    n_iterations : (K,) of each keyframe.
    max_iterations : the limit of those, where there is one.
    doubts : what else contradicts the answer, a sentence each.
    method, kernel, wall_s : as in :class:`ssm_graph.mission.estimate.Estimate`.
    """
    rows = problem.beams
    status, reason = _settled(n_iterations, max_iterations)
    error = _beam_errors(problem, states) if beams.error is None else beams.error
    every = [*doubts_of_beams(problem, states.v_n, error, beams.weight), *doubts]
    lost = np.flatnonzero(~_is_finite(states.R_nb, states.p_n, states.v_n, covariance))
    if len(lost):
        begin_s = problem.keyframe_s[lost[0]]
        status, reason = Status.DIVERGED, f"{Status.DIVERGED.value} at {begin_s:.1f} s"
    elif any(every):
        status, reason = Status.SUSPECT, "; ".join(filter(None, every))
    return Estimate(
        method=method,
        kernel=kernel,
        status=status,
        reason=reason,
        trajectory=trajectory_from_states(problem, states, covariance),
        beams=BeamTable(
            time_s=problem.keyframe_s[rows.keyframe],
            beam=(rows.beam + 1).astype(np.float64),
            innovation=-error if beams.innovation is None else beams.innovation,
            mahalanobis_sq=beams.mahalanobis_sq,
            weight=beams.weight,
        ),
        iterations=(),
        wall_s=wall_s,
        cost=np.nan,
        start=problem.start,
        notes=(
            *problem.notes,
            *taken_as_exact(problem.extras),
            *not_used([aid.section for aid in problem.aids]),
        ),
        keyframe_iterations=float(np.mean(n_iterations)),
    )


def not_used(sections: Sequence[str]) -> tuple[str, ...]:
    """Return the note of an estimator without further aids, if the mission has some."""
    if not sections:
        return ()
    return (
        f"{', '.join(sections)} of mission.toml left out: this estimator is not aided by them; "
        "ssm-graph smooth is",
    )


def _beam_errors(problem: Problem, states: MovingState) -> Array:
    """Return predicted minus measured beam speeds (N,), m/s."""
    beams, k = problem.beams, problem.beams.keyframe
    return beam_residual(
        states.R_nb[k],
        states.v_n[k],
        states.bias[k, 3:],
        speed=beams.speed,
        gyro_b=beams.gyro_b,
        beam_b=beams.beam_b,
        lever_arm_b=beams.lever_arm_b,
        omega_ie_n=problem.frame.omega_ie_n,
    ).error


def _is_finite(*arrays: Array) -> NDArray[np.bool_]:
    """Return (K,) whether all that is known of a keyframe is finite."""
    finite = [np.isfinite(a).reshape(len(a), -1).all(axis=1) for a in arrays]
    return np.asarray(np.all(finite, axis=0))


def _settled(n_iterations: Array, limit: int | None) -> tuple[Status, str]:
    reason = (
        f"{len(n_iterations)} keyframes one by one, {np.mean(n_iterations):.1f} iterations each, "
        f"{np.max(n_iterations):.0f} at most"
    )
    if limit is None:
        return Status.CONVERGED, reason
    at_limit = int(np.sum(n_iterations >= limit))
    is_settled = at_limit <= UNSETTLED_SHARE * len(n_iterations)
    return (
        Status.CONVERGED if is_settled else Status.MAX_ITERATIONS,
        f"{reason}; {at_limit} keyframes at the limit of {limit}",
    )
