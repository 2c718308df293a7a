"""Whether the stated start alone speaks for a fault: a start that is off would explain it as well.

A velocity or a heading of the start that is wrong contradicts the DVL for as long as nothing else
tells, as a bottom that moves does. So the evidence of what was freed is asked for once more with
the navigation of the start hardly known, from the joint posterior of the first keyframe and the
size of what was freed; no new solution is needed.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np

from ssm_graph.base.frozen import Array
from ssm_graph.engine.chain import ChainSolution
from ssm_graph.engine.error_state import POSITION, ROTATION, VELOCITY
from ssm_graph.engine.marginal_prior import MarginalPrior
from ssm_graph.engine.states import States

UNSURE: Final = np.repeat([1.0, 1e3, 3.0], 3)
"""Sigmas of a start of which hardly anything is known: attitude, rad, position, m, velocity, m/s.
Biases stay as they are stated."""
MOST_UNSURE: Final = 1e4
"""Factor of the stated sigmas: beyond it the difference of two covariances is rounding."""
BEYOND_CHANCE: Final = 14.2
"""Chi-square of three numbers with the tail of three sigmas of one."""


class WithoutStart(NamedTuple):
    """What is left of a fault, and what the start would be off by."""

    chi_sq: float
    off: str
    """For people"""


def without_start(
    prior: MarginalPrior, states: States, step: ChainSolution, at: slice
) -> WithoutStart:
    """Return the evidence of some constants once the start is hardly known.

    Parameters
    ----------
    prior : the start as it is stated.
    states : the answer.
    step : its covariance.
    at : the constants (d,) of what was freed.
    """
    n = step.step.shape[1]
    rows, shared = prior.rows(states), step.sensitivity[0] @ step.constants_cov[:, at]
    own, size = step.covariance(n)[0], step.constants_cov[at, at]
    joint = np.block([[own, shared], [shared.T, size]])
    scale = np.sqrt(np.diagonal(joint))
    stated = np.linalg.inv(rows[:, :n])
    mean = stated @ rows[:, n]  # of the start, beside the answer
    stated = stated @ stated.T
    wide, inner = stated.copy(), np.arange(len(UNSURE))
    at_most = MOST_UNSURE**2 * np.diagonal(stated)[inner]
    wide[inner, inner] += np.minimum(UNSURE**2, at_most)
    less = np.linalg.inv(wide) - np.linalg.inv(stated)
    information = np.linalg.inv(joint / np.outer(scale, scale))
    information[:n, :n] += less * np.outer(scale[:n], scale[:n])
    pull = np.zeros(len(scale))
    pull[:n] = scale[:n] * (less @ mean)
    covariance = np.linalg.inv(information)
    moved = scale * (covariance @ pull)
    left = (states.constants[at] + moved[n:]) / scale[n:]
    pulled = np.linalg.solve(covariance[n:, n:], np.column_stack([left, covariance[n:, :n]]))
    # What the start would be off by without the fault, and how well that is known.
    off = moved[:n] - mean - scale[:n] * (covariance[:n, n:] @ pulled[:, 0])
    known = covariance[:n, :n] - covariance[:n, n:] @ pulled[:, 1:]
    return WithoutStart(
        float(left @ pulled[:, 0]),
        _said(off, states.R_nb[0], stated + known * np.outer(scale[:n], scale[:n])),
    )


def _said(off: Array, R_nb: Array, covariance: Array) -> str:
    """Return words for what is off beyond chance, or for what is off most by its covariance."""
    turn = np.degrees(R_nb @ off[ROTATION])
    words = {
        f"its attitude is off by {np.linalg.norm(turn):.2g} deg": ROTATION,
        f"its position is off by {np.linalg.norm(off[POSITION]):.2g} m": POSITION,
        f"its velocity is off by {np.linalg.norm(off[VELOCITY]):.2g} m/s": VELOCITY,
    }
    by = {
        text: float(off[part] @ np.linalg.solve(covariance[part, part], off[part]))
        for text, part in words.items()
    }
    many = [text for text in words if by[text] > BEYOND_CHANCE]
    return " and ".join(many or [max(by, key=by.__getitem__)])
