"""Whether a settled answer may be believed: do the measurements agree with it."""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np
from scipy.stats import chi2

from ssm_graph.data import Array
from ssm_graph.estimate import Status
from ssm_graph.graph.linearize import GraphLinearizer
from ssm_graph.graph.states import States

LOW_WEIGHT = 0.1
SUSPECT_SHARE = 0.5
"""More than this share of the beams below the low weight is no outlier problem any more."""
PRIOR_TAIL = 1e-9
"""Probability below which the initial state is contradicted by the data."""
MISFIT = 9.0
"""Mean squared whitened residual above which a sensor is contradicted: three times its sigma."""


@dataclass(frozen=True, slots=True)
class Verdict:
    """Status of a settled run, and why."""

    status: Status
    reason: str


def judge(linearizer: GraphLinearizer, states: States, weights: Array) -> Verdict:
    """Compare every kind of measurement with the answer; the first contradiction is named."""
    doubts = [
        _doubt_beams(weights),
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
    found = [doubt for doubt in doubts if doubt]
    if found:
        return Verdict(Status.SUSPECT, "; ".join(found))
    return Verdict(Status.CONVERGED, Status.CONVERGED.value)


def _doubt_beams(weights: Array) -> str:
    if len(weights) == 0:
        return ""
    share = float(np.mean(weights < LOW_WEIGHT))
    if share <= SUSPECT_SHARE:
        return ""
    return (
        f"{100.0 * share:.0f} % of the {len(weights)} beam speeds contradict the answer (weight "
        f"below {LOW_WEIGHT}): check the start heading, beam order, mounting and signs of the DVL, "
        f"and its noise"
    )


def _doubt_prior(prior: gtsam.NonlinearFactorGraph, states: States) -> str:
    names = ("position or attitude", "velocity", "bias")
    for i, name in enumerate(names):
        factor = prior.at(i)
        assert isinstance(factor, gtsam.NoiseModelFactor)
        whitened = factor.whitenedError(states.values)
        chi_sq = float(whitened @ whitened)
        if chi2.sf(chi_sq, df=len(whitened)) < PRIOR_TAIL:
            return (
                f"the initial {name} is contradicted by the data (chi-square {chi_sq:.0f} for "
                f"{len(whitened)} degrees of freedom, largest {np.max(np.abs(whitened)):.0f} "
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
