"""Reader of CommonRoad scenarios (XML, 2018b and 2020a): lanelets and their marks."""

from __future__ import annotations

from pathlib import Path
from typing import Final
from xml.etree import ElementTree

import numpy as np

from ssm_graph.base.errors import DataError
from ssm_graph.base.frozen import Array
from ssm_graph.systems.road_map.maps.road_map import (
    Lane,
    LineKind,
    Mark,
    RoadLine,
    RoadMap,
    unique_lines,
    with_sides,
    without_repeats,
)

_MARKS: Final = {
    "solid": Mark.SOLID,
    "broad_solid": Mark.SOLID,
    "dashed": Mark.DASHED,
    "broad_dashed": Mark.DASHED,
}
_BOUNDARIES: Final = frozenset({"curb", "lowered_curb"})
_NO_CARS: Final = frozenset({"sidewalk", "crosswalk", "bicycleLane", "border"})


def read_commonroad(path: Path) -> RoadMap:
    """Return the map of a scenario.

    A bound without a neighbour beyond it is a boundary of the road; between lanes it is a lane
    line, painted as the file says, or of unknown paint where it says nothing.
    """
    try:
        root = ElementTree.parse(path).getroot()
        lanelets = list(root.iterfind("lanelet"))
        notes: list[str] = []
        lanes = {x.name: x for e in lanelets if (x := _lane(e, notes)) is not None}
        lines = [line for e in lanelets for line in _lines(e)]
    except (ElementTree.ParseError, KeyError, ValueError, AttributeError, TypeError) as error:
        raise DataError(f"{path}: expected a CommonRoad scenario, got {error!r}") from error
    if not lanelets:
        raise DataError(f"{path}: expected lanelets of a CommonRoad scenario, got none")
    return RoadMap(path.name, unique_lines(lines), lanes, notes=tuple(notes))


def _bound(element: ElementTree.Element, side: str) -> Array:
    points = [
        (float(p.findtext("x", "nan")), float(p.findtext("y", "nan")))
        for p in element.iterfind(f"{side}Bound/point")
    ]
    return without_repeats(np.array(points).reshape(-1, 2))


def _lane(element: ElementTree.Element, notes: list[str]) -> Lane | None:
    kinds = {kind.text for kind in element.iterfind("laneletType")}
    return with_sides(
        element.attrib["id"],
        _bound(element, "left"),
        _bound(element, "right"),
        notes,
        successors=tuple(s.attrib["ref"] for s in element.iterfind("successor")),
        is_road=not kinds & _NO_CARS,
    )


def _lines(element: ElementTree.Element) -> list[RoadLine]:
    lines = []
    for side in ("left", "right"):
        points = _bound(element, side)
        if len(points) < 2:
            continue
        name = f"{element.attrib['id']} {side}"
        said = (element.findtext(f"{side}Bound/lineMarking") or "unknown").strip()
        is_edge = element.find(f"adjacent{side.capitalize()}") is None
        if is_edge or said in _BOUNDARIES:
            lines.append(RoadLine(name, LineKind.BOUNDARY, points))
        if said not in _BOUNDARIES and said != "no_marking" and (said in _MARKS or not is_edge):
            mark = _MARKS.get(said, Mark.UNKNOWN)
            lines.append(RoadLine(name, LineKind.LANE_LINE, points, mark))
    return lines
