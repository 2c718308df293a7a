"""What a smoother found beside the states, as part of its answer: calibrations and the current."""

from __future__ import annotations

import numpy as np

from ssm_graph.base.frozen import Array
from ssm_graph.engine.error_state import STATE_DIM
from ssm_graph.engine.extras import Extras
from ssm_graph.mission.current import CURRENT, CURRENT_UP
from ssm_graph.mission.estimate import CalibratedValue, Calibration, CurrentTrack, Determined
from ssm_graph.smoothers.stretch import Stretch


def calibration_of(
    extras: Extras, walks: Array, constants: Array, covariance: Array, *, span_s: float
) -> Calibration | None:
    """Return the calibration of an answer, None if it has none.

    Parameters
    ----------
    extras : what was estimated.
    walks : (K, s) at every keyframe.
    constants : (C,)
    covariance : (E, E) of the walks at the last keyframe and of the constants.
    span_s : from the first keyframe to the last, s.
    """
    found = np.concatenate([walks[-1], constants])
    prior = _prior_sigma_at_end(extras, span_s)
    values, kept = [], []
    for block in extras.blocks:
        if not block.is_lasting:
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
    kept_walks = walks[:, [own for own in kept if own < extras.n_walks]]
    return Calibration(tuple(values), covariance[np.ix_(kept, kept)], kept_walks)


def calibration_of_last(extras: Extras, track: Stretch, *, span_s: float) -> Calibration | None:
    """Return the calibration that the last keyframe of a window's track carries in its state."""
    own = slice(STATE_DIM, None)
    covariance = track.covariance[-1, own, own]
    return calibration_of(extras, track.states.walks, np.zeros(0), covariance, span_s=span_s)


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


def _prior_sigma_at_end(extras: Extras, span_s: float) -> Array:
    """Return the prior sigmas (E,); of a walk, what the whole mission makes of it."""
    variance = extras.sigma**2
    factor, sigma = extras.transitions(np.atleast_1d(span_s))
    walks = slice(0, extras.n_walks)
    variance[walks] = factor[0] ** 2 * variance[walks] + sigma[0] ** 2
    return np.asarray(np.sqrt(variance))


def current_of(
    extras: Extras, time_s: Array, walks: Array, covariance: Array
) -> CurrentTrack | None:
    """Return the current of an answer with its covariance, None if it has none.

    Parameters
    ----------
    extras : what was estimated.
    time_s : (K,) s, of the keyframes.
    walks : (K, s)
    covariance : (K, s, s) of the walks of each keyframe.
    """
    if CURRENT not in extras:
        return None
    n, known = len(time_s), [*_columns(extras, CURRENT), *_columns(extras, CURRENT_UP)]
    velocity, own = np.zeros((n, 3)), np.zeros((n, 3, 3))
    for i, a in enumerate(known):
        velocity[:, i] = walks[:, a]
        for j, b in enumerate(known):
            own[:, i, j] = covariance[:, a, b]
    return CurrentTrack(time_s, velocity, own)


def current_along(extras: Extras, track: Stretch) -> CurrentTrack | None:
    """Return the current that the keyframes of a window's track carry in their states."""
    covariance = track.covariance[:, STATE_DIM:, STATE_DIM:]
    return current_of(extras, track.time_s, track.states.walks, covariance)


def _columns(extras: Extras, name: str) -> range:
    """Return the walks of a variable, none for one that there is not."""
    if name not in extras:
        return range(0)
    columns = extras.columns(name)
    return range(columns.start - STATE_DIM, columns.stop - STATE_DIM)
