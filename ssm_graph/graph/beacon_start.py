"""Where an unknown beacon may be, from ranges along a track: a start for its estimate, or a doubt.

Seen from a straight line a beacon may as well lie on the other side, and from a short one nearly
anywhere: the search starts from many places about the stated one and keeps the best. It is robust,
and takes the track as it is; what the track is off by widens the residuals and with them the scale
that they are judged by.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from factors.similarity import LogKernel
from ssm_graph.base.frozen import Array
from ssm_graph.engine.error_state import STATE_DIM
from ssm_graph.engine.extras import Extras
from ssm_graph.engine.states import States
from ssm_graph.graph.aids.ranges import Ranges, beacon_name
from ssm_graph.graph.measurements import Measurements

STARTS = (-1.0, 0.0, 1.0)
"""Prior sigmas east, north and up of the stated place at which searches start."""
ROUNDS = 40
FIRST_DAMPING = 1e-2
SIGMA_OF_MEDIAN = 1.4826
"""A Gaussian's standard deviation over its median absolute value."""
SAME_PLACE = 30.0
"""Places nearer to each other than so many residual sigmas are one and the same."""
AMBIGUOUS = 6.0
"""Another place whose cost is higher by less is as good: a likelihood ratio of 400."""
SIGMAS_APART = 10.0
"""And nearer than so many of its posterior sigmas."""
SETTLED_M = 1e-3
KERNEL = LogKernel()


class BeaconRanges(NamedTuple):
    """The ranges to one unknown beacon, along a track."""

    name: str
    track_l: Array
    """(N, 3) places of the transducer from the stated place of the beacon, m."""
    range_m: Array
    """(N,) m"""
    sigma: Array
    """(N,) m"""
    prior_sigma: Array
    """(3,) of the stated place, m."""


def beacon_start(ranges: BeaconRanges) -> tuple[Array, Array]:
    """Return a place (3,) from the stated one, east, north, up, m, and weights (N,)."""
    found = _searches(ranges)
    # All are judged by one scale, that of the one that fits best.
    scale = np.minimum.reduce([_scale(ranges, place) for place in found])
    best = min(found, key=lambda place: _cost(ranges, place, scale))
    return best, KERNEL.weight((_residual(ranges, best) / scale) ** 2)


def rival_place(ranges: BeaconRanges, at: Array, *, apart_m: float) -> Array | None:
    """Return another place (3,) that explains the ranges as well as ``at``, if there is one.

    Places nearer to each other than ``apart_m``, or than the ranges can tell apart, are the same.
    """
    scale = _scale(ranges, at)
    apart_m = max(apart_m, SAME_PLACE * float(np.median(scale)))
    limit = _cost(ranges, at, scale) + AMBIGUOUS
    for place in _searches(ranges):
        if np.linalg.norm(place - at) > apart_m and _cost(ranges, place, scale) < limit:
            return place
    return None


def _searches(ranges: BeaconRanges) -> list[Array]:
    starts = itertools.product(STARTS, repeat=3)
    return [_search(ranges, np.array(start) * ranges.prior_sigma) for start in starts]


def _search(ranges: BeaconRanges, at: Array) -> Array:
    """Return where a damped robust search from ``at`` ends."""
    prior, damping = ranges.prior_sigma, FIRST_DAMPING
    scale = _scale(ranges, at)
    for _ in range(ROUNDS):
        residual, sight = _residual(ranges, at), at - ranges.track_l
        J = sight / np.maximum(np.linalg.norm(sight, axis=1), 1e-3)[:, None]
        weight = KERNEL.weight((residual / scale) ** 2) / scale**2
        normal = (J * weight[:, None]).T @ J + np.diag(1.0 / prior**2)
        gradient = J.T @ (weight * residual) + at / prior**2
        step = -np.linalg.solve(normal + damping * np.diag(normal.diagonal()), gradient)
        if _cost(ranges, at + step, scale) <= _cost(ranges, at, scale):
            at, damping = at + step, damping / 10.0
            if float(np.linalg.norm(step)) < SETTLED_M:
                break
            scale = _scale(ranges, at)
        else:
            damping *= 10.0
    return at


def _residual(ranges: BeaconRanges, at: Array) -> Array:
    return np.asarray(np.linalg.norm(at - ranges.track_l, axis=1) - ranges.range_m)


def _scale(ranges: BeaconRanges, at: Array) -> Array:
    """Return the sigmas (N,) that the ranges seem to have: not below those stated."""
    seen = SIGMA_OF_MEDIAN * float(np.median(np.abs(_residual(ranges, at))))
    return np.maximum(ranges.sigma, seen)


def _cost(ranges: BeaconRanges, at: Array, scale: Array) -> float:
    t = (_residual(ranges, at) / scale) ** 2
    loss = KERNEL.similarity(np.zeros_like(t)) - KERNEL.similarity(t)
    return float(loss.sum() + 0.5 * np.sum((at / ranges.prior_sigma) ** 2))


def find_beacons(
    states: States, aids: Measurements, extras: Extras, weights: Array
) -> tuple[States, Array]:
    """Return the states with all unknown beacons where the ranges along them put them.

    With them come the weights (M,) of all measurements.
    """
    constants, weights = states.constants.copy(), weights.copy()
    for aid, heard, columns, ranges in _unknown(states, aids, extras):
        constants[columns], own = beacon_start(ranges)
        aids.of(aid, weights)[heard] = own
    return states._replace(constants=constants), weights


def ambiguous_beacons(
    states: States, aids: Measurements, extras: Extras, covariance: Array
) -> list[str]:
    """Say in a sentence each which beacons may as well be elsewhere, at final states.

    ``covariance`` (E, E) is that of walks and constants.
    """
    doubts = []
    for _, _, columns, ranges in _unknown(states, aids, extras):
        at = states.constants[columns]
        own = np.arange(extras.n_walks + columns.start, extras.n_walks + columns.stop)
        reach_m = SIGMAS_APART * math.sqrt(float(covariance[own, own].sum()))
        rival = rival_place(ranges, at, apart_m=reach_m)
        if rival is not None:
            doubts.append(
                f"{ranges.name} may as well be {np.linalg.norm(rival - at):.0f} m from where it "
                "was found: its ranges do not tell; pass it on another side, or state it nearer"
            )
    return doubts


def _unknown(
    states: States, aids: Measurements, extras: Extras
) -> Iterator[tuple[Ranges, NDArray[np.bool_], slice, BeaconRanges]]:
    """Yield each unknown beacon: the aid, its ranges, its columns among the constants."""
    for ranges in aids.all:
        if not isinstance(ranges, Ranges):
            continue
        for i in np.flatnonzero(~ranges.is_known):
            heard, name = ranges.beacon == i, beacon_name(int(ranges.number[i]))
            if not heard.any():
                continue
            k, whole = ranges.keyframe[heard], extras.columns(name)
            track_n = states.p_n[k] + states.R_nb[k] @ ranges.lever_arm_b
            along = BeaconRanges(
                name,
                (track_n - ranges.beacon_n[i]) @ ranges.R_nl[i],
                ranges.range_m[heard],
                ranges.sigma[heard],
                extras.sigma[whole.start - STATE_DIM : whole.stop - STATE_DIM],
            )
            first = whole.start - extras.state_dim
            yield ranges, heard, slice(first, first + 3), along
