"""Where something holds, stretch by stretch."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray


def runs_of(mask: NDArray[Any]) -> list[tuple[int, int]]:
    """Return begin and end, one past the last, of every stretch of true values of (N,)."""
    inside = np.asarray(mask, dtype=np.int8)
    edges = np.flatnonzero(np.diff(inside, prepend=0, append=0))
    return [(begin, end) for begin, end in edges.reshape(-1, 2).tolist()]
