"""From a drive to a lane: verdicts on made-up roads, folders, bad input, the patent's method."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from ssm_graph.base.errors import ConfigError, DataError
from ssm_graph.base.frozen import Array
from ssm_graph.cli.main import main
from ssm_graph.filters.rules.hypotheses import Hypothesis
from ssm_graph.systems.road_map.drive import Chassis, Curves, Drive, GnssFixes, dead_reckoned
from ssm_graph.systems.road_map.folder import read_drive, write_drive
from ssm_graph.systems.road_map.follow import follow
from ssm_graph.systems.road_map.hypotheses import apart, is_same_lane, known_along
from ssm_graph.systems.road_map.locate import Located, locate
from ssm_graph.systems.road_map.maps.road_map import Lane, LineKind, Mark, RoadLine, RoadMap
from ssm_graph.systems.road_map.motion import first_course, motion_errors
from ssm_graph.systems.road_map.patent import Normalisation, PatentSettings, locate_by_patent
from ssm_graph.systems.road_map.refinement import Prior, sigmas_of
from ssm_graph.systems.road_map.simulate import (
    DriveModel,
    damaged,
    driven,
    indices_of,
    simulate_drive,
)
from ssm_graph.systems.road_map.verdict import Verdict


def beside(centre: Array, offset: float) -> Array:
    """Return a line beside another one, to its left, m."""
    d = np.gradient(centre, axis=0)
    normal = np.column_stack([-d[:, 1], d[:, 0]]) / np.hypot(*d.T)[:, None]
    return np.asarray(centre + offset * normal)


def road(centre: Array, *, shift: float = 0.0, name: str = "") -> list[RoadLine]:
    """Return a road of three lanes: kerbs, a solid and a dashed line."""
    at = beside(centre, shift)
    return [
        RoadLine(f"{name}l", LineKind.BOUNDARY, beside(at, 5.5)),
        RoadLine(f"{name}r", LineKind.BOUNDARY, beside(at, -6.0)),
        RoadLine(f"{name}a", LineKind.LANE_LINE, beside(at, 1.75), Mark.SOLID),
        RoadLine(f"{name}b", LineKind.LANE_LINE, beside(at, -1.75), Mark.DASHED),
    ]


def winding() -> Array:
    """Return the middle of a road with bends, 300 m."""
    s = np.arange(0.0, 300.0, 1.0)
    yaw = 0.9 * np.sin(s / 30.0)
    return np.column_stack([np.cumsum(np.cos(yaw)), np.cumsum(np.sin(yaw))])


def straight(length: float = 500.0) -> Array:
    """Return the middle of a straight road."""
    return np.column_stack([np.arange(0.0, length), np.zeros(int(length))])


def drive_on(
    centre: Array, lines: list[RoadLine], *, seed: int = 0, aside: float = -3.6
) -> tuple[Drive, RoadMap]:
    """Return a drive along the right lane of a road."""
    rng = np.random.default_rng(seed)
    model = DriveModel(length_m=70.0)
    truth = driven(beside(centre, aside)[len(centre) // 4 :], model, rng)
    road_map = RoadMap("made up", tuple(lines), {})
    return simulate_drive("made up", truth, road_map, model, rng), road_map


@cache
def on_the_bend() -> tuple[Drive, RoadMap, Located]:
    """Return a drive on the winding road, with its answer."""
    drive, road_map = drive_on(winding(), road(winding()))
    return drive, road_map, locate(drive, road_map)


def error(drive: Drive, found: Located) -> tuple[float, float, float]:
    """Return across, along and turn of an answer."""
    assert drive.truth is not None
    return apart(drive.truth.at(found.track.time_s[-1:])[0], found.pose)


def test_bends_tell_the_lane_and_the_place() -> None:
    """Converged within five sigma, centimetres across."""
    drive, _, found = on_the_bend()
    across, along, turn = error(drive, found)
    assert found.verdict is Verdict.CONVERGED
    assert abs(across) < min(0.15, 5.0 * found.sigmas[0])
    assert abs(along) < min(2.0, 5.0 * found.sigmas[1])
    assert abs(turn) < 0.01
    assert found.first_fix_s < 10.0
    assert found.track.n_particles[-1] < found.track.n_particles[0]


def arc() -> Array:
    """Return the middle of a road of 200 m radius, 500 m."""
    turn = np.arange(0.0, 500.0) / 200.0
    return 200.0 * np.column_stack([np.sin(turn), 1.0 - np.cos(turn)])


@pytest.mark.parametrize("shape", [straight, arc])
def test_a_road_that_looks_alike_is_unresolved_along(shape: Callable[[], Array]) -> None:
    """The lane is right, and the sigma along is not below what is not known."""
    drive, road_map = drive_on(shape(), road(shape()))
    found = locate(drive, road_map)
    across, along, _ = error(drive, found)
    assert found.verdict is Verdict.UNRESOLVED_ALONG
    assert abs(across) < 0.2
    assert abs(along) < 3.0 * found.sigmas[1]


def test_places_along_a_bend_are_one_lane() -> None:
    """Chords of an arc lead across; a place in the next lane is another one all the same."""
    here = Hypothesis((0.0, 0.0, 0.0), 0.0)
    turn = 0.25
    ahead, left = np.sin(turn), 1.0 - np.cos(turn)
    assert is_same_lane(here, np.array([150.0 * ahead, 150.0 * left, turn]))
    inside = np.array([146.5 * ahead, 3.5 + 146.5 * left, turn])
    assert not is_same_lane(here, inside)
    rivals = [here, Hypothesis((20.0, 0.0, 0.0), 0.0), Hypothesis((0.0, 3.5, 0.0), -8.0)]
    known = known_along(rivals, np.array([19.0, 0.0, 0.0]), 4.0)
    assert known[0].pose == (20.0, 0.0, 0.0)
    assert known[0].share > 0.95
    assert sum(h.share for h in known) == pytest.approx(1.0)


def test_a_kerb_that_the_map_lacks_is_no_failure() -> None:
    """Half of the curves lie on no line, the others on theirs."""
    drive, road_map, _ = on_the_bend()
    found = locate(drive, replace(road_map, lines=road_map.lines[1:]))
    assert found.verdict.has_lane
    assert abs(error(drive, found)[0]) < 0.2


def test_the_way_tells_a_course_that_the_receiver_does_not() -> None:
    """Within three of its sigmas, from the fix on by which it is known."""
    drive, _, _ = on_the_bend()
    assert drive.truth is not None
    begin = first_course(replace(drive, gnss=replace(drive.gnss, yaw=None)))
    assert begin.fix > 0
    assert begin.yaw is not None
    truth = drive.truth.at(drive.gnss.time_s[[begin.fix]])[0]
    assert abs(np.angle(np.exp(1j * (begin.yaw - truth[2])))) < 3.0 * begin.sigma
    standing = replace(drive.chassis, speed=np.zeros_like(drive.chassis.speed))
    still = replace(drive, chassis=standing, gnss=replace(drive.gnss, yaw=None))
    assert first_course(still).yaw is None


def test_a_fix_far_from_every_road_is_named() -> None:
    """With how far, and what to try."""
    drive, road_map, _ = on_the_bend()
    far = replace(drive, gnss=replace(drive.gnss, x_y=drive.gnss.x_y + np.array([0.0, 95.0])))
    with pytest.raises(DataError, match=r"is \d+ m from every boundary and lane line"):
        locate(far, road_map)


@pytest.mark.slow
def test_two_roads_alike_are_ambiguous() -> None:
    """A twin 16 m beside: the rival is named, with about half of the evidence."""
    twins = [*road(straight()), *road(straight(), shift=16.0, name="twin ")]
    model = DriveModel(length_m=70.0, gnss_bias_m=0.1)
    truth = driven(beside(straight(), -3.6)[100:], model, np.random.default_rng(0))
    road_map = RoadMap("twins", tuple(twins), {})
    drive = simulate_drive("twins", truth, road_map, model, np.random.default_rng(1))
    found = locate(replace(drive, gnss_bias_m=20.0), road_map)
    assert found.verdict is Verdict.AMBIGUOUS
    offs = [abs(error_of(h.pose, drive)) for h in found.hypotheses if h.share > 0.05]
    assert min(offs) < 0.5
    assert max(offs) == pytest.approx(16.0, abs=0.5)
    assert "rival" in found.reason


def error_of(pose: tuple[float, ...], drive: Drive) -> float:
    """Return how far across a pose is."""
    assert drive.truth is not None
    return apart(drive.truth.at(drive.curves.time_s[-1:])[0], np.array(pose))[0]


def test_the_wrong_map_fails() -> None:
    """Curves of a winding road on a map of a straight one across it."""
    drive, _, _ = on_the_bend()
    assert drive.truth is not None
    middle = drive.truth.x_y[len(drive.truth.x_y) // 2]
    across = np.column_stack([np.full(400, middle[0]), middle[1] + np.arange(-200.0, 200.0)])
    found = locate(drive, RoadMap("other", tuple(road(across)), {}))
    assert not found.verdict.has_lane


@pytest.mark.slow
def test_map_errors_are_survived() -> None:
    """Some boundaries missing or shifted by half a metre: still the right lane."""
    drive, road_map, _ = on_the_bend()
    rng = np.random.default_rng(0)
    worn = damaged(road_map, rng, missing=0.0, shifted=1.0, by_m=0.5)
    assert any(
        np.any(a.points != b.points) for a, b in zip(worn.lines, road_map.lines, strict=True)
    )
    found = locate(drive, worn)
    assert abs(error(drive, found)[0]) < 0.6


def test_without_a_course_the_way_tells_it() -> None:
    """A receiver that gives no course: found all the same, not backwards."""
    drive, road_map, _ = on_the_bend()
    g = drive.gnss
    found = locate(replace(drive, gnss=GnssFixes(g.time_s, g.x_y, g.sigma_m)), road_map)
    across, _, turn = error(drive, found)
    assert abs(across) < 0.3
    assert abs(turn) < 0.05


def test_same_seed_same_answer() -> None:
    """Nothing is drawn that is not of the seed."""
    drive, road_map, found = on_the_bend()
    again = locate(drive, road_map)
    np.testing.assert_array_equal(found.pose, again.pose)
    np.testing.assert_array_equal(found.track.cov, again.track.cov)


@pytest.mark.parametrize("how", list(Normalisation))
def test_the_patents_method(how: Normalisation) -> None:
    """Its particles come nearer than they began, and its grid is 15 by 15."""
    drive, road_map, _ = on_the_bend()
    settings = PatentSettings(normalisation=how)
    answer = locate_by_patent(drive, indices_of(road_map), settings)
    assert drive.truth is not None
    last = drive.truth.at(drive.curves.time_s[-1:])[0]
    off = np.hypot(*(answer.pose[:2] - last[:2]))
    first = np.hypot(*(drive.gnss.x_y[0] - drive.truth.x_y[0]))
    assert off < (first if how is not Normalisation.SUM else 2.0 * first)


def test_folder_there_and_back(tmp_path: Path) -> None:
    """What is written is read again, and the command's exit code is the verdict's."""
    drive, road_map, _ = on_the_bend()
    features = [
        {
            "properties": {
                "kind": "boundary" if line.kind is LineKind.BOUNDARY else "lane line",
                "mark": line.mark.name.lower(),
            },
            "geometry": {"type": "LineString", "coordinates": line.points.tolist()},
        }
        for line in road_map.lines
    ]
    map_file = tmp_path / "map.geojson"
    map_file.write_text(json.dumps({"plane": True, "features": features}))
    write_drive(tmp_path / "drive", drive, map_file)
    back, back_map = read_drive(tmp_path / "drive")
    np.testing.assert_array_equal(back.curves.cubic, drive.curves.cubic)
    np.testing.assert_allclose(back.chassis.yaw_rate, drive.chassis.yaw_rate, atol=1e-15)
    assert back.gnss.yaw is not None
    assert drive.gnss.yaw is not None
    off = back.gnss.yaw - drive.gnss.yaw
    np.testing.assert_allclose(np.exp(1j * off), 1.0, atol=1e-9)
    assert len(back_map.lines) == 4
    out = tmp_path / "out"
    assert main(["locate", str(tmp_path / "drive"), "--out", str(out)]) == 0
    result = json.loads((out / "result.json").read_text())
    assert result["verdict"] == "CONVERGED"
    assert (out / "locate.png").stat().st_size > 10_000
    toml = tmp_path / "drive" / "drive.toml"
    toml.write_text(toml.read_text().replace("[gnss]", "[gnss]\ndelay = 1.0"))
    assert main(["locate", str(tmp_path / "drive")]) == 2
    with pytest.raises(ConfigError, match="delay_s"):
        read_drive(tmp_path / "drive")


def curves_with(**changes: Array) -> Curves:
    """Return one curve with something wrong."""
    usual = {
        "time_s": np.zeros(1),
        "kind": np.zeros(1),
        "side": np.ones(1),
        "cubic": np.zeros((1, 4)),
        "reach": np.array([[0.0, 30.0]]),
        "sigma_m": np.ones(1),
        "mark": np.zeros(1),
    }
    return Curves(**{**usual, **changes})


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"cubic": np.full((1, 4), np.nan)}, "coefficients are not finite"),
        ({"reach": np.array([[5.0, 5.0]])}, "range of x has no length"),
        ({"side": np.zeros(1)}, "neither 1"),
        ({"sigma_m": np.zeros(1)}, "sigma is not above zero"),
    ],
)
def test_bad_curves_are_named(changes: dict[str, Array], message: str) -> None:
    """Row, time and what is wrong."""
    drive, _, _ = on_the_bend()
    with pytest.raises(DataError, match=f"row 1 at 0.000 s.*{message}"):
        replace(drive, curves=curves_with(**changes))


def test_bad_times_are_named() -> None:
    """Repeated stamps, gaps of the chassis, another clock for the curves."""
    drive, road_map, _ = on_the_bend()
    c = drive.chassis
    twice = Chassis(np.concatenate([c.time_s[:5], c.time_s[4:-1]]), c.speed, c.yaw_rate)
    with pytest.raises(DataError, match=r"chassis: expected times that increase.*row 6"):
        replace(drive, chassis=twice)
    gap = Chassis(np.where(c.time_s > 3.0, c.time_s + 2.0, c.time_s), c.speed, c.yaw_rate)
    with pytest.raises(DataError, match=r"gap of 2\.10 s after 3\.000 s"):
        replace(drive, chassis=gap)
    k = drive.curves
    late = Curves(k.time_s + 1e4, k.kind, k.side, k.cubic, k.reach, k.sigma_m, k.mark)
    with pytest.raises(DataError, match="curves: none within the times"):
        locate(replace(drive, curves=late), road_map)
    some = replace(k, time_s=k.time_s + 3.0)
    with pytest.raises(DataError, match="% of them are not within the times"):
        locate(replace(drive, curves=some), road_map)
    fixes = replace(drive.gnss, time_s=drive.gnss.time_s + 1e3)
    with pytest.raises(DataError, match="gnss: no fix within the times"):
        locate(replace(drive, gnss=fixes), road_map)


@pytest.mark.parametrize(
    ("log", "change", "message"),
    [
        ("chassis", {"speed": 3.6}, "its way spreads over"),
        ("chassis", {"yaw_rate": -1.0}, "times -1 it would be .* is it clockwise"),
        ("chassis", {"yaw_rate": np.pi / 180.0}, "is it in rad/s"),
        ("chassis", {"yaw_rate": 180.0 / np.pi}, "turned from rad/s into deg/s twice"),
        ("curves", {"side": -1.0}, "lie on the other side than they say"),
        ("gnss", {"yaw": -1.0}, "the heading is [-+][0-9]+ deg off"),
    ],
)
def test_other_units_and_sides_are_named(log: str, change: dict[str, float], message: str) -> None:
    """km/h, curves whose sides are exchanged, courses that count from east."""
    drive, road_map, _ = on_the_bend()
    (name, factor), own = next(iter(change.items())), getattr(drive, log)
    values = getattr(own, name) * factor + (2.0 if name == "yaw" else 0.0)
    with pytest.raises(DataError, match=message):
        locate(replace(drive, **{log: replace(own, **{name: values})}), road_map)


def test_motion_errors_are_found() -> None:
    """Scale, bias and delay of a made-up minute, within four sigma, and worth the name."""
    t = np.arange(0.0, 60.0, 0.05)
    speed, rate = 12.0 + 3.0 * np.sin(t / 7.0), 0.2 * np.sin(t / 11.0)
    true = Chassis(t, speed, rate)
    told = Chassis(t, speed / 1.02, rate + 0.003)
    stamp = np.arange(2.0, 58.0, 0.5)
    when = np.concatenate([[0.0], stamp - 0.15])
    x_y = dead_reckoned(np.array([5.0, -3.0, 2.0]), when, true)[1:, :2]
    x_y = x_y + np.random.default_rng(0).normal(0.0, 0.5, x_y.shape)
    found = motion_errors(told, GnssFixes(stamp, x_y, np.full(len(stamp), 0.5)))
    got = np.array([found.scale, found.bias, found.delay_s])
    off = np.abs(got - [0.02, 0.003, 0.15]) / found.sigma[3:]
    assert off.max() < 4.0
    assert found.sigma[5] < 0.02


def test_a_lane_has_its_middle() -> None:
    """Between bounds of unequal length."""
    left, right = np.array([[0.0, 2.0], [10.0, 2.0]]), np.array([[0, 0], [5, 0], [10, 0]], float)
    lane = Lane("a", left, right)
    np.testing.assert_allclose(lane.centre(5.0), [[0.0, 1.0], [5.0, 1.0], [10.0, 1.0]])


def test_the_localiser_goes_on_from_a_known_lane() -> None:
    """Along a winding road its errors stay within what it says, and centimetres across."""
    drive, road_map, _ = on_the_bend()
    assert drive.truth is not None
    first_s = float(drive.curves.time_s[0])
    start = drive.truth.at(np.array([first_s]))[0] + [0.3, -0.2, 0.01]
    sigma = np.array([0.5, 0.5, 0.02, 0.01, 1e-3])
    prior = Prior(np.array([*start, 0.0, 0.0]), np.diag(1.0 / sigma**2))
    found = follow(drive, prior, first_s, indices_of(road_map))
    true = drive.truth.at(found.time_s)
    off = np.array([apart(t, p) for t, p in zip(true, found.pose, strict=True)])
    assert np.abs(off[:, 0]).max() < 0.3
    assert np.median(np.abs(off[20:, 0])) < 0.05
    sigmas = np.array([sigmas_of(p, c) for p, c in zip(found.pose, found.cov, strict=True)])
    assert np.mean(np.abs(off[:, 1]) < 3.0 * sigmas[:, 1]) > 0.9
    assert np.all(np.linalg.eigvalsh(found.cov) > 0.0)
    with pytest.raises(DataError, match="expected pictures from"):
        follow(drive, prior, 1e6, indices_of(road_map))
