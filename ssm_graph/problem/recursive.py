"""The estimate of an estimator that goes keyframe by keyframe, and whether it may be believed."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ssm_graph.data import Array
from ssm_graph.estimate import BeamTable, Estimate, Status
from ssm_graph.problem.problem import Problem
from ssm_graph.problem.trajectory import KeyframeStates, trajectory_from_states

LARGEST_SPEED = 50.0
"""m/s, above which no underwater vehicle goes."""
LOW_WEIGHT = 0.1
SUSPECT_SHARE = 0.5
"""More than this share of the beams below the low weight is no outlier problem any more."""
UNSETTLED_SHARE = 0.01
"""More than this share of the keyframes at their iteration limit is said by the status."""


class RecursiveBeams(NamedTuple):
    """What became of the N beam speeds of a problem."""

    innovation: Array
    """(N,) m/s, measured minus predicted with the posterior"""
    mahalanobis_sq: Array
    """(N,)"""
    weight: Array
    """(N,) 1 = nominal"""


def recursive_estimate(
    problem: Problem,
    states: KeyframeStates,
    covariance: Array,
    beams: RecursiveBeams,
    n_iterations: Array,
    *,
    max_iterations: int | None = None,
    method: str,
    kernel: str,
    wall_s: float,
) -> Estimate:
    """Return the estimate of one run, judged.

    Parameters
    ----------
    problem : what was estimated.
    states, covariance : of its K keyframes; (K, 15, 15).
    beams : of its N beam speeds.
    n_iterations : (K,) of each keyframe.
    max_iterations : the limit of those, where there is one.
    method, kernel, wall_s : as in :class:`ssm_graph.estimate.Estimate`.
    """
    rows = problem.beams
    status, reason = _verdict(states, covariance, beams.weight)
    if status is Status.CONVERGED:
        status, reason = _settled(n_iterations, max_iterations)
    return Estimate(
        method=method,
        kernel=kernel,
        status=status,
        reason=reason,
        trajectory=trajectory_from_states(problem, states, covariance),
        beams=BeamTable(
            time_s=problem.keyframe_s[rows.keyframe],
            beam=(rows.beam + 1).astype(np.float64),
            **beams._asdict(),
        ),
        iterations=(),
        wall_s=wall_s,
        cost=np.nan,
        start=problem.start,
        notes=problem.notes,
    )


def _verdict(states: KeyframeStates, covariance: Array, weight: Array) -> tuple[Status, str]:
    if not all(np.all(np.isfinite(x)) for x in (states.R_nb, states.p_n, states.v_n, covariance)):
        return Status.DIVERGED, Status.DIVERGED.value
    largest = float(np.linalg.norm(states.v_n, axis=1).max())
    if largest > LARGEST_SPEED:
        return Status.SUSPECT, f"a speed of {largest:.0f} m/s, more than any underwater vehicle's"
    share = float(np.mean(weight < LOW_WEIGHT)) if len(weight) else 0.0
    if share > SUSPECT_SHARE:
        return Status.SUSPECT, (
            f"{100.0 * share:.0f} % of the {len(weight)} beam speeds contradict the estimate "
            f"(weight below {LOW_WEIGHT}): check the start, beam order, mounting and signs of the "
            "DVL"
        )
    return Status.CONVERGED, ""


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
