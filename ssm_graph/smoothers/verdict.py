"""Whether a settled answer may be believed: do the measurements agree with it."""

from __future__ import annotations

import gtsam
import numpy as np
from scipy.stats import chi2

from ssm_graph.data import Array
from ssm_graph.graph.linearize import BeamRows, GraphLinearizer
from ssm_graph.graph.marginal_prior import MarginalPrior
from ssm_graph.graph.states import States
from ssm_graph.problem.problem import Problem
from ssm_graph.problem.recursive import LARGEST_SPEED, LOW_WEIGHT, SUSPECT_SHARE

TRUSTED = 0.5
"""Beams of at least this weight are believed."""
SUSPECT_STRETCH_S = 60.0
"""So long may that last within a mission."""
PRIOR_TAIL = 1e-9
"""Probability below which the initial state is contradicted by the data."""
MISFIT = 9.0
"""Mean squared whitened residual above which a sensor is contradicted: three times its sigma."""


def contradictions(
    linearizer: GraphLinearizer, states: States, beam_rows: BeamRows, weights: Array
) -> list[str]:
    """Compare every kind of measurement with the answer; say in a sentence each what disagrees."""
    doubts = [
        _doubt_speed(states),
        _doubt_beams(weights),
        _doubt_residuals((beam_rows.error / linearizer.problem.beams.sigma)[weights >= TRUSTED]),
        _doubt_stretches(linearizer.problem, weights),
        _doubt_prior(linearizer.prior, states),
        _doubt_sensor("GNSS", linearizer.gnss, states, "look for a wrong datum or lever arm"),
        _doubt_sensor("depth", linearizer.depth, states, "look at its zero, sign and unit"),
        _doubt_sensor(
            "inertial",
            linearizer.inertial,
            states,
            "look at the noise of [imu], its units, axes and time stamps",
        ),
    ]
    return [doubt for doubt in doubts if doubt]


def _doubt_speed(states: States) -> str:
    largest = float(np.max(np.linalg.norm(states.v_n, axis=1)))
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
        "(rms): outliers went in with full weight, try --kernel log; or the DVL's noise is stated "
        "too small"
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


def _doubt_prior(prior: MarginalPrior, states: States) -> str:
    whitened = prior.whitened(states)
    for name, part in (
        ("position or attitude", whitened[:6]),
        ("velocity", whitened[6:9]),
        ("bias", whitened[9:]),
    ):
        chi_sq = float(part @ part)
        if chi2.sf(chi_sq, df=len(part)) < PRIOR_TAIL:
            return (
                f"the initial {name} is contradicted by the data (chi-square {chi_sq:.0f} for "
                f"{len(part)} degrees of freedom, largest {np.max(np.abs(part)):.0f} "
                "sigma): check the start, above all its heading, or drop [initial] to align"
            )
    return ""


def _doubt_sensor(name: str, graph: gtsam.NonlinearFactorGraph, states: States, hint: str) -> str:
    n_factors = graph.size()
    if n_factors == 0:
        return ""
    n_rows = n_factors * (1 if name == "depth" else graph.at(0).dim())
    misfit = 2.0 * graph.error(states.values) / n_rows
    if misfit <= MISFIT:
        return ""
    return (
        f"{name} data miss the answer by {np.sqrt(misfit):.1f} of their own sigmas (rms over "
        f"{n_factors} factors): {hint}"
    )
