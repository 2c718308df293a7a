"""A DVL's recording and an IMU's table become one mission, on the clock that their turns show."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from ssm_graph.base.errors import ConfigError, DataError
from ssm_graph.cli.main import ExitCode, main
from ssm_graph.io.mission_folder.folder import read_mission, write_mission
from ssm_graph.io.mission_folder.vehicle import read_vehicle
from ssm_graph.io.raw_log.log import RawLog
from ssm_graph.live.recorded.merge import merge_recordings
from ssm_graph.live.recorded.turns import clock_offset
from ssm_graph.sensors.messages import Message
from ssm_graph.simulation import CALM, SimulatedMission, SurveyRoute
from tests.helpers import simulated
from tests.water_linked_fixture import velocity_report

AHEAD_S = 1_750_000_123.456
"""Of the DVL's clock before the IMU's."""


@cache
def sim() -> SimulatedMission:
    """Return three survey lines of 30 s: they do not repeat."""
    return simulated(duration_s=80.0, route=SurveyRoute(line_m=45.0), seed=6)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the mission as a folder, and beside it what the DVL sent, on a clock of its own."""
    found = tmp_path_factory.mktemp("merge")
    mission = sim().mission
    write_mission(found / "mission", mission)
    pings = zip(mission.dvl.time_s, mission.dvl.speed, strict=True)
    lines = [(t, velocity_report(t + AHEAD_S, speed)) for t, speed in pings]
    yaw_s = np.arange(1.0, 79.0, 0.2)
    heading = np.degrees(sim().truth_at(yaw_s).roll_pitch_heading[:, 2]) + 40.0
    noise = np.random.default_rng(3).normal(0.0, 0.3, len(yaw_s))
    lines += [(t, local(t, h)) for t, h in zip(yaw_s, heading + noise, strict=True)]
    text = "".join(f"{line}\n" for _, line in sorted(lines, key=lambda one: one[0]))
    (found / "dvl.json").write_text(text)
    return found


def local(time_s: float, yaw_deg: float) -> str:
    """Return a report of the dead reckoning."""
    yaw = (yaw_deg + 180.0) % 360.0 - 180.0
    return json.dumps({"type": "position_local", "ts": time_s + AHEAD_S, "yaw": yaw, "status": 0})


def test_the_mission_is_the_one_that_both_are_of(folder: Path, tmp_path: Path) -> None:
    """To 20 ms of the DVL's clock; the inertial data are those of the table."""
    vehicle, mission = read_vehicle(folder / "mission"), sim().mission
    logs = [folder / "dvl.json", folder / "mission" / "imu.csv"]
    found = merge_recordings(logs, tmp_path / "both", vehicle=vehicle)
    assert "onto the clock of the IMU" in " ".join(found.notes)
    dvl, imu = found.mission.dvl, found.mission.imu
    np.testing.assert_array_equal(imu.time_s, mission.imu.time_s)
    np.testing.assert_array_equal(imu.gyro_b, mission.imu.gyro_b)
    assert len(dvl.time_s) == len(mission.dvl.time_s)
    off_s = dvl.time_s - mission.dvl.time_s
    assert np.ptp(off_s) < 1e-5
    assert abs(off_s[0]) < 0.02
    np.testing.assert_array_equal(dvl.speed, mission.dvl.speed)
    stated = merge_recordings(logs, tmp_path / "by", vehicle=vehicle, offset_s=-AHEAD_S)
    off_s = stated.mission.dvl.time_s - mission.dvl.time_s
    np.testing.assert_allclose(off_s, 0.0, atol=1e-5)


