"""The loop of a live run: order, rates, defects that it survives, crashes and the way back."""

from __future__ import annotations

import json
import os
import threading
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ssm_graph.base.errors import ConfigError, DataError
from ssm_graph.io.mission_folder.folder import read_mission
from ssm_graph.io.raw_log.log import RawLog
from ssm_graph.io.results.tables import read_results
from ssm_graph.io.tables.checkpoint import CHECKPOINT_NAME, older_name
from ssm_graph.live.run.clock_file import ClockFile
from ssm_graph.live.run.disk import CheckpointWriter
from ssm_graph.live.run.replay_source import ReplaySource
from ssm_graph.live.run.run_folder import RunFolder
from ssm_graph.live.run.runner import (
    MOST_FAILURES,
    Connections,
    Engine,
    RunEnd,
    Runner,
    RunnerConfig,
    StopReason,
)
from ssm_graph.live.sockets.outputs import Every, OutputFormat, Publisher
from ssm_graph.mission.navigation import Event, Navigation, Severity
from ssm_graph.mission.run_status import LinkState, RunStatus
from ssm_graph.sensors.dvl import Ping
from ssm_graph.sensors.imu import ImuSample
from ssm_graph.sensors.messages import Message
from tests.live_fixture import (
    FAKE,
    Crash,
    FakeEstimator,
    ListSource,
    Recorder,
    connect,
    run_folder,
    some_messages,
    vehicle,
)

RESULTS = ("trajectory.csv", "beams.csv", "log/imu.csv", "log/dvl.csv")
OFTEN = RunnerConfig(checkpoint_every_s=2.0)


def run(path: Path, source: ListSource, engine: Engine = FAKE, **options: Any) -> RunEnd:
    """Run until the source ends."""
    outlet = options.pop("outlet", None)
    config = options.pop("config", OFTEN)
    runner = Runner(run_folder(path), engine, connect(source, outlet), config=config, **options)
    return runner.run()


def events_of(path: Path) -> list[dict[str, Any]]:
    """Return the events of a run."""
    return [json.loads(line) for line in (path / "events.jsonl").read_text().splitlines()]


def kinds(path: Path) -> list[str]:
    """Return the kinds of the events of a run, without the estimator's."""
    return [event["kind"] for event in events_of(path) if event["kind"] != "ping"]


def assert_same(one: Path, other: Path) -> None:
    """Two runs have the same results, bit for bit, and the same events of the estimator."""
    for name in RESULTS:
        assert (one / name).read_bytes() == (other / name).read_bytes(), name
    events = [[e for e in events_of(path) if e["kind"] == "ping"] for path in (one, other)]
    assert events[0] == events[1]
    newest = [json.loads((path / "summary.json").read_text())["newest"] for path in (one, other)]
    assert newest[0] == newest[1]


