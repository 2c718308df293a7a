"""Further aids in mission and result folders."""

from __future__ import annotations

import csv
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ssm_graph.evaluation.errors import evaluate
from ssm_graph.io.mission_folder.folder import read_mission, write_mission
from ssm_graph.io.mission_folder.vehicle import read_vehicle, vehicle_of
from ssm_graph.io.results.tables import read_results, write_results
from ssm_graph.mission.estimate import Estimate
from ssm_graph.mission.mission import Aids, Mission
from ssm_graph.mission.problem import build_problem
from ssm_graph.sensors.acoustic import RangeLog
from ssm_graph.simulation import SimulatedMission
from ssm_graph.smoothers.batch import SsmSmoother
from tests.aids_fixture import UNKNOWN, ranging, with_every_aid
from tests.helpers import simulated
from tests.unit.test_mission_roundtrip import assert_same


@pytest.fixture(scope="module")
def sim() -> SimulatedMission:
    """Return a mission with everything."""
    return with_every_aid()


@pytest.mark.parametrize("order", ["time", "arrival"])
def test_round_trip(tmp_path: Path, sim: SimulatedMission, order: str) -> None:
    """Every value comes back, several ranges of one time too, in either order of the rows."""
    aids = sim.mission.aids
    together = aids[RangeLog].time_s.copy()
    together[1::2] = together[0 : 2 * len(together[1::2]) : 2]  # both beacons answer one ping
    mission = replace(sim.mission, aids=aids.having(replace(aids[RangeLog], time_s=together)))
    write_mission(tmp_path, mission)
    path = tmp_path / "mission.toml"
    path.write_text(f'order = "{order}"\n' + path.read_text(encoding="utf-8"), encoding="utf-8")
    got = read_mission(tmp_path)
    assert_same(got.aids, mission.aids)
    assert got.notes == ()


def test_sections_say_what_there_is(tmp_path: Path, sim: SimulatedMission) -> None:
    """In a mission as in its vehicle, whose live estimator does without."""
    names = ("[usbl]", "[ranges]", "[heading]", "[magnetometer]", "[[standstill]]")
    assert sim.mission.aids.sections == names
    assert vehicle_of(sim.mission).aids.sections == names
    write_mission(tmp_path, sim.mission)
    assert read_vehicle(tmp_path).aids.sections == names
    assert Aids().sections == ()


def answer(mission: Mission) -> Estimate:
    """Smooth a mission."""
    return SsmSmoother().solve(build_problem(mission))


def test_results_tell_of_every_measurement(tmp_path: Path, sim: SimulatedMission) -> None:
    """In aids.csv, counted in the summary; an answer without them takes the table away."""
    estimate = answer(sim.mission)
    assert sim.mission.reference is not None
    metrics = evaluate(estimate.trajectory, sim.mission.reference)
    write_results(tmp_path, estimate, mission=sim.mission, metrics=metrics, settings={})
    with (tmp_path / "aids.csv").open(encoding="utf-8", newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert {row["aid"] for row in rows} == {
        "depth",
        "USBL",
        "range",
        "heading",
        "magnetometer",
        "standstill",
    }
    assert {row["unit"] for row in rows} == {"m", "deg", "m/s", "uT"}
    headings = [float(row["innovation"]) for row in rows if row["unit"] == "deg"]
    assert 0.2 < np.std(headings) < 5.0
    counted = read_results(tmp_path).summary["aids"]
    for name, components in (
        ("depth", 1),
        ("USBL", 3),
        ("range", 1),
        ("heading", 1),
        ("magnetometer", 3),
        ("standstill", 3),
    ):
        n_rows = sum(row["aid"] == name for row in rows)
        assert counted[name]["n_measurements"] * components == n_rows
    calibration = read_results(tmp_path).summary["calibration"]
    assert calibration["beacon_7_east_m"]["prior_sigma"] == pytest.approx(40.0)
    assert calibration["heading_offset_deg"]["prior_sigma"] == pytest.approx(4.0)
    plain = replace(sim.mission, aids=Aids(), depth=None, gnss=None)
    write_results(tmp_path, answer(plain), mission=plain, metrics=None, settings={})
    assert not (tmp_path / "aids.csv").exists()
    assert "aids" not in read_results(tmp_path).summary


def test_a_beacon_that_was_found_is_a_section_to_copy(tmp_path: Path) -> None:
    """At its true place, within three of the sigmas that stand beside it."""
    sim = simulated(duration_s=300.0, aids=ranging(UNKNOWN))
    estimate = answer(sim.mission)
    write_results(tmp_path, estimate, mission=sim.mission, metrics=None, settings={})
    text = (tmp_path / "calibration.toml").read_text(encoding="utf-8")
    (beacon,) = tomllib.loads(text)["beacon"]
    assert beacon["number"] == UNKNOWN.number
    lat, lon = np.radians(beacon["lat_deg"]), np.radians(beacon["lon_deg"])
    found = sim.mission.frame.p_n_from_geodetic(lat, lon, beacon["height_m"])
    line = next(line for line in text.splitlines() if line.startswith("# position_sigma_m"))
    sigma = np.array(tomllib.loads(line.removeprefix("# "))["position_sigma_m"])
    assert np.all(np.abs(found - UNKNOWN.enu) < 3.0 * sigma)
    assert sigma[:2].max() < 5.0
