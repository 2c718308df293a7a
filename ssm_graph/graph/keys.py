"""Keys of the keyframes and the order in which they are eliminated."""

from __future__ import annotations

import gtsam
from gtsam.symbol_shorthand import B, V, X


def chain_ordering(n_keyframes: int) -> gtsam.Ordering:
    """Return the elimination order: keyframe by keyframe in time."""
    ordering = gtsam.Ordering()
    for k in range(n_keyframes):
        for symbol in (X, V, B):
            ordering.push_back(symbol(k))
    return ordering
