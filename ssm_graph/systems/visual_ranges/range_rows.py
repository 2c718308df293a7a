"""Rows of ranges along a path: those of some anchors, and how far they are off."""

from __future__ import annotations

import itertools
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ssm_graph.base.frozen import Array
from ssm_graph.systems.visual_ranges.range_fit import (
    Problem,
    Solution,
    problem_of,
    search,
    solution,
    unknowns_of,
)
from ssm_graph.systems.visual_ranges.range_terms import Places
from ssm_graph.systems.visual_ranges.ranges import Indices
from ssm_graph.systems.visual_ranges.start import StartRules, later_anchor
from ssm_graph.systems.visual_ranges.weights import NLOS_WEIGHT, POLISH, robust_rms

SAME_PLACE_M: Final = 0.2
"""Nearer than this two places of an anchor are one."""


def plain_errors(at: Places, found: Solution) -> tuple[Array, Array]:
    """Return errors (M,), m, and weights (M,) of ranges at a solution, without modes."""
    at = with_arm(at, found)
    camera = at.camera + found.clock_s * at.velocity
    line = found.scale * camera + at.lever + found.clock_s * at.lever_rate
    error = np.linalg.norm(line - found.anchors[at.anchor], axis=1) + found.biases[at.anchor]
    error = error - at.range_m
    return error, POLISH.weight(error, 0.0, at.sigma_m)


def with_arm(at: Places, found: Solution) -> Places:
    """Return places by the lever arm that was found, exact from now on."""
    if at.arm is None or found.arm is None:
        return at
    return at._replace(lever=at.lever + at.arm @ found.arm, arm=None)


def placed_later(
    own: Places, found: Solution, rules: StartRules
) -> tuple[Array, float, Array] | None:
    """Return place, bias and covariance (4, 4) of an anchor by its ranges, if they tell them.

    Scale and lever arm are those that were found already.
    """
    own = with_arm(own._replace(anchor=np.zeros(len(own.anchor), dtype=np.intp)), found)
    problem = problem_of(own, 1, rules.kernel, drift=0.0, bias_walk_m=0.0)
    places = later_anchor(problem, float(np.log(found.scale)), rules)
    where, covariance, _ = places[0]
    limit = rules.anchor_sigma_share * float(np.median(own.range_m))
    limit = max(rules.anchor_sigma_m, limit)
    if len(places) > 1 or float(np.sqrt(np.trace(covariance[:3, :3]))) > limit:
        return None
    place = where[:3] + found.scale * problem.middle
    line = found.scale * own.camera + own.lever - place
    error = np.linalg.norm(line, axis=1) + where[3] - own.range_m
    if robust_rms(error) > rules.rms_sigmas * float(np.median(own.sigma_m)):
        return None
    return place, float(where[3]), covariance


def against_rivals(
    problem: Problem,
    found: Solution,
    i: int,
    others: tuple[tuple[Array, float], ...],
    gap: float,
) -> tuple[Solution, tuple[tuple[Array, float], ...]]:
    """Return the best solution with anchor ``i`` elsewhere, and its places that are as good.

    ``others`` are places (3,) and biases to be tried, ``gap`` the deviance from which one is worse,
    but for what it overstates.
    """
    starts = [found.unknowns]
    for place, bias in others:
        anchors, biases = found.anchors.copy(), found.biases.copy()
        anchors[i], biases[i] = place, bias
        starts.append(unknowns_of(problem, found.scale, anchors, biases, found.clock_s))
    fit = search(problem, np.array(starts))
    best = int(np.argmin(fit.cost))
    if best and fit.cost[best] < fit.cost[0] - gap:
        found = solution(problem, fit.unknowns[best], is_near=True)
    kept: list[tuple[Array, float]] = []
    for unknowns, cost in zip(fit.unknowns, fit.cost, strict=True):
        one = unknowns[2 + 4 * i : 6 + 4 * i]
        place = one[:3] + np.exp(unknowns[0]) * problem.middle
        taken = np.array([found.anchors[i], *(other for other, _ in kept)])
        is_new = float(np.linalg.norm(taken - place, axis=1).min()) > SAME_PLACE_M
        if is_new and cost < float(fit.cost.min()) + gap * found.understated:
            kept.append((place, float(one[3])))
    return found, (*kept,)


def is_sharp(found: Solution, rules: StartRules, at: Places, i: int) -> bool:
    """Return whether the place of anchor ``i`` is known as well as the rules ask for."""
    sigma = float(np.sqrt(np.trace(found.anchor_covariance(i))))
    median = float(np.median(at.range_m[at.anchor == i]))
    return sigma <= max(rules.anchor_sigma_m, rules.anchor_sigma_share * median)


def lost_since(time_s: Array, is_own: NDArray[np.bool_], weight: Array) -> float:
    """Return the time from which an anchor's ranges fit no more: most of them, none before."""
    own = np.flatnonzero(is_own & np.isfinite(weight))
    over = (weight[own] < NLOS_WEIGHT) - 0.5
    return float(time_s[own[int(np.argmax(np.cumsum(over[::-1])[::-1]))]])


def of_anchors(places: Places, anchors: Indices) -> tuple[Places, Indices]:
    """Return the places of some anchors, counted anew, and their rows."""
    column = np.full(int(places.anchor.max(initial=0)) + 1, -1, dtype=np.intp)
    inside = anchors[anchors < len(column)]
    column[inside] = np.flatnonzero(anchors < len(column))
    kept = np.flatnonzero(column[places.anchor] >= 0)
    own = places.rows(kept)
    return own._replace(anchor=column[own.anchor]), kept


def largest_turn(R_cw: Array) -> float:
    """Return the largest angle from the first camera's axes, rad."""
    cosine = (np.einsum("kij,ij->k", R_cw, R_cw[0]) - 1.0) / 2.0
    return float(np.arccos(np.clip(cosine.min(initial=1.0), -1.0, 1.0)))


def known_spacing(known_position: Array, anchors: Indices) -> tuple[tuple[int, int, float], ...]:
    """Return pairs among some anchors whose places are known (J, 3), and their distance, m.

    The map's own axes are unknown, so that of a surveyed place only what is relative counts.
    """
    own = [known_position[j] if j < len(known_position) else np.full(3, np.nan) for j in anchors]
    pairs = itertools.combinations(range(len(own)), 2)
    apart = [(i, j, float(np.linalg.norm(own[i] - own[j]))) for i, j in pairs]
    return tuple(pair for pair in apart if np.isfinite(pair[2]))
