"""Maps of all formats, the projection and the index: against closed forms and other libraries."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from ssm_graph.base.errors import ConfigError, DataError
from ssm_graph.base.frozen import Array
from ssm_graph.base.projection import TransverseMercator
from ssm_graph.systems.road_map.maps.geojson import read_geojson
from ssm_graph.systems.road_map.maps.index import LineIndex
from ssm_graph.systems.road_map.maps.opendrive import read_opendrive
from ssm_graph.systems.road_map.maps.read import read_map
from ssm_graph.systems.road_map.maps.road_map import (
    LineKind,
    Mark,
    RoadLine,
    RoadMap,
    line_length,
    with_sides,
)

DATA = Path(os.environ.get("SSM_GRAPH_DATA", "../shared/data")) / "systems"


def utm(lon: float) -> TransverseMercator:
    """Return the UTM zone of a place north of the equator, rad."""
    zone = np.floor((np.degrees(lon) + 180.0) / 6.0)
    return TransverseMercator(0.0, float(np.radians(6.0 * zone - 177.0)), 0.9996, 500e3)


def data(name: str) -> Path:
    """Return a file of real data, or skip."""
    path = DATA / name
    if not path.exists():
        pytest.skip(f"{path}: no real data there; set SSM_GRAPH_DATA")
    return path


def test_projection_there_and_back() -> None:
    """A point a few degrees off the meridian comes back to less than a micrometre."""
    plane = TransverseMercator(0.8, 0.1)
    lat, lon = np.array([0.7, 0.8, 0.9]), np.array([0.08, 0.1, 0.13])
    back = plane.inverse(plane.forward(lat, lon))
    np.testing.assert_allclose(back, [lat, lon], atol=1e-13)


def test_projection_is_utm() -> None:
    """The example of the Wikipedia page on UTM: CN Tower, zone 17."""
    lat, lon = np.radians(43.0 + 38.0 / 60 + 33.24 / 3600), -np.radians(79 + 23 / 60 + 13.7 / 3600)
    np.testing.assert_allclose(utm(lon).forward(lat, lon), [630084.0, 4833438.0], atol=1.0)


def lines_of(rng: np.random.Generator) -> list[RoadLine]:
    """Return twenty crooked lines within 100 m."""
    return [
        RoadLine(
            str(k), LineKind.BOUNDARY, rng.uniform(0, 100, 2) + rng.normal(0, 4, (6, 2)).cumsum(0)
        )
        for k in range(20)
    ]


def distance_from(lines: list[RoadLine], points: Array) -> Array:
    """Return the distance (n,) of points (n, 2) from the nearest piece of all, m."""
    best = np.full(len(points), np.inf)
    for line in lines:
        for a, b in zip(line.points[:-1], line.points[1:], strict=True):
            share = np.clip((points - a) @ (b - a) / ((b - a) @ (b - a)), 0, 1)
            foot = a + share[:, None] * (b - a)
            best = np.minimum(best, np.hypot(*(points - foot).T))
    return best


@pytest.mark.parametrize("piece_m", [0.2, 1.0, 5.0])
def test_a_foot_on_a_bend_is_the_nearest_place(piece_m: float) -> None:
    """However short the pieces are: the one next to that of the cell may be nearer."""
    rng = np.random.default_rng(2)
    turn = np.arange(0.0, 60.0, piece_m) / 100.0
    line = RoadLine(
        "arc", LineKind.LANE_LINE, 100.0 * np.column_stack([np.cos(turn), np.sin(turn)])
    )
    at, off = rng.uniform(0.05, 0.5, 500), rng.uniform(98.0, 102.0, 500)
    points = off[:, None] * np.column_stack([np.cos(at), np.sin(at)])
    found = LineIndex([line]).foot(points).distance
    np.testing.assert_allclose(found, distance_from([line], points), atol=1e-9)


def test_index_is_the_nearest_line() -> None:
    """Against all pieces of all lines; only where two are as far may the other one be meant."""
    rng = np.random.default_rng(0)
    lines = lines_of(rng)
    points = rng.uniform(-5, 105, (2000, 2))
    best = distance_from(lines, points)
    index = LineIndex(lines)
    found = index.foot(points).distance
    near = best < 12.0
    excess = found[near] - best[near]
    assert excess.min() > -1e-9
    assert excess.max() < 0.75
    assert np.quantile(excess, 0.9) < 1e-9
    assert np.all(np.isinf(found[best > 16.0]))


def test_index_far_off_the_map() -> None:
    """A point a kilometre away is near no line, and costs no memory."""
    index = LineIndex(lines_of(np.random.default_rng(1)))
    assert np.isinf(index.foot(np.array([[1e4, -1e4]])).distance).all()


def test_swapped_sides_are_put_right_and_told() -> None:
    """A lane to the east has its left bound north; bounds against each other are turned."""
    north = np.array([[0.0, 3.0], [10.0, 3.0]])
    south = np.array([[0.0, 0.0], [10.0, 0.0]])
    notes: list[str] = []
    lane = with_sides("a", south, north, notes)
    assert lane is not None
    np.testing.assert_array_equal(lane.left, north)
    turned = with_sides("b", north, south[::-1], notes)
    assert turned is not None
    np.testing.assert_array_equal(turned.right, south)
    assert [note.split(":")[0] for note in notes] == ["lane a", "lane b"]


def test_a_map_says_how_far_off_a_fix_is() -> None:
    """Beyond the map the message has the distance; very far it names exchanged coordinates."""
    road_map = RoadMap(
        "m", (RoadLine("k", LineKind.BOUNDARY, np.array([[0.0, 0.0], [100.0, 0.0]])),), {}
    )
    with pytest.raises(DataError, match="400 m off the map: take the map of that place"):
        road_map.within(np.array([500.0, 0.0]), 50.0)
    with pytest.raises(DataError, match="latitude and longitude exchanged"):
        road_map.within(np.array([5e5, 0.0]), 50.0)
    with pytest.raises(DataError, match="expected road boundaries or lane lines, got none"):
        RoadMap("empty", (), {})


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("m.xodr", '<OpenDRIVE><road id="7" length="9"><lanes><laneSection s="0"/></lanes></road>'
         "</OpenDRIVE>", "road 7 without a geometry"),
        ("m.xodr", "<OpenDRIVE><road", "expected OpenDRIVE, got ParseError"),
        ("m.osm", '<osm><node id="1"/></osm>', "expected nodes with lat and lon"),
        ("m.osm", '<osm><node id="1" lat="120" lon="49"/></osm>', "longitude exchanged"),
        ("m.osm", "<osm/>", "expected an OSM file with nodes"),
        ("m.xml", "<commonRoad/>", "expected lanelets"),
        ("m.json", "[1, 2]", "expected a map of Argoverse 2"),
        ("m.geojson", "{}", "expected a collection of GeoJSON lines"),
    ],
)  # fmt: skip
def test_what_no_map_is(name: str, text: str, message: str, tmp_path: Path) -> None:
    """Each is refused with the file and what was expected of it."""
    (tmp_path / name).write_text(text)
    with pytest.raises(DataError, match=rf"{name}.*{message}"):
        read_map(tmp_path / name)


def test_unknown_format_is_refused() -> None:
    """By the end of the name."""
    with pytest.raises(ConfigError, match=r"\.osm, \.xml"):
        read_map(Path("road.shp"))


def test_geojson(tmp_path: Path) -> None:
    """Degrees become metres; exchanged coordinates are seen."""
    line = {"type": "LineString", "coordinates": [[8.4, 49.0], [8.4, 49.001]]}
    feature = {"properties": {"kind": "lane line", "mark": "dashed"}, "geometry": line}
    path = tmp_path / "map.geojson"
    path.write_text(json.dumps({"features": [feature]}))
    found = read_geojson(path).lines[0]
    assert (found.kind, found.mark) == (LineKind.LANE_LINE, Mark.DASHED)
    assert line_length(found.points) == pytest.approx(111.2, abs=0.1)  # a thousandth of a degree
    line["coordinates"] = [[8.4, 149.0], [8.4, 149.001]]
    path.write_text(json.dumps({"features": [feature]}))
    with pytest.raises(DataError, match="exchanged, or metres"):
        read_geojson(path)


ROAD = """<OpenDRIVE><road id="1" length="{length}" junction="-1" rule="{rule}"><planView>
<geometry s="0" x="1" y="2" hdg="0.3" length="{length}">{shape}</geometry></planView>
<lanes><laneOffset s="0" a="0.5" b="0" c="0" d="0"/><laneSection s="0">
<center><lane id="0" type="none"><roadMark sOffset="0" type="broken"/></lane></center>
<right><lane id="-1" type="driving"><width sOffset="0" a="3.5" b="0" c="0" d="0"/>
<roadMark sOffset="0" type="solid"/></lane></right></laneSection></lanes></road></OpenDRIVE>"""


def centre_of(tmp_path: Path, shape: str, length: float = 40.0, rule: str = "RHT") -> RoadMap:
    """Return the map of one road."""
    path = tmp_path / "road.xodr"
    path.write_text(ROAD.format(length=length, shape=shape, rule=rule))
    return read_opendrive(path)


SHAPES: dict[str, tuple[str, Callable[[Array], Array]]] = {
    "line": ("<line/>", lambda s: 0.0 * s),
    "arc": ('<arc curvature="0.02"/>', lambda s: 0.02 * s),
    "right": ('<arc curvature="-0.02"/>', lambda s: -0.02 * s),
    "spiral": ('<spiral curvStart="0.0" curvEnd="0.05"/>', lambda s: 0.5 * 0.05 / 40 * s**2),
    "back": (
        '<spiral curvStart="-0.04" curvEnd="0.01"/>',
        lambda s: -0.04 * s + 0.5 * 0.05 / 40 * s**2,
    ),
}


@pytest.mark.parametrize("name", SHAPES)
def test_opendrive_lines_have_their_curvature(tmp_path: Path, name: str) -> None:
    """The middle line, half a metre beside the reference, against the integrated heading."""
    shape, turn = SHAPES[name]
    found = centre_of(tmp_path, shape).lines[0].points
    s = np.linspace(0.0, 40.0, 40001)
    heading = 0.3 + turn(s)
    step = s[1]
    x = 1 + np.concatenate([[0], np.cumsum(np.cos(heading[:-1] + 0.5 * np.diff(heading))) * step])
    y = 2 + np.concatenate([[0], np.cumsum(np.sin(heading[:-1] + 0.5 * np.diff(heading))) * step])
    wanted = np.column_stack([x - 0.5 * np.sin(heading), y + 0.5 * np.cos(heading)])
    np.testing.assert_allclose(found, wanted[::1000], atol=1e-4)


def test_opendrive_cubics(tmp_path: Path) -> None:
    """A paramPoly3 and a poly3 of the same parabola, the latter by its length."""
    parametric = (
        '<paramPoly3 pRange="normalized" aU="0" bU="40" cU="0" dU="0" aV="0" bV="0" cV="8" dV="0"/>'
    )
    same = '<poly3 a="0" b="0" c="0.005" d="0"/>'
    one, other = (centre_of(tmp_path, shape).lines[0].points for shape in (parametric, same))
    c, s = np.cos(0.3), np.sin(0.3)
    at = np.linspace(0.0, 40.0, 41)
    turn = np.arctan(0.01 * at)
    local = np.column_stack([at - 0.5 * np.sin(turn), 0.005 * at**2 + 0.5 * np.cos(turn)])
    np.testing.assert_allclose(one, [1.0, 2.0] + local @ [[c, s], [-s, c]], atol=1e-9)
    u = np.linspace(0, 40, 20001)
    end = np.interp(40.0, np.cumsum(np.hypot(np.diff(u), np.diff(0.005 * u**2))), u[1:])
    turn = np.arctan(0.01 * end)
    last = np.array([end - 0.5 * np.sin(turn), 0.005 * end**2 + 0.5 * np.cos(turn)])
    wanted = [1.0 + c * last[0] - s * last[1], 2.0 + s * last[0] + c * last[1]]
    np.testing.assert_allclose(other[-1], wanted, atol=1e-3)


def test_opendrive_lanes_run_as_traffic_does(tmp_path: Path) -> None:
    """The right lane goes with the reference line; where traffic keeps left it goes against it."""
    for rule, sign in (("RHT", 1.0), ("LHT", -1.0)):
        road_map = centre_of(tmp_path, "<line/>", rule=rule)
        (lane,) = road_map.lanes.values()
        course = lane.centre()[-1] - lane.centre()[0]
        assert sign * (course @ [np.cos(0.3), np.sin(0.3)]) > 39.0
        marks = {(line.kind, line.mark) for line in road_map.lines}
        assert (LineKind.LANE_LINE, Mark.DASHED) in marks
        assert (LineKind.BOUNDARY, Mark.UNKNOWN) in marks


def test_opendrive_borders_are_widths(tmp_path: Path) -> None:
    """A border is where the lane ends, from the reference line; not where that is shifted."""
    path = tmp_path / "road.xodr"
    text = ROAD.format(length=40.0, shape="<line/>", rule="RHT")
    text = text.replace('a="0.5"', 'a="0"')
    path.write_text(text)
    by_width = read_opendrive(path)
    borders = (
        '<border sOffset="0" a="-3.5" b="0" c="0" d="0"/>'
        '<border sOffset="20" a="-3.5" b="-0.1" c="0" d="0"/>'
    )
    width = '<width sOffset="0" a="3.5" b="0" c="0" d="0"/>'
    path.write_text(text.replace(width, borders))
    by_border = read_opendrive(path)
    (one,), (other,) = (tuple(m.lanes.values()) for m in (by_width, by_border))
    np.testing.assert_allclose(other.left, one.left, atol=1e-12)
    wider = np.linalg.norm(other.right - one.right, axis=1)
    np.testing.assert_allclose(wider, 0.1 * np.maximum(np.arange(41.0) - 20.0, 0.0), atol=1e-9)
    path.write_text(text.replace(width, width + borders))
    np.testing.assert_array_equal(read_opendrive(path).lines[1].points, by_width.lines[1].points)
    for wrong, message in (
        (text.replace('"0" a="0"', '"0" a="0.5"').replace(width, borders), "beside a laneOffset"),
        (text.replace(width, borders.replace("-3.5", "3.5")), "on the other side"),
    ):
        path.write_text(wrong)
        with pytest.raises(DataError, match=message):
            read_opendrive(path)


@pytest.mark.parametrize(
    ("said", "offset", "wanted"),
    [
        ("+proj=utm +zone=32 +datum=WGS84 +units=m", (0, 0), (691596.710, 5334746.441)),
        ("EPSG:25832", (691000, 5334000), (596.710, 746.441)),
        (
            "+proj=tmerc +lat_0=48 +lon_0=9 +k=0.9996 +x_0=500000 +ellps=GRS80",
            (0, 0),
            (691596.710, 18446.216),
        ),
        ("+proj=utm +zone=32 +south +ellps=WGS84", (0, 0), (691596.710, 15334746.441)),
    ],
)
def test_opendrive_knows_its_place(
    tmp_path: Path, said: str, offset: tuple[int, int], wanted: tuple[float, float]
) -> None:
    """A place in Munich, against numbers by PROJ."""
    road_map = with_header(tmp_path, said, '<offset x="{}" y="{}"/>'.format(*offset))
    assert road_map.projection is not None
    assert road_map.notes == ()
    at = np.radians([48.1371, 11.5754])
    x_y = road_map.projection.forward(*at)
    np.testing.assert_allclose(x_y, wanted, atol=1e-3)
    np.testing.assert_allclose(road_map.projection.inverse(x_y), at, atol=1e-12)


@pytest.mark.parametrize(
    ("said", "offset", "message"),
    [
        ("+proj=merc +datum=WGS84", "", "projection 'merc'"),
        ("+proj=tmerc +ellps=bessel", "", "Earth of bessel"),
        ("+proj=utm +zone=99 +datum=WGS84", "", "zone of 99"),
        ("+proj=utm +zone=32 +datum=WGS84 +units=us-ft", "", "other than metres"),
        ("+proj=utm +zone=32 +datum=WGS84", '<offset x="0" y="0" hdg="0.1"/>', "hdg"),
    ],
)
def test_opendrive_says_what_it_does_not_know(
    tmp_path: Path, said: str, offset: str, message: str
) -> None:
    """The map is read; where it lies is not, and a note says why."""
    road_map = with_header(tmp_path, said, offset)
    assert road_map.projection is None
    assert message in road_map.notes[0]


def with_header(tmp_path: Path, said: str, offset: str) -> RoadMap:
    """Return the map of one road that says where it lies."""
    path = tmp_path / "road.xodr"
    text = ROAD.format(length=40.0, shape="<line/>", rule="RHT")
    header = f"<header><geoReference><![CDATA[{said}]]></geoReference>{offset}</header>"
    path.write_text(text.replace("<OpenDRIVE>", "<OpenDRIVE>" + header))
    return read_opendrive(path)


def test_lanelet2_agrees_with_the_library() -> None:
    """Bounds of all lanelets within a centimetre of those of the reference implementation."""
    lanelet2 = pytest.importorskip("lanelet2")
    path = data("lanelet2/mapping_example.osm")
    ours = read_map(path)
    assert ours.projection is not None
    lat, lon = np.degrees([ours.projection.lat0, ours.projection.lon0])
    origin = lanelet2.io.Origin(float(lat), float(lon))
    projector = lanelet2.projection.UtmProjector(origin)
    theirs = lanelet2.io.load(str(path), projector)
    zone = utm(ours.projection.lon0)
    shift = zone.forward(ours.projection.lat0, ours.projection.lon0)
    assert len(theirs.laneletLayer) == len(ours.lanes) == 371
    for lanelet in theirs.laneletLayer:
        lane = ours.lanes[str(lanelet.id)]
        for bound, points in ((lanelet.leftBound, lane.left), (lanelet.rightBound, lane.right)):
            x_y = zone.forward(*ours.projection.inverse(points)) - shift
            np.testing.assert_allclose([(p.x, p.y) for p in bound], x_y, atol=1e-3)


def test_commonroad_agrees_with_the_library() -> None:
    """Bounds and successors of all lanelets of a motorway and a town."""
    reader = pytest.importorskip("commonroad.common.file_reader")
    for name in ("DEU_A9-3_1_T-1", "FRA_Anglet-1_1_T-1"):
        path = data(f"commonroad/{name}.xml")
        scenario, _ = reader.CommonRoadFileReader(str(path)).open()
        ours = read_map(path)
        lanelets = scenario.lanelet_network.lanelets
        assert len(lanelets) == len(ours.lanes)
        for lanelet in lanelets:
            lane = ours.lanes[str(lanelet.lanelet_id)]
            np.testing.assert_allclose(lanelet.left_vertices, lane.left, atol=1e-2)
            np.testing.assert_allclose(lanelet.right_vertices, lane.right, atol=1e-2)
            assert {str(s) for s in lanelet.successor} == set(lane.successors)


def test_real_maps_are_read() -> None:
    """Karlsruhe and an Argoverse 2 log: as many lanes and lines as the files hold."""
    karlsruhe = read_map(data("lanelet2/mapping_example.osm"))
    assert len(karlsruhe.of_kind(LineKind.LANE_LINE)) == 187
    assert len(karlsruhe.of_kind(LineKind.BOUNDARY)) == 614
    av2 = read_map(data("av2/3b3570b4-7b0b-3268-a571-b0889dbf40b6/map.json"))
    assert len(av2.lanes) == 150
    assert all(line_length(line.points) > 0.0 for line in av2.lines)
