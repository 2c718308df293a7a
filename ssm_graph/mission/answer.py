"""The answer of an estimator as an estimate: its trajectory, and whether it may be believed."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from factors.dvl_beam import beam_residual
from factors.inertial import MovingState
from ssm_graph.base import chi2
from ssm_graph.base.earth import LocalFrame
from ssm_graph.base.frames import phi_D_roll_pitch_heading, roll_pitch_heading_from_R_lb
from ssm_graph.base.frozen import Array
from ssm_graph.base.runs import runs_of
from ssm_graph.engine.error_state import POSITION, ROTATION, VELOCITY
from ssm_graph.graph.aids.aid import Aid
from ssm_graph.mission.calibration import taken_as_exact
from ssm_graph.mission.estimate import BeamTable, Estimate, Status, Trajectory
from ssm_graph.mission.problem import Problem
from ssm_graph.sensors import dvl_readings


def trajectory_from_states(problem: Problem, states: MovingState, covariance: Array) -> Trajectory:
    """Express states and their covariances (K, 15, 15) along east, north, up at the vehicle."""
    n_beams = np.bincount(problem.beams.keyframe, minlength=problem.n_keyframes).astype(float)
    return trajectory_at(problem.frame, problem.keyframe_s, states, covariance, n_beams=n_beams)


def trajectory_at(
    frame: LocalFrame, time_s: Array, states: MovingState, covariance: Array, *, n_beams: Array
) -> Trajectory:
    """Express states at any times (K,), with the beam speeds used at each, as a trajectory."""
    lat, lon, height = frame.geodetic_from_p_n(states.p_n)
    R_ln = np.swapaxes(frame.R_nl_at(states.p_n), 1, 2)
    R_lb = R_ln @ states.R_nb
    roll, pitch, heading = roll_pitch_heading_from_R_lb(R_lb)
    rph_D_phi = np.asarray(np.linalg.inv(phi_D_roll_pitch_heading(roll, pitch)), float)
    return Trajectory(
        time_s=time_s,
        lat=lat,
        lon=lon,
        height=height,
        velocity_enu=np.einsum("kij,kj->ki", R_ln, states.v_n),
        roll_pitch_heading=np.stack([roll, pitch, heading], axis=-1),
        gyro_bias=states.bias[:, 3:],
        accel_bias=states.bias[:, :3],
        position_cov_enu=_turned(R_lb, covariance[:, POSITION, POSITION]),
        velocity_sigma_enu=_sigmas(_turned(R_ln, covariance[:, VELOCITY, VELOCITY])),
        attitude_sigma=_sigmas(_turned(rph_D_phi, covariance[:, ROTATION, ROTATION])),
        n_beams=n_beams,
    )


def covariance_at(frame: LocalFrame, states: MovingState, covariance: Array) -> Array:
    """Return the covariance (K, 9, 9) of what a trajectory has, from that of the error state.

    Its order is position and velocity along east, north, up, then roll, pitch, heading.
    """
    R_ln = np.swapaxes(frame.R_nl_at(states.p_n), 1, 2)
    R_lb = R_ln @ states.R_nb
    roll, pitch, _ = roll_pitch_heading_from_R_lb(R_lb)
    J = np.zeros((len(R_lb), 9, covariance.shape[-1]))
    J[:, :3, POSITION], J[:, 3:6, VELOCITY] = R_lb, R_ln
    J[:, 6:, ROTATION] = np.linalg.inv(phi_D_roll_pitch_heading(roll, pitch))
    return _turned(J, covariance)


def _turned(J: Array, covariance: Array) -> Array:
    return np.asarray(J @ covariance @ np.swapaxes(J, 1, 2))


def _sigmas(covariance: Array) -> Array:
    """Return standard deviations; a variance that a lost filter let become negative is no limit."""
    variance = np.diagonal(covariance, axis1=1, axis2=2)
    return np.sqrt(np.where(variance < 0.0, np.inf, variance))


LARGEST_SPEED = dvl_readings.LARGEST_SPEED
"""m/s, of the vehicle: what a beam that looks ahead could still read."""
LOW_WEIGHT = 0.1
TRUSTED = 0.5
"""Beams of at least this weight are believed."""
SUSPECT_SHARE = 0.5
"""More than this share of the beams below the low weight is no outlier problem any more."""
SUSPECT_STRETCH_S = 60.0
"""So long may that last within a mission."""
MISFIT = 9.0
"""Mean squared whitened residual above which a sensor is contradicted: three times its sigma."""


def doubts_of_beams(problem: Problem, v_n: Array, error: Array, weights: Array) -> list[str]:
    """Say in a sentence each what disagrees; an empty one where nothing does.

    Parameters
    ----------
    problem : with N beam speeds at K keyframes.
    v_n : (K, 3) velocities of the answer, m/s.
    error : (N,) what the answer misses of the beam speeds, m/s.
    weights : (N,) weight of each.
    """
    return [
        _doubt_speed(v_n),
        _doubt_beams(weights),
        _doubt_residuals((error / problem.beams.sigma)[weights >= TRUSTED]),
        _doubt_stretches(problem, weights),
    ]


def _doubt_speed(v_n: Array) -> str:
    largest = float(np.max(np.linalg.norm(v_n, axis=1)))
    if largest <= LARGEST_SPEED:
        return ""
    return (
        f"a speed of {largest:.0f} m/s, more than any underwater vehicle's: look for a long "
        "silence of the DVL, and at the inertial data there"
    )


def _doubt_beams(weights: Array) -> str:
    share = float(np.mean(weights < LOW_WEIGHT)) if len(weights) else 0.0
    if share <= SUSPECT_SHARE:
        return ""
    return (
        f"{100.0 * share:.0f} % of the {len(weights)} beam speeds contradict the answer (weight "
        f"below {LOW_WEIGHT}): check the start heading, beam order, mounting and signs of the DVL, "
        "and its noise"
    )


def _doubt_residuals(whitened: Array) -> str:
    """Look at what the trusted beams still miss; a robust kernel trusts none that misses much."""
    misfit = float(np.mean(whitened**2)) if len(whitened) else 0.0
    if misfit <= MISFIT:
        return ""
    return (
        f"the beam speeds that count miss the answer by {np.sqrt(misfit):.1f} of their own sigmas "
        "(rms): outliers went in with full weight, try a robust kernel; or the DVL's noise is "
        "stated too small"
    )


def _doubt_stretches(problem: Problem, weights: Array) -> str:
    """Look for a long stretch in which most beams of every ping are rejected."""
    pings, row = np.unique(problem.beams.keyframe, return_inverse=True)
    if len(pings) == 0:
        return ""
    is_bad = np.bincount(row, weights=weights < LOW_WEIGHT) > SUSPECT_SHARE * np.bincount(row)
    runs = np.array(runs_of(is_bad))
    if len(runs) == 0:
        return ""
    begin_s = problem.keyframe_s[pings[runs[:, 0]]]
    end_s = problem.keyframe_s[pings[runs[:, 1] - 1]]
    longest = int(np.argmax(end_s - begin_s))
    if end_s[longest] - begin_s[longest] < SUSPECT_STRETCH_S:
        return ""
    return (
        f"most beams of every ping contradict the answer from {begin_s[longest]:.1f} s to "
        f"{end_s[longest]:.1f} s: look at the DVL's bottom lock and the inertial data there"
    )


RUN = 20
"""Successive depths, or position fixes, that are looked at together."""
SHORTEST_RUN = 8
"""Of fewer nothing is said."""
SLOW_SIGMAS = 6.0
"""So long the median has to be where a search has looked for what lasts: the rest is swell and
multipath, which are nobody's fault."""
RUN_TAIL = 0.03
"""Share of Gaussian errors that are longer than the median of a run may be: three times the sigma
of one component, twice that of three. Half of a run has to be that long, which has a chance of
1e-10 for twenty and 6e-5 for eight; as many may be gross and say nothing."""


