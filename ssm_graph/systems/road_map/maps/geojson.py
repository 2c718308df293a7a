"""Reader of GeoJSON: lines with a kind, in degrees or in metres."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ssm_graph.base.errors import DataError
from ssm_graph.base.frozen import Array
from ssm_graph.base.projection import TransverseMercator
from ssm_graph.base.settings import parse_json
from ssm_graph.systems.road_map.maps.road_map import (
    LineKind,
    Mark,
    RoadLine,
    RoadMap,
    without_repeats,
)


def read_geojson(path: Path) -> RoadMap:
    """Return the map of a GeoJSON file.

    Each ``LineString`` or ``MultiLineString`` has the property ``kind``, "boundary" or "lane line",
    and may have ``mark``, "solid" or "dashed"; other features are left out. Coordinates are
    longitude and latitude, deg, as the format wants them (RFC 7946), or metres in a plane where the
    file says ``"plane": true``.
    """
    try:
        found = parse_json(path.read_bytes())
        parts = [part for feature in found["features"] for part in _parts(feature)]
        is_plane = bool(found.get("plane", False))
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise DataError(f"{path}: expected a collection of GeoJSON lines, got {error!r}") from error
    projection = None
    if parts and not is_plane:
        lon, lat = np.radians(np.concatenate([points for *_, points in parts])).T
        if np.abs(lat).max() > 0.5 * math.pi or np.abs(lon).max() > math.pi:
            raise DataError(
                f"{path}: expected longitude and latitude in degrees, in this order, got "
                f"{np.degrees(lon[0]):.3f}, {np.degrees(lat[0]):.3f}; exchanged, or metres? "
                'then say "plane": true'
            )
        projection = TransverseMercator(
            0.5 * float(lat.min() + lat.max()), 0.5 * float(lon.min() + lon.max())
        )
    lines = []
    for name, kind, mark, points in parts:
        x_y = points
        if projection is not None:
            x_y = projection.forward(np.radians(points[:, 1]), np.radians(points[:, 0]))
        x_y = without_repeats(x_y)
        if len(x_y) > 1:
            lines.append(RoadLine(name, kind, x_y, mark))
    return RoadMap(path.name, tuple(lines), {}, projection)


def _parts(feature: Mapping[str, Any]) -> Iterator[tuple[str, LineKind, Mark, Array]]:
    said = feature.get("properties") or {}
    shape = feature.get("geometry") or {}
    kind = str(said.get("kind", "")).replace("_", " ").lower()
    if kind not in {"boundary", "lane line"}:
        return
    points_of = shape.get("coordinates") or []
    several = {"LineString": [points_of], "MultiLineString": points_of}
    mark = Mark.__members__.get(str(said.get("mark", "")).upper(), Mark.UNKNOWN)
    what = LineKind.BOUNDARY if kind == "boundary" else LineKind.LANE_LINE
    for points in several.get(str(shape.get("type")), []):
        array = np.array([point[:2] for point in points], dtype=np.float64).reshape(-1, 2)
        yield str(feature.get("id", said.get("name", ""))), what, mark, array
