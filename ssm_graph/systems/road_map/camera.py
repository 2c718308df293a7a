"""A simulated camera: what of a map's lines is seen from a pose, as cubics with errors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from ssm_graph.base.frozen import Array
from ssm_graph.systems.road_map.drive import Curves
from ssm_graph.systems.road_map.maps.index import LineIndex
from ssm_graph.systems.road_map.maps.road_map import LineKind, Mark

BIN_M: Final = 1.0
_GAP_M: Final = 1.0
"""Between neighbouring bins a line moves sideways by no more than this and half its slope."""
_SHORTEST_M: Final = 8.0
_FROM_M: Final = -5.0


@dataclass(frozen=True, slots=True)
class CameraModel:
    """How far it sees and how it errs; the defaults are those of docs/road-map.md."""

    rate_hz: float = 5.0
    reach_m: float = 40.0
    boundary_side_m: float = 14.0
    """Boundaries farther to the side are not seen."""
    line_side_m: float = 5.0
    """Lane lines farther to the side are not taken for those of the own lane."""
    boundary_sigma_m: float = 0.08
    line_sigma_m: float = 0.03
    slope_sigma: float = 4e-3
    scatter_m: float = 0.02
    """Of the points through which the cubic is laid."""
    p_missed: float = 0.1
    p_false: float = 0.0
    """Chance of a curve that is none, in place of a true one."""
    p_occluded: float = 0.0
    """Chance that traffic hides all beyond 8 to 20 m."""
    p_wrong_mark: float = 0.1
    """Chance that dashed and solid are taken for each other."""


def seen(
    pose: Array,
    indices: dict[LineKind, LineIndex],
    model: CameraModel,
    rng: np.random.Generator,
) -> list[tuple[float, ...]]:
    """Return the curves seen from a pose (3,): rows of kind, side, c0-c3, x range, sigma, mark."""
    rows = []
    for kind, index in indices.items():
        is_line = kind is LineKind.LANE_LINE
        y_max = model.line_side_m if is_line else model.boundary_side_m
        reach_m = model.reach_m
        if rng.random() < model.p_occluded:
            reach_m = rng.uniform(8.0, 20.0)
        near = index.tree.query_ball_point(pose[:2], np.hypot(model.reach_m, y_max) + 1.0)
        points, owner = index.points[near], index.owner[near]
        c, s = np.cos(pose[2]), np.sin(pose[2])
        d = points - pose[:2]
        x, y = d @ [c, s], d @ [-s, c]
        for side in (1, -1):
            noise = _Noise(rng, model, is_line=is_line)
            if rng.random() < model.p_missed:
                continue
            is_ahead = (x > _FROM_M) & (x < reach_m) & (side * y > 0.0) & (side * y < 2.0 * y_max)
            fitted = _fitted(x[is_ahead], side * y[is_ahead], owner[is_ahead], y_max, noise)
            if fitted is None:
                continue
            cubic, low, high, owners = fitted
            mark = _mark(index, owners, model, rng) if is_line else Mark.UNKNOWN
            cubic = side * cubic
            if rng.random() < model.p_false:
                cubic[0] += rng.uniform(-3.0, 3.0)
            sigma = model.line_sigma_m if is_line else model.boundary_sigma_m
            rows.append((int(kind), side, *cubic, low, high, sigma, int(mark)))
    return rows


@dataclass(frozen=True, slots=True)
class _Noise:
    rng: np.random.Generator
    model: CameraModel
    is_line: bool

    @property
    def offset(self) -> float:
        model = self.model
        sigma = model.line_sigma_m if self.is_line else model.boundary_sigma_m
        return float(self.rng.normal(0.0, sigma))


def _fitted(
    x: Array, y: Array, owner: Array, y_max: float, noise: _Noise
) -> tuple[Array, float, float, Array] | None:
    """Lay a cubic through the nearest line on the left of points (N,); None where none is long.

    In each bin of x the nearest line hides what is behind it; bins that go on from each other,
    beginning where the line is nearest to the vehicle, are one curve.
    """
    if len(x) == 0:
        return None
    bins = np.floor((x - _FROM_M) / BIN_M).astype(int)
    order = np.lexsort((y, bins))
    first = np.unique(bins[order], return_index=True)
    pick = order[first[1]]
    bx, by, bo, bi = x[pick], y[pick], owner[pick], first[0]
    is_joined = (np.diff(bi) <= 2) & (np.abs(np.diff(by)) < _GAP_M * np.maximum(np.diff(bx), 0.5))
    part = np.concatenate([[0], np.cumsum(~is_joined)])
    is_start = by < y_max
    if not is_start.any():
        return None
    begin = int(np.argmin(np.where(is_start, np.abs(bx), np.inf)))
    if abs(bx[begin]) > 0.4 * noise.model.reach_m:
        return None
    mine = part == part[begin]
    bx, by, bo = bx[mine], by[mine], bo[mine]
    if bx[-1] - bx[0] < _SHORTEST_M:
        return None
    by = by + noise.rng.normal(0.0, noise.model.scatter_m, len(by))
    scale = noise.model.reach_m
    cubic = np.polynomial.polynomial.polyfit(bx / scale, by, 3) / scale ** np.arange(4)
    misfit = np.abs(np.polynomial.polynomial.polyval(bx, cubic) - by).max()
    if misfit > 0.5:  # no cubic: as a detector would, the far part is given up
        half = bx < 0.5 * (bx[0] + bx[-1])
        if half.sum() * BIN_M < _SHORTEST_M:
            return None
        bx, by, bo = bx[half], by[half], bo[half]
        cubic = np.polynomial.polynomial.polyfit(bx / scale, by, 3) / scale ** np.arange(4)
    cubic[0] += noise.offset
    cubic[1] += noise.rng.normal(0.0, noise.model.slope_sigma)
    return cubic, float(bx[0]), float(bx[-1]), bo


def _mark(index: LineIndex, owners: Array, model: CameraModel, rng: np.random.Generator) -> Mark:
    marks, counts = np.unique(index.mark[owners.astype(int)], return_counts=True)
    mark = Mark(int(marks[counts.argmax()]))
    if mark is Mark.UNKNOWN or rng.random() >= model.p_wrong_mark:
        return mark
    return Mark.DASHED if mark is Mark.SOLID else Mark.SOLID


def curves_of(time_s: list[float], rows: list[list[tuple[float, ...]]]) -> Curves:
    """Return the curves of pictures (times and rows as of `seen`) as one table."""
    t = np.array([when for when, group in zip(time_s, rows, strict=True) for _ in group])
    table = np.array([row for group in rows for row in group]).reshape(-1, 10)
    return Curves(
        t, table[:, 0], table[:, 1], table[:, 2:6], table[:, 6:8], table[:, 8], table[:, 9]
    )
