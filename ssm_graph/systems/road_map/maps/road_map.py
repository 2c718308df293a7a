"""The neutral map: lines that can be seen, lanes that can be driven, and where they come from."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import IntEnum
from typing import Final, Self

import numpy as np

from ssm_graph.base.errors import DataError
from ssm_graph.base.frozen import Array, FrozenArrays, shaped
from ssm_graph.base.projection import TransverseMercator


class LineKind(IntEnum):
    """What a line is on the road; the number stands in tables."""

    BOUNDARY = 0
    """Kerb, guard rail, wall, edge of the drivable area."""
    LANE_LINE = 1
    """Painted, between lanes or at the edge of one."""


class Mark(IntEnum):
    """How a lane line is painted; the number stands in tables."""

    UNKNOWN = 0
    SOLID = 1
    DASHED = 2


@dataclass(frozen=True, slots=True, eq=False)
class RoadLine(FrozenArrays):
    """A line that can be seen from the road."""

    name: str
    """As in the file."""
    kind: LineKind
    points: Array = shaped("N", 2)
    """m, two or more."""
    mark: Mark = Mark.UNKNOWN


@dataclass(frozen=True, slots=True, eq=False)
class Lane(FrozenArrays):
    """A lane with its bounds along the direction of travel."""

    name: str
    left: Array = shaped("N", 2)
    """m"""
    right: Array = shaped("M", 2)
    """m"""
    successors: tuple[str, ...] = ()
    is_road: bool = True
    """Whether cars drive here, in this direction only."""

    def centre(self, spacing_m: float = 1.0) -> Array:
        """Return the line between the bounds, (N, 2), points about so far apart."""
        length = max(line_length(self.left), line_length(self.right))
        share = np.linspace(0.0, 1.0, max(2, int(np.ceil(length / spacing_m)) + 1))
        return 0.5 * (_at_share(self.left, share) + _at_share(self.right, share))


_SIDES: Final = ("left", "right")
FAR_M: Final = 2000.0
"""A fix so far off the map is one of another map."""


@dataclass(frozen=True, slots=True, eq=False)
class RoadMap:
    """Lines and lanes in one plane."""

    name: str
    lines: tuple[RoadLine, ...]
    lanes: Mapping[str, Lane]
    projection: TransverseMercator | None = None
    """From latitude and longitude to the plane; None where the file does not say."""
    notes: tuple[str, ...] = ()
    """What was mended on the way."""
    bounds: tuple[float, float, float, float] = field(init=False)
    """Least x, least y, largest x, largest y of the lines, m."""
    _line_boxes: Array = field(init=False, repr=False)
    """(L, 4) the same of each line ..."""
    _lane_boxes: Array = field(init=False, repr=False)
    """... and of both bounds of each lane."""

    def __post_init__(self) -> None:
        if not self.lines:
            raise DataError(
                f"{self.name}: expected road boundaries or lane lines, got none; is it a map of "
                "roads with their edges, in one of the formats that are read?"
            )
        boxes = boxes_of([line.points for line in self.lines])
        if not np.all(np.isfinite(boxes)):
            raise DataError(f"{self.name}: expected finite coordinates, got NaN or infinity")
        low, high = boxes[:, :2].min(axis=0), boxes[:, 2:].max(axis=0)
        object.__setattr__(self, "bounds", (*map(float, low), *map(float, high)))
        object.__setattr__(self, "_line_boxes", boxes)
        left, right = (boxes_of([getattr(x, side) for x in self.lanes.values()]) for side in _SIDES)
        both = np.minimum(left[:, :2], right[:, :2]), np.maximum(left[:, 2:], right[:, 2:])
        object.__setattr__(self, "_lane_boxes", np.column_stack(both))

    def of_kind(self, kind: LineKind) -> tuple[RoadLine, ...]:
        """Return the lines of one kind."""
        return tuple(line for line in self.lines if line.kind is kind)

    def within(self, x_y: Array, reach_m: float) -> Self:
        """Return what comes as near as ``reach_m`` to the box around points (..., 2), m.

        Raises :class:`DataError` where there is nothing, with how far off the map it is.
        """
        points = np.reshape(x_y, (-1, 2))
        low, high = points.min(axis=0) - reach_m, points.max(axis=0) + reach_m
        lines = tuple(self.lines[i] for i in touching(self._line_boxes, low, high))
        if not lines:
            raise DataError(f"{self.name}: {self._off(points.mean(axis=0), reach_m)}")
        every = list(self.lanes.items())
        lanes = dict(every[i] for i in touching(self._lane_boxes, low, high))
        return replace(self, lines=lines, lanes=lanes)

    def _off(self, x_y: Array, reach_m: float) -> str:
        x0, y0, x1, y1 = self.bounds
        off = np.hypot(*(np.maximum(np.maximum([x0, y0] - x_y, x_y - [x1, y1]), 0.0)))
        text = (
            f"expected a boundary or lane line within {reach_m:.0f} m of "
            f"({x_y[0]:.1f}, {x_y[1]:.1f}), got none; "
        )
        if off == 0.0:
            return text + "the map has a gap there"
        text += f"that is {off:.0f} m off the map"
        if off < FAR_M:
            return text + ": take the map of that place"
        return text + ": latitude and longitude exchanged, or another projection?"


def boxes_of(lines: Sequence[Array]) -> Array:
    """Return least x, least y, largest x, largest y of lines (N, 2): (L, 4), m."""
    if not lines:
        return np.empty((0, 4))
    first = np.cumsum([0, *map(len, lines[:-1])])
    points = np.concatenate(lines)
    low, high = (f.reduceat(points, first) for f in (np.minimum, np.maximum))
    return np.column_stack([low, high])


def touching(boxes: Array, low: Array, high: Array) -> list[int]:
    """Return which boxes (L, 4) have something in common with the one from low to high."""
    is_near = np.all(boxes[:, 2:] >= low, axis=1) & np.all(boxes[:, :2] <= high, axis=1)
    return np.flatnonzero(is_near).tolist()


def line_length(points: Array) -> float:
    """Return the length of a line (N, 2), m."""
    return float(np.hypot(*np.diff(points, axis=0).T).sum())


def resampled(points: Array, spacing_m: float) -> Array:
    """Return a line (N, 2) with points evenly apart, at most by the spacing, m."""
    n = max(1, int(np.ceil(line_length(points) / spacing_m)))
    return _at_share(points, np.linspace(0.0, 1.0, n + 1))


def with_sides(
    name: str, left: Array, right: Array, notes: list[str], **more: object
) -> Lane | None:
    """Return a lane whose left bound is on the left; None for one without length.

    Bounds that run against each other are turned; bounds that are exchanged are put right, and a
    note says so.
    """
    if len(left) < 2 or len(right) < 2:
        notes.append(f"lane {name}: left out, a bound has less than two points")
        return None
    same = np.hypot(*(left[0] - right[0])) + np.hypot(*(left[-1] - right[-1]))
    turned = np.hypot(*(left[0] - right[-1])) + np.hypot(*(left[-1] - right[0]))
    if turned < same:
        right = right[::-1]
        notes.append(f"lane {name}: its bounds ran against each other; the right one is turned")
    if signed_area(np.concatenate([left, right[::-1]])) > 0.0:
        left, right = right, left
        notes.append(f"lane {name}: left and right were exchanged; put right")
    return Lane(name, left, right, **more)  # type: ignore[arg-type]


def signed_area(polygon: Array) -> float:
    """Return the area of a polygon (N, 2), m^2, positive where it runs anticlockwise."""
    x, y = polygon[:, 0] - polygon[0, 0], polygon[:, 1] - polygon[0, 1]
    return float(0.5 * (x[:-1] @ y[1:] - x[1:] @ y[:-1]))  # the last corner leads to zero


def without_repeats(points: Array) -> Array:
    """Return a line (N, 2) without points that repeat the one before."""
    if len(points) == 0:
        return points
    moves = np.any(np.diff(points, axis=0) != 0.0, axis=1)
    return np.asarray(points[np.concatenate([[True], moves])])


def unique_lines(lines: Sequence[RoadLine]) -> tuple[RoadLine, ...]:
    """Return lines without those that run along another one of their kind, point by point (cm)."""
    found: dict[tuple[object, ...], RoadLine] = {}
    for line in lines:
        cells = [tuple(cell) for cell in np.rint(line.points * 100.0).astype(np.int64).tolist()]
        key = (line.kind, *min(cells, cells[::-1]))
        if key not in found or found[key].mark is Mark.UNKNOWN:
            found[key] = line
    return tuple(found.values())


def _at_share(points: Array, share: Array) -> Array:
    s = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])
    at = share * s[-1]
    return np.column_stack([np.interp(at, s, points[:, 0]), np.interp(at, s, points[:, 1])])