def test_an_interrupted_merge_leaves_nothing(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A mission that lacks its end would look like a whole one."""
    append, n_rows = RawLog.append, 0

    def stop(self: RawLog, message: Message) -> None:
        nonlocal n_rows
        n_rows += 1
        if n_rows > 50:
            raise KeyboardInterrupt
        append(self, message)

    monkeypatch.setattr(RawLog, "append", stop)
    logs = [folder / "dvl.json", folder / "mission" / "imu.csv"]
    with pytest.raises(KeyboardInterrupt):
        merge_recordings(logs, tmp_path / "out", vehicle=read_vehicle(folder / "mission"))
    assert not [*tmp_path.iterdir()]


def test_tables_of_any_columns_join_a_recording(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A map without a DVL, whose recording lies beside the tables; without one it is refused."""
    imu = sim().mission.imu
    flu = np.array([1.0, -1.0, -1.0])
    rows = np.column_stack([1e3 * imu.time_s, np.degrees(imu.gyro_b) * flu, imu.accel_b * flu])
    head = "t_ms,wx,wy,wz,ax,ay,az"
    np.savetxt(tmp_path / "own.csv", rows, "%.12g", ",", header=head, comments="")
    (tmp_path / "map.toml").write_text(
        'format = 1\n[imu]\ntime = { column = "t_ms", unit = "ms" }\n'
        'gyro = { columns = ["wx", "wy", "wz"], unit = "deg/s", axes = "FLU" }\n'
        'accel = { columns = ["ax", "ay", "az"], axes = "FLU" }\n'
    )
    words = ["convert", "--map", str(tmp_path / "map.toml"), "--vehicle", str(folder / "mission")]
    words += ["--out", str(tmp_path / "out"), str(tmp_path / "own.csv")]
    assert main(words) == 2
    assert "or the recording of a DVL beside the tables" in capsys.readouterr().err
    assert main([*words, str(folder / "dvl.json")]) == 0
    assert "onto the clock of the IMU" in capsys.readouterr().out
    found = read_mission(tmp_path / "out")
    np.testing.assert_allclose(found.imu.gyro_b, imu.gyro_b, atol=1e-9)
    np.testing.assert_array_equal(found.dvl.speed, sim().mission.dvl.speed)
    assert np.abs(found.dvl.time_s - sim().mission.dvl.time_s).max() < 0.02


def test_of_two_instruments_of_a_kind_one_counts(folder: Path, tmp_path: Path) -> None:
    """That of the file named first; of one log in two files nothing is lost but what is in both."""
    vehicle, mission = read_vehicle(folder / "mission"), sim().mission
    lines = (folder / "dvl.json").read_text().splitlines(keepends=True)
    half = len(lines) // 2
    parts = {"first": lines[: half + 20], "second": lines[half:], "other": lines}
    for name, some in parts.items():
        (tmp_path / f"{name}.json").write_text("".join(some))
    files = [folder / "mission" / "imu.csv", *(tmp_path / f"{name}.json" for name in parts)]
    found = merge_recordings(files, tmp_path / "all", vehicle=vehicle, offset_s=-AHEAD_S)
    np.testing.assert_allclose(found.mission.dvl.time_s, mission.dvl.time_s, atol=1e-5)
    said = [note for note in found.notes if "of [dvl] left out" in note]
    assert [note.partition(":")[0] for note in said] == ["second.json", "other.json"]
    assert f"{len(mission.dvl.time_s)} of {len(mission.dvl.time_s)} rows" in said[1]


def test_offset_and_its_sigma() -> None:
    """Over many noises: right on the mean, and as uncertain as is said, to a factor of three."""
    imu, time_s = sim().mission.imu, np.arange(1.0, 79.0, 0.2)
    heading = sim().truth_at(time_s).roll_pitch_heading[:, 2]
    rng = np.random.default_rng(8)
    found = [
        clock_offset(imu, time_s + 5.0, heading + rng.normal(0.0, 0.01, len(time_s)))
        for _ in range(12)
    ]
    off = np.array([one.seconds + 5.0 for one in found])
    assert abs(off.mean()) < 0.02
    assert off.std() < 3.0 * np.mean([one.sigma_s for one in found]) < 9.0 * off.std() + 0.02


Change = Callable[[str], str]


@pytest.mark.parametrize(
    ("change", "why"),
    [
        (lambda text: text.replace("position_local", "response"), "has no headings"),
        (lambda text: text.replace('"yaw": ', '"yaw": 1e-9, "x": '), "turn too little"),
        (lambda text: "\n".join(reversed(text.splitlines())), "set back"),
        (lambda text: text + local(1e6, 5.0), "was the clock set amid it"),
    ],
)
def test_what_does_not_tell_is_refused(
    folder: Path, tmp_path: Path, change: Change, why: str
) -> None:
    """With what to state."""
    (tmp_path / "dvl.json").write_text(change((folder / "dvl.json").read_text()))
    logs = [tmp_path / "dvl.json", folder / "mission" / "imu.csv"]
    with pytest.raises(DataError, match=why):
        merge_recordings(logs, tmp_path / "out", vehicle=read_vehicle(folder / "mission"))


def test_turns_of_another_run_are_refused(folder: Path) -> None:
    """Rates that are alike nowhere."""
    time_s = np.arange(0.0, 78.0, 0.2)
    heading = np.cumsum(np.random.default_rng(2).normal(0.0, 0.05, len(time_s)))
    with pytest.raises(DataError, match="of one run"):
        clock_offset(sim().mission.imu, time_s, heading)
    vehicle = read_vehicle(folder / "mission")
    with pytest.raises(ConfigError, match=r"one table with the columns of imu\.csv"):
        merge_recordings([folder / "dvl.json"], folder / "none", vehicle=vehicle)


def test_lines_that_repeat_are_refused() -> None:
    """Two offsets are as good: nobody can say which."""
    sim = simulated(duration_s=80.0, route=SurveyRoute(line_m=15.0), waves=CALM, seed=6)
    time_s = np.arange(1.0, 79.0, 0.2)
    with pytest.raises(DataError, match="at another offset"):
        clock_offset(sim.mission.imu, time_s, sim.truth_at(time_s).roll_pitch_heading[:, 2])


def test_on_the_command_line(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Two files and a vehicle; the offset is said, and the mission is one."""
    logs = [str(folder / "dvl.json"), str(folder / "mission" / "imu.csv")]
    out = ["--out", str(tmp_path / "m")]
    assert main(["convert", *logs, *out]) == ExitCode.USAGE
    assert "--vehicle FILE" in capsys.readouterr().err
    assert main(["convert", *logs, *out, "--vehicle", str(folder / "mission")]) == ExitCode.GOOD
    said = " ".join(capsys.readouterr().out.split())
    assert "80 pings" in said
    assert "s onto the clock of the IMU" in said
    mission = read_mission(tmp_path / "m")
    assert replace(mission, notes=()).dvl.mount.n_beams == 4
