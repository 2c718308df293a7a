"""All sockets of a live estimator in one thread; none of them can make another one wait."""

from __future__ import annotations

import math
import selectors
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Final, Self

from ssm_graph.live.protocols.decoder import Decoder
from ssm_graph.live.sockets.clocks import Now, RunClock, StampClocks, boot_s, called
from ssm_graph.live.sockets.endpoints import Endpoint, Transport
from ssm_graph.live.sockets.feed import Feed, Limits
from ssm_graph.live.sockets.inputs import Input, TcpClientInput, TcpServerInput, UdpInput
from ssm_graph.live.sockets.outputs import Output, OutputFormat, TcpServerOutput, UdpOutput
from ssm_graph.live.sockets.places import Known, Places
from ssm_graph.live.sockets.serial_port import SerialInput
from ssm_graph.mission.events import EventLog
from ssm_graph.mission.navigation import Event, Severity
from ssm_graph.mission.run_status import OutputStatus, SourceStatus
from ssm_graph.sensors.messages import Message, Readings

STANDSTILL_S: Final = 2.0
"""Nobody has looked after the sockets for longer: the process was stopped, or something hung."""
REMEMBER_S: Final = 1.0
"""From one time that it is remembered where instruments are heard to the next, if that changed."""


@dataclass(frozen=True, slots=True)
class InputConfig:
    """One source."""

    name: str
    endpoint: Endpoint
    make_decoder: Callable[[], Decoder]
    limits: Limits = Limits()


@dataclass(frozen=True, slots=True)
class OutputConfig:
    """One place that answers go to."""

    form: OutputFormat
    endpoint: Endpoint


