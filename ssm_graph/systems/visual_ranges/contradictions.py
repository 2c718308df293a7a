"""Ranges that contradict themselves: too wide, too long, too biased, and halves that disagree."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ssm_graph.base.frozen import Array
from ssm_graph.systems.visual_ranges.range_fit import BIAS_M, Problem, Solution, polished
from ssm_graph.systems.visual_ranges.ranges import Indices
from ssm_graph.systems.visual_ranges.weights import robust_rms, sight_kernel

Mask = NDArray[np.bool_]

SQUARE_OF_3_SIGMA: Final = 14.16
"""Quantile of 0.9973 of chi-square with three degrees of freedom."""
LONG_OF_HALF: Final = 0.8
"""Share of the ranges of one half that may be too long; bursts that take 40 % of all may take so
much of it. Without a limit a half says nothing against an answer that fits none of it."""


def contradictions(
    problem: Problem,
    names: tuple[str, ...],
    best: Solution,
    *,
    stated_m: Array,
    rms_sigmas: float,
    long_share: float,
) -> list[str]:
    """Return what speaks against the ranges themselves, a sentence each.

    Parameters
    ----------
    names : (J,) of the anchors.
    stated_m : (M,) standard deviations as stated; the problem's may have been widened.
    rms_sigmas : up to which residuals may be wider than stated.
    long_share : of an anchor's ranges that may be too long, see :class:`.weights.SightKernel`.
    """
    at = problem.places
    told = misfits(
        names, at.anchor, best.error, at.sigma_m, best.biases,
        stated_m=stated_m, rms_sigmas=rms_sigmas, long_share=long_share,
    )  # fmt: skip
    first = at.time_s < np.median(at.time_s)
    own_of = {"first": first, "second": ~first}
    halves = [polished(_part(problem, own), best) for own in own_of.values()]
    for (which, own), half in zip(own_of.items(), halves, strict=True):
        shares = long_shares(len(names), at.anchor[own], half.error, at.sigma_m[own])
        told += [
            f"{100.0 * share:.0f} % of the ranges to anchor {name} in the {which} half are too "
            "long: are all of them of this anchor?"
            for name, share in zip(names, shares, strict=True)
            if share > LONG_OF_HALF
        ]
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


def long_shares(n: int, anchor: Indices, error: Array, sigma_m: Array) -> list[float]:
    """Return which share of the ranges (M,) to each of n anchors is too long, 0 without ranges."""
    shares = np.broadcast_to(sight_kernel(error, sigma_m, anchor).share, error.shape)
    own = [shares[anchor == j] for j in range(n)]
    return [float(one[0]) if len(one) else 0.0 for one in own]


def misfits(
    names: tuple[str, ...],
    anchor: Indices,
    error: Array,
    sigma_m: Array,
    biases: Array,
    *,
    stated_m: Array,
    rms_sigmas: float,
    long_share: float,
) -> list[str]:
    """Return which anchors' ranges are wider, longer or more biased than may be, a sentence each.

    Parameters
    ----------
    anchor, error, sigma_m : (M,) of the ranges; errors are predicted minus measured, m.
    biases : (J,) m
    stated_m, rms_sigmas, long_share : as in :func:`contradictions`.
    """
    told = []
    shares = long_shares(len(names), anchor, error, sigma_m)
    for j, name in enumerate(names):
        own = anchor == j
        stated, seen = float(np.median(stated_m[own])), robust_rms(error[own])
        if seen > rms_sigmas * stated:
            told.append(f"residuals of anchor {name} are {seen:.2f} m, {stated:.2f} m were stated")
        if abs(biases[j]) > 3.0 * BIAS_M:
            told.append(f"the bias of anchor {name} would be {biases[j]:.2f} m")
        if shares[j] > long_share:
            told.append(f"{100.0 * shares[j]:.0f} % of the ranges to anchor {name} are too long")
    return told


def _part(problem: Problem, kept: Mask) -> Problem:
    rows = np.flatnonzero(kept)
    return replace(
        problem,
        places=problem.places.rows(rows),
        drift=problem.drift[rows],
        walk=problem.walk[rows],
    )