@pytest.fixture(autouse=True)
def prompt_disk(monkeypatch: pytest.MonkeyPatch) -> None:
    """Checkpoints are there at once, so that it does not depend on the disk how many there are."""
    write = CheckpointWriter.write

    def write_and_wait(writer: CheckpointWriter, *state: Any) -> None:
        write(writer, *state)
        writer.wait()

    monkeypatch.setattr(CheckpointWriter, "write", write_and_wait)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a run that nothing interrupted."""
    path = tmp_path_factory.mktemp("whole") / "run"
    end = run(path, ListSource(some_messages()))
    assert end.reason is StopReason.SOURCE_ENDED
    assert (end.n_messages, end.n_errors) == (500, 0)
    return path


def test_a_run_leaves_results_and_a_log_that_is_a_mission(whole: Path) -> None:
    """What comes out can be read by everything that reads missions and results."""
    results = read_results(whole)
    assert len(results.trajectory["time_s"]) == 100
    assert results.summary["ended"] == StopReason.SOURCE_ENDED.value
    assert results.summary["is_good"] is True
    logged = read_mission(whole / "log")
    assert len(logged.imu.time_s) == 400
    assert len(logged.dvl.time_s) == 100
    assert kinds(whole) == ["ended"]


@pytest.mark.parametrize("crash_after", [1, 130, 251, 497])
def test_a_crash_changes_nothing(whole: Path, tmp_path: Path, crash_after: int) -> None:
    """Whenever the process ends, the next one comes to the same results, bit for bit."""
    messages = some_messages()
    with pytest.raises(Crash):
        run(tmp_path, ListSource(messages, crash_after=crash_after))
    assert not (tmp_path / "summary.json").exists()
    end = run(tmp_path, ListSource(messages))
    assert end.n_messages == 500
    assert_same(whole, tmp_path)
    assert kinds(tmp_path) == ["resumed", "ended"]


def test_crash_after_crash_changes_nothing(whole: Path, tmp_path: Path) -> None:
    """Also where a process dies before it has caught up or written a checkpoint."""
    messages = some_messages()
    for crash_after in (60, 60, 75, 200, 201, 340):
        with pytest.raises(Crash):
            run(tmp_path, ListSource(messages, crash_after=crash_after))
    run(tmp_path, ListSource(messages))
    assert_same(whole, tmp_path)


def test_a_run_that_ended_in_order_can_be_gone_on_with(whole: Path, tmp_path: Path) -> None:
    """The end empties the window; going on takes that back."""
    messages = some_messages()
    end = run(tmp_path, ListSource(messages), config=RunnerConfig(2.0, duration_s=7.0))
    assert end.reason is StopReason.DURATION
    assert read_results(tmp_path).summary["ended"] == StopReason.DURATION.value
    run(tmp_path, ListSource(messages))
    assert_same(whole, tmp_path)


@pytest.mark.parametrize("n_damaged", [1, 2])
def test_damaged_checkpoints_cost_time_only(whole: Path, tmp_path: Path, n_damaged: int) -> None:
    """The older one, or the whole log, leads to the same results; it is said."""
    messages = some_messages()
    with pytest.raises(Crash):
        run(tmp_path, ListSource(messages, crash_after=400))
    newest = tmp_path / CHECKPOINT_NAME
    for path in (newest, older_name(newest))[:n_damaged]:
        path.write_bytes(path.read_bytes()[:-100])
    run(tmp_path, ListSource(messages))
    assert_same(whole, tmp_path)
    assert "resumed_with_loss" in kinds(tmp_path)


def test_a_checkpoint_that_cannot_be_restored_is_left_out(whole: Path, tmp_path: Path) -> None:
    """After an update of the program, for example: the log is gone through from its begin."""
    messages = some_messages()
    with pytest.raises(Crash):
        run(tmp_path, ListSource(messages, crash_after=400))

    def restore(*_: object) -> FakeEstimator:
        raise KeyError("a state of another version")

    run(tmp_path, ListSource(messages), Engine(FakeEstimator, restore))
    assert_same(whole, tmp_path)
    assert {"restore_failed", "resumed_with_loss"} <= set(kinds(tmp_path))


def test_results_that_a_power_failure_took_are_missed(tmp_path: Path) -> None:
    """A table that is shorter than the checkpoint knew it is said; the run goes on."""
    messages = some_messages()
    with pytest.raises(Crash):
        run(tmp_path, ListSource(messages, crash_after=400))
    (tmp_path / "beams.csv").write_text("time_s,beam,innovation_m_per_s,mahalanobis_sq,weight\n")
    run(tmp_path, ListSource(messages))
    (said,) = (e for e in events_of(tmp_path) if e["kind"] == "resumed_with_loss")
    assert "beams.csv" in said["text"]


def test_other_vehicles_settings_and_folders_are_refused(whole: Path, tmp_path: Path) -> None:
    """A run belongs to one vehicle, one set of settings and one process."""
    with pytest.raises(ConfigError, match=r"lag_s = 3\.0, not 5\.0"):
        run_folder(whole, lag_s=5.0)
    with pytest.raises(ConfigError, match="beam_noise_m_per_s"):
        RunFolder(whole, replace(vehicle(), beam_sigma=0.5), {"lag_s": 3.0})
    assert read_results(whole).summary["is_good"]
    with run_lock(tmp_path / "new"), pytest.raises(ConfigError, match="another process"):
        run_folder(tmp_path / "new")
    (tmp_path / "m").mkdir()
    (tmp_path / "m" / "mission.toml").write_text("")
    with pytest.raises(ConfigError, match="of something else"):
        run_folder(tmp_path / "m")
    (tmp_path / "new" / "run.json").write_text("{")
    with pytest.raises(DataError, match=r"run\.json"):
        run_folder(tmp_path / "new")
    (tmp_path / "file").write_text("")
    with pytest.raises(DataError, match="cannot be written"):
        run_folder(tmp_path / "file" / "run")


class run_lock:
    """Holds a run folder."""

    def __init__(self, path: Path) -> None:
        self.folder = run_folder(path)

    def __enter__(self) -> RunFolder:
        return self.folder

    def __exit__(self, *_: object) -> None:
        self.folder.close()


def test_a_message_is_logged_before_it_is_used(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whatever the estimator does to the process, all that had come is on the disk."""
    order: list[str] = []
    append = RawLog.append

    def logged(log: RawLog, message: Message) -> None:
        order.append("log")
        append(log, message)

    monkeypatch.setattr(RawLog, "append", logged)

    class Watching(FakeEstimator):
        def push(self, message: Message) -> None:
            order.append("push")
            super().push(message)

    run(tmp_path, ListSource(some_messages(20)), Engine(Watching, Watching.restore))
    batches = [7, 7, 7, 4]
    assert order == [what for n in batches for what in ["log"] * n + ["push"] * n]


