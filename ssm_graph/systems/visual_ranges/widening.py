"""Ranges, path and anchors no better known than they show: sigmas and drift are widened."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np

from ssm_graph.base.frozen import Array
from ssm_graph.systems.visual_ranges.range_fit import Problem, Solution, search, solution
from ssm_graph.systems.visual_ranges.weights import robust_rms

WIDENINGS: Final = 8
WIDER: Final = 1.1
"""Mean square of the path's modes from which its drift is taken to be more than assumed."""
REACH: Final = (3.0, 4.0, 5.5, 8.0, 12.0)
"""Sigmas along its weakest direction at which an anchor is tried elsewhere, on both sides."""
SQUARE_OF_3: Final = 9.0
"""Deviance at 3 sigma, along one direction."""


def widened(problem: Problem, best: Solution) -> Problem:
    """Return the problem with sigmas that are not below what each anchor's residuals show.

    Nor is the drift of the path below what its modes show: a map may be bent by more than images
    tell, by a lens or a shutter that is not as assumed. That is the expectation maximisation of
    their variance, from what was assumed upwards.
    """
    sigma = problem.places.sigma_m.copy()
    for j in range(problem.n_anchors):
        own = problem.places.anchor == j
        sigma[own] = np.fmax(sigma[own], robust_rms(best.error[own]))
    problem = replace(problem, places=problem.places._replace(sigma_m=sigma))
    for _ in range(WIDENINGS):
        if best.drift_square < WIDER:
            break
        problem = replace(problem, drift=np.sqrt(best.drift_square) * problem.drift)
        best = solution(problem, best.unknowns, is_near=True, rounds=15)
    return problem


def opened(problem: Problem, best: Solution) -> Array:
    """Return how many times its sigma each anchor (J,) is open along its weakest direction.

    Near the plane of a path the height of an anchor acts by its square: one sigma from a straight
    row may be a small part of what the ranges leave open. So each anchor is held at places along
    that direction, and all else is found anew: 3 sigma are where the deviance has risen by 9, times
    what it overstates.
    """
    found = np.ones(problem.n_anchors)
    for j in range(problem.n_anchors):
        square, axes = np.linalg.eigh(best.anchor_covariance(j))
        own = slice(2 + 4 * j, 5 + 4 * j)
        for side in (-1.0, 1.0):
            tried = np.tile(best.unknowns, (len(REACH), 1))
            tried[:, own] += side * np.outer(REACH, np.sqrt(square[-1]) * axes[:, -1])
            held = np.arange(own.start, own.stop)
            rise = (search(problem, tried, held=held).cost - best.cost) / best.understated
            over = np.flatnonzero(rise >= SQUARE_OF_3)
            last = int(over[0]) if len(over) else len(REACH)
            if not last:
                continue
            reach = REACH[last - 1]
            if last < len(REACH):
                share = (SQUARE_OF_3 - rise[last - 1]) / (rise[last] - rise[last - 1])
                reach += float(share) * (REACH[last] - reach)
            found[j] = max(found[j], reach / REACH[0])
    return found


def with_open(found: Solution, times: Array) -> Solution:
    """Return a solution whose anchors are so many times (J,) as open along their weakest axes."""
    covariance = found.covariance.copy()
    for j, factor in enumerate(times):
        square, axes = np.linalg.eigh(found.anchor_covariance(j))
        own = slice(2 + 4 * j, 5 + 4 * j)
        more = (factor**2 - 1.0) * square[-1]
        covariance[own, own] += more * np.outer(axes[:, -1], axes[:, -1])
    return replace(found, covariance=covariance)
