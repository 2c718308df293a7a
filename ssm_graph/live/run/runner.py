"""The loop of a live run: receive, log, estimate, publish, keep; nothing that comes in ends it."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

from ssm_graph.base.errors import ConfigError
from ssm_graph.live.run.interfaces import Connect, Connections, Delayed, Engine, Source
from ssm_graph.live.run.notices import Notices
from ssm_graph.live.run.run_folder import Resumed, RunFolder
from ssm_graph.live.run.run_summary import MOST_FAILURES, RunEnd, StopReason, summary_of
from ssm_graph.live.sockets.publisher import Every, Outlet, Publisher
from ssm_graph.mission.estimate import Found
from ssm_graph.mission.navigation import Event, Navigation, Severity
from ssm_graph.mission.run_status import Latency, RunStatus
from ssm_graph.sensors.imu import ImuSample
from ssm_graph.sensors.messages import Message

POLL_S: Final = 0.05
LATE_S: Final = 5.0
"""A disk that needs longer for a checkpoint is complained of."""
N_EVENTS: Final = 8
"""Shown to a person."""


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

    Parameters
    ----------
    folder : where everything goes, and where an earlier process of the same run left it.
    engine : makes the estimator.
    connect : opens sockets, once an earlier process has been caught up with.
    publisher, config : what goes out and how often.
    on_status : told twice a second how it goes.
    steady_s : a clock that is never set.
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
        self._notices = Notices(self._now_s, steady_s)
        self._connections: Connections | None = None
        self._data_s, self._n_messages, self._n_failures = 0.0, 0, 0
        self._checkpoint_s, self._written_s = float("-inf"), 0.0
        self._is_checkpoint_due = False
        self._asked = False
        self._note = ""
        self._navigation: Navigation | None = None
        self._events: deque[Event] = deque(maxlen=N_EVENTS)
        self._latencies: deque[float] = deque(maxlen=1000)
        self._checkpoints = Every(self.config.checkpoint_every_s)
        self._delayed = Every(self.config.delayed_every_s)
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
                for message in messages:
                    try:
                        log.append(message)
                    except Exception as error:
                        self._notices.failure("raw log", "log_failed", error)
                    self._push(message)
                if messages:
                    self._publish(outlet, source.time_s)
                    self._latencies.append(self._steady_s() - begin_s)
                self._keep(source)
            return self._end(reason)
        finally:
            self.folder.close()

    def _reason(self, source: Source) -> StopReason | None:
        if self._n_failures > MOST_FAILURES:
            return StopReason.FAILED
        if self._asked:
            return StopReason.ASKED
        if source.is_finished:
            return StopReason.SOURCE_ENDED
        duration_s = self.config.duration_s
        return (
            StopReason.DURATION
            if duration_s is not None and source.elapsed_s >= duration_s
            else None
        )

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
            self._notices.tell("run", "resumed", text, Severity.INFO)
        for note in resumed.notes:
            self._notices.tell("run", "resumed_with_loss", note, Severity.WARNING, burst=10)

    def _restored(self, resumed: Resumed) -> Resumed:
        """Make the estimator; return where it is."""
        if resumed.n_messages:
            try:
                self._estimator = self._engine.restore(resumed.arrays, resumed.meta)
                return resumed
            except Exception as error:
                self._notices.failure("checkpoint", "restore_failed", error)
                resumed = resumed.without_checkpoint(
                    "the checkpoint could not be restored; the whole log was gone through"
                )
        self._estimator = self._engine.new()
        return resumed

    def _push(self, message: Message) -> None:
        self._n_messages += 1
        if isinstance(message, ImuSample) or self._data_s == 0.0:
            self._data_s = message.time_s
        try:
            self._estimator.push(message)
            self._n_failures = 0
        except Exception as error:
            self._n_failures += 1
            self._notices.failure("estimator", "estimator_failed", error)

    def _publish(self, outlet: Outlet, now_s: float) -> None:
        for form in self._publisher.due(outlet, now_s):
            navigation = self._newest()
            if navigation is not None:
                try:
                    self._publisher.send(outlet, form, navigation)
                except Exception as error:
                    self._notices.failure("publisher", "publish_failed", error)

    def _newest(self) -> Navigation | None:
        """Return the newest answer; the one before where it cannot be had."""
        try:
            self._navigation = self._estimator.newest()
        except Exception as error:
            self._notices.failure("estimator", "estimator_failed", error)
        return self._navigation

    def _found(self) -> Found:
        try:
            return self._estimator.found()
        except Exception as error:
            self._notices.failure("estimator", "estimator_failed", error)
            return Found()

    def _keep(self, source: Source) -> None:
        """Write what has come about, and show it."""
        for event in source.take_events():
            self._note_event(event)
        self._keep_results()
        self._keep_checkpoint()
        problem = self.folder.problems()
        if problem is not None:
            self._notices.tell("disk", "disk", problem, Severity.ERROR)
        self._show()

    def _keep_results(self) -> None:
        self._take_events()
        if self._delayed.is_due(self._data_s):
            self._write_delayed(self._estimator.take_delayed)

    def _take_events(self) -> None:
        try:
            for event in self._estimator.take_events():
                self._note_event(event)
        except Exception as error:
            self._notices.failure("estimator", "estimator_failed", error)
        for event in self._notices.take():
            self._note_event(event)

    def _note_event(self, event: Event) -> None:
        self._events.append(event)
        self.folder.write_event(event)

    def _write_delayed(self, take: Callable[[], Sequence[Delayed]]) -> None:
        assert self.folder.results is not None
        try:
            for delayed in take():
                self.folder.results.append(delayed.trajectory, delayed.beams, delayed.current)
        except Exception as error:
            self._notices.failure("results", "results_failed", error)

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
            self._notices.tell("checkpoint", "checkpoint_late", text, Severity.WARNING)

    def _tell_unwritten(self) -> None:
        error = self.folder.writer.take_error()
        if error is not None:
            self._notices.failure("checkpoint", "checkpoint_failed", error)

    def _write_checkpoint(self) -> None:
        self._written_s = self._steady_s()
        self._write_delayed(self._estimator.take_delayed)
        self._take_events()
        if self.folder.problems() is not None:  # it would count on what is not on the disk
            return
        try:
            arrays, meta = self._estimator.checkpoint()
            self.folder.write_checkpoint(
                arrays, meta, n_messages=self._n_messages, data_s=self._data_s
            )
            self._checkpoint_s = self._data_s
        except Exception as failure:
            self._notices.failure("checkpoint", "checkpoint_failed", failure)

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
        self._notices.tell("run", "ended", reason.value, Severity.INFO)
        self._take_events()
        end = RunEnd(reason, navigation, found, self._n_messages, self._notices.n_errors)
        assert self.folder.results is not None
        self.folder.results.finish(summary_of(self.folder, end))
        return end

    def _show(self, *, at_once: bool = False) -> None:
        if self._on_status is None or not (self._status.is_due(self._steady_s()) or at_once):
            return
        try:
            self._on_status(self._run_status())
        except Exception as error:
            self._notices.failure("status", "status_failed", error)

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
            events=tuple(self._events),
            log_problem=self.folder.problems(),
            checkpoint_age_s=self._data_s - self._checkpoint_s,
            found=self._found(),
            note=self._note,
        )
