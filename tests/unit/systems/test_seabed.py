"""A start on the seabed: rays, grids, verdicts on made-up ground, a mission from end to end."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from ssm_graph.base.earth import LocalFrame
from ssm_graph.base.errors import ConfigError, DataError
from ssm_graph.base.frozen import Array
from ssm_graph.cli.main import ExitCode, main
from ssm_graph.filters.rules.hypotheses import apart_from_each_other, told
from ssm_graph.io.mission_folder.folder import read_mission, write_mission
from ssm_graph.mission.estimate import Estimate, Status
from ssm_graph.mission.mission import LocalStart
from ssm_graph.mission.problem import ProblemConfig
from ssm_graph.sensors.seabed import MapErrors, SeabedGrid, TerrainLog
from ssm_graph.simulation import Grade
from ssm_graph.smoothers.settings import SmootherConfig
from ssm_graph.study.ledger import Key, Row
from ssm_graph.systems.seabed.dive import find_start, is_in_doubt, smooth_dive, without_map
from ssm_graph.systems.seabed.locate import Located, Verdict, locate
from ssm_graph.systems.seabed.simulate import (
    DIVE,
    DiveSettings,
    SimulatedDive,
    mission_with_map,
    simulate_dive,
)
from ssm_graph.systems.seabed.study import keys_of, summary
from ssm_graph.systems.seabed.terrain import (
    FLAT,
    ROUGH,
    SurveySettings,
    TerrainSettings,
    met,
    seabed,
    surveyed,
)
from ssm_graph.systems.seabed.track import Doubt, Track, turned

FRAME = LocalFrame(0.8, 0.2, 0.0)
BEAMS = np.array([[1, 1, -1.7], [1, -1, -1.7], [-1, -1, -1.7], [-1, 1, -1.7]])
BEAMS = BEAMS / np.linalg.norm(BEAMS, axis=1)[:, None]
"""East, north, up, of a level instrument."""
DOUBT = Doubt(yaw=0.03, rate=5e-5, rate_walk=1e-4, scale=0.003, walk=0.05)


def ground(settings: TerrainSettings, seed: int = 0) -> tuple[SeabedGrid, SeabedGrid, MapErrors]:
    """Return a seabed of 1.5 km, its map and what is stated of it."""
    rng = np.random.default_rng(seed)
    truth = seabed(replace(settings, side_m=1500.0), FRAME, np.zeros(2), rng)
    return truth, *surveyed(truth, SurveySettings(), rng)


def dived(truth: SeabedGrid, doubt: Doubt = DOUBT) -> tuple[Track, Array]:
    """Return a dead-reckoned dive of 500 m from elsewhere, turned by 2 degrees; and its way."""
    s = np.arange(0.0, 500.0, 3.0)
    way = np.column_stack([-150.0 + 0.6 * s, -100.0 + 60.0 * np.sin(s / 90.0)])
    from_n = np.broadcast_to(
        np.column_stack([way, np.full(len(s), -40.0)])[:, None], (len(s), 4, 3)
    )
    along = np.broadcast_to(BEAMS, from_n.shape)
    ends = met(truth, from_n, along, 200.0)[..., None] * along
    turn = np.full(len(s), -np.radians(2.0))
    track = Track(
        doubt,
        time_s=s / 1.5,
        x_y=turned(way - way[0], turn),
        height=np.full(len(s), -40.0),
        ends=np.concatenate([turned(ends[..., :2], turn[:, None]), ends[..., 2:]], axis=-1),
        sigma=np.full((len(s), 4), 0.3),
        way_m=np.full(len(s), 3.0),
    )
    return track, way


def found_on(
    chart: SeabedGrid, errors: MapErrors, track: Track, middle: Array, radius_m: float = 150.0
) -> Located:
    """Return what is found within a circle."""
    return locate(chart, errors, track, middle=middle, radius_m=radius_m)


def test_rays_meet_a_plane_where_it_is() -> None:
    """Within a centimetre of the closed form; none meets what is too far or beyond the edge."""
    x, y = np.meshgrid(np.arange(-300.0, 301.0, 5.0), np.arange(-300.0, 301.0, 5.0))
    flat = LocalFrame(0.8, 0.2, 0.0)
    _, _, height = flat.geodetic_from_p_n(np.stack([x, y, -70.0 + 0.1 * x - 0.2 * y], axis=-1))
    plane = SeabedGrid("plane", flat, -300.0, -300.0, 5.0, height)
    from_n = np.broadcast_to([10.0, 20.0, -30.0], BEAMS.shape)
    # z0 + r uz = -70 + 0.1 (x0 + r ux) - 0.2 (y0 + r uy)
    want = (-70.0 + 1.0 - 4.0 + 30.0) / (BEAMS @ [-0.1, 0.2, 1.0])
    np.testing.assert_allclose(met(plane, from_n, BEAMS, 200.0), want, atol=0.01)
    assert np.isnan(met(plane, from_n, BEAMS, 40.0)).all()
    assert np.isnan(met(plane, from_n + np.array([285.0, 0.0, 0.0]), BEAMS, 200.0)[:2]).all()


def test_grid_between_its_cells() -> None:
    """The cubic is exact on a parabola, its slope too; off the map and beside a hole is nothing."""
    x, y = np.meshgrid(np.arange(0.0, 100.0, 5.0), np.arange(0.0, 80.0, 5.0))
    height = 0.01 * x**2 - 0.02 * x * y + 3.0
    grid = SeabedGrid("parabola", FRAME, 0.0, 0.0, 5.0, height)
    at = np.array([31.3, 52.0]), np.array([22.2, 47.9])
    found = grid.surface_at(*at)
    np.testing.assert_allclose(found.height, 0.01 * at[0] ** 2 - 0.02 * at[0] * at[1] + 3.0)
    np.testing.assert_allclose(found.slope[:, 0], 0.02 * at[0] - 0.02 * at[1])
    np.testing.assert_allclose(found.slope[:, 1], -0.02 * at[0])
    holed = height.copy()
    holed[4, 6] = np.nan
    holed_grid = replace(grid, height=holed)
    assert np.isnan(holed_grid.surface_at(np.array(31.0), np.array(22.0)).height)
    assert np.isnan(grid.height_at(np.array([-1.0]), np.array([10.0])))[0]


def test_seabed_has_the_relief_and_spectrum_that_are_asked_for() -> None:
    """Power of short waves falls as k^-(2 H + 2): here by 3.8 decades a decade."""
    grid = seabed(
        replace(ROUGH, side_m=4000.0, slope=(0.0, 0.0)),
        FRAME,
        np.zeros(2),
        np.random.default_rng(1),
    )
    assert grid.height.std() == pytest.approx(6.0, rel=0.2)
    window = np.hanning(len(grid.height))
    power = np.abs(np.fft.fft2(grid.height * window[:, None] * window)) ** 2
    k = np.fft.fftfreq(len(grid.height), grid.cell_m)
    k_abs = np.hypot(k[:, None], k)
    ring = [power[(k_abs > a) & (k_abs < 1.2 * a)].mean() for a in (0.01, 0.04)]
    slope = np.log(ring[1] / ring[0]) / np.log(4.0)
    assert slope == pytest.approx(-3.8, abs=0.25)


def test_rough_ground_tells_the_place() -> None:
    """Within three sigmas, which are a few metres, whatever the dead reckoning was turned by."""
    truth, chart, errors = ground(ROUGH)
    track, way = dived(truth)
    found = found_on(chart, errors, track, way[0] + [60.0, -80.0])
    assert found.verdict is Verdict.CONVERGED, found.reason
    off = found.start - way[0]
    assert np.hypot(*off) < 4.0
    assert off @ np.linalg.solve(found.cov[:2, :2], off) < 9.0
    assert np.hypot(*(found.track.x_y[-1] - way[-1])) < 8.0
    assert np.degrees(found.hypotheses[0].pose[2]) == pytest.approx(2.0, abs=0.6)


@pytest.mark.slow
def test_no_heading_at_all() -> None:
    """A dive whose north is unknown is found as well, with its turn."""
    truth, chart, errors = ground(ROUGH)
    track, way = dived(truth, DOUBT._replace(yaw=np.inf))
    track = replace(
        track,
        x_y=turned(track.x_y, np.full(len(track.x_y), -2.0)),
        ends=np.concatenate(
            [turned(track.ends[..., :2], np.full(track.ends.shape[:2], -2.0)), track.ends[..., 2:]],
            axis=-1,
        ),
    )
    found = found_on(chart, errors, track, way[0] + [20.0, -30.0], 80.0)
    assert found.verdict is Verdict.CONVERGED, found.reason
    assert np.hypot(*(found.start - way[0])) < 4.0
    assert found.hypotheses[0].pose[2] == pytest.approx(2.0 + np.radians(2.0), abs=0.02)


def test_flat_ground_is_said_to_be_flat() -> None:
    """And a plane, whose slope the unknown bias of the map hides, says nothing either."""
    for settings in (FLAT, replace(FLAT, slope=(0.03, -0.04))):
        truth, chart, errors = ground(settings)
        track, way = dived(truth)
        found = found_on(chart, errors, track.part(slice(0, None, 5)), way[0] + [60.0, -80.0])
        assert found.verdict is Verdict.UNRESOLVED
        assert found.reason.startswith("flat: unresolved")


def test_ground_that_repeats_itself_is_ambiguous() -> None:
    """Two starts 120 m apart see the same; both are named."""
    truth, _, _ = ground(ROUGH)
    height = truth.height.copy()
    n = round(120.0 / truth.cell_m)
    for begin in range(n, height.shape[1], n):
        part = height[:, begin : begin + n]
        part[:] = height[:, : part.shape[1]]
    # Made smooth over the seams, and as high everywhere.
    height += np.linspace(0.0, 1.0, n)[None, np.arange(height.shape[1]) % n] * (
        height[:, [0]] - height[:, [n - 1]]
    )
    again = replace(truth, height=height)
    track, way = dived(again)
    found = found_on(again, MapErrors(), track, way[0] + [60.0, 0.0], 140.0)
    assert found.verdict is Verdict.AMBIGUOUS, found.reason
    rival = np.abs(np.subtract(found.hypotheses[1].pose[:2], found.hypotheses[0].pose[:2]))
    np.testing.assert_allclose(rival, [120.0, 0.0], atol=8.0)


def test_a_map_of_another_place_fails() -> None:
    """Nothing there explains the ranges."""
    truth, _, errors = ground(replace(ROUGH, relief_m=12.0))
    _, other, _ = ground(replace(ROUGH, relief_m=12.0), seed=5)
    track, way = dived(truth)
    found = found_on(other, errors, track, way[0])
    assert found.verdict is Verdict.FAILED
    assert "a start more than 150 m from where it is said to be" in found.reason


def test_rivals_apart_from_each_other() -> None:
    """The better of two in one place is kept; shares are of those that are kept."""
    value = np.array([1.0, 3.0, 2.9, 0.0])
    place = np.array([0.0, 10.0, 10.5, 30.0])
    kept = apart_from_each_other(value, lambda b, r: np.abs(place[r] - place[b]) < 1.0, 3)
    assert kept == [1, 0, 3]
    shares = [h.share for h in told(place[:, None], value, value, kept)]
    assert sum(shares[row] for row in kept) == pytest.approx(1.0)
    assert shares[1] / shares[0] == pytest.approx(np.exp(2.0))


@cache
def short_dive() -> SimulatedDive:
    """Return a dive of two minutes, its start 100 m in doubt."""
    mission = replace(DIVE, duration_s=120.0, imu_rate_hz=20.0, grade=Grade.TACTICAL, seed=3)
    terrain = replace(ROUGH, side_m=1200.0)
    return simulate_dive(DiveSettings(mission=mission, terrain=terrain, start_m=100.0))


def test_map_in_a_folder(tmp_path: Path) -> None:
    """It comes back as it was written; what is wrong with it is said with its key."""
    mission = mission_with_map(short_dive())
    write_mission(tmp_path, mission)
    wrote, read = mission.aids[TerrainLog], read_mission(tmp_path).aids[TerrainLog]
    assert read.errors == wrote.errors
    assert read.within_m == wrote.within_m
    np.testing.assert_array_equal(read.grid.height, wrote.grid.height)
    assert (read.grid.x0_m, read.grid.y0_m) == (wrote.grid.x0_m, wrote.grid.y0_m)
    toml = tmp_path / "mission.toml"
    text = toml.read_text()
    for old, new, said in (
        ('values = "heights"', 'values = "up"', "[map] values"),
        ('file = "seabed.asc"', 'file = "seabad.asc"', "there is no such map"),
        ('crs = "local"', 'crs = "EPSG:3857"', "UTM zone"),
        ("within_m = 100.0", "within_m = -3.0", "[map] within_m"),
    ):
        toml.write_text(text.replace(old, new))
        with pytest.raises(ConfigError, match=said.replace("[", r"\[")):
            read_mission(tmp_path)


def test_a_map_that_says_nothing_is_told() -> None:
    """A known start: a map of elsewhere makes the answer suspect, half a map is a note."""
    mission = replace(DIVE, grade=Grade.MEMS, imu_rate_hz=20.0, duration_s=40.0)
    mission = replace(mission, dvl=replace(mission.dvl, rate_hz=0.25))
    terrain = replace(ROUGH, side_m=600.0)
    dive = simulate_dive(DiveSettings(mission=mission, terrain=terrain, start_m=0.0))
    known = mission_with_map(dive)
    log = known.aids[TerrainLog]
    graph, loop = ProblemConfig(keyframe_interval_s=4.0), SmootherConfig(fault_search=None)

    def answer(east_m: float) -> Estimate:
        moved = replace(log, grid=replace(log.grid, x0_m=log.grid.x0_m + east_m))
        one = replace(known, aids=known.aids.having(moved))
        found = smooth_dive(one, loop, problem_config=graph).estimate
        assert found is not None
        return found

    assert not any("[map]" in note for note in answer(0.0).notes)
    off = answer(5000.0)
    assert off.status is Status.SUSPECT
    assert "[map]: 0 of 40 ranges end on the map" in off.reason
    assert "is it the right map" in off.reason
    assert any("ranges end on the map; beyond it" in note for note in answer(300.0).notes)


def test_ranges_are_needed() -> None:
    """A DVL without ranges has nothing to compare."""
    dive = short_dive()
    silent = replace(
        dive, mission=replace(dive.mission, dvl=replace(dive.mission.dvl, range_m=None))
    )
    with pytest.raises(DataError, match="range1_m"):
        mission_with_map(silent)


@pytest.mark.slow
def test_a_start_is_found_and_the_smoother_goes_on(tmp_path: Path) -> None:
    """The command's answer, and a smoothed mission within its sigmas; without a place as well."""
    dive = short_dive()
    mission = mission_with_map(dive)
    write_mission(tmp_path / "m", mission)
    assert main(["seabed", str(tmp_path / "m"), "--out", str(tmp_path / "r")]) == ExitCode.GOOD
    result = json.loads((tmp_path / "r" / "result.json").read_text())
    assert result["verdict"] == "CONVERGED"
    assert np.hypot(result["x_m"] - 1.2, result["y_m"] - 0.9) < 8.0  # it began at the origin
    assert (tmp_path / "r" / "seabed.png").is_file()
    words = ["smooth", str(tmp_path / "m"), "--out", str(tmp_path / "s"), "--no-figure"]
    assert main(words) == ExitCode.GOOD
    summary = json.loads((tmp_path / "s" / "summary.json").read_text())
    assert summary["rmse_horizontal_m"] < 2.0
    assert summary["nees_position"] < 5.0
    assert any(note.startswith("seabed: CONVERGED") for note in summary["notes"])
    assert mission.initial is not None
    local = LocalStart(mission.frame.lat, mission.initial.heading, np.radians(1.0))
    nowhere = replace(mission, initial=None, local=local)
    found = find_start(nowhere)
    assert found.located is not None
    assert found.located.verdict is Verdict.CONVERGED, found.located.reason
    assert np.hypot(*(found.located.start - [result["x_m"], result["y_m"]])) < 5.0


