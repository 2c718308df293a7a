"""Whether an answer agrees with the beam speeds it was made of, whoever made it."""

from __future__ import annotations

import numpy as np

from ssm_graph.base.frozen import Array
from ssm_graph.mission.problem import Problem
from ssm_graph.sensors import dvl_readings

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
    edges = np.diff(np.concatenate([[0], is_bad.astype(int), [0]]))
    begin_s = problem.keyframe_s[pings[np.flatnonzero(edges == 1)]]
    end_s = problem.keyframe_s[pings[np.flatnonzero(edges == -1) - 1]]
    if len(begin_s) == 0:
        return ""
    longest = int(np.argmax(end_s - begin_s))
    if end_s[longest] - begin_s[longest] < SUSPECT_STRETCH_S:
        return ""
    return (
        f"most beams of every ping contradict the answer from {begin_s[longest]:.1f} s to "
        f"{end_s[longest]:.1f} s: look at the DVL's bottom lock and the inertial data there"
    )
