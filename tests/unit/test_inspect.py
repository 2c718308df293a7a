"""One look at a path: what it is, what its sensors say, whether it can be smoothed."""

from __future__ import annotations

import io
import json
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ssm_graph.base.errors import DataError
from ssm_graph.base.frozen import Array
from ssm_graph.cli.main import main
from ssm_graph.cli.terminal import console_on, say_json
from ssm_graph.inspection.look import inspect_mission, inspect_path
from ssm_graph.inspection.picture import save_picture
from ssm_graph.inspection.timing import timing_of
from ssm_graph.io.mission_folder.folder import write_mission
from ssm_graph.io.nmea_sentences import checksum
from ssm_graph.mission.mission import Mission
from ssm_graph.sensors.gnss import GnssLog
from ssm_graph.simulation import scenario_config, simulate
from ssm_graph.smoothers.mission import smooth
from tests.mission_fixture import make_mission


@pytest.fixture(scope="module")
def mission() -> Mission:
    """Return a minute and a half of the demo."""
    return simulate(replace(scenario_config("demo"), duration_s=90.0)).mission


def test_times_tell_rate_jitter_and_gaps() -> None:
    """Gaps are steps of more than three usual ones; repeats and steps back are counted."""
    t: Array = np.array([*0.1 * np.arange(100), *20.0 + 0.1 * np.arange(50), 24.95, 24.95, 24.8])
    found = timing_of(t)
    assert found.rate_hz == pytest.approx(10.0)
    assert (found.n_gaps, found.n_repeats, found.n_back) == (1, 1, 1)
    assert found.gaps[0] == pytest.approx((9.9, 10.1))
    regular = timing_of(np.linspace(0.0, 10.0, 50))
    assert regular.jitter_s == pytest.approx(0.0, abs=1e-12)
    assert timing_of(np.array([3.0])).begin_s == 3.0
    assert timing_of(np.zeros(0)).n == 0


