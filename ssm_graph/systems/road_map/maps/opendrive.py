"""Reader of OpenDRIVE 1.4 to 1.7: reference lines, lane widths and offsets, road marks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final
from xml.etree import ElementTree

import numpy as np

from ssm_graph.base.errors import DataError
from ssm_graph.base.frozen import Array
from ssm_graph.systems.road_map.maps.georeference import plane_of
from ssm_graph.systems.road_map.maps.road_map import (
    Lane,
    LineKind,
    Mark,
    RoadLine,
    RoadMap,
    without_repeats,
)

STEP_M: Final = 1.0
"""Between points of the lines that are made; a chord of a bend of 10 m radius is off by 1.3 cm."""
_CARS: Final = frozenset(
    {"driving", "entry", "exit", "onRamp", "offRamp", "connectingRamp", "bidirectional"}
)
_ROADWAY: Final = _CARS | {"stop", "shoulder", "parking", "bus", "taxi", "HOV", "biking", "median"}


def read_opendrive(path: Path, step_m: float = STEP_M) -> RoadMap:
    """Return the map of an OpenDRIVE file, its lines with points about ``step_m`` apart.

    Road marks "solid" and "broken" are lane lines, "curb" is a boundary; so is the outer edge of
    the outermost lane of the roadway, where no mark says so, but not within junctions, whose roads
    cross each other.
    """
    try:
        root = ElementTree.parse(path).getroot()
        lines: list[RoadLine] = []
        lanes: dict[str, Lane] = {}
        for road in root.iterfind("road"):
            _add_road(road, step_m, lines, lanes)
        joined = _joined(lanes)
        projection, notes = plane_of(root)
    except (ElementTree.ParseError, KeyError, ValueError) as error:
        raise DataError(f"{path}: expected OpenDRIVE, got {error!r}") from error
    return RoadMap(path.name, tuple(lines), joined, projection, notes)


@dataclass(frozen=True, slots=True)
class _Cubic:
    """Pieces a + b d + c d^2 + d d^3, each from its s on."""

    s: Array
    terms: Array

    @classmethod
    def of(cls, elements: Sequence[ElementTree.Element], start: str = "s") -> _Cubic:
        if not elements:
            return cls(np.zeros(1), np.zeros((1, 4)))
        s = np.array([float(e.attrib[start]) for e in elements])
        terms = np.array([[float(e.attrib[k]) for k in "abcd"] for e in elements])
        order = np.argsort(s, kind="stable")
        return cls(s[order], terms[order])

    def at(self, s: Array) -> Array:
        piece = np.clip(np.searchsorted(self.s, s, side="right") - 1, 0, len(self.s) - 1)
        d = s - self.s[piece]
        a, b, c, cubic = self.terms[piece].T
        return np.asarray(a + d * (b + d * (c + d * cubic)))


def reference_line(road: ElementTree.Element, s: Array) -> Array:
    """Return x, y [m] and heading [rad] (N, 3) of a road's reference line at lengths (N,), m."""
    pieces = list(road.iterfind("planView/geometry"))
    if not pieces:
        raise ValueError(f"road {road.get('id', '')} without a geometry in its planView")
    begin = np.array([float(piece.attrib["s"]) for piece in pieces])
    which = np.clip(np.searchsorted(begin, s, side="right") - 1, 0, len(begin) - 1)
    found = np.empty((len(s), 3))
    for number, piece in enumerate(pieces):
        mine = which == number
        if not mine.any():
            continue
        u, v, turn = _local(piece, s[mine] - begin[number])
        x, y, heading = (float(piece.attrib[key]) for key in ("x", "y", "hdg"))
        c, sn = np.cos(heading), np.sin(heading)
        found[mine] = np.column_stack([x + c * u - sn * v, y + sn * u + c * v, heading + turn])
    return found


