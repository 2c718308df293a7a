"""Beams that repeat one reading: a register that is stuck measures nothing."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from ssm_graph.data import Array

STUCK_PINGS: Final = 8
"""So many equal readings in a row, while other beams change with every ping, are no measurements.

A beam of a resting vehicle whose noise is half of its resolution repeats itself in some half of the
pings, and others change as well in most of them: eight in a row come once in a thousand pings, and
then leave out what the other beams tell too.
"""


def stuck_beams(speed: Array) -> NDArray[np.bool_]:
    """Return which beam speeds (P, 4), m/s, NaN without bottom lock, belong to a stuck beam."""
    is_stuck = np.zeros(speed.shape, bool)
    if len(speed) < STUCK_PINGS:
        return is_stuck
    repeats = speed[1:] == speed[:-1]
    has_changed = np.isfinite(speed[1:] - speed[:-1]) & ~repeats
    repeats &= has_changed.any(axis=1)[:, None]
    for beam in np.flatnonzero(repeats.sum(axis=0) >= STUCK_PINGS - 1):
        edges = np.flatnonzero(np.diff(repeats[:, beam].astype(np.int8), prepend=0, append=0))
        for begin, end in edges.reshape(-1, 2).tolist():
            if end - begin >= STUCK_PINGS - 1:
                is_stuck[begin : end + 1, beam] = True
    return is_stuck