def doubt_of_run(
    aid: type[Aid], time_s: Array, whitened_sq: Array, *, dim: int, least_sigmas: float = 0.0
) -> str:
    """Say whether successive measurements of place miss the answer together; empty if not.

    Parameters
    ----------
    aid : what measured.
    time_s : (M,) when, s.
    whitened_sq : (M,) squared length of what each misses, in its own sigmas.
    dim : of a measurement.
    least_sigmas : the median of a run below which it is nobody's fault.
    """
    size = min(RUN, len(time_s))
    if size < SHORTEST_RUN:
        return ""
    median = np.median(np.lib.stride_tricks.sliding_window_view(whitened_sq, size), axis=1)
    worst = int(np.argmax(median))
    sigmas = np.sqrt(median[worst] / chi2.ppf(0.5, dim))
    if median[worst] <= chi2.isf(RUN_TAIL, dim) or sigmas < least_sigmas:
        return ""
    return (
        f"{aid.name} measurements from {time_s[worst]:.1f} s to {time_s[worst + size - 1]:.1f} s "
        f"miss the answer by {sigmas:.1f} of their own sigmas (median): their noise is stated too "
        f"small, or {aid.hint}"
    )


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
    known = (states.R_nb, states.p_n, states.v_n, covariance)
    finite = [np.isfinite(x).reshape(len(x), -1).all(axis=1) for x in known]
    lost = np.flatnonzero(~np.all(finite, axis=0))
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
