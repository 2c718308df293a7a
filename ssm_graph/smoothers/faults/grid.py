"""Blocks of keyframes, whose edges are where stretches begin and end."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ssm_graph.base.frozen import Array
from ssm_graph.smoothers.faults.columns import TREND_S


class Grid(NamedTuple):
    """Blocks of keyframes, whose edges are where stretches begin and end."""

    edges: NDArray[np.intp]
    """(N + 1) keyframes, the last one after the mission's end"""
    middle_s: Array
    """(N,) s"""
    length_s: Array
    """(N,) s"""
    block_s: float
    """Of a coarse block, s"""
    origin_s: float = 0.0
    """When the mission begins, from which on rates count, s"""

    @classmethod
    def of(
        cls,
        keyframe_s: Array,
        edges_s: Iterable[float],
        *,
        block_s: float = 10.0,
        piece: tuple[int, int] | None = None,
    ) -> Grid:
        """Return the blocks between some times, s, and the ends of the mission, or of a piece.

        A piece is its first keyframe and the first one after it.
        """
        begin, end = piece or (0, len(keyframe_s))
        inner = np.searchsorted(keyframe_s, np.array(sorted(edges_s))).clip(begin, end)
        edges = np.unique(np.concatenate([[begin], inner, [end]]))
        last = np.append(keyframe_s, keyframe_s[-1])
        begin_s, end_s = last[edges[:-1]], last[edges[1:]]
        return cls(edges, 0.5 * (begin_s + end_s), end_s - begin_s, block_s, float(keyframe_s[0]))

    def coarse(self) -> tuple[NDArray[np.intp], Array]:
        """Return the first block of each coarse one (G,), and their middles, s."""
        begin_s = self.middle_s - 0.5 * self.length_s
        number = np.floor((self.middle_s - begin_s[0]) / self.block_s)
        first = np.flatnonzero(np.diff(number, prepend=-1.0))
        ends_s = np.append(begin_s[first[1:]], begin_s[-1] + self.length_s[-1])
        return first, 0.5 * (begin_s[first] + ends_s)

    @property
    def begin_since(self) -> Array:
        """(N,) what a rate counts where each block begins, from the begin of the mission on."""
        return np.asarray(self.middle_since - 0.5 * self.length_s / TREND_S)

    @property
    def middle_since(self) -> Array:
        """(N,) the same in their middles."""
        return np.asarray((self.middle_s - self.origin_s) / TREND_S)

    @property
    def n_blocks(self) -> int:
        """How many there are."""
        return len(self.middle_s)