class SocketHub:
    """Reads all sources and sends to all outputs.

    Raises :class:`ConfigError` for an unknown host, and for an address where nothing can listen.

    Connections are made on the way, again and again if need be. ``wall_s`` is the vehicle's clock,
    which stamps arrivals; ``steady_s`` one that is never set, for rates and patience. Messages are
    in the time of the run, which goes on where the vehicle's clock is set; ``set_by_s`` is by how
    much that was set in earlier processes of the run. ``note_clock`` remembers that: it is told the
    time of the run, how far the vehicle's clock is ahead of it, and the steady clock, all in s, at
    the begin and where the clock was set, and returns why it could not. ``known`` are places that
    kept others out in earlier processes of the run; ``note_places`` remembers those of this one,
    and returns why it could not.
    """

    is_finished = False
    """Sockets never are."""

    def __init__(
        self,
        inputs: Sequence[InputConfig] = (),
        outputs: Sequence[OutputConfig] = (),
        *,
        wall_s: Callable[[], float] = time.time,
        steady_s: Callable[[], float] = boot_s,
        set_by_s: float = 0.0,
        note_clock: Callable[[float, float, float], str | None] | None = None,
        known: Iterable[Known] = (),
        note_places: Callable[[Iterable[Known]], str | None] | None = None,
    ) -> None:
        self._steady_s = steady_s
        self._begin_s = self._polled_s = steady_s()
        self._clock = RunClock(wall_s, steady_s, set_by_s)
        self._note_clock = note_clock
        self._stamps = StampClocks(self._clock)
        self._places = Places(_still_there(known, inputs), self._begin_s)
        self._note_places, self._noted, self._noted_s = note_places, self._places.known(), -math.inf
        self._events = EventLog(lambda: self.time_s, steady_s)
        self._selector = selectors.DefaultSelector()
        self.inputs: list[Input] = []
        self.outputs: list[Output] = []
        self._keep_clock(Now(wall_s(), steady_s()))
        try:
            for wanted in inputs:
                self.inputs.append(self._input(wanted))
            for output in outputs:
                self.outputs.append(self._output(output))
        except BaseException:
            self.close()
            raise

    @property
    def _links(self) -> tuple[Input | Output, ...]:
        return (*self.inputs, *self.outputs)

    @property
    def time_s(self) -> float:
        """The time of the run: the vehicle's clock, less what it has been set by since, s."""
        return self._clock.time_s

    @property
    def set_by_s(self) -> float:
        """By how much the vehicle's clock has been set since the run began, s.

        0 where there are no sources: what is replayed has a time of its own.
        """
        return self._clock.set_by_s if self.inputs else 0.0

    @property
    def is_behind(self) -> bool:
        """Whether what came while this process stood still is not read to its end."""
        return any(source.is_behind for source in self.inputs)

    @property
    def elapsed_s(self) -> float:
        """Since the begin, s."""
        return self._steady_s() - self._begin_s

    def poll(self, timeout_s: float) -> list[Message]:
        """Wait until something comes, no longer than this; return what messages it completes."""
        ready = self._selector.select(max(0.0, timeout_s))
        now, step_s = self._clock.read()
        if step_s:
            text = f"the vehicle's clock was set by {step_s:+.6g} s"
            if self._clock.has_begun:
                text += ": the run goes on in its own time, answers are stamped by that clock"
            self._events.note("run", "clock_set", text, Severity.WARNING, burst=5)
            self._keep_clock(now)
        self._look_for_a_standstill(now, timeout_s)
        messages: list[Message] = []
        for key, mask in ready:
            try:
                if isinstance(key.data, TcpServerOutput):
                    key.data.on_ready(key.fileobj, mask, now)  # type: ignore[arg-type]
                else:
                    messages += key.data.on_ready(key.fileobj, now)
            except Exception as error:  # a defect: others go on
                self._events.failure(key.data.name, "socket_failed", error)
                key.data.abandon(key.fileobj)
        for link in self._links:
            with self._events.surviving(link.name, "socket_failed"):
                messages += link.tick(now) or []  # outputs have none
        self._keep_places(now)
        return messages

    def waiting(self) -> list[Readings]:
        """Return what has come and waits: for what tells its time, or for a sentence beside it."""
        now = self._now()
        return [*self._stamps.waiting(now), *self._held(now)]

    def end(self) -> list[Message]:
        """Return what waits, as is likelier now that nothing more comes; tell what is refused."""
        now = self._now()
        held = [readings[0] for readings in self._held(now)]
        messages, strangers = self._stamps.end(now)
        for source, left in strangers:
            text = f"{len(left)} {called(left[0])} of another clock, which waited for that to be "
            text += "believed when the run ended: refused"
            self._events.note(source or "imu", "clock_refused", text, Severity.WARNING, burst=20)
        return [*messages, *held]

    def _held(self, now: Now) -> list[Readings]:
        return [readings for source in self.inputs for readings in source.waiting(now)]

    def _now(self) -> Now:
        return Now(self._clock.time_s + self._clock.set_by_s, self._steady_s())

    def _keep_clock(self, now: Now) -> None:
        """Have it remembered how far the vehicle's clock is ahead of the time of the run."""
        if self._note_clock is not None:
            set_by_s = self._clock.set_by_s
            problem = self._note_clock(now.wall_s - set_by_s, set_by_s, now.steady_s)
            if problem is not None:
                self._events.note("disk", "disk", problem, Severity.ERROR)

    def _keep_places(self, now: Now) -> None:
        """Have it remembered where instruments are heard, where that has changed."""
        if self._note_places is None or now.steady_s - self._noted_s < REMEMBER_S:
            return
        self._noted_s, known = now.steady_s, self._places.known()
        if known != self._noted:
            problem = self._note_places(known)
            if problem is None:
                self._noted = known
            else:  # tried again and again
                self._events.note("disk", "disk", problem, Severity.ERROR)

    def _look_for_a_standstill(self, now: Now, timeout_s: float) -> None:
        """Notice where this process was stopped: what waits came at times that nobody knows."""
        span_s = now.steady_s - self._polled_s - max(0.0, timeout_s)
        self._polled_s = now.steady_s
        if self.inputs and span_s > STANDSTILL_S:
            text = f"this process stood still for {span_s:.1f} s; what came meanwhile is refused "
            text += "where only its arrival says when it was"
            self._events.note("run", "stood_still", text, Severity.WARNING)
            for source in self.inputs:
                source.stood_still(span_s)

    def wait(self, timeout_s: float) -> None:
        """Look after the outputs so long; for a run whose messages come from elsewhere."""
        end_s = self._steady_s() + timeout_s
        while True:
            self.poll(end_s - self._steady_s())
            if self._steady_s() >= end_s:
                return

    def wants(self, form: OutputFormat) -> bool:
        """Return whether anybody listens to answers of this form."""
        return any(output.form is form and output.n_clients for output in self.outputs)

    def send(self, form: OutputFormat, data: bytes) -> None:
        """Send an answer to everybody who listens to this form; never waits."""
        for output in self.outputs:
            if output.form is form:
                with self._events.surviving(output.name, "socket_failed"):
                    output.send(data)

    def take_events(self) -> tuple[Event, ...]:
        """Return what happened since the last call."""
        return self._events.take()

    def source_status(self) -> tuple[SourceStatus, ...]:
        """Return how the sources are doing."""
        now = self._now()
        return tuple(source.status(now) for source in self.inputs)

    def output_status(self) -> tuple[OutputStatus, ...]:
        """Return how the outputs are doing."""
        return tuple(output.status() for output in self.outputs)

    def close(self) -> None:
        """Close all sockets."""
        for link in self._links:
            link.close()
        self._selector.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _input(self, config: InputConfig) -> Input:
        where = str(config.endpoint)
        feed = Feed(
            config.name,
            where,
            config.make_decoder,
            limits=config.limits,
            events=self._events,
            clocks=self._stamps,
            places=self._places,
        )
        kinds: dict[Transport, type[TcpClientInput | TcpServerInput | UdpInput | SerialInput]] = {
            Transport.TCP_CLIENT: TcpClientInput,
            Transport.TCP_SERVER: TcpServerInput,
            Transport.UDP: UdpInput,
            Transport.SERIAL: SerialInput,
        }
        kind = kinds[config.endpoint.transport]
        return kind(feed, self._selector, config.endpoint)

    def _output(self, config: OutputConfig) -> Output:
        if config.endpoint.transport is Transport.UDP:
            return UdpOutput(config.form, config.endpoint, self._events)
        return TcpServerOutput(config.form, config.endpoint, self._events, self._selector)


def _still_there(known: Iterable[Known], inputs: Sequence[InputConfig]) -> list[Known]:
    """Return known places without those that nobody calls or listens for any more."""
    calls = (Transport.TCP_CLIENT, Transport.SERIAL)
    dialled = {f"{one.name} {one.endpoint}" for one in inputs if one.endpoint.transport in calls}
    heard = tuple(f"{one.name} " for one in inputs if one.endpoint.transport not in calls)
    return [one for one in known if one.host in dialled or one.host.startswith(heard)]