class Failing(FakeEstimator):
    """Fails at every message whose number is in ``at``."""

    at: Sequence[int] = ()
    error: type[BaseException] = ZeroDivisionError

    def push(self, message: Message) -> None:
        """Fail or not."""
        super().push(message)
        if self.n_pushed in self.at:
            raise self.error("a defect")


def failing(at: Sequence[int], error: type[BaseException] = ZeroDivisionError) -> Engine:
    """Return estimators that fail."""

    class Made(Failing):
        pass

    Made.at, Made.error = at, error
    return Engine(Made, Made.restore)


def test_a_defect_of_the_estimator_does_not_end_the_run(tmp_path: Path) -> None:
    """It is told with its place; the messages after it are pushed as ever."""
    end = run(tmp_path, ListSource(some_messages()), failing([7, *range(200, 290)]))
    assert end.reason is StopReason.SOURCE_ENDED
    assert end.n_errors == 91
    told = [e for e in events_of(tmp_path) if e["kind"] == "estimator_failed"]
    assert 1 <= len(told) <= 3
    assert told[0]["severity"] == "error"
    assert "ZeroDivisionError: a defect" in told[0]["text"]
    assert "test_live_runner.py:" in told[0]["text"]


def test_an_estimator_that_always_fails_ends_the_run(tmp_path: Path) -> None:
    """A hundred messages in a row are not bad data any more."""
    end = run(tmp_path, ListSource(some_messages(), batch=1), failing(range(50, 1000)))
    assert end.reason is StopReason.FAILED
    assert end.n_messages == 50 + MOST_FAILURES
    assert read_results(tmp_path).summary["ended"] == StopReason.FAILED.value


@pytest.mark.parametrize("error", [KeyboardInterrupt, SystemExit])
def test_interrupts_pass_and_leave_everything_closed(
    tmp_path: Path, whole: Path, error: type[BaseException]
) -> None:
    """The second Ctrl-C ends at once; the run can be gone on with."""
    with pytest.raises(error):
        run(tmp_path, ListSource(some_messages()), failing([200], error))
    run(tmp_path, ListSource(some_messages()))
    for name in ("trajectory.csv", "log/dvl.csv"):
        assert (tmp_path / name).read_bytes() == (whole / name).read_bytes()


def test_every_other_defect_is_survived_too(tmp_path: Path) -> None:
    """Of answers, events, results, checkpoints, outputs, and of who shows it."""

    class Broken(FakeEstimator):
        def newest(self) -> Navigation | None:
            raise ValueError("no answer")

        def take_events(self) -> Sequence[Event]:
            raise ValueError("no events")

        def take_delayed(self) -> Any:
            raise ValueError("no states")

        def finish(self) -> Any:
            raise ValueError("no end")

        def checkpoint(self) -> Any:
            raise ValueError("no checkpoint")

    def show(_: RunStatus) -> None:
        raise BrokenPipeError("no terminal")

    end = run(tmp_path, ListSource(some_messages()), Engine(Broken, Broken.restore), on_status=show)
    assert end.reason is StopReason.SOURCE_ENDED
    assert end.navigation is None
    assert {"estimator_failed", "results_failed", "checkpoint_failed", "status_failed"} <= set(
        kinds(tmp_path)
    )

    class Deaf(Recorder):
        def send(self, *_: object) -> None:
            raise OSError("cable")

    run(tmp_path / "deaf", ListSource(some_messages()), outlet=Deaf())
    assert "publish_failed" in kinds(tmp_path / "deaf")


