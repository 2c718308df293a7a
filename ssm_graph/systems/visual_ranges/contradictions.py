"""Ranges that contradict themselves: too wide, too long, too biased, and halves that disagree."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ssm_graph.base.frozen import Array
from ssm_graph.systems.visual_ranges.range_fit import BIAS_M, Problem, Solution, polished
from ssm_graph.systems.visual_ranges.weights import robust_rms

Mask = NDArray[np.bool_]

SQUARE_OF_3_SIGMA: Final = 14.16
"""Quantile of 0.9973 of chi-square with three degrees of freedom."""


def contradictions(
    problem: Problem,
    names: tuple[str, ...],
    best: Solution,
    *,
    stated_m: Array,
    rms_sigmas: float,
    marked_share: float,
) -> list[str]:
    """Return what speaks against the ranges themselves, a sentence each.

    Parameters
    ----------
    names : (J,) of the anchors.
    stated_m : (M,) standard deviations as stated; the problem's may have been widened.
    rms_sigmas : up to which residuals may be wider than stated.
    marked_share : of an anchor's ranges that may be too long.
    """
    at, told = problem.places, []
    for j, name in enumerate(names):
        own = at.anchor == j
        stated, seen = float(np.median(stated_m[own])), robust_rms(best.error[own])
        if seen > rms_sigmas * stated:
            told.append(f"residuals of anchor {name} are {seen:.2f} m, {stated:.2f} m were stated")
        bias = float(best.biases[j])
        if abs(bias) > 3.0 * BIAS_M:
            told.append(f"the bias of anchor {name} would be {bias:.2f} m")
        marked = float(np.mean(best.error[own] < -4.0 * at.sigma_m[own]))
        if marked > marked_share:
            told.append(f"{100.0 * marked:.0f} % of the ranges to anchor {name} are too long")
    first = at.time_s < np.median(at.time_s)
    halves = [polished(_part(problem, half), best) for half in (first, ~first)]
    apart = np.log(halves[0].scale / halves[1].scale)
    sigma = float(np.hypot(halves[0].sigma_log_scale, halves[1].sigma_log_scale))
    if abs(apart) > 3.0 * sigma:
        told.append(
            f"the scales of the first and second half differ by {100.0 * abs(apart):.1f} %, "
            f"{abs(apart) / sigma:.1f} sigma"
        )
    for j, name in enumerate(names):
        way = halves[0].anchors[j] - halves[1].anchors[j]
        both = halves[0].anchor_covariance(j) + halves[1].anchor_covariance(j)
        if float(way @ np.linalg.solve(both, way)) > SQUARE_OF_3_SIGMA:
            told.append(
                f"anchor {name} moves by {np.linalg.norm(way):.2f} m between the first and the "
                "second half: did it move, or is the antenna not calibrated?"
            )
    return told


def _part(problem: Problem, kept: Mask) -> Problem:
    rows = np.flatnonzero(kept)
    return replace(
        problem,
        places=problem.places.rows(rows),
        drift=problem.drift[rows],
        walk=problem.walk[rows],
    )