def _local(piece: ElementTree.Element, d: Array) -> tuple[Array, Array, Array]:
    """Return a geometry's own coordinates and turn at lengths (N,) from its beginning."""
    length = float(piece.attrib["length"])
    shape = next((e for e in piece if e.tag in _SHAPES), None)
    if shape is None:
        raise ValueError(f"a geometry without one of {', '.join(_SHAPES)}")
    said = {key: float(value) for key, value in shape.attrib.items() if key != "pRange"}
    if shape.tag == "line":
        return d, np.zeros_like(d), np.zeros_like(d)
    if shape.tag == "arc":
        k = said["curvature"]
        turn = k * d
        return d * np.sinc(turn / np.pi), d * _versine(turn), turn
    if shape.tag == "spiral":
        return _spiral(said["curvStart"], said["curvEnd"], length, d)
    if shape.tag == "poly3":
        a, b, c, e = (said[key] for key in "abcd")
        u = _u_of_length(b, c, e, d)
        return u, a + u * (b + u * (c + u * e)), np.arctan(b + u * (2 * c + 3 * u * e))
    p = d if shape.attrib.get("pRange") == "arcLength" else d / length
    (au, bu, cu, du), (av, bv, cv, dv) = ([said[k + q] for k in "abcd"] for q in "UV")
    turn = np.arctan2(bv + p * (2 * cv + 3 * p * dv), bu + p * (2 * cu + 3 * p * du))
    return au + p * (bu + p * (cu + p * du)), av + p * (bv + p * (cv + p * dv)), turn


_SHAPES: Final = ("line", "arc", "spiral", "poly3", "paramPoly3")


def _versine(turn: Array) -> Array:
    """Return (1 - cos turn) / turn without loss where the turn is small."""
    return np.asarray(np.sin(0.5 * turn) * np.sinc(0.5 * turn / np.pi))


def _spiral(first: float, last: float, length: float, d: Array) -> tuple[Array, Array, Array]:
    """Return a clothoid whose curvature goes evenly from first to last, by Fresnel integrals."""
    from scipy.special import fresnel

    rate = (last - first) / length
    turn = d * (first + 0.5 * rate * d)
    if abs(rate) < 1e-12:
        bend = first * d
        return d * np.sinc(bend / np.pi), d * _versine(bend), turn
    a = np.sqrt(abs(rate) / np.pi)
    begin = first / (abs(rate)) * np.sign(rate)
    s1, c1 = fresnel(a * (begin + d))
    s0, c0 = fresnel(a * begin)
    u, v = (c1 - c0) / a, np.sign(rate) * (s1 - s0) / a
    angle = -0.5 * rate * begin**2  # of the piece's beginning against the clothoid's middle
    c, sn = np.cos(angle), np.sin(angle)
    return c * u - sn * v, sn * u + c * v, turn


def _u_of_length(b: float, c: float, e: float, d: Array) -> Array:
    """Return where along u a poly3 is as long as (N,) lengths, m."""
    u = np.linspace(0.0, float(d.max()) + 1e-9, 2000)
    slope = np.hypot(1.0, b + u * (2 * c + 3 * u * e))
    s = np.concatenate([[0.0], np.cumsum(0.5 * (slope[1:] + slope[:-1]) * np.diff(u))])
    return np.asarray(np.interp(d, s, u))


def _add_road(
    road: ElementTree.Element, step_m: float, lines: list[RoadLine], lanes: dict[str, Lane]
) -> None:
    length = float(road.attrib["length"])
    offset = _Cubic.of(list(road.iterfind("lanes/laneOffset")))
    sections = list(road.iterfind("lanes/laneSection"))
    starts = [float(section.attrib["s"]) for section in sections]
    is_junction = road.get("junction", "-1") != "-1"
    is_left_hand = road.get("rule", "RHT") == "LHT"
    for number, (section, start) in enumerate(zip(sections, starts, strict=True)):
        end = starts[number + 1] if number + 1 < len(starts) else length
        if end - start < 1e-6:
            continue
        s = np.linspace(start, end, max(2, int(np.ceil((end - start) / step_m)) + 1))
        at = reference_line(road, np.minimum(s, length - 1e-9))
        normal = np.column_stack([-np.sin(at[:, 2]), np.cos(at[:, 2])])
        middle = offset.at(s)
        name = f"road {road.attrib['id']} section {number}"
        centre = at[:, :2] + middle[:, None] * normal
        for lane in section.iterfind("center/lane"):
            _add_marks(lane, name, s - start, centre, lines)
        for side, sign in (("left", 1.0), ("right", -1.0)):
            t, inner, last_road = middle.copy(), centre, None
            group = list(section.iterfind(f"{side}/lane"))
            for lane in sorted(group, key=lambda e: abs(int(e.attrib["id"]))):
                t = _outer(lane, t, s - start, middle, sign, name)
                outer = at[:, :2] + t[:, None] * normal
                has_curb = _add_marks(lane, name, s - start, outer, lines)
                if lane.get("type") in _ROADWAY:
                    last_road = None if has_curb else outer
                key = f"{road.attrib['id']}/{number}/{lane.attrib['id']}"
                goes_back = (sign > 0.0) != is_left_hand
                _add_lane(key, lane, inner, outer, lanes, is_left=sign > 0.0, goes_back=goes_back)
                inner = outer
            if last_road is not None and not is_junction:
                points = without_repeats(last_road)
                if len(points) > 1:
                    lines.append(RoadLine(f"{name} {side} edge", LineKind.BOUNDARY, points))


