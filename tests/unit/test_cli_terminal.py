"""Signals, standard streams and disks that fail: the work ends in order, files are whole."""

from __future__ import annotations

import errno
import json
import os
import re
import resource
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from ssm_graph.cli import smooth
from ssm_graph.cli.main import ExitCode, main
from ssm_graph.cli.terminal import SIGNALS
from ssm_graph.io.mission_folder.folder import write_mission
from ssm_graph.io.results.tables import read_results
from ssm_graph.live.run.replay_source import ReplaySource
from ssm_graph.sensors.messages import Message
from tests.mission_fixture import make_mission

ENDED = (ExitCode.GOOD, ExitCode.NOT_GOOD)
"""In order, whatever the last answer was worth."""


@pytest.fixture(scope="module")
def mission(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of a straight run of a minute."""
    folder = tmp_path_factory.mktemp("terminal") / "mission"
    write_mission(folder, make_mission())
    return folder


def words(mission: Path, run: Path) -> list[str]:
    """Return a replay of 20 s."""
    options = ["--speed", "full", "--duration", "20", "--lag", "5"]
    return ["online", "--replay", str(mission), *options, "--out", str(run)]


def send_at(monkeypatch: pytest.MonkeyPatch, *numbers: int) -> None:
    """Have this process get signals amid a replay."""
    poll, n_polls = ReplaySource.poll, 0

    def polled(source: ReplaySource, timeout_s: float) -> list[Message]:
        nonlocal n_polls
        n_polls += 1
        if n_polls == 100:
            for number in numbers:
                os.kill(os.getpid(), number)
        return poll(source, timeout_s)

    monkeypatch.setattr(ReplaySource, "poll", polled)


@pytest.mark.parametrize(
    "numbers",
    [(signal.SIGINT,), (signal.SIGTERM,), (signal.SIGHUP,), (signal.SIGHUP,) * 3, (15, 1), (1, 1)],
)
def test_a_signal_ends_a_run_in_order(
    mission: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, numbers: tuple[int, ...]
) -> None:
    """A terminal that is closed hangs up twice; a service manager after its SIGTERM."""
    send_at(monkeypatch, *numbers)
    assert main(words(mission, tmp_path / "run")) in ENDED
    assert read_results(tmp_path / "run").summary["ended"] == "it was asked to stop"
    assert [signal.getsignal(n) for n in SIGNALS][1:] == [signal.SIG_DFL] * 2


def test_a_second_request_ends_it_at_once(
    mission: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also where the terminal hung up first."""
    send_at(monkeypatch, signal.SIGHUP, signal.SIGTERM)
    assert main(words(mission, tmp_path / "run")) == ExitCode.INTERRUPTED
    assert not (tmp_path / "run" / "summary.json").exists()


def test_what_is_ignored_stays_so(
    mission: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Under nohup a terminal that is closed ends nothing."""
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        send_at(monkeypatch, signal.SIGHUP)
        main(words(mission, tmp_path / "run"))
    finally:
        signal.signal(signal.SIGHUP, before)
    assert read_results(tmp_path / "run").summary["ended"] == "its time was over"


@pytest.mark.parametrize(("cause", "ends"), [(KeyboardInterrupt(), 130), (None, None)])
def test_a_package_that_is_interrupted_while_it_loads(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    cause: BaseException | None,
    ends: int | None,
) -> None:
    """Its ImportError is the interrupt's; any other is a defect that is shown."""

    def run(*_: object) -> bool:
        raise ImportError("initialization failed") from cause

    monkeypatch.setattr("ssm_graph.cli.instruments.run", run)
    if ends is None:
        with pytest.raises(ImportError):
            main(["instruments"])
        return
    assert main(["instruments"]) == ends
    assert capsys.readouterr().err == "interrupted\n"


@pytest.mark.parametrize("number", SIGNALS)
def test_other_commands_are_interrupted_by_any_of_them(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    number: int,
) -> None:
    """What they do on the way out (keep finished runs, remove parts) is done."""

    def run(*_: object) -> bool:
        os.kill(os.getpid(), number)
        raise AssertionError("the signal came to nothing")

    monkeypatch.setattr(smooth, "run_mission", run)
    assert main(["smooth", "m", "--out", str(tmp_path / "r")]) == ExitCode.INTERRUPTED
    assert "interrupted" in capsys.readouterr().err


class Full:
    """A stream on a full disk."""

    encoding = "utf-8"

    def write(self, _: str) -> int:
        """Fail."""
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    def flush(self) -> None:
        """Do nothing."""

    def isatty(self) -> bool:
        """Return that it is none."""
        return False

    def fileno(self) -> int:
        """Fail: there is no descriptor that a test could spare."""
        raise ValueError


@pytest.mark.parametrize("stream", ["stdout", "stderr"])
def test_a_full_standard_stream_costs_nothing_else(
    mission: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    stream: str,
) -> None:
    """The run ends as it would have, and the other stream says what happened."""
    monkeypatch.setattr(sys, stream, Full())
    assert main(words(mission, tmp_path / "run")) in ENDED
    assert read_results(tmp_path / "run").summary["ended"] == "its time was over"
    if stream == "stdout":
        assert "standard output: No space left" in capsys.readouterr().err


def test_closed_streams_are_no_result_files(tmp_path: Path) -> None:
    """With ``>&-`` the next file would be standard output, and prints would go into it."""
    code = "from ssm_graph.cli.main import main; raise SystemExit(main())"
    command = f'"{sys.executable}" -c "{code}" simulate survey --duration 60 --out "$0" >&- 2>&-'
    done = subprocess.run(["sh", "-c", command, str(tmp_path / "m")], check=False)
    assert done.returncode == ExitCode.GOOD
    for path in (tmp_path / "m").iterdir():
        assert b"inertial samples" not in path.read_bytes()


def test_names_that_are_no_text_can_be_told(capfd: pytest.CaptureFixture[str]) -> None:
    """Bytes of a path that no encoding has."""
    assert main(["smooth", "m\udcff", "--out", "r"]) == ExitCode.USAGE
    assert "\\udcff" in capfd.readouterr().err


@pytest.fixture
def small_files() -> Iterator[None]:
    """Let no file grow beyond 60 kB, as if the disk were full then."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (60_000, hard))
    yield
    resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@pytest.mark.usefixtures("small_files")
def test_a_disk_that_fills_up_is_told_to_the_end(
    mission: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Navigation goes on to the end of its time; it is said how many rows are nowhere."""
    run = tmp_path / "run"
    main([*words(mission, run), "--duration", "30"])
    shown = capsys.readouterr()
    assert "rows that wait in memory for the disk" in shown.out
    summary = json.loads((run / "summary.json").read_text())
    assert summary["ended"] == "its time was over"  # no signal from outside, of a time limit say
    assert "at the end" in summary["notes"][0]
    (n_waiting,) = re.findall(r"wait in memory for the disk: (\d+)", summary["notes"][0])
    assert 0 < int(n_waiting) == summary["n_messages"] - (run / "log" / "arrivals").stat().st_size
    assert (run / "log" / "imu.csv").stat().st_size <= 60_000


@pytest.mark.parametrize("n_bytes", [10, 150, 400, 1000])
def test_a_disk_that_is_full_from_the_begin_is_refused(
    mission: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], n_bytes: int
) -> None:
    """With the cause; nothing half begun is left that would be refused later."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (n_bytes, hard))
    try:
        assert main(words(mission, tmp_path / "run")) == ExitCode.DATA
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert "File too large" in capsys.readouterr().err
    assert main(words(mission, tmp_path / "run")) in ENDED