def test_a_mission_folder_can_be_smoothed(
    mission: Mission, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Rates, gravity and beams are those of the simulation; the picture and JSON say the same."""
    folder = tmp_path / "d\u00e9mo 9.41\u202fAM"
    write_mission(folder, mission)
    picture = tmp_path / "inspect.png"
    assert main(["inspect", str(folder), "--json", "--figure", str(picture)]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["verdict"] == "can be smoothed"
    assert told["path"] == str(folder)
    rates = {one["name"]: round(one["rate_hz"]) for one in told["sensors"]}
    assert rates == {"IMU": 100, "DVL": 1, "depth": 2, "GNSS": 1}
    assert "specific force 9.8" in told["sensors"][0]["facts"][0]
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert main(["inspect", str(folder)]) == 0
    assert "verdict: can be smoothed" in capsys.readouterr().out


def test_json_stays_json() -> None:
    """Whatever a name holds that the console would escape."""
    stream, name = io.StringIO(), "a\u202fb\x7f\x1b[2J\u200f\n"
    say_json(console_on(stream), name)
    assert json.loads(stream.getvalue()) == name


def test_what_is_missing_is_said(mission: Mission) -> None:
    """No speed, no start, clocks that do not meet, gravity along another axis."""
    path = Path("mission")
    silent = replace(mission.dvl, speed=np.full_like(mission.dvl.speed, np.nan))
    found = inspect_mission(replace(mission, dvl=silent), path)
    assert "no beam has a speed" in found.verdict
    found = inspect_mission(replace(mission, initial=None, gnss=None), path)
    assert "give [initial] in mission.toml" in found.verdict
    later = replace(mission.dvl, time_s=mission.dvl.time_s + 1000.0)
    found = inspect_mission(replace(mission, dvl=later), path)
    assert "do not overlap: are they on one clock?" in found.verdict
    turned = replace(mission.imu, accel_b=mission.imu.accel_b[:, [2, 1, 0]])
    found = inspect_mission(replace(mission, imu=turned), path)
    assert any("gravity lies along x" in odd for odd in found.sensors[0].oddities)


@pytest.mark.parametrize("n_rows", [0, 1])
@pytest.mark.parametrize("name", ["dvl", "depth", "gnss"])
def test_tables_of_one_row_or_none(name: str, n_rows: int) -> None:
    """Are looked at, and smoothed, as any other."""
    mission = make_mission()
    log = getattr(mission, name)
    few = replace(mission, **{name: log.rows(np.arange(len(log.time_s)) < n_rows)})
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = inspect_mission(few, Path("mission"))
        smooth(few)
    assert found.can_be_smoothed == (name != "dvl" or n_rows == 1)
    assert any(one.facts == ("no rows",) for one in found.sensors) == (n_rows == 0)


def test_gaps_and_frozen_readings_are_odd(mission: Mission) -> None:
    """With their times, so that a person can look there."""
    assert mission.depth is not None
    assert mission.gnss is not None
    stuck = np.where(mission.depth.time_s > 60.0, 3.25, mission.depth.depth)
    kept = (mission.gnss.time_s < 3.5) | (mission.gnss.time_s > 9.5)
    rows = {n: getattr(mission.gnss, n)[kept] for n in ("time_s", "lat", "lon", "height")}
    rows["sigma_enu"] = mission.gnss.sigma_enu[kept]
    gnss: GnssLog = replace(mission.gnss, **rows)
    changed = replace(mission, depth=replace(mission.depth, depth=stuck), gnss=gnss)
    found = {one.name: one for one in inspect_mission(changed, Path("m")).sensors}
    assert found["depth"].oddities[0].startswith("repeats 3.250 m from 60.5 to 90.0 s")
    assert "the longest 7.00 s from 3.0 s on" in found["GNSS"].oddities[0]


def test_a_recording_says_what_it_reads(tmp_path: Path) -> None:
    """Its format in the first line, sensors by their names; of a folder each file."""
    bodies = ["GPRMC,100000,A,4500.000,N,00700.000,E,0,0,010526,,"]
    for k in range(9):
        bodies += [f"GPGGA,1000{k:02d},4500.{k:03d},N,00700.000,E,1,08,1.0,5,M,0,M,,"]
        bodies += [f"HEHDT,{10 * k}.0,T"]
    text = "".join(f"${body}*{checksum(body)}\r\n" for body in bodies)
    (tmp_path / "gps.log").write_text(text)
    (tmp_path / "photo.png").write_bytes(b"\x89PNG" + bytes(40))
    found = inspect_path(tmp_path / "gps.log")
    assert found.kind == "NMEA 0183, 9 positions, 9 headings"
    names = {one.name: one for one in found.sensors}
    assert names["GNSS"].facts[0].startswith("within 0 m east and 15 m north")
    assert names["compass"].facts == ("turns by 80 deg in all",)
    assert names["GNSS"].curves
    folder = inspect_path(tmp_path)
    assert folder.kind == "folder of 2 files"
    assert folder.notes[0] == f"gps.log: {found.kind}"
    assert "convert its files by name" in folder.verdict
    assert "an image" in inspect_path(tmp_path / "photo.png").verdict


def test_other_files_are_named_by_their_content(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A table, an unknown file, a damaged folder, nothing: each said, none by a crash."""
    table = tmp_path / "log.csv"
    table.write_text("time_s,speed\n" + "".join(f"{0.5 * k},{k}\n" for k in range(20)))
    found = inspect_path(table)
    assert found.kind == "table, 20 rows of 2 columns"
    assert found.sensors[0].timing.rate_hz == pytest.approx(2.0)
    assert found.sensors[0].facts[1] == "speed: 0 to 19"
    unknown = tmp_path / "a.bin"
    unknown.write_bytes(b"\x89HDF\r\n" + bytes(40))
    assert "an HDF5 file" in inspect_path(unknown).verdict
    folder = tmp_path / "broken"
    folder.mkdir()
    (folder / "mission.toml").write_text("[imu\n")
    assert main(["inspect", str(folder)]) == 4
    assert "cannot be smoothed as it is" in capsys.readouterr().out
    with pytest.raises(DataError, match="no such file"):
        inspect_path(tmp_path / "nothing")
    with pytest.raises(DataError, match="nothing to draw"):
        save_picture(inspect_path(unknown), tmp_path / "x.png")
