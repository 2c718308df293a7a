"""Nearest line to a point, for tens of thousands of points at once.

A raster keeps for every cell which piece of a line is nearest to its centre; the distance to that
piece is then exact. Only where two pieces are equally far within a cell can the other one be meant,
and the distance is then too large by less than the cell. Tiles of the raster are made when they
are first asked for.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ssm_graph.base.frozen import Array
from ssm_graph.systems.road_map.maps.road_map import Mark, RoadLine

CELL_M: Final = 0.5
_BITS: Final = 5
TILE: Final = 1 << _BITS
"""Cells along a tile."""
SPACING_M: Final = 0.5
"""Between points of the lines from which the raster is made."""
REACH_M: Final = 14.0
"""Cells farther from every line know none."""
AT_ONCE: Final = 16384
"""So many points are looked up at once: of 190 000 each costs several times as much, for the memory
that is asked for and given back."""
_FEW: Final = 48
"""Pieces about a tile up to which all are compared with every cell, which is then faster than a
search in the tree: 2 ns a piece against 400 ns."""


def in_blocks(n_rows: int, n_points: int) -> Iterator[slice]:
    """Yield the rows of blocks that have at most ``AT_ONCE`` points, ``n_points`` a row."""
    n = max(1, AT_ONCE // max(1, n_points))
    for first in range(0, n_rows, n):
        yield slice(first, first + n)


_Pieces = NDArray[np.int32]
"""Numbers of pieces, cells and tiles: half the memory is faster."""


class Foot(NamedTuple):
    """Nearest place on a line to points (...)."""

    distance: Array
    """(...) m; infinite where no line is near."""
    segment: _Pieces
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
        self._slots = np.full(n.astype(int) + 1, -1, dtype=np.int32)
        self._raster = np.full((8, TILE * TILE), len(self.start) - 1, dtype=np.int32)
        self._n_tiles = 1  # the first stays empty: beyond the map
        self._slots[[0, -1], :] = 0
        self._slots[:, [0, -1]] = 0

    def _make_tree(self) -> None:
        from scipy.spatial import cKDTree

        step = self.step[:-1]
        n = np.maximum(1, np.ceil(np.hypot(*step.T) / SPACING_M).astype(np.int64))
        self.owner = np.repeat(np.arange(len(n), dtype=np.int32), n)
        """(P,) the piece of each point."""
        number = np.arange(len(self.owner)) - np.repeat(np.cumsum(n) - n, n)
        share = (number + 0.5) / n[self.owner]
        self.points = self.start[self.owner] + share[:, None] * step[self.owner]
        """(P, 2) m, points all along the lines."""
        self.tree = cKDTree(self.points)

    def nearest(self, x: Array, y: Array) -> tuple[Array, _Pieces]:
        """Return distance, m, and piece of the nearest line to points (...)."""
        dx, dy, segment = self.off(x, y)
        return np.sqrt(dx * dx + dy * dy), segment

    def off(self, x: Array, y: Array) -> tuple[Array, Array, _Pieces]:
        """Return from the nearest places on lines to points (...), m along x and y, and the pieces.

        Where no line is near that is some 1e12 m.
        """
        segment = self.segment_at(x, y)
        return *self._off(x, y, segment), segment

    def foot(self, x_y: Array) -> Foot:
        """Return the nearest places on lines to points (..., 2), m.

        From the piece that is nearest to the middle of a point's cell on along its line, until none
        of its neighbours is nearer to the point.
        """
        x, y = x_y[..., 0], x_y[..., 1]
        dx, dy, segment = self.off(x, y)
        none = len(self.start) - 1
        goes_on = True
        while goes_on:
            goes_on = False
            for step in (-1, 1):
                beside = np.minimum(np.maximum(segment + step, 0), none)
                beside = np.where(self.line_of[beside] == self.line_of[segment], beside, segment)
                bx, by = self._off(x, y, beside)
                nearer = bx * bx + by * by < dx * dx + dy * dy
                segment = np.where(nearer, beside, segment)
                dx, dy = np.where(nearer, bx, dx), np.where(nearer, by, dy)
                goes_on |= bool(nearer.any())
        distance = np.where(segment == none, np.inf, np.sqrt(dx * dx + dy * dy))
        return Foot(distance, segment, x_y - np.stack([dx, dy], axis=-1))

    def is_painted_otherwise(self, seen: Array, segment: _Pieces) -> NDArray[np.bool_]:
        """Whether pieces (...) are dashed where what was seen (...) is solid, or the reverse."""
        return np.asarray(self.mark.take(segment) * seen == Mark.SOLID * Mark.DASHED)

    def _off(self, x: Array, y: Array, segment: _Pieces) -> tuple[Array, Array]:
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

    def segment_at(self, x: Array, y: Array) -> _Pieces:
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
        slot <<= 2 * _BITS
        slot += (i & (TILE - 1)) << _BITS
        slot += j & (TILE - 1)
        found: _Pieces = self._raster.ravel().take(slot)
        return found

    @staticmethod
    def _cell(x: Array, low: float, n_tiles: int) -> _Pieces:
        """Return the cells of coordinates (...), those beyond the raster in its outermost ones."""
        at = np.asarray((x - low) * (1.0 / CELL_M))
        np.fmax(at, 0.0, out=at)  # NaN as well
        np.minimum(at, n_tiles * TILE - 1.0, out=at)
        return at.astype(np.int32)

    def _make_tile(self, ti: int, tj: int) -> None:
        cells = (np.arange(TILE) + 0.5) * CELL_M
        x = self._low[0] + ti * TILE * CELL_M + cells
        y = self._low[1] + tj * TILE * CELL_M + cells
        slot = 0
        near = self._pieces_about(np.array([x.mean(), y.mean()]))
        if near.size:
            slot = self._n_tiles
            if slot == len(self._raster):
                more = np.full_like(self._raster, len(self.start) - 1)
                self._raster = np.concatenate([self._raster, more])
            self._raster[slot] = self._nearest_piece(np.repeat(x, TILE), np.tile(y, TILE), near)
            self._n_tiles += 1
        self._slots[ti, tj] = slot

    def _pieces_about(self, middle: Array) -> _Pieces:
        """Return the pieces that can be nearest to a cell of the tile about a point (2,)."""
        half_m = CELL_M * TILE / np.sqrt(2.0)
        nearest_m = float(self.tree.query(middle)[0])
        if nearest_m > self.reach_m + half_m + SPACING_M:
            return np.empty(0, dtype=np.int32)
        points = self.tree.query_ball_point(middle, nearest_m + 2.0 * half_m + SPACING_M)
        return np.unique(self.owner[points])

    def _nearest_piece(self, x: Array, y: Array, near: _Pieces) -> _Pieces:
        """Return which of some pieces is nearest to points (n,); the last one where none is."""
        none = len(self.start) - 1
        if len(near) > _FEW:
            at = np.column_stack([x, y])
            _, point = self.tree.query(at, distance_upper_bound=self.reach_m)
            found: _Pieces = np.append(self.owner, np.int32(none))[point]
            return found
        dx, dy = self._off(x[:, None], y[:, None], near[None])
        distance_sq = dx * dx + dy * dy
        best = near[distance_sq.argmin(axis=1)]
        is_near = distance_sq.min(axis=1) < self.reach_m**2
        return np.asarray(np.where(is_near, best, none), dtype=np.int32)
