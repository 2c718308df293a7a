"""Inertial data of which many samples are missing here and there, in steps too short for gaps.

Every sample stands for the step that it ends. Where most of such a step was seen by samples that
were lost, what is taken for it is late, all the time, and no density of noise says so. One rule
holds for a log and on the way: more than :data:`MOST_MISSING` of the samples due between two
keyframes are missing.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from ssm_graph.base.frozen import Array
from ssm_graph.base.times import usual_interval

MOST_MISSING: Final = 0.3
"""A larger share of the inertial samples missing leaves turns and shocks unseen: where a third is,
one step in nine is of three intervals or more."""
PERIOD_OF: Final = 200
"""Samples whose median interval is one sampling interval; the shortest of all is that when most
came."""


def sampling_interval(time_s: Array) -> float:
    """Return the interval of samples at times (N,) where most of them came, s; N from 2 on."""
    begins = range(0, max(len(time_s) - PERIOD_OF, 0) + 1, PERIOD_OF // 2)
    return min(usual_interval(time_s[begin : begin + PERIOD_OF]) for begin in begins)


def missing_samples(time_s: Array, edge_s: Array, period_s: float) -> tuple[Array, Array]:
    """Return of each span between successive edges how much is without samples.

    Parameters
    ----------
    time_s : (N,) times of the samples that came, s, rising.
    edge_s : (K,) begins and ends of the spans, s, rising.
    period_s : the interval between samples where all come, s.

    Returns
    -------
    tuple
        (K - 1,) shares of the samples due that have not come, and (K - 1,) the longest steps to one
        that has, from the one before or from the span's begin, s.
    """
    n_due = np.floor(np.diff(edge_s) / period_s - 1.0)
    n_come = np.diff(np.searchsorted(time_s, edge_s, side="right"))
    share = np.where(n_due > 0.0, 1.0 - n_come / np.maximum(n_due, 1.0), 0.0)
    span = np.searchsorted(edge_s, time_s) - 1
    is_inside = (span >= 0) & (span < len(edge_s) - 1)
    before_s = np.concatenate([[-np.inf], time_s[:-1]])[is_inside]
    step_s = time_s[is_inside] - np.maximum(before_s, edge_s[span[is_inside]])
    longest_s = np.zeros(len(edge_s) - 1)
    np.maximum.at(longest_s, span[is_inside], step_s)
    return share, longest_s


def unseen_steps(time_s: Array, edge_s: Array, gaps: tuple[Array, Array], period_s: float) -> Array:
    """Return how long of the steps nothing is seen of where many samples are missing, (K - 1,) s.

    0 where fewer are, and where a span has some of a gap, which is bridged. ``gaps`` are begins and
    ends, s; the others as in :func:`missing_samples`.
    """
    share, longest_s = missing_samples(time_s, edge_s, period_s)
    is_thin = share > MOST_MISSING
    for begin_s, end_s in zip(*gaps, strict=True):
        is_thin &= (edge_s[:-1] >= end_s) | (edge_s[1:] <= begin_s)
    return np.where(is_thin, np.maximum(longest_s - period_s, 0.0), 0.0)
