"""Ranges that contradict themselves: too wide, too long, too biased, and halves that disagree."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ssm_graph.base.frozen import Array
from ssm_graph.systems.visual_ranges.range_fit import (
    BIAS_M,
    Fit,
    Problem,
    Solution,
    residuals,
    search,
    understated,
)
from ssm_graph.systems.visual_ranges.ranges import Indices
from ssm_graph.systems.visual_ranges.weights import robust_rms

Mask = NDArray[np.bool_]

SQUARE_OF_3_SIGMA: Final = 14.16
"""Quantile of 0.9973 of chi-square with three degrees of freedom."""
SQUARE_OF_3: Final = 9.0
"""The same with one."""


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
    at = problem.places
    told = misfits(
        names, at.anchor, best.error, at.sigma_m, best.biases,
        stated_m=stated_m, rms_sigmas=rms_sigmas, marked_share=marked_share,
    )  # fmt: skip
    return told + _halves_apart(problem, names, best)


def _halves_apart(problem: Problem, names: tuple[str, ...], best: Solution) -> list[str]:
    """Return where the halves of the ranges disagree, a sentence each.

    Halves are compared by what both know: by how much worse they fit where a value is held at the
    answer of all. A half that knows little may end anywhere, at no price, and its sigma there says
    nothing. The kernel is the one that never lets go, so that ranges which all became longer speak.
    """
    whole = search(problem, best.unknowns[None]).unknowns
    first = problem.places.time_s < np.median(problem.places.time_s)
    parts = [_part(problem, half) for half in (first, ~first)]
    ends = [search(part, whole) for part in parts]
    own = [_anchors(end, len(names)) for end in ends]

    def price(held: Indices) -> float:
        both = zip(parts, ends, strict=True)
        return sum(_price(part, whole, end, held) for part, end in both)

    told = []
    scale = price(np.zeros(1, dtype=np.intp))
    if scale > SQUARE_OF_3:
        apart = abs(float(ends[0].unknowns[0, 0] - ends[1].unknowns[0, 0]))
        told.append(
            f"the scales of the first and second half differ by {100.0 * apart:.1f} %, "
            f"{np.sqrt(scale):.1f} sigma"
        )
    for j, name in enumerate(names):
        if price(2 + 4 * j + np.arange(3)) > SQUARE_OF_3_SIGMA:
            told.append(
                f"anchor {name} moves by {np.linalg.norm(own[0][j] - own[1][j]):.2f} m between the "
                "first and the second half: did it move, or is the antenna not calibrated?"
            )
    return told


def misfits(
    names: tuple[str, ...],
    anchor: Indices,
    error: Array,
    sigma_m: Array,
    biases: Array,
    *,
    stated_m: Array,
    rms_sigmas: float,
    marked_share: float,
) -> list[str]:
    """Return which anchors' ranges are wider, longer or more biased than may be, a sentence each.

    Parameters
    ----------
    anchor, error, sigma_m : (M,) of the ranges; errors are predicted minus measured, m.
    biases : (J,) m
    stated_m, rms_sigmas, marked_share : as in :func:`contradictions`.
    """
    told = []
    for j, name in enumerate(names):
        own = anchor == j
        stated, seen = float(np.median(stated_m[own])), robust_rms(error[own])
        if seen > rms_sigmas * stated:
            told.append(f"residuals of anchor {name} are {seen:.2f} m, {stated:.2f} m were stated")
        if abs(biases[j]) > 3.0 * BIAS_M:
            told.append(f"the bias of anchor {name} would be {biases[j]:.2f} m")
        marked = float(np.mean(error[own] < -4.0 * sigma_m[own]))
        if marked > marked_share:
            told.append(f"{100.0 * marked:.0f} % of the ranges to anchor {name} are too long")
    return told


def _part(problem: Problem, kept: Mask) -> Problem:
    rows = np.flatnonzero(kept)
    return replace(
        problem,
        places=problem.places.rows(rows),
        drift=problem.drift[rows],
        walk=problem.walk[rows],
    )


def _anchors(end: Fit, n_anchors: int) -> Array:
    """Return anchors (J, 3), from the middle of the path, m."""
    return end.unknowns[0, 2 : 2 + 4 * n_anchors].reshape(n_anchors, 4)[:, :3]


def _price(part: Problem, at: Array, end: Fit, held: Indices) -> float:
    """Return the deviance that it costs to hold unknowns at ``at`` (1, P) and not as in ``end``.

    Over how many ranges say the same.
    """
    fit = search(part, at, held=held)
    error = residuals(part, end.unknowns)[0][0]
    weight = part.kernel.weight(error, 0.0, part.places.sigma_m)
    return float(fit.cost[0] - end.cost[0]) / understated(part, error, weight)
