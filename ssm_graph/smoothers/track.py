"""Keyframes as they were at one moment, with what was found beside: calibrations, current."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from ssm_graph.base.frozen import Array
from ssm_graph.base.times import Indices
from ssm_graph.engine.error_state import STATE_DIM
from ssm_graph.engine.extras import Extras
from ssm_graph.engine.states import States
from ssm_graph.graph.aids.aid import Aid
from ssm_graph.graph.freed import FAULTS
from ssm_graph.graph.measurements import JudgedAid, joined_aids
from ssm_graph.mission.calibration import CURRENT, CURRENT_UP
from ssm_graph.mission.estimate import CalibratedValue, Calibration, CurrentTrack, Determined


class Stretch(NamedTuple):
    """Successive keyframes as they were at one moment, with the beams of all of them."""

    time_s: Array
    """(K,) s"""
    states: States
    """(K, ...)"""
    covariance: Array
    """(K, n, n)"""
    n_beams: Array
    """(K,)"""
    beam: Indices
    """(M,) from 0, of each beam speed"""
    innovation: Array
    """(M,) m/s, measured minus predicted before the first update"""
    mahalanobis_sq: Array
    """(M,)"""
    weight: Array
    """(M,)"""
    aids: Mapping[str, JudgedAid]
    """Measurements of aids that have weights, by the aid's name"""


def joined(stretches: Sequence[Stretch]) -> Stretch:
    """Return successive stretches as one."""
    states, aids = ([getattr(one, name) for one in stretches] for name in ("states", "aids"))
    names = dict.fromkeys(name for of_one in aids for name in of_one)
    columns: dict[str, Any] = {
        name: np.concatenate([getattr(one, name) for one in stretches])
        for name in Stretch._fields
        if name not in ("states", "aids")
    }
    return Stretch(
        states=states[0].followed_by(*states[1:]),
        aids={n: joined_aids([of_one[n] for of_one in aids if n in of_one]) for n in names},
        **columns,
    )


def pack_judged(aids: Mapping[str, JudgedAid]) -> Iterator[tuple[str, Array]]:
    """Yield name and array of what became of aids, for checkpoints."""
    for name, judged in aids.items():
        for column, array in judged.aid.pack():
            yield f"aid_{name}_{column}", array
        for column, array in zip(JudgedAid._fields[1:], judged[1:], strict=True):
            yield f"judged_{name}_{column}", array


def unpack_judged(
    arrays: Mapping[str, Array], sensors: Mapping[str, Aid], *, prefix: str
) -> dict[str, JudgedAid]:
    """Return what was packed, of sensors by their names; names of arrays begin with ``prefix``."""
    found = {}
    for name, template in sensors.items():
        if f"{prefix}judged_{name}_weight" in arrays:
            own = {n: arrays[f"{prefix}aid_{name}_{n}"] for n in template.columns()}
            others = (arrays[f"{prefix}judged_{name}_{n}"] for n in JudgedAid._fields[1:])
            found[name] = JudgedAid(template.unpack(own), *others)
    return found


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
        if not block.is_lasting or block.name == FAULTS:
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
