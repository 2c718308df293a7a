"""What the smoother found of the instruments, as part of its answer."""

from __future__ import annotations

import numpy as np

from ssm_graph.data import Array
from ssm_graph.estimate import CalibratedValue, Calibration, Determined
from ssm_graph.graph.states import States
from ssm_graph.problem.calibration import is_calibration
from ssm_graph.problem.error_state import STATE_DIM
from ssm_graph.problem.problem import Problem


def calibration_of(problem: Problem, states: States, covariance: Array) -> Calibration | None:
    """Return the calibration of an answer, None if the problem has none.

    ``covariance`` (E, E) is that of the walks at the last keyframe and of the constants.
    """
    extras = problem.extras
    found = np.concatenate([states.walks[-1], states.constants])
    prior = _prior_sigma_at_end(problem)
    values, kept = [], []
    for block in extras.blocks:
        if not is_calibration(block.name):
            continue
        columns = extras.columns(block.name)
        for label, i in zip(block.labels, range(columns.start, columns.stop), strict=True):
            own = i - STATE_DIM
            kept.append(own)
            values.append(
                CalibratedValue(
                    variable=block.name,
                    label=label,
                    unit=block.unit,
                    value=float(found[own]),
                    sigma=float(np.sqrt(covariance[own, own])),
                    prior_sigma=float(prior[own]),
                )
            )
    if not values:
        return None
    walks = states.walks[:, [own for own in kept if own < extras.n_walks]]
    return Calibration(tuple(values), covariance[np.ix_(kept, kept)], walks)


def undetermined(calibration: Calibration | None) -> tuple[str, ...]:
    """Return a note that names what the mission did not determine."""
    values = calibration.values if calibration else ()
    red = [value.label for value in values if value.determined is Determined.RED]
    if not red:
        return ()
    return (
        f"not determined by this mission: {', '.join(red)}; they stay at their priors: turn, and "
        "change speed and depth, while GNSS is there",
    )


def _prior_sigma_at_end(problem: Problem) -> Array:
    """Return the prior sigmas (E,); of a walk, what the whole mission makes of it."""
    extras = problem.extras
    variance = extras.sigma**2
    span_s = np.atleast_1d(problem.keyframe_s[-1] - problem.keyframe_s[0])
    factor, sigma = extras.transitions(span_s)
    walks = slice(0, extras.n_walks)
    variance[walks] = factor[0] ** 2 * variance[walks] + sigma[0] ** 2
    return np.asarray(np.sqrt(variance))
