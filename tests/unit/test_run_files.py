"""Files of a live run that somebody moves, removes, replaces or cuts: nothing is destroyed."""

from __future__ import annotations

import errno
import itertools
import json
import os
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from ssm_graph.base.errors import ConfigError, DataError
from ssm_graph.io.raw_log.log import RawLog, replay
from ssm_graph.io.tables.append_file import TORN_ROW, AppendFile
from ssm_graph.live.run.run_folder import RunFolder
from ssm_graph.live.run.runner import Runner, RunnerConfig
from ssm_graph.sensors.dvl import Ping
from ssm_graph.sensors.imu import ImuSample
from ssm_graph.sensors.messages import Message, Readings
from tests.live_fixture import FAKE, Crash, ListSource, connect, run_folder, some_messages, vehicle

OFTEN = RunnerConfig(checkpoint_every_s=2.0)
TABLES = ("trajectory.csv", "beams.csv", "log/imu.csv", "log/dvl.csv")


class Meddled(ListSource):
    """Does something to the disk once so many messages were given."""

    def __init__(self, messages: list[Message], after: int, act: Callable[[], object]) -> None:
        super().__init__(messages)
        self._after, self._act = after, act

    def poll(self, timeout_s: float) -> list[Message]:
        """Act at its time."""
        if 0 <= self._after <= self._n_given:
            self._after = -1
            self._act()
        return super().poll(timeout_s)


class Waiting(ListSource):
    """Knows the times of pings only once there are five of them."""

    def __init__(self, messages: list[Message], **settings: int) -> None:
        super().__init__(messages, **settings)
        self._pings: list[Message] = []

    def poll(self, timeout_s: float) -> list[Message]:
        """Give back all but pings, or them too."""
        taken: list[Message] = []
        for message in super().poll(timeout_s):
            (self._pings if isinstance(message, Ping) else taken).append(message)
        if len(self._pings) < 5:
            return taken
        released, self._pings = self._pings, []
        return [*taken, *released]

    def waiting(self) -> list[Readings]:
        """Return them, in two readings."""
        return [(ping, replace(ping, time_s=ping.time_s + 3.0)) for ping in self._pings]

    def end(self) -> list[Message]:
        """Return what waits, as is likelier."""
        return [readings[0] for readings in self.waiting()]


def run(path: Path, source: ListSource) -> None:
    """Run until the source ends, by a clock that goes a second on with every look at it."""
    ticks = itertools.count()
    steady_s = lambda: float(next(ticks))  # noqa: E731
    Runner(run_folder(path), FAKE, connect(source), config=OFTEN, steady_s=steady_s).run()


def content(path: Path) -> dict[str, bytes]:
    """Return all files of a run but its lock, by name."""
    return {
        str(one.relative_to(path)): one.read_bytes()
        for one in sorted(path.rglob("*"))
        if one.is_file() and one.name != "lock"
    }


def altered(path: Path) -> list[str]:
    """Return what was told of files that somebody altered."""
    events = [json.loads(line) for line in (path / "events.jsonl").read_text().splitlines()]
    return [event["text"] for event in events if event["kind"] == "file_altered"]


@pytest.fixture
def crashed(tmp_path: Path) -> Path:
    """Return a run whose process died, with checkpoints."""
    path = tmp_path / "run"
    with pytest.raises(Crash):
        run(path, ListSource(some_messages(), crash_after=400))
    return path


@pytest.mark.parametrize("crash_after", [203, 231, 252])
def test_what_waits_in_the_source_outlives_the_process(tmp_path: Path, crash_after: int) -> None:
    """Not a message of one that was killed is missing; states are those of the log as it is."""
    messages = some_messages(300)
    with pytest.raises(Crash):
        run(tmp_path / "run", Waiting(messages, crash_after=crash_after))
    run(tmp_path / "run", Waiting(messages))
    logged = list(replay(tmp_path / "run" / "log", vehicle(), {}))
    assert sorted(map(repr, logged)) == sorted(map(repr, messages))
    run(tmp_path / "again", ListSource(logged))
    for name in ("trajectory.csv", "beams.csv"):
        assert (tmp_path / "run" / name).read_bytes() == (tmp_path / "again" / name).read_bytes()


@pytest.mark.parametrize(
    ("gone", "says"),
    [
        ("log", r"log/mission\.toml: not there, but checkpoint\.npz"),
        ("log/mission.toml", r"log/mission\.toml: not there, but checkpoint\.npz"),
        ("run.json", r"bring run\.json back"),
    ],
)
def test_a_run_that_is_not_whole_is_refused_untouched(
    crashed: Path, tmp_path: Path, gone: str, says: str
) -> None:
    """A partition that is not mounted costs nothing: brought back, the run goes on."""
    aside = tmp_path / "aside"
    (crashed / gone).rename(aside)
    before = content(crashed)
    with pytest.raises(ConfigError, match=says):
        run_folder(crashed)
    assert content(crashed) == before
    aside.rename(crashed / gone)
    run(crashed, ListSource(some_messages()))
    assert (crashed / "trajectory.csv").read_bytes().count(b"\n") == 101