@pytest.mark.slow
def test_flat_ground_leaves_the_answer_without_the_map() -> None:
    """It is said, and is not good."""
    dive = short_dive()
    settings = replace(dive.settings, terrain=replace(FLAT, side_m=1200.0))
    mission = mission_with_map(simulate_dive(settings))
    assert is_in_doubt(mission)
    found = smooth_dive(mission, SmootherConfig())
    assert found.estimate is not None
    assert not found.estimate.status.is_good
    assert "flat: unresolved" in found.estimate.reason
    assert without_map(mission).aids.get(TerrainLog) is None


def test_summary_of_a_study() -> None:
    """A declared start outside its three sigmas is wrong; grades take turns in the keys."""
    base = {"begin_m": 1.0, "particles_s": 90.0, "cpu_s": 2.0, "verdict": "CONVERGED"}
    sigmas = {0: 1.0, 1: 3.4, 2: 3.5}
    rows: dict[Key, Row] = {
        ("rough", "MEMS", seed): {**base, "begin_sigmas": s} for seed, s in sigmas.items()
    }
    rows["rough", "MEMS", 3] = {**base, "begin_sigmas": 90.0, "verdict": "UNRESOLVED"}
    one, every = summary(rows)
    assert one[1:4] == ("mems", "4", "3")
    assert one[4].startswith("50.0 %")
    assert one[5].startswith("25.0 %")
    assert every[1] == "all"
    keys = keys_of(4)
    assert [key[1] for key in keys if key[0] == "rough"] == [grade.name for grade in Grade]
