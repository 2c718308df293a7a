"""Reader of lanelet2 maps (OSM XML)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final
from xml.etree import ElementTree

import numpy as np

from ssm_graph.base.errors import DataError
from ssm_graph.base.frozen import Array
from ssm_graph.base.projection import TransverseMercator
from ssm_graph.systems.road_map.maps.road_map import (
    Lane,
    LineKind,
    Mark,
    RoadLine,
    RoadMap,
    signed_area,
    without_repeats,
)

BOUNDARIES: Final = frozenset(
    {"curbstone", "road_border", "guard_rail", "fence", "wall", "jersey_barrier"}
)
LANE_LINES: Final = frozenset({"line_thin", "line_thick"})
ROADS: Final = frozenset({"road", "highway", "road_shoulder", "bus_lane", "emergency_lane"})


@dataclass(slots=True)
class _File:
    nodes: dict[str, int] = field(default_factory=dict)
    lat_lon: list[tuple[float, float]] = field(default_factory=list)
    local: list[tuple[float, float]] = field(default_factory=list)
    ways: dict[str, tuple[list[str], dict[str, str]]] = field(default_factory=dict)
    lanelets: list[tuple[str, dict[str, str], list[str], list[str]]] = field(default_factory=list)


def read_lanelet2(path: Path) -> RoadMap:
    """Return the map of a lanelet2 file.

    The plane is transverse Mercator about the middle of the map with scale 1, or, where every node
    has ``local_x`` and ``local_y`` (Autoware), that of the file. Lanelets follow each other where
    they share the last and first nodes of both bounds.
    """
    file = _parsed(path)
    if not file.nodes:
        raise DataError(f"{path}: expected an OSM file with nodes, got none")
    notes: list[str] = []
    projection, x_y = _plane(path, file)
    points = {name: x_y[row] for name, row in file.nodes.items()}
    lines, n_lost = _lines(file, points)
    if n_lost:
        notes.append(f"{path.name}: {n_lost} ways left out, nodes of theirs are missing")
    lanes = _lanes(file, points, notes)
    return RoadMap(path.name, lines, lanes, projection, tuple(notes))


def _parsed(path: Path) -> _File:
    file = _File()
    try:
        for _, element in ElementTree.iterparse(path):
            if element.tag == "node":
                _add_node(file, element)
            elif element.tag == "way":
                tags = _tags(element)
                names = [nd.attrib["ref"] for nd in element.iterfind("nd")]
                file.ways[element.attrib["id"]] = (names, tags)
            elif element.tag == "relation":
                tags = _tags(element)
                if tags.get("type") == "lanelet":
                    sides = {
                        role: [
                            m.attrib["ref"]
                            for m in element.iterfind("member")
                            if m.get("role") == role
                        ]
                        for role in ("left", "right")
                    }
                    file.lanelets.append(
                        (element.attrib["id"], tags, sides["left"], sides["right"])
                    )
            else:
                continue
            element.clear()
    except (ElementTree.ParseError, KeyError, ValueError) as error:
        raise DataError(f"{path}: expected lanelet2 in OSM XML, got {error}") from error
    return file


def _add_node(file: _File, element: ElementTree.Element) -> None:
    file.nodes[element.attrib["id"]] = len(file.lat_lon)
    file.lat_lon.append((float(element.get("lat", "nan")), float(element.get("lon", "nan"))))
    tags = _tags(element)
    if "local_x" in tags and "local_y" in tags:
        file.local.append((float(tags["local_x"]), float(tags["local_y"])))


def _tags(element: ElementTree.Element) -> dict[str, str]:
    return {tag.attrib["k"]: tag.attrib["v"] for tag in element.iterfind("tag")}


def _plane(path: Path, file: _File) -> tuple[TransverseMercator | None, Array]:
    if len(file.local) == len(file.nodes):
        return None, np.array(file.local)
    lat, lon = np.radians(np.array(file.lat_lon)).T
    if not (np.isfinite(lat).any() and np.isfinite(lon).any()):
        raise DataError(
            f"{path}: expected nodes with lat and lon, or all with local_x and local_y, got none"
        )
    middle = [0.5 * (float(np.nanmin(a)) + float(np.nanmax(a))) for a in (lat, lon)]
    if abs(middle[0]) > 0.5 * math.pi:
        raise DataError(
            f"{path}: the latitude of the map's middle is {math.degrees(middle[0]):.3f} deg: "
            "latitude and longitude exchanged?"
        )
    projection = TransverseMercator(middle[0], middle[1])
    return projection, projection.forward(lat, lon)


def _lines(file: _File, points: Mapping[str, Array]) -> tuple[tuple[RoadLine, ...], int]:
    lines, n_lost = [], 0
    for name, (nodes, tags) in file.ways.items():
        kind = tags.get("type", "")
        if kind not in BOUNDARIES | LANE_LINES:
            continue
        if any(node not in points for node in nodes):
            n_lost += 1
            continue
        line = without_repeats(np.array([points[node] for node in nodes]).reshape(-1, 2))
        if len(line) < 2:
            continue
        what = LineKind.BOUNDARY if kind in BOUNDARIES else LineKind.LANE_LINE
        lines.append(RoadLine(name, what, line, _mark(tags.get("subtype", ""))))
    return tuple(lines), n_lost


def _mark(subtype: str) -> Mark:
    if subtype == "dashed":
        return Mark.DASHED
    return Mark.SOLID if subtype in {"solid", "solid_solid"} else Mark.UNKNOWN


def _lanes(file: _File, points: Mapping[str, Array], notes: list[str]) -> dict[str, Lane]:
    """Return all lanelets, and which follow each other."""
    ends: dict[str, tuple[tuple[str, str], tuple[str, str]]] = {}
    kept: dict[str, tuple[Array, Array, bool]] = {}
    for name, tags, left_ways, right_ways in file.lanelets:
        left, right = (_joined(file, ways) for ways in (left_ways, right_ways))
        if min(len(left), len(right)) < 2 or any(n not in points for n in [*left, *right]):
            notes.append(f"lanelet {name}: left out, a bound of it is not in the file")
            continue
        left, right = _aligned(left, right, points)
        ends[name] = (left[0], right[0]), (left[-1], right[-1])
        is_road = tags.get("subtype") in ROADS and tags.get("one_way", "yes") not in {"no", "false"}
        line, other = (np.array([points[n] for n in side]) for side in (left, right))
        kept[name] = line, other, is_road
    starts: dict[tuple[str, str], list[str]] = {}
    for name, (first, _) in ends.items():
        starts.setdefault(first, []).append(name)
    return {
        name: Lane(name, left, right, tuple(starts.get(ends[name][1], ())), is_road)
        for name, (left, right, is_road) in kept.items()
    }


def _joined(file: _File, ways: Sequence[str]) -> list[str]:
    """Return the nodes of ways end to end; [] where one is missing or they do not meet."""
    if any(way not in file.ways for way in ways):
        return []
    parts = [list(file.ways[way][0]) for way in ways]
    if not parts:
        return []
    nodes = parts.pop(0)
    while parts:
        for part in parts:
            if part[0] == nodes[-1]:
                nodes = nodes + part[1:]
            elif part[-1] == nodes[-1]:
                nodes = nodes + part[-2::-1]
            elif part[-1] == nodes[0]:
                nodes = part[:-1] + nodes
            elif part[0] == nodes[0]:
                nodes = part[:0:-1] + nodes
            else:
                continue
            parts.remove(part)
            break
        else:
            return []
    return nodes


def _aligned(
    left: list[str], right: list[str], points: Mapping[str, Array]
) -> tuple[list[str], list[str]]:
    """Turn bounds so that they run along each other with the left one on the left.

    The roles of a lanelet's bounds say in which direction it is driven, the order of their nodes
    says nothing.
    """
    a, b = (np.array([points[node] for node in side]) for side in (left, right))
    same = np.hypot(*(a[0] - b[0])) + np.hypot(*(a[-1] - b[-1]))
    turned = np.hypot(*(a[0] - b[-1])) + np.hypot(*(a[-1] - b[0]))
    if turned < same:
        right, b = right[::-1], b[::-1]
    if signed_area(np.concatenate([a, b[::-1]])) > 0.0:
        left, right = left[::-1], right[::-1]
    return left, right
