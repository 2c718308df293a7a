"""``ssm-graph online`` as a person types it."""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ssm_graph.cli.main import ExitCode, build_parser, main
from ssm_graph.cli.online_run import input_configs, output_configs, replay_speed
from ssm_graph.io.mission_folder.folder import read_mission, write_mission
from ssm_graph.io.nmea_sentences import checksum
from ssm_graph.io.results.tables import read_results
from ssm_graph.live.protocols.json_messages import JsonDecoder
from ssm_graph.live.protocols.nmea import NmeaDecoder
from ssm_graph.live.protocols.waterlinked import WaterLinkedDecoder
from ssm_graph.live.sockets.endpoints import Transport
from ssm_graph.live.sockets.feed import Limits
from ssm_graph.live.sockets.outputs import OutputFormat
from tests.calibration_cases import SCALE
from tests.mission_fixture import make_mission
from tests.window_fixture import asked, off


@pytest.fixture(scope="module")
def mission(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of a straight run of a minute."""
    folder = tmp_path_factory.mktemp("online") / "mission"
    write_mission(folder, make_mission())
    return folder


def parsed(*words: str) -> argparse.Namespace:
    """Return what the words mean."""
    line = ["online", "v.toml", "--out", "r", *words]
    return build_parser(line).parse_args(line)


def test_a_replay_is_a_run(
    mission: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A mission without a word about its vehicle; results, log and settings are there."""
    run = tmp_path / "run"
    words = ["online", "--replay", str(mission), "--speed", "full", "--out", str(run)]
    words += ["--kernel", "sqrt", "--dof", "4", "--lag", "5", "--duration", "30"]
    assert main(words) == ExitCode.GOOD
    shown = capsys.readouterr()
    assert "GOOD" in shown.out
    assert "its time was over" in shown.out
    assert f"results in {run}" in shown.out
    settings = json.loads((run / "run.json").read_text())["settings"]
    assert settings == {"lag_s": 5.0, "kernel": "sqrt(dof=4)", "similarity": "expected"}
    results = read_results(run)
    assert results.summary["kernel"] == "sqrt(dof=4)"
    assert results.trajectory["time_s"][-1] == pytest.approx(30.0, abs=1.1)
    assert len(read_mission(run / "log").imu.time_s) == pytest.approx(600, abs=5)
    assert main([*words[:-4], "--lag", "6"]) == ExitCode.USAGE
    assert "lag_s = 5.0, not 6.0" in capsys.readouterr().err


def test_a_replay_says_what_it_found_of_the_instruments(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """At its end on the terminal and in the summary, with sigma and unit."""
    write_mission(tmp_path / "m", asked(off(duration_s=20.0).mission))
    run = tmp_path / "run"
    words = ["online", "--replay", str(tmp_path / "m"), "--speed", "full", "--out", str(run)]
    assert main(words) == ExitCode.GOOD
    assert "dvl_scale_error" in capsys.readouterr().out
    found = json.loads((run / "summary.json").read_text())["calibration"]["dvl_scale_error"]
    assert abs(found["value"] - SCALE) < 3.0 * found["sigma"]
    assert 0.0 < found["sigma"] < found["prior_sigma"] == pytest.approx(0.03)


def test_pings_off_the_water_are_logged_and_count(tmp_path: Path) -> None:
    """A mission that has them has a current, in the log and in the summary too."""
    mission = make_mission()
    assert mission.initial is not None
    level = replace(mission.initial, roll=0.0, pitch=0.0)  # as it is; the fixture's start is off
    mission = replace(mission, initial=level)
    water = (np.arange(len(mission.dvl.time_s)) % 4 == 3).astype(float)
    write_mission(tmp_path / "m", replace(mission, dvl=replace(mission.dvl, water_track=water)))
    words = ["online", "--replay", str(tmp_path / "m"), "--speed", "full", "--duration", "30"]
    assert main([*words, "--out", str(tmp_path / "run")]) == ExitCode.GOOD
    assert "water_track" not in (tmp_path / "run" / "events.jsonl").read_text()
    found = json.loads((tmp_path / "run" / "summary.json").read_text())["current"]
    assert 0.0 < found["final_sigma_enu_m_per_s"][0] < 0.1
    assert abs(found["final_enu_m_per_s"][0]) < 4.0 * found["final_sigma_enu_m_per_s"][0]
    track = read_results(tmp_path / "run").trajectory
    assert track["current_east_m_per_s"][-1] == pytest.approx(
        found["final_enu_m_per_s"][0], abs=1e-7
    )
    assert track["sigma_current_east_m_per_s"][-1] < 0.1
    log = read_mission(tmp_path / "run" / "log")
    assert log.current is not None
    logged = log.dvl
    np.testing.assert_array_equal(logged.is_water, water[: len(logged.time_s)] > 0.0)
    assert logged.is_water.sum() == 7


def test_a_run_without_an_answer_has_its_code(
    mission: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Too short to align: the log is kept, and where it is is said."""
    folder = tmp_path / "m"
    folder.mkdir()
    for path in mission.iterdir():
        text = path.read_bytes()
        if path.name == "mission.toml":
            begin, end = text.index(b"[initial]"), text.index(b"[reference]")
            text = text[:begin] + text[end:]
        (folder / path.name).write_bytes(text)
    run = tmp_path / "run"
    words = ["online", "--replay", str(folder), "--speed", "full", "--duration", "0.5"]
    assert main([*words, "--out", str(run)]) == ExitCode.NO_RESULT
    assert "no answer" in capsys.readouterr().err
    assert (run / "log" / "imu.csv").stat().st_size > 500


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ([], "no source"),
        (["--dvl", "tcp://127.0.0.1:9"], "inertial data"),
        (["--imu", "udp://:9", "--replay", "m"], "--replay: expected alone"),
        (["--imu", "9000"], "--imu: expected tcp://HOST:PORT"),
        (["--imu", "udp://:9", "--publish", "tcp://a:1"], "--publish: expected tcp-listen"),
        (["--imu", "udp://:9", "--nmea", "udp://:0"], "--nmea: expected a port"),
        (["--imu", "udp://:9", "--kernel", "gaussian", "--dof", "3"], "--dof"),
        (["--imu", "udp://:9", "--kernel", "log", "--dof", "-3"], "--kernel log"),
        (["--imu", "udp://:9", "--lag", "-3"], "lag_s"),
        (["--imu", "udp://:9", "--output-rate", "0"], "output rate"),
        (["--imu", "udp://:9", "--checkpoint-every", "0"], "checkpoint_every_s"),
        (["--imu", "udp://:9", "--max-rate", "nan"], "rate limit"),
        (["--imu", "udp://:9", "--max-rate", "0"], "rate limit"),
        (["--imu", "udp://:9", "--stall", "-1"], "stall_s"),
        (["--imu", "udp://:9"], "VEHICLE"),
        (["--replay", "m", "--speed", "fast"], "--speed"),
        (["--replay", "m", "--speed", "0"], "--speed"),
    ],
)
def test_wrong_options_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], words: list[str], said: str
) -> None:
    """Before anything is opened or written."""
    run = tmp_path / "run"
    assert main(["online", "--out", str(run), *words]) == ExitCode.USAGE
    assert said in capsys.readouterr().err
    assert not run.exists()


def test_sources_and_outputs() -> None:
    """Every source has its decoder and limits; outputs may be several."""
    arguments = parsed(
        *("--dvl", "tcp://192.168.194.95:16171", "--gnss", "udp://:9001", "--depth", "udp://:9002"),
        *("--imu", "tcp-listen://:9003", "--messages", "udp://[::1]:9004", "--max-rate", "4000"),
        *("--publish", "udp://:9005", "--publish", "tcp-listen://:9006", "--nmea", "udp://:9007"),
        *("--clock", "arrival", "--axes", "FLU", "--surface-height", "40", "--stall", "3"),
    )
    inputs = {config.name: config for config in input_configs(arguments)}
    assert list(inputs) == ["dvl", "gnss", "depth", "imu", "messages"]
    kinds = {name: type(config.make_decoder()) for name, config in inputs.items()}
    assert kinds["dvl"] is WaterLinkedDecoder
    assert kinds["gnss"] is kinds["depth"] is NmeaDecoder
    assert kinds["imu"] is kinds["messages"] is JsonDecoder
    limits = inputs["dvl"].limits
    assert limits == Limits(4000.0, 8000, 2.0 * Limits().bytes_per_s, 3.0)
    assert inputs["imu"].endpoint.transport is Transport.TCP_SERVER
    outputs = output_configs(arguments)
    assert [config.form for config in outputs] == [
        OutputFormat.JSON,
        OutputFormat.JSON,
        OutputFormat.NMEA,
    ]
    assert all(config.endpoint.host == "127.0.0.1" for config in outputs)


def test_speeds() -> None:
    """A number, or as fast as it goes."""
    assert replay_speed("full") is None
    assert replay_speed("2.5") == 2.5


def test_what_of_nmea_and_the_dvl_is_read(capsys: pytest.CaptureFixture[str]) -> None:
    """Depths by name, a compass, the yaw of the DVL; each only where it is asked for."""
    depth = f"$SDDPT,12.5,0.0*{checksum('SDDPT,12.5,0.0')}\r\n".encode()
    heading = f"$HEHDT,45.0,T*{checksum('HEHDT,45.0,T')}\r\n".encode()
    yaw = b'{"type": "position_local", "yaw": 45.0, "status": 0}\n'
    for words, counts in (
        ((), [0, 1, 0]),
        (("--depth-sentence", "dpt", "--dvl-heading"), [1, 1, 1]),
    ):
        inputs = ("--depth", "udp://:9", "--heading", "udp://:10", "--dvl", "tcp://a:11")
        configs = {one.name: one for one in input_configs(parsed(*inputs, *words))}
        found = [
            len(configs[name].make_decoder().feed(data, arrival_s=1.7e9))
            for name, data in (("depth", depth), ("heading", heading), ("dvl", yaw))
        ]
        assert found == counts
    with pytest.raises(SystemExit):
        parsed("--depth-sentence", "XDR")
    assert "expected one of PRVAT, PIPS, PVIPS2, DPT, DBT, got 'XDR'" in capsys.readouterr().err
