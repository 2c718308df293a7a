"""Readings that repeat themselves: a sensor, or its driver, that has stopped measuring."""

from __future__ import annotations

from typing import Final

import numpy as np

from ssm_graph.base.frozen import Array
from ssm_graph.base.runs import runs_of

USUALLY_EQUAL: Final = 0.2
"""Where more of the other successive readings are equal, resolution makes them so, or rest."""


def frozen_runs(
    time_s: Array, values: Array, *, least_s: float, least_count: int
) -> list[tuple[int, int]]:
    """Return first and last of readings (N, d) in a row that are equal in all components.

    Parameters
    ----------
    time_s : (N,)
    values : (N, d)
    least_s, least_count : so long, and so many times, one has to be repeated.
    """
    equal = np.all(values[1:] == values[:-1], axis=1)
    runs = [
        (begin, end)
        for begin, end in runs_of(equal)
        if end - begin >= least_count and time_s[end] - time_s[begin] >= least_s
    ]
    inside = sum(end - begin for begin, end in runs)
    others = len(equal) - inside
    is_usual = inside > others or np.sum(equal) - inside > USUALLY_EQUAL * others
    return [] if is_usual else runs
