"""Nearest line to a point, for tens of thousands of points at once.

A raster keeps for every cell which piece of a line is nearest to its centre; the distance to that
piece is then exact. Only where two pieces are equally far within a cell can the other one be meant,
and the distance is then too large by less than the cell. Tiles of the raster are made when they
are first asked for.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ssm_graph.base.frozen import Array
from ssm_graph.systems.road_map.maps.road_map import RoadLine

CELL_M: Final = 0.5
TILE: Final = 64
"""Cells along a tile."""
SPACING_M: Final = 0.5
"""Between points of the lines from which the raster is made."""
REACH_M: Final = 14.0
"""Cells farther from every line know none."""


class Foot(NamedTuple):
    """Nearest place on a line to points (...)."""

    distance: Array
    """(...) m; infinite where no line is near."""
    segment: NDArray[np.int64]
    """(...) piece of a line; the last one, which is none, where no line is near."""
    x_y: Array
    """(..., 2) m, the foot."""


class LineIndex:
    """Pieces of lines with the raster to find the nearest."""

    def __init__(self, lines: Sequence[RoadLine], reach_m: float = REACH_M) -> None:
        self.lines = tuple(lines)
        self.reach_m = reach_m
        a = [line.points[:-1] for line in lines]
        b = [line.points[1:] for line in lines]
        far = np.full((1, 2), 1e12)  # the piece that is none
        self.start = np.concatenate([*a, far])
        """(S + 1, 2) m, first points of the pieces."""
        self.step = np.concatenate([*b, far + 1.0]) - self.start
        """(S + 1, 2) m, from first to last point."""
        self.line_of = np.repeat(np.arange(len(lines) + 1), [*map(len, a), 1])
        """(S + 1,) number of the line."""
        self.mark = np.array([*(int(line.mark) for line in lines), 0])[self.line_of]
        """(S + 1,) how the piece is painted."""
        self._per_length_sq = 1.0 / np.maximum(np.einsum("ij,ij->i", self.step, self.step), 1e-12)
        self._make_tree()
        low, high = self.start[:-1].min(axis=0), self.start[:-1].max(axis=0)
        self._low = low - reach_m - 2.0 * CELL_M * TILE
        n = np.ceil((high + reach_m + 2.0 * CELL_M * TILE - self._low) / (CELL_M * TILE))
        self._slots = np.full(n.astype(int) + 1, -1, dtype=np.int32)
        self._raster = np.full((8, TILE * TILE), len(self.start) - 1, dtype=np.int32)
        self._n_tiles = 1  # the first stays empty: beyond the map
        self._slots[[0, -1], :] = 0
        self._slots[:, [0, -1]] = 0

    def _make_tree(self) -> None:
        points, owner = [], []
        for segment, (start, step) in enumerate(zip(self.start[:-1], self.step[:-1], strict=True)):
            n = max(1, int(np.ceil(np.hypot(*step) / SPACING_M)))
            share = (np.arange(n) + 0.5) / n
            points.append(start + share[:, None] * step)
            owner.append(np.full(n, segment))
        self.points = np.concatenate([*points, np.empty((0, 2))])
        """(P, 2) m, points all along the lines."""
        self.owner = np.concatenate([*owner, np.empty(0, dtype=int)]).astype(np.int64)
        """(P,) the piece of each point."""
        self.tree = cKDTree(self.points)

    def nearest(self, x: Array, y: Array) -> tuple[Array, NDArray[np.int64]]:
        """Return distance, m, and piece of the nearest line to points (...)."""
        segment = self.segment_at(x, y)
        start, step = self.start[segment], self.step[segment]
        dx, dy = x - start[..., 0], y - start[..., 1]
        sx, sy = step[..., 0], step[..., 1]
        share = np.clip((dx * sx + dy * sy) * self._per_length_sq[segment], 0.0, 1.0)
        dx -= share * sx
        dy -= share * sy
        return np.sqrt(dx * dx + dy * dy), segment

    def foot(self, x_y: Array) -> Foot:
        """Return the nearest places on lines to points (..., 2), m."""
        distance, segment = self.nearest(x_y[..., 0], x_y[..., 1])
        start, step = self.start[segment], self.step[segment]
        along = np.einsum("...i,...i->...", x_y - start, step) * self._per_length_sq[segment]
        foot = start + np.clip(along, 0.0, 1.0)[..., None] * step
        is_none = segment == len(self.start) - 1
        return Foot(np.where(is_none, np.inf, distance), segment, foot)

    def segment_at(self, x: Array, y: Array) -> NDArray[np.int64]:
        """Return the piece of the nearest line to points (...)."""
        i = np.floor((x - self._low[0]) * (1.0 / CELL_M)).astype(np.int64)
        j = np.floor((y - self._low[1]) * (1.0 / CELL_M)).astype(np.int64)
        ti = np.clip(i // TILE, 0, self._slots.shape[0] - 1)
        tj = np.clip(j // TILE, 0, self._slots.shape[1] - 1)
        slot = self._slots[ti, tj]
        if slot.min() < 0:
            missing = np.unique(np.stack([ti[slot < 0], tj[slot < 0]], axis=-1), axis=0)
            for row, column in missing:
                self._make_tile(int(row), int(column))
            slot = self._slots[ti, tj]
        return np.asarray(self._raster[slot, (i % TILE) * TILE + j % TILE], dtype=np.int64)

    def _make_tile(self, ti: int, tj: int) -> None:
        cells = (np.arange(TILE) + 0.5) * CELL_M
        x = self._low[0] + ti * TILE * CELL_M + cells
        y = self._low[1] + tj * TILE * CELL_M + cells
        grid = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)
        _, near = self.tree.query(grid, distance_upper_bound=self.reach_m)
        owner = np.append(self.owner, len(self.start) - 1)
        slot = 0
        if np.any(near < len(self.points)):
            slot = self._n_tiles
            if slot == len(self._raster):
                more = np.full_like(self._raster, len(self.start) - 1)
                self._raster = np.concatenate([self._raster, more])
            self._raster[slot] = owner[near]
            self._n_tiles += 1
        self._slots[ti, tj] = slot
