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

from ssm_graph.base.frozen import Array
from ssm_graph.systems.road_map.maps.road_map import RoadLine

CELL_M: Final = 0.5
_BITS: Final = 6
TILE: Final = 1 << _BITS
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
        length_sq = np.maximum(np.einsum("ij,ij->i", self.step, self.step), 1e-12)
        self.normal = (
            np.column_stack([-self.step[:, 1], self.step[:, 0]]) / np.sqrt(length_sq)[:, None]
        )
        """(S + 1, 2) unit vector to the left of the piece."""
        self._piece = np.column_stack([self.start, self.step, self.step / length_sq[:, None]])
        self._make_tree()
        low, high = self.start[:-1].min(axis=0), self.start[:-1].max(axis=0)
        self._low = low - reach_m - 2.0 * CELL_M * TILE
        n = np.ceil((high + reach_m + 2.0 * CELL_M * TILE - self._low) / (CELL_M * TILE))
        self._slots = np.full(n.astype(int) + 1, -1, dtype=np.int64)
        self._raster = np.full((8, TILE * TILE), len(self.start) - 1, dtype=np.int64)
        self._n_tiles = 1  # the first stays empty: beyond the map
        self._slots[[0, -1], :] = 0
        self._slots[:, [0, -1]] = 0

    def _make_tree(self) -> None:
        from scipy.spatial import cKDTree

        step = self.step[:-1]
        n = np.maximum(1, np.ceil(np.hypot(*step.T) / SPACING_M).astype(np.int64))
        self.owner = np.repeat(np.arange(len(n)), n)
        """(P,) the piece of each point."""
        number = np.arange(len(self.owner)) - np.repeat(np.cumsum(n) - n, n)
        share = (number + 0.5) / n[self.owner]
        self.points = self.start[self.owner] + share[:, None] * step[self.owner]
        """(P, 2) m, points all along the lines."""
        self.tree = cKDTree(self.points)

    def nearest(self, x: Array, y: Array) -> tuple[Array, NDArray[np.int64]]:
        """Return distance, m, and piece of the nearest line to points (...)."""
        segment = self.segment_at(x, y)
        dx, dy = self._off(x, y, segment)
        return np.sqrt(dx * dx + dy * dy), segment

    def foot(self, x_y: Array) -> Foot:
        """Return the nearest places on lines to points (..., 2), m."""
        segment = self.segment_at(x_y[..., 0], x_y[..., 1])
        dx, dy = self._off(x_y[..., 0], x_y[..., 1], segment)
        is_none = segment == len(self.start) - 1
        distance = np.where(is_none, np.inf, np.sqrt(dx * dx + dy * dy))
        return Foot(distance, segment, x_y - np.stack([dx, dy], axis=-1))

    def _off(self, x: Array, y: Array, segment: NDArray[np.int64]) -> tuple[Array, Array]:
        """Return from their feet on pieces to points (...), m along x and y."""
        piece = self._piece.take(segment, axis=0)
        sx, sy = piece[..., 2], piece[..., 3]
        dx, dy = x - piece[..., 0], y - piece[..., 1]
        share = dx * piece[..., 4]
        share += dy * piece[..., 5]
        share = np.minimum(np.maximum(share, 0.0), 1.0)
        dx -= share * sx
        dy -= share * sy
        return dx, dy

    def segment_at(self, x: Array, y: Array) -> NDArray[np.int64]:
        """Return the piece of the nearest line to points (...)."""
        n_rows, n_columns = self._slots.shape
        i = self._cell(x, self._low[0], n_rows)
        j = self._cell(y, self._low[1], n_columns)
        tile = (i >> _BITS) * n_columns + (j >> _BITS)
        slot = self._slots.ravel().take(tile)
        if slot.min(initial=0) < 0:
            for number in np.unique(tile[slot < 0]):
                self._make_tile(*divmod(int(number), n_columns))
            slot = self._slots.ravel().take(tile)
        inside = ((i & (TILE - 1)) << _BITS) + (j & (TILE - 1))
        found: NDArray[np.int64] = self._raster.ravel().take((slot << (2 * _BITS)) + inside)
        return found

    @staticmethod
    def _cell(x: Array, low: float, n_tiles: int) -> NDArray[np.int64]:
        """Return the cells of coordinates (...), those beyond the raster in its outermost ones."""
        at = np.fmax((x - low) * (1.0 / CELL_M), 0.0)  # NaN as well
        return np.asarray(np.minimum(at, n_tiles * TILE - 1.0), dtype=np.int64)

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
