"""Whether a settled answer may be believed: do the measurements agree with it."""

from __future__ import annotations

import numpy as np
from scipy.stats import chi2

from ssm_graph.base.frozen import Array
from ssm_graph.engine.error_state import STATE_DIM
from ssm_graph.engine.extras import Extras
from ssm_graph.engine.marginal_prior import MarginalPrior
from ssm_graph.engine.states import States
from ssm_graph.graph.beam_rows import BeamRows
from ssm_graph.graph.linearize import GraphLinearizer, Misfit
from ssm_graph.mission.current import CURRENTS
from ssm_graph.mission.doubts import MISFIT, doubts_of_beams

PRIOR_TAIL = 1e-9
"""Probability below which the initial state is contradicted by the data."""


HINTS = {
    "GNSS": "look for a wrong datum or lever arm",
    "depth": "look at its zero, sign and unit",
    "inertial": "look at the noise of [imu], its units, axes and time stamps",
}
"""What to look at when a kind of measurement contradicts the answer."""


def contradictions(
    linearizer: GraphLinearizer, states: States, beam_rows: BeamRows, weights: Array
) -> list[str]:
    """Compare every kind of measurement with the answer; say in a sentence each what disagrees."""
    misfits = linearizer.misfits(states)
    doubts = [
        *doubts_of_beams(linearizer.problem, states.v_n, beam_rows.error, weights),
        _doubt_prior(linearizer.prior, states),
        *(
            _doubt_sensor(name, misfits[name], hint)
            for name, hint in HINTS.items()
            if name in misfits
        ),
        *_doubt_extras(linearizer.problem.extras, states),
        *_doubt_current(linearizer.problem.extras, states),
    ]
    return [doubt for doubt in doubts if doubt]


def _doubt_prior(prior: MarginalPrior, states: States) -> str:
    whitened = prior.whitened(states)
    for name, part in (
        ("position or attitude", whitened[:6]),
        ("velocity", whitened[6:9]),
        ("bias", whitened[9:STATE_DIM]),
    ):
        chi_sq = float(part @ part)
        if chi2.sf(chi_sq, df=len(part)) < PRIOR_TAIL:
            return (
                f"the initial {name} is contradicted by the data (chi-square {chi_sq:.0f} for "
                f"{len(part)} degrees of freedom, largest {np.max(np.abs(part)):.0f} "
                "sigma): check the start, above all its heading, or drop [initial] to align"
            )
    return ""


def _doubt_sensor(name: str, misfit: Misfit, hint: str) -> str:
    mean_sq = misfit.sum_sq / misfit.n_rows
    if mean_sq <= MISFIT:
        return ""
    return (
        f"{name} data miss the answer by {np.sqrt(mean_sq):.1f} of their own sigmas (rms over "
        f"{misfit.n_factors} factors): {hint}"
    )


def _doubt_extras(extras: Extras, states: States) -> list[str]:
    """Look for a calibration that lies further off than its prior can mean."""
    doubts = []
    for block in extras.blocks:
        if block.name in CURRENTS:
            continue
        value = extras.value(block.name, states.walks[0], states.constants, default=np.zeros(0))
        whitened = value / block.sigma
        if chi2.sf(float(whitened @ whitened), df=len(whitened)) < PRIOR_TAIL:
            doubts.append(
                f"the calibration of {block.name} lies {np.max(np.abs(whitened)):.0f} of its prior "
                "sigmas off: state it nearer, or a larger sigma; or another instrument is wrong"
            )
    return doubts


def _doubt_current(extras: Extras, states: States) -> list[str]:
    """Look for a current that is larger than what is known beforehand can mean."""
    doubts = []
    for block in extras.blocks:
        if block.name not in CURRENTS:
            continue
        value = extras.value(block.name, states.walks, states.constants, default=np.zeros(0))
        chi_sq = np.sum((value / block.sigma) ** 2, axis=-1)
        worst = int(np.argmax(chi_sq))
        if chi2.sf(float(chi_sq[worst]), df=len(block.sigma)) < PRIOR_TAIL:
            doubts.append(
                f"a current of {np.linalg.norm(value[worst]):.2f} m/s "
                f"({' and '.join(block.labels)}) with a sigma of {block.sigma[0]:g} m/s each: "
                "state a larger one in [current]; or are pings off the ground marked as water_track"
            )
    return doubts
