"""Ranges and path no better than they show themselves: sigmas and drift are widened."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np

from ssm_graph.systems.visual_ranges.range_fit import Problem, Solution, solution
from ssm_graph.systems.visual_ranges.weights import robust_rms

WIDENINGS: Final = 8
WIDER: Final = 1.1
"""Mean square of the path's modes from which its drift is taken to be more than assumed."""


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