@pytest.mark.parametrize("left", ["trajectory.csv", "beams.csv", "events.jsonl", "summary.json"])
def test_any_trace_of_a_run_is_enough_to_refuse(crashed: Path, left: str) -> None:
    """Even where all else is gone: what is left might be all that there is."""
    (crashed / left).touch()
    if left == "summary.json":
        (crashed / left).write_text("{}")
    for path in crashed.iterdir():
        if path.name not in (left, "run.json"):
            shutil.rmtree(path) if path.is_dir() else path.unlink()
    before = content(crashed)
    with pytest.raises(ConfigError, match=f"but {left}"):
        run_folder(crashed)
    assert content(crashed) == before


def test_a_start_that_was_cut_short_is_not_a_trace(tmp_path: Path) -> None:
    """Heads of tables and settings alone lose nothing."""
    folder = run_folder(tmp_path)
    folder.logged(folder.resume())
    RawLog(tmp_path / "log", vehicle()).close()
    folder.close()
    (tmp_path / "log" / "mission.toml").unlink()
    run(tmp_path, ListSource(some_messages(20)))


def test_a_log_of_another_version_is_refused_before_results_are_cut(crashed: Path) -> None:
    """With no checkpoint left the tables would begin anew; the refusal has to come first."""
    for path in crashed.glob("checkpoint*"):
        path.unlink()
    imu = crashed / "log" / "imu.csv"
    imu.write_bytes(imu.read_bytes().replace(b"gyro_x", b"other", 1))
    before = content(crashed)
    with pytest.raises(ConfigError, match="another version"):
        run(crashed, ListSource(some_messages()))
    assert content(crashed) == before


