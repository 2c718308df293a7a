"""Where an unknown beacon may be, from ranges along a track: the start of its estimate.

Seen from a straight line a beacon may as well lie on the other side, and from a short one nearly
anywhere: the search starts from many places about the stated one and keeps the best. It is robust,
and takes the track as it is; what the track is off by widens the residuals and with them the scale
that they are judged by.
"""

from __future__ import annotations

import itertools
from typing import NamedTuple

import numpy as np

from factors.similarity import LogKernel
from ssm_graph.data import Array
from ssm_graph.graph.aids.acoustic import RangeAid
from ssm_graph.graph.aids.weighted import WeightedAids
from ssm_graph.graph.states import States
from ssm_graph.problem.aid_errors import beacon_name
from ssm_graph.problem.error_state import STATE_DIM
from ssm_graph.problem.extras import Extras

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
KERNEL = LogKernel()


class BeaconStart(NamedTuple):
    """A place for a beacon with what speaks for it."""

    offset: Array
    """(3,) m from the stated place, east, north, up"""
    weights: Array
    """(N,) of the ranges"""
    rival: Array | None
    """(3,) another place that explains the ranges as well"""


def beacon_start(
    track_l: Array, range_m: Array, *, sigma: Array, prior_sigma: Array
) -> BeaconStart:
    """Find a beacon.

    Parameters
    ----------
    track_l : (N, 3) places of the transducer from the stated place of the beacon, m.
    range_m, sigma : (N,) m
    prior_sigma : (3,) of the stated place, m.
    """
    searches = [
        _search(np.array(start) * prior_sigma, track_l, range_m, sigma=sigma, prior=prior_sigma)
        for start in itertools.product(STARTS, repeat=3)
    ]
    # All are judged by one scale, that of the one that fits best.
    scale = np.minimum.reduce([_scale(track_l, range_m, found, sigma) for found in searches])
    costs = [_cost(track_l, range_m, found, scale, prior_sigma) for found in searches]
    best = searches[int(np.argmin(costs))]
    rivals = [
        found
        for cost, found in zip(costs, searches, strict=True)
        if cost - min(costs) < AMBIGUOUS
        and np.linalg.norm(found - best) > SAME_PLACE * float(np.median(scale))
    ]
    residual = _residual(track_l, range_m, best) / scale
    return BeaconStart(best, KERNEL.weight(residual**2), rivals[0] if rivals else None)


def _search(at: Array, track_l: Array, range_m: Array, *, sigma: Array, prior: Array) -> Array:
    """Return where a damped robust search from ``at`` ends."""
    damping = FIRST_DAMPING
    scale = _scale(track_l, range_m, at, sigma)
    for _ in range(ROUNDS):
        residual = _residual(track_l, range_m, at)
        sight = at - track_l
        J = sight / np.maximum(np.linalg.norm(sight, axis=1), 1e-3)[:, None]
        weight = KERNEL.weight((residual / scale) ** 2) / scale**2
        normal = (J * weight[:, None]).T @ J + np.diag(1.0 / prior**2)
        gradient = J.T @ (weight * residual) + at / prior**2
        step = -np.linalg.solve(normal + damping * np.diag(normal.diagonal()), gradient)
        before = _cost(track_l, range_m, at, scale, prior)
        if _cost(track_l, range_m, at + step, scale, prior) <= before:
            at, damping = at + step, damping / 10.0
            scale = _scale(track_l, range_m, at, sigma)
        else:
            damping *= 10.0
    return at


def _residual(track_l: Array, range_m: Array, at: Array) -> Array:
    return np.asarray(np.linalg.norm(at - track_l, axis=1) - range_m)


def _scale(track_l: Array, range_m: Array, at: Array, sigma: Array) -> Array:
    """Return the sigmas that the ranges seem to have: not below those stated."""
    seen = SIGMA_OF_MEDIAN * float(np.median(np.abs(_residual(track_l, range_m, at))))
    return np.maximum(sigma, seen)


def _cost(track_l: Array, range_m: Array, at: Array, scale: Array, prior: Array) -> float:
    t = (_residual(track_l, range_m, at) / scale) ** 2
    loss = KERNEL.similarity(np.zeros_like(t)) - KERNEL.similarity(t)
    return float(loss.sum() + 0.5 * np.sum((at / prior) ** 2))


def find_beacons(
    states: States, aids: WeightedAids, extras: Extras, weights: Array
) -> tuple[States, Array, tuple[str, ...]]:
    """Return the states with all unknown beacons where the ranges along them put them.

    With them, the weights (M,) of all measurements, and notes on places that are ambiguous.
    """
    constants, weights = states.constants.copy(), weights.copy()
    notes: list[str] = []
    for aid in aids.all:
        if not isinstance(aid, RangeAid):
            continue
        ranges, own = aid.ranges, aids.of(aid, weights)
        for i in np.flatnonzero(~ranges.is_known):
            heard = ranges.beacon == i
            if not heard.any():
                continue
            k, name = ranges.keyframe[heard], beacon_name(int(ranges.number[i]))
            track_n = states.p_n[k] + states.R_nb[k] @ ranges.lever_arm_b
            columns = extras.columns(name)
            start = beacon_start(
                (track_n - ranges.beacon_n[i]) @ ranges.R_nl[i],
                ranges.range_m[heard],
                sigma=ranges.sigma[heard],
                prior_sigma=extras.sigma[columns.start - STATE_DIM : columns.stop - STATE_DIM],
            )
            first = columns.start - extras.state_dim
            constants[first : first + 3], own[heard] = start.offset, start.weights
            notes += _ambiguity(name, start)
    return states._replace(constants=constants), weights, tuple(notes)


def _ambiguity(name: str, start: BeaconStart) -> list[str]:
    if start.rival is None:
        return []
    apart = float(np.linalg.norm(start.rival - start.offset))
    return [
        f"{name} may as well be {apart:.0f} m from where it was found, as far as its ranges along "
        "the first track tell: pass it on another side, or state its place nearer"
    ]
