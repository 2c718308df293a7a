"""The loop of a live run: receive, log, estimate, publish, keep; nothing that comes in ends it."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from enum import Enum
from typing import Any, Final, NamedTuple, Protocol

from ssm_graph.base.errors import ConfigError
from ssm_graph.base.frozen import Array
from ssm_graph.io.raw_log.log import RawLog
from ssm_graph.io.results.summary import as_json, calibration_fields, current_fields, versions
from ssm_graph.live.protocols.json_messages import navigation_fields
from ssm_graph.live.run.run_folder import LOG_NAME, Resumed, RunFolder
from ssm_graph.live.sockets.outputs import Every, Outlet, Publisher
from ssm_graph.mission.estimate import (
    BeamTable,
    CurrentTrack,
    Found,
    ProtectionTrack,
    Status,
    Trajectory,
)
from ssm_graph.mission.events import EventLog
from ssm_graph.mission.navigation import Event, Health, Navigation, Severity
from ssm_graph.mission.run_status import Latency, RunStatus, SourceStatus
from ssm_graph.sensors.imu import ImuSample
from ssm_graph.sensors.messages import Message, Readings

POLL_S: Final = 0.05
LATE_S: Final = 5.0
"""A disk that needs longer for a checkpoint is complained of."""
WATCH_S: Final = 1.0
"""From one look after the files of the run to the next."""
N_EVENTS: Final = 8
"""Shown to a person."""
MOST_FAILURES: Final = 100
"""Messages in a row that an estimator may fail at before the run is given up."""
_STATUS: Final = {
    Health.GOOD: Status.CONVERGED,
    Health.DEGRADED: Status.SUSPECT,
    Health.BAD: Status.DIVERGED,
    Health.ALIGNING: Status.SUSPECT,
}


class StopReason(Enum):
    """Why a run ended; the text is shown to the user."""

    SOURCE_ENDED = "all messages were given"
    ASKED = "it was asked to stop"
    DURATION = "its time was over"
    FAILED = f"the estimator failed at {MOST_FAILURES} messages in a row: a defect"


class RunEnd(NamedTuple):
    """How a run ended."""

    reason: StopReason
    navigation: Navigation | None
    """The last answer."""
    found: Found
    """What was known then beside it."""
    n_messages: int
    n_errors: int
    """Exceptions that nobody expected and the run survived."""
    notes: tuple[str, ...] = ()
    """What is not on the disk, or was altered there by somebody, one sentence each."""


class Delayed(Protocol):
    """Successive states that nothing will change any more."""

    @property
    def trajectory(self) -> Trajectory: ...  # noqa: D102
    @property
    def beams(self) -> BeamTable: ...  # noqa: D102
    @property
    def current(self) -> CurrentTrack | None: ...  # noqa: D102
    @property
    def protection(self) -> ProtectionTrack | None: ...  # noqa: D102


class Estimator(Protocol):
    """What is run: `ssm_graph.live.estimator.FixedLagSmoother`, or a stand-in for it."""

    def push(self, message: Message) -> None: ...  # noqa: D102
    def newest(self) -> Navigation | None: ...  # noqa: D102
    def found(self) -> Found: ...  # noqa: D102
    def status(self) -> tuple[Health, str]: ...  # noqa: D102
    def take_events(self) -> Sequence[Event]: ...  # noqa: D102
    def take_delayed(self) -> Sequence[Delayed]: ...  # noqa: D102
    def finish(self) -> Sequence[Delayed]: ...  # noqa: D102
    def checkpoint(self) -> tuple[Mapping[str, Array], Mapping[str, Any]]: ...  # noqa: D102


class Engine(NamedTuple):
    """How an estimator is made."""

    new: Callable[[], Estimator]
    restore: Callable[[Mapping[str, Array], Mapping[str, Any]], Estimator]
    """From the arrays and the meta values of a checkpoint."""


class Source(Protocol):
    """Where messages come from."""

    @property
    def is_finished(self) -> bool: ...  # noqa: D102
    @property
    def time_s(self) -> float: ...  # noqa: D102
    @property
    def elapsed_s(self) -> float: ...  # noqa: D102
    def poll(self, timeout_s: float) -> list[Message]: ...  # noqa: D102
    def waiting(self) -> Sequence[Readings]: ...  # noqa: D102
    def end(self) -> Sequence[Message]: ...  # noqa: D102
    def take_events(self) -> Sequence[Event]: ...  # noqa: D102
    def source_status(self) -> tuple[SourceStatus, ...]: ...  # noqa: D102


class Connections(NamedTuple):
    """What a run is connected with."""

    source: Source
    outlet: Outlet


Connect = Callable[[int], Connections]
"""Opens the connections, told how many messages earlier processes of the run were given."""


@dataclass(frozen=True, slots=True)
class RunnerConfig:
    """How often what is done."""

    checkpoint_every_s: float = 10.0
    """Of data time."""
    delayed_every_s: float = 1.0
    """Of data time, from one writing of smoothed states to the next."""
    status_every_s: float = 0.5
    duration_s: float | None = None
    """The run ends by itself then."""

    def __post_init__(self) -> None:
        for name in ("checkpoint_every_s", "delayed_every_s", "status_every_s", "duration_s"):
            value = getattr(self, name)
            if value is not None and not 0.0 < value < float("inf"):
                raise ConfigError(f"{name}: expected a number above 0, got {value}")


class Runner:
    """Runs an estimator until it is told to stop, or its source ends.

    ``connect`` opens sockets once an earlier process of the same run has been caught up with;
    ``on_status`` is told twice a second how it goes; ``steady_s`` is a clock that is never set.
    """

    def __init__(
        self,
        folder: RunFolder,
        engine: Engine,
        connect: Connect,
        *,
        publisher: Publisher | None = None,
        config: RunnerConfig | None = None,
        on_status: Callable[[RunStatus], None] | None = None,
        steady_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self.folder, self.config = folder, config or RunnerConfig()
        self._engine, self._connect = engine, connect
        self._publisher = publisher or Publisher()
        self._on_status, self._steady_s = on_status, steady_s
        self._events = EventLog(self._now_s, steady_s)
        self._connections: Connections | None = None
        self._data_s, self._n_messages, self._n_failures = 0.0, 0, 0
        self._checkpoint_s, self._written_s = float("-inf"), 0.0
        self._is_checkpoint_due = False
        self._asked = False
        self._note = ""
        self._navigation: Navigation | None = None
        self._shown: deque[Event] = deque(maxlen=N_EVENTS)
        self._latencies: deque[float] = deque(maxlen=1000)
        self._checkpoints = Every(self.config.checkpoint_every_s)
        self._delayed = Every(self.config.delayed_every_s)
        self._watch = Every(WATCH_S)
        self._status = Every(self.config.status_every_s, at_once=True)

    def stop(self) -> None:
        """Ask the run to end; may be called by a signal handler."""
        self._asked = True

    def run(self) -> RunEnd:
        """Catch up with an earlier process, then run; all files are whole when this returns."""
        try:
            self._recover()
            log = self.folder.open_log()
            source, outlet = self._connections = self._connect(self._n_messages)
            while (reason := self._reason(source)) is None:
                messages = source.poll(POLL_S)
                begin_s = self._steady_s()
                self._take(messages, source.waiting(), log)
                if messages:
                    self._publish(outlet, source.time_s)
                    self._latencies.append(self._steady_s() - begin_s)
                self._keep()
            self._take(source.end(), (), log)
            return self._end(reason)
        finally:
            self.folder.close()

    def _take(self, messages: Sequence[Message], waiting: Sequence[Readings], log: RawLog) -> None:
        """Log messages, all that have come and what waits; then use them."""
        for message in messages:
            with self._events.surviving("raw log", "log_failed"):
                log.append(message)
        with self._events.surviving("raw log", "log_failed"):
            log.hold(waiting)
        for message in messages:
            self._push(message)

    def _reason(self, source: Source) -> StopReason | None:
        if self._n_failures > MOST_FAILURES:
            return StopReason.FAILED
        if self._asked:
            return StopReason.ASKED
        if source.is_finished:
            return StopReason.SOURCE_ENDED
        is_over = source.elapsed_s >= (self.config.duration_s or math.inf)
        return StopReason.DURATION if is_over else None

    def _now_s(self) -> float:
        return self._data_s if self._connections is None else self._connections.source.time_s

    def _recover(self) -> None:
        """Bring the estimator to where an earlier process was when it ended, however it did."""
        resumed = self._restored(self.folder.resume())
        self._n_messages, self._data_s = resumed.n_messages, resumed.data_s
        n_before = self._n_messages
        for message in self.folder.logged(resumed):
            if self._asked:  # nothing has changed yet: the next process goes through it again
                raise KeyboardInterrupt
            self._push(message)
            self._keep_results()
            if (self._n_messages - n_before) % 256 == 1:
                self._note = f"going through the log: {self._n_messages - n_before} messages"
                self._show()
        self._take_events()
        self._note = ""
        if self._n_messages:
            text = (
                f"gone on with: {n_before} messages from the checkpoint and "
                f"{self._n_messages - n_before} from the log after it"
            )
            self._events.note("run", "resumed", text, Severity.INFO)
        for note in resumed.notes:
            self._events.note("run", "resumed_with_loss", note, Severity.WARNING, burst=10)

    def _restored(self, resumed: Resumed) -> Resumed:
        """Make the estimator; return where it is."""
        if resumed.n_messages:
            try:
                self._estimator = self._engine.restore(resumed.arrays, resumed.meta)
                return resumed
            except Exception as error:
                self._events.failure("checkpoint", "restore_failed", error)
                lost = "the checkpoint could not be restored; the whole log was gone through"
                resumed = Resumed(notes=(*resumed.notes, lost))
        self._estimator = self._engine.new()
        return resumed

    def _push(self, message: Message) -> None:
        self._n_messages += 1
        if isinstance(message, ImuSample) or self._data_s == 0.0:
            self._data_s = message.time_s
        self._n_failures += 1
        with self._of_estimator():
            self._estimator.push(message)
            self._n_failures = 0

    def _of_estimator(self) -> AbstractContextManager[None]:
        return self._events.surviving("estimator", "estimator_failed")

    def _publish(self, outlet: Outlet, now_s: float) -> None:
        for form in self._publisher.due(outlet, now_s):
            navigation = self._newest()
            if navigation is not None:
                with self._events.surviving("publisher", "publish_failed"):
                    self._publisher.send(outlet, form, navigation)

    def _newest(self) -> Navigation | None:
        """Return the newest answer; the one before where it cannot be had."""
        with self._of_estimator():
            self._navigation = self._estimator.newest()
        return self._navigation

    def _found(self) -> Found:
        found = Found()
        with self._of_estimator():
            found = self._estimator.found()
        return found

    def _keep(self) -> None:
        """Write what has come about, and show it."""
        if self._watch.is_due(self._steady_s()):
            self.folder.syncer.begin()
            for text in self.folder.regain():
                self._events.note("disk", "file_altered", text, Severity.ERROR, burst=20)
                self._is_checkpoint_due = True  # the last one knows the files of before
        self._keep_results()
        self._keep_checkpoint()
        if (problem := self.folder.problems()) is not None:
            self._events.note("disk", "disk", problem, Severity.ERROR)
        self._show()

    def _keep_results(self) -> None:
        self._take_events()
        if self._delayed.is_due(self._data_s):
            self._write_delayed(self._estimator.take_delayed)

    def _take_events(self) -> None:
        if self._connections is not None:
            for event in self._connections.source.take_events():
                self._note_event(event)
        with self._of_estimator():
            for event in self._estimator.take_events():
                self._note_event(event)
        for event in self._events.take():
            self._note_event(event)

    def _note_event(self, event: Event) -> None:
        self._shown.append(event)
        self.folder.write_event(event)

    def _write_delayed(self, take: Callable[[], Sequence[Delayed]]) -> None:
        assert self.folder.results is not None
        with self._events.surviving("results", "results_failed"):
            for delayed in take():
                self.folder.results.append(
                    delayed.trajectory, delayed.beams, delayed.current, delayed.protection
                )

    def _keep_checkpoint(self) -> None:
        """Write one where it is due and the disk is done with the last one."""
        self._tell_unwritten()
        if self._checkpoints.is_due(self._data_s):
            self._is_checkpoint_due = True
        if not self._is_checkpoint_due:
            return
        if not self.folder.writer.is_busy:
            self._is_checkpoint_due = False
            self._write_checkpoint()
        elif self._steady_s() - self._written_s > LATE_S:
            text = f"the disk has been busy with the last one for more than {LATE_S:g} s"
            self._events.note("checkpoint", "checkpoint_late", text, Severity.WARNING)

    def _tell_unwritten(self) -> None:
        error = self.folder.writer.take_error()
        if error is not None:
            self._events.failure("checkpoint", "checkpoint_failed", error)

    def _write_checkpoint(self) -> None:
        self._written_s = self._steady_s()
        self._write_delayed(self._estimator.take_delayed)
        self._take_events()
        if self.folder.problems() is not None:  # it would count on what is not on the disk
            return
        with self._events.surviving("checkpoint", "checkpoint_failed"):
            n_messages, data_s = self._n_messages, self._data_s
            self.folder.write_checkpoint(
                *self._estimator.checkpoint(), n_messages=n_messages, data_s=data_s
            )
            self._checkpoint_s = data_s

    def _end(self, reason: StopReason) -> RunEnd:
        self._note = "writing the last results"
        self._show(at_once=True)  # for the last time: then there is no newest state any more
        self.folder.writer.wait()
        if reason is not StopReason.FAILED:
            self._write_checkpoint()  # before the window is emptied: a restart goes on from here
            self.folder.writer.wait()
        self._tell_unwritten()
        navigation, found = self._newest(), self._found()
        self._write_delayed(self._estimator.finish)
        self._events.note("run", "ended", reason.value, Severity.INFO)
        self._take_events()
        local = self.folder.vehicle.local
        said = () if local is None else (local.sentence,)
        notes = (*said, *self.folder.settle())
        end = RunEnd(reason, navigation, found, self._n_messages, self._events.n_errors, notes)
        assert self.folder.results is not None
        self.folder.results.finish(summary_of(self.folder, end))
        return end

    def _show(self, *, at_once: bool = False) -> None:
        if self._on_status is None or not (self._status.is_due(self._steady_s()) or at_once):
            return
        with self._events.surviving("status", "status_failed"):
            self._on_status(self._run_status())

    def _run_status(self) -> RunStatus:
        connections, navigation = self._connections, self._newest()
        return RunStatus(
            vehicle=self.folder.vehicle.name,
            folder=str(self.folder.path),
            elapsed_s=0.0 if connections is None else connections.source.elapsed_s,
            n_messages=self._n_messages,
            navigation=navigation,
            reason=self._estimator.status()[1] if navigation is None else navigation.reason,
            latency=Latency.of(self._latencies),
            sources=() if connections is None else connections.source.source_status(),
            outputs=() if connections is None else connections.outlet.output_status(),
            events=tuple(self._shown),
            log_problem=self.folder.problems(),
            checkpoint_age_s=self._data_s - self._checkpoint_s,
            found=self._found(),
            note=self._note,
        )


def summary_of(folder: RunFolder, end: RunEnd) -> dict[str, Any]:
    """Return how a run ended, in the terms of the summaries of other estimators."""
    navigation = end.navigation
    health = Health.ALIGNING if navigation is None else navigation.health
    status = _STATUS[health]
    summary: dict[str, Any] = {
        "mission": folder.vehicle.name,
        "method": "live fixed lag, delayed states",
        "kernel": folder.settings.get("kernel"),
        "status": status.name,
        "status_text": status.value,
        "is_good": status.is_good,
        "reason": health.value if navigation is None else navigation.reason,
        "ended": end.reason.value,
        "n_messages": end.n_messages,
        "raw_log": LOG_NAME,
        "newest": None if navigation is None else navigation_fields(navigation),
        **({} if folder.vehicle.local is None else {"local_start": folder.vehicle.local.sentence}),
        "settings": folder.settings,
        "calibration": calibration_fields(end.found.calibration),
        "current": current_fields(end.found.current),
        "notes": end.notes,
        "versions": versions(),
    }
    return {key: as_json(value) for key, value in summary.items()}
