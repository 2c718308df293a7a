"""Whether a settled answer may be believed: do the measurements agree with it."""

from __future__ import annotations

import gtsam
import numpy as np
from scipy.stats import chi2

from ssm_graph.data import Array
from ssm_graph.graph.linearize import BeamRows, GraphLinearizer
from ssm_graph.graph.marginal_prior import MarginalPrior
from ssm_graph.graph.states import States
from ssm_graph.problem.doubts import MISFIT, doubts_of_beams

PRIOR_TAIL = 1e-9
"""Probability below which the initial state is contradicted by the data."""


def contradictions(
    linearizer: GraphLinearizer, states: States, beam_rows: BeamRows, weights: Array
) -> list[str]:
    """Compare every kind of measurement with the answer; say in a sentence each what disagrees."""
    doubts = [
        *doubts_of_beams(linearizer.problem, states.v_n, beam_rows.error, weights),
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