def test_results_that_begin_anew_set_the_old_ones_aside(crashed: Path) -> None:
    """Neither checkpoint nor the begin of the log: the longer trajectory is still there."""
    for path in crashed.glob("checkpoint*"):
        path.unlink()
    before = (crashed / "trajectory.csv").read_bytes()
    for name in ("imu.csv", "dvl.csv", "arrivals"):
        path = crashed / "log" / name
        path.write_bytes(path.read_bytes()[: path.stat().st_size // 3])
    run(crashed, ListSource(some_messages(20)))
    assert (crashed / "trajectory.older.csv").read_bytes() == before
    run(crashed, ListSource(some_messages(40)))
    assert (crashed / "trajectory.older.csv").read_bytes() == before


def test_a_log_that_is_shorter_than_the_checkpoint_knew_it_is_said(crashed: Path) -> None:
    """The checkpoint is gone on from all the same."""
    (crashed / "log" / "imu.csv").write_bytes(b"")
    run(crashed, ListSource(some_messages()))
    assert "log/imu.csv: " in (crashed / "events.jsonl").read_text()


def test_settings_that_cannot_be_read_are_refused_untouched(crashed: Path) -> None:
    """A file system that failed at run.json."""
    (crashed / "run.json").write_text("{")
    before = content(crashed)
    with pytest.raises(DataError, match="nothing was changed"):
        run_folder(crashed)
    assert content(crashed) == before


@pytest.mark.parametrize("name", [*TABLES, "log", "log/mission.toml", "events.jsonl", "run.json"])
def test_what_vanishes_under_a_run_is_said_and_written_again(tmp_path: Path, name: str) -> None:
    """What was moved is whole where it went; what comes later is where it belongs."""
    path, aside = tmp_path / "run", tmp_path / "aside"
    run(path, Meddled(some_messages(), 200, lambda: (path / name).rename(aside)))
    assert any(f"run/{name}" in text and "moved" in text for text in altered(path))
    assert aside.exists()
    summary = json.loads((path / "summary.json").read_text())
    assert any(f"run/{name}" in note for note in summary["notes"])
    for table in TABLES:
        assert (path / table).read_bytes().startswith(b"time_s,")
    sent, log = (
        [(type(m).__name__, m.time_s) for m in messages]
        for messages in (some_messages(), replay(path / "log", vehicle()))
    )
    assert log == [one for one in sent if one in set(log)]
    assert log[-1] == sent[-1]
    before = (path / "trajectory.csv").read_bytes()
    run(path, ListSource(some_messages()))  # it can be gone on with
    assert (path / "trajectory.csv").read_bytes() == before


def test_a_run_folder_that_is_moved_whole_is_begun_again(tmp_path: Path) -> None:
    """The old one is a run of its own; the new one has all that came later."""
    path, aside = tmp_path / "run", tmp_path / "aside"
    run(path, Meddled(some_messages(), 200, lambda: path.rename(aside)))
    assert len(altered(path)) >= 6
    rows = [(one / "log" / "imu.csv").read_bytes().count(b"\n") - 1 for one in (path, aside)]
    assert sum(rows) == 400
    assert min(rows) > 100


def test_a_table_that_is_replaced_or_cut_is_gone_on_with(tmp_path: Path) -> None:
    """By an editor, or by a shell's redirection."""
    path = tmp_path / "run"
    imu, beams = path / "log" / "imu.csv", path / "beams.csv"

    def meddle() -> None:
        copy = imu.with_suffix(".new")
        copy.write_bytes(imu.read_bytes())
        copy.replace(imu)
        beams.write_bytes(b"")

    run(path, Meddled(some_messages(), 200, meddle))
    said = altered(path)
    assert any("imu.csv was replaced" in text for text in said)
    assert any("beams.csv was changed" in text for text in said)
    assert imu.read_bytes().count(b"\n") == 401 - 5  # a batch went into the old one
    assert beams.read_bytes().startswith(b"time_s,beam")


@pytest.mark.parametrize("kind", ["folder", "fifo", "foreign"])
def test_what_is_in_the_way_is_set_aside(tmp_path: Path, kind: str) -> None:
    """Whatever somebody put there is kept, and so is every record."""
    path = tmp_path / "dvl.csv"
    file = AppendFile(path, ending=TORN_ROW)
    file.append(b"a,b\n")
    path.rename(tmp_path / "moved")
    if kind == "folder":
        path.mkdir()
    elif kind == "fifo":
        os.mkfifo(path)
    else:
        path.write_bytes(b"something else\n")
    assert "is dvl.csv.aside now" in str(file.regain(b"a,b\n"))
    assert file.problem is None
    file.append(b"a,b\n1,2\n")
    assert path.read_bytes() == b"a,b\n1,2\n"
    assert (tmp_path / "moved").read_bytes() == b"a,b\n"
    aside = tmp_path / "dvl.csv.aside"
    assert kind != "foreign" or aside.read_bytes() == b"something else\n"
    file.close()


def test_what_cannot_be_gone_on_with_is_a_problem_of_the_disk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A mount point cannot be renamed: records go on into the old file, and it is said."""
    path = tmp_path / "dvl.csv"
    file = AppendFile(path, ending=TORN_ROW)
    path.rename(tmp_path / "moved")
    path.mkdir()

    def busy(*_: object) -> None:
        raise OSError(errno.EBUSY, os.strerror(errno.EBUSY))

    monkeypatch.setattr(Path, "rename", busy)
    assert file.regain(b"a,b\n") is None
    assert "cannot be gone on with: Device or resource busy" in str(file.problem)
    file.append(b"1,2\n")
    assert (tmp_path / "moved").read_bytes() == b"1,2\n"
    file.close()


def test_a_table_that_is_emptied_begins_with_its_head_again(tmp_path: Path) -> None:
    """Rows that came until it was noticed stand aside, whole."""
    path = tmp_path / "run"
    imu = path / "log" / "imu.csv"
    run(path, Meddled(some_messages(), 200, lambda: imu.write_bytes(b"")))
    assert imu.read_bytes().startswith(b"time_s,")
    aside = imu.with_name("imu.csv.aside").read_bytes()
    assert aside.count(b"\n") + imu.read_bytes().count(b"\n") - 1 > 200
    assert len(altered(path)) == 1


def test_rows_that_wait_are_written_where_the_table_is_now(tmp_path: Path) -> None:
    """A full disk and a moved table at once."""
    log = RawLog(tmp_path, vehicle())
    samples = [m for m in some_messages(40) if isinstance(m, ImuSample)]
    for sample in samples[:10]:
        log.append(sample)
    (tmp_path / "imu.csv").rename(tmp_path / "aside")
    imu = log._tables["imu.csv"]
    append, imu.append = imu.append, _full  # type: ignore[method-assign,assignment]
    for sample in samples[10:20]:
        log.append(sample)
    imu.append = append  # type: ignore[method-assign]
    assert any("aside" not in text for text in log.regain())
    log.sync()
    log.append(samples[20])
    log.close()
    found = [m.time_s for m in replay(tmp_path, vehicle())]
    assert found == [m.time_s for m in samples[10:21]]


def _full(_: bytes) -> None:
    raise OSError(28, "No space left on device")


def test_a_second_process_that_took_over_a_removed_lock_is_said(tmp_path: Path) -> None:
    """Both would write the same files."""
    path = tmp_path / "run"
    others: list[RunFolder] = []

    def meddle() -> None:
        (path / "lock").unlink()
        others.append(run_folder(path))

    run(path, Meddled(some_messages(), 200, meddle))
    others[0].close()
    assert "another process" in (path / "events.jsonl").read_text()