def test_a_full_disk_is_said_and_no_checkpoint_counts_on_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Navigation goes on; a restart must not skip what was never written."""
    monkeypatch.setattr(RawLog, "problems", lambda _: "raw log: no space left")
    run(tmp_path, ListSource(some_messages()))
    assert "disk" in kinds(tmp_path)
    assert not (tmp_path / CHECKPOINT_NAME).exists()


def test_a_slow_disk_does_not_hold_up_the_loop(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A checkpoint that is due while the last one is on its way waits, and it is said."""
    monkeypatch.setattr("ssm_graph.live.run.disk.CheckpointWriter.is_busy", True)
    ticks = iter(range(100_000))
    run(tmp_path, ListSource(some_messages()), steady_s=lambda: float(next(ticks)))
    assert "checkpoint_late" in kinds(tmp_path)


def test_no_message_waits_for_the_disk_to_confirm(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """While a run goes on only threads of the disk wait for fsync, each second of it anew."""
    waited: list[tuple[bool, int]] = []
    source = ListSource(some_messages())
    clock_file = ClockFile(tmp_path, boot="a")

    def fsync(_: int) -> None:
        waited.append((threading.current_thread() is threading.main_thread(), source._n_given))

    class Setting(FakeEstimator):
        def push(self, message: Message) -> None:
            """Have the clock be set as well."""
            super().push(message)
            assert clock_file.note(message.time_s, 30.0, 0.0) is None

    monkeypatch.setattr(os, "fsync", fsync)
    ticks = iter(range(100_000))
    run(tmp_path, source, Engine(Setting, Setting.restore), steady_s=lambda: float(next(ticks)))
    on_the_way = [is_main for is_main, n_given in waited if 0 < n_given < len(some_messages())]
    assert len(on_the_way) > 10
    assert not any(on_the_way)


def test_what_a_source_says_at_the_end_is_an_event(tmp_path: Path) -> None:
    """It is told what was refused then."""
    source = ListSource(some_messages())
    source.last_events = [Event(1.0, Severity.WARNING, "clock_refused", "3 pings")]
    run(tmp_path, source)
    assert "clock_refused" in kinds(tmp_path)


def test_a_checkpoint_that_fails_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever goes wrong in the thread that writes it."""

    def fail(*_: object) -> None:
        raise OSError("no space left")

    monkeypatch.setattr("ssm_graph.live.run.disk.write_checkpoint", fail)
    run(tmp_path, ListSource(some_messages()))
    assert "checkpoint_failed" in kinds(tmp_path)


def test_answers_go_out_at_their_rates(tmp_path: Path) -> None:
    """JSON with every batch up to its rate, NMEA once a second, nothing before the first answer."""
    outlet = Recorder()
    messages = some_messages(200)
    run(tmp_path / "a", ListSource(messages, batch=1), outlet=outlet)
    lines = [json.loads(data) for form, data in outlet.sent if form is OutputFormat.JSON]
    assert len(lines) == pytest.approx(200, abs=5)
    assert all(line["type"] == "navigation" for line in lines)
    sentences = [data for form, data in outlet.sent if form is OutputFormat.NMEA]
    assert len(sentences) == pytest.approx(10, abs=1)
    assert all(data.startswith(b"$INGGA") for data in sentences)
    outlet = Recorder(OutputFormat.JSON)
    run(
        tmp_path / "b", ListSource(messages, batch=1), outlet=outlet, publisher=Publisher(rate_hz=2)
    )
    assert len(outlet.sent) == pytest.approx(20, abs=1)


def test_wrong_rates_are_refused() -> None:
    """Before anything begins."""
    with pytest.raises(ConfigError, match="output rate"):
        Publisher(rate_hz=0.0)
    with pytest.raises(ConfigError, match="NMEA rate"):
        Publisher(nmea_rate_hz=float("nan"))
    with pytest.raises(ConfigError, match="checkpoint_every_s"):
        RunnerConfig(checkpoint_every_s=-1.0)
    with pytest.raises(ConfigError, match="speed"):
        ReplaySource([], speed=0.0)


def test_every_survives_clocks_that_are_set() -> None:
    """An interval may be a rounding short; a jump back begins anew, and so does one forward."""
    every = Every(0.1)
    due = [now for now in (0.0, 0.05, 0.1 - 1e-12, 0.15, -50.0, -49.95, 9e9) if every.is_due(now)]
    assert due == [0.1 - 1e-12, -50.0, 9e9]
    assert Every(1.0, at_once=True).is_due(5.0)


def test_stop_ends_in_order(tmp_path: Path) -> None:
    """As a signal handler asks for it."""
    source = ListSource(some_messages())
    runner = Runner(run_folder(tmp_path), FAKE, connect(source), config=OFTEN)

    def stop_at_100(timeout_s: float) -> list[Message]:
        if source._n_given >= 100:
            runner.stop()
        return ListSource.poll(source, timeout_s)

    source.poll = stop_at_100  # type: ignore[method-assign]
    end = runner.run()
    assert end.reason is StopReason.ASKED
    assert 100 <= end.n_messages < 120
    assert read_results(tmp_path).summary["n_messages"] == end.n_messages


def test_stop_while_catching_up_leaves_all_as_it_was(whole: Path, tmp_path: Path) -> None:
    """Half a log gone through is no end; the next process does it again."""
    messages = some_messages()
    with pytest.raises(Crash):
        run(tmp_path, ListSource(messages, crash_after=251))
    runner = Runner(run_folder(tmp_path), FAKE, connect(ListSource(messages)))
    runner.stop()
    with pytest.raises(KeyboardInterrupt):
        runner.run()
    run(tmp_path, ListSource(messages))
    assert_same(whole, tmp_path)


def test_status_tells_everything(tmp_path: Path) -> None:
    """Twice a second of the steady clock, at the begin and before the end."""
    shown: list[RunStatus] = []
    source = ListSource(some_messages(), batch=1)
    source.events = [Event(100.0, Severity.WARNING, "connect_failed", "dvl: no route")]
    ticks = iter(range(100_000))
    run(tmp_path, source, on_status=shown.append, steady_s=lambda: 0.05 * next(ticks))
    assert 30 < len(shown) < 300
    assert shown[0].navigation is None
    assert shown[0].reason == "waiting for a ping"
    assert shown[0].events[0].kind == "connect_failed"
    last = shown[-1]
    assert last.n_messages == 500
    assert last.note == "writing the last results"
    assert last.navigation is not None
    assert last.latency is not None
    assert last.latency.median_s <= last.latency.p99_s <= last.latency.max_s
    assert last.checkpoint_age_s < 2.5
    assert last.outputs[0].name == "recorder"
    assert last.sources[0].n_messages == 500


def test_a_replay_keeps_the_pace() -> None:
    """Messages come when their time has come, at N times the speed of the clock."""
    now = [50.0]

    def wait(seconds: float) -> None:
        now[0] += seconds

    messages = some_messages(40)
    source = ReplaySource(messages, speed=10.0, wait=wait, steady_s=lambda: now[0], end_s=2.0)
    got: list[Message] = []
    while not source.is_finished:
        batch = source.poll(0.02)
        got += batch
        for message in batch:
            due_s = 50.0 + (message.time_s - 0.05) / 10.0
            assert due_s - 1e-9 <= now[0] <= due_s + 0.02
    assert got == messages
    assert now[0] == pytest.approx(50.0 + 1.95 / 10.0, abs=0.02)
    (status,) = source.source_status()
    assert status.state is LinkState.DONE
    assert "% done" in status.address
    assert source.elapsed_s == pytest.approx(1.94)
    assert source.take_events() == []


def test_a_replay_at_full_speed_gives_one_sample_at_a_time() -> None:
    """So that answers do not depend on how fast the computer is; earlier messages are left out."""
    messages = some_messages(40)
    altitude = np.array([0.5, 1.0]), np.array([7.0, np.nan])
    source = ReplaySource(messages, skip=10, altitude=altitude)
    got: list[Message] = []
    while not source.is_finished:
        batch = source.poll(1.0)
        heard = source.source_status()[0].altitude_m
        assert heard == 7.0 if source.time_s >= 0.5 else np.isnan(heard)
        assert sum(isinstance(message, ImuSample) for message in batch) <= 1
        assert isinstance(batch[0], ImuSample) or not got
        got += batch
    assert got == messages[10:]
    assert any(isinstance(message, Ping) for message in got)
    assert ReplaySource([]).is_finished


def test_connections_are_opened_after_the_log_is_gone_through(tmp_path: Path) -> None:
    """What comes meanwhile would wait in the sockets and be late."""
    messages = some_messages()
    with pytest.raises(Crash):
        run(tmp_path, ListSource(messages, crash_after=251))
    opened: list[int] = []

    def open_all(n_messages: int) -> Connections:
        opened.append(n_messages)
        source = ListSource(messages)
        source._n_given = n_messages
        return Connections(source, Recorder())

    Runner(run_folder(tmp_path), FAKE, open_all).run()
    assert opened == [252]
