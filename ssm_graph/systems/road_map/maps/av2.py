"""Reader of Argoverse 2 vector maps (JSON) and of the poses beside them (Feather)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from ssm_graph.base.errors import DataError
from ssm_graph.base.frozen import Array
from ssm_graph.base.settings import parse_json
from ssm_graph.systems.road_map.maps.road_map import (
    Lane,
    LineKind,
    Mark,
    RoadLine,
    RoadMap,
    boxes_of,
    resampled,
    touching,
    unique_lines,
    with_sides,
    without_repeats,
)

_STEP_M: Final = 1.0
_OUTSIDE_M: Final = 0.3
"""An edge of the drivable area with drivable ground so far beyond it is a seam, not an edge."""


def read_av2(path: Path) -> RoadMap:
    """Return the map of an Argoverse 2 log: lane marks, and edges of the drivable area.

    The plane is that of the city. Edges that drivable areas share are no boundaries.
    """
    try:
        found = parse_json(path.read_bytes())
        segments = found["lane_segments"].values()
        areas = [_points(area["area_boundary"]) for area in found["drivable_areas"].values()]
        notes: list[str] = []
        lanes = {lane.name: lane for s in segments if (lane := _lane(s, notes)) is not None}
        lines = [line for segment in segments for line in _marks(segment)]
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise DataError(f"{path}: expected a map of Argoverse 2, got {error!r}") from error
    return RoadMap(path.name, (*unique_lines(lines), *_edges(areas)), lanes, notes=tuple(notes))


def _points(raw: Sequence[Mapping[str, float]]) -> Array:
    return without_repeats(np.array([(p["x"], p["y"]) for p in raw]).reshape(-1, 2))


def _lane(segment: Mapping[str, Any], notes: list[str]) -> Lane | None:
    return with_sides(
        str(segment["id"]),
        _points(segment["left_lane_boundary"]),
        _points(segment["right_lane_boundary"]),
        notes,
        successors=tuple(str(name) for name in segment["successors"]),
        is_road=segment["lane_type"] in {"VEHICLE", "BUS"},
    )


def _marks(segment: Mapping[str, Any]) -> list[RoadLine]:
    lines = []
    for side in ("left", "right"):
        mark = str(segment[f"{side}_lane_mark_type"])
        points = _points(segment[f"{side}_lane_boundary"])
        if mark in {"NONE", "UNKNOWN"} or len(points) < 2:
            continue
        kind = Mark.DASHED if mark.startswith("DASHED") else Mark.SOLID
        if "DASH" in mark and "SOLID" in mark:
            kind = Mark.UNKNOWN
        lines.append(RoadLine(f"{segment['id']} {side}", LineKind.LANE_LINE, points, kind))
    return lines


def _edges(areas: Sequence[Array]) -> list[RoadLine]:
    lines, boxes = [], boxes_of(areas)
    for number, area in enumerate(areas):
        ring = resampled(np.concatenate([area, area[:1]]), _STEP_M)
        d = np.diff(ring, axis=0)
        normal = np.column_stack([-d[:, 1], d[:, 0]]) / np.hypot(*d.T)[:, None]
        middle = 0.5 * (ring[1:] + ring[:-1])
        is_covered = np.zeros(len(middle), dtype=bool)
        box = boxes[number]
        for other in touching(boxes, box[:2] - _OUTSIDE_M, box[2:] + _OUTSIDE_M):
            for side in (-_OUTSIDE_M, _OUTSIDE_M) if other != number else ():
                is_covered |= is_inside(middle + side * normal, areas[other])
        bounds = np.flatnonzero(np.diff(np.concatenate([[True], is_covered, [True]]).astype(int)))
        for first, last in zip(bounds[::2], bounds[1::2], strict=True):
            points = ring[first : last + 1]
            lines.append(RoadLine(f"area {number}", LineKind.BOUNDARY, points))
    return lines


def is_inside(points: Array, polygon: Array) -> NDArray[np.bool_]:
    """Return which points (N, 2) lie in a polygon (M, 2), by the even-odd rule."""
    low, high = polygon.min(axis=0), polygon.max(axis=0)
    found: NDArray[np.bool_] = np.all((points >= low) & (points <= high), axis=1)
    x, y = points[found, None, 0], points[found, None, 1]
    x0, y0 = polygon.T
    x1, y1 = np.roll(polygon, -1, axis=0).T
    crosses = (y0 > y) != (y1 > y)
    with np.errstate(divide="ignore", invalid="ignore"):
        is_left = x < x0 + (y - y0) / (y1 - y0) * (x1 - x0)
    found[found] = np.count_nonzero(crosses & is_left, axis=1) % 2 == 1
    return found