def _outer(
    lane: ElementTree.Element, t: Array, s: Array, middle: Array, sign: float, name: str
) -> Array:
    """Return how far to the left of the reference line a lane's outer edge is, (N,) m.

    By the lane's widths from its inner edge ``t`` on, else by its borders, which count from the
    reference line; lengths ``s`` are those from the section's beginning.
    """
    widths, borders = list(lane.iterfind("width")), list(lane.iterfind("border"))
    if widths or not borders:
        return np.asarray(t + sign * np.maximum(_Cubic.of(widths, "sOffset").at(s), 0.0))
    if np.any(middle != 0.0):
        raise ValueError(
            f"{name} lane {lane.get('id')}: a border beside a laneOffset; tools differ in from "
            "where it counts: give widths"
        )
    border = _Cubic.of(borders, "sOffset").at(s)
    if np.any(sign * border < -0.01):
        raise ValueError(f"{name} lane {lane.get('id')}: a border on the other side of the road")
    return np.asarray(t + sign * np.maximum(sign * (border - t), 0.0))


def _add_lane(
    key: str,
    lane: ElementTree.Element,
    inner: Array,
    outer: Array,
    lanes: dict[str, Lane],
    *,
    is_left: bool,
    goes_back: bool,
) -> None:
    if lane.get("type") not in _CARS:
        return
    left, right = (outer, inner) if is_left else (inner, outer)
    if goes_back:
        left, right = right[::-1], left[::-1]
    lanes[key] = Lane(key, left, right)


def _add_marks(
    lane: ElementTree.Element, name: str, s: Array, points: Array, lines: list[RoadLine]
) -> bool:
    """Add the marks along a lane's outer edge; return whether a kerb is among them."""
    marks = sorted(lane.iterfind("roadMark"), key=lambda e: float(e.get("sOffset", "0")))
    starts = [float(mark.get("sOffset", "0")) for mark in marks]
    has_curb = False
    for mark, first, last in zip(marks, starts, [*starts, np.inf][1:], strict=True):
        said = mark.get("type", "none")
        part = without_repeats(points[(s >= first - 1e-9) & (s <= last)])
        if said == "none" or len(part) < 2:
            continue
        kind = LineKind.LANE_LINE
        if said in {"curb", "grass", "edge"}:
            kind, has_curb = LineKind.BOUNDARY, True
        paint = Mark.UNKNOWN
        if said in {"solid", "solid solid"}:
            paint = Mark.SOLID
        elif said in {"broken", "broken broken"}:
            paint = Mark.DASHED
        lines.append(RoadLine(f"{name} lane {lane.attrib['id']}", kind, part, paint))
    return has_curb


def _joined(lanes: dict[str, Lane]) -> dict[str, Lane]:
    """Return lanes that follow each other where the end of one is the beginning of another."""
    cells: dict[tuple[int, int], list[str]] = {}
    for name, lane in lanes.items():
        start = 0.5 * (lane.left[0] + lane.right[0])
        cells.setdefault((round(start[0]), round(start[1])), []).append(name)
    joined = {}
    for name, lane in lanes.items():
        end = 0.5 * (lane.left[-1] + lane.right[-1])
        course = end - 0.5 * (lane.left[-2] + lane.right[-2])
        near = [
            other
            for i in (-1, 0, 1)
            for j in (-1, 0, 1)
            for other in cells.get((round(end[0]) + i, round(end[1]) + j), [])
        ]
        following = tuple(o for o in near if o != name and _follows(lanes[o], end, course))
        joined[name] = Lane(name, lane.left, lane.right, following, lane.is_road)
    return joined


def _follows(lane: Lane, end: Array, course: Array) -> bool:
    start = 0.5 * (lane.left[0] + lane.right[0])
    away = 0.5 * (lane.left[1] + lane.right[1]) - start
    cosine = float(course @ away) / max(float(np.hypot(*course) * np.hypot(*away)), 1e-12)
    return float(np.hypot(*(start - end))) < 0.5 and cosine > 0.8
