"""What all sources share: their decoder, their limits and their counts, whatever the socket."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from ssm_graph.base.errors import ConfigError
from ssm_graph.base.usual import MESSAGES_PER_S, STALL_S
from ssm_graph.live.protocols.decoder import Decoder
from ssm_graph.live.protocols.framing import TokenBucket
from ssm_graph.live.sockets.clocks import Now, StampClocks, called
from ssm_graph.live.sockets.doubt import DOUBT_S
from ssm_graph.live.sockets.places import Place, Places
from ssm_graph.mission.events import EventLog
from ssm_graph.mission.navigation import Severity
from ssm_graph.mission.run_status import LinkState, SourceStatus
from ssm_graph.sensors.imu import ImuSample
from ssm_graph.sensors.messages import Message, Readings

IDLE_S: Final = 1.0
"""A source that is silent so long gets to feed nothing, which lets a decoder release what waits."""
OTHERS_SHARE: Final = 0.1
"""Of the rate of inertial samples, what each other kind of message may come at."""
BURST: Final = 5
"""Refusals of one source that may be told at once: their texts differ."""
AHEAD_S: Final = 0.1
"""Bytes for so long may come at once, s."""


@dataclass(frozen=True, slots=True)
class Limits:
    """What one source may do."""

    messages_per_s: float = MESSAGES_PER_S
    """Inertial samples; of every other kind a tenth, so that none crowds out another."""
    burst: int = 4000
    """Inertial samples at once; of every other kind a tenth."""
    bytes_per_s: float = 6e5
    """In the mean, 300 for every message; a source that sends more is read no faster."""
    stall_s: float = STALL_S
    """Time without a sound message after which a connection is given up."""
    max_clients: int = 4
    """Connections to one server."""
    connect_s: float = 5.0
    """Patience with a connection on its way."""
    retry_s: tuple[float, float] = (0.5, 3.0)
    """First and longest wait before the next attempt to connect: nobody is missed for 5 s."""

    def __post_init__(self) -> None:
        TokenBucket(rate_per_s=self.messages_per_s, burst=self.burst)
        for name in ("bytes_per_s", "stall_s", "connect_s"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0.0):
                raise ConfigError(f"Limits.{name}: expected a number above 0, got {value}")


class Channel:
    """One connection's decoder, and when it last heard a sound message, s on the steady clock."""

    def __init__(self, decoder: Decoder, now: Now, place: Place) -> None:
        self.decoder, self.place = decoder, place
        self.heard_s = now.steady_s
        self.fed_s = now.steady_s
        self.is_stale = False
        """Whether what waits came while this process stood still, nobody knows when."""

    def stand_still(self, span_s: float) -> None:
        """Take out a time in which nobody listened, s: what waits is stale, silence was none."""
        self.heard_s += span_s
        self.is_stale = True

    def stand_for(self, channel: Channel) -> None:
        """Take note of what has come by one of those that this one stands for."""
        self.heard_s = max(self.heard_s, channel.heard_s)
        self.fed_s = max(self.fed_s, channel.fed_s)

    def speak_for(self, place: Place) -> None:
        """Be that of another place from now on."""
        self.place = place

    def swap_decoders(self, channel: Channel) -> None:
        """Give another one what was begun here, for what that one has begun."""
        self.decoder, channel.decoder = channel.decoder, self.decoder

    def catch_up(self) -> None:
        """All that waited has been read."""
        self.is_stale = False


class Feed:
    """One source: bytes to messages, limited and counted.

    ``name`` and ``address`` are for people; every connection has a decoder of its own.
    """

    def __init__(
        self,
        name: str,
        address: str,
        make_decoder: Callable[[], Decoder],
        *,
        limits: Limits,
        events: EventLog,
        clocks: StampClocks,
        places: Places,
    ) -> None:
        self.name, self.address, self.limits = name, address, limits
        self._clocks, self._places = clocks, places
        self.n_reconnects = 0
        self._make_decoder, self._events = make_decoder, events
        self._buckets: dict[type[Message], TokenBucket] = {}
        self._n_bytes = self._n_messages = self._n_refused = 0
        self._free_s = self._last_s = -math.inf
        self._rate_hz, self._marked_s, self._n_marked = 0.0, -math.inf, 0
        self._altitude_m = math.nan

    def channel(self, now: Now, place: Place | None = None) -> Channel:
        """Return the begin of a connection; of one that others begin, from where."""
        place = place or self.place(self.address, self.address)
        return Channel(self._make_decoder(), now, place)

    def place(self, where: str, host: str = "") -> Place:
        """Return a place of this source, with the host at its other end."""
        return Place(f"{self.name}, {where}", host and f"{self.name} {host}")

    def take(self, channel: Channel, data: bytes, now: Now) -> list[Message]:
        """Return the messages that these bytes complete and that are not too many."""
        if data:
            self._n_bytes += len(data)
            self._free_s = max(self._free_s, now.steady_s) + len(data) / self.limits.bytes_per_s
        channel.fed_s = now.steady_s
        decoder = channel.decoder
        n_before, n_sound = decoder.n_refused, decoder.n_sound
        arrival_s = math.nan if channel.is_stale else now.wall_s
        try:
            messages = decoder.feed(data, arrival_s=arrival_s)
            refusals = decoder.take_refusals()
        except Exception as error:  # a decoder never raises; if it does, others go on
            self._events.failure(self.name, "decoder_failed", error)
            channel.decoder = self._make_decoder()
            return []
        self._n_refused += decoder.n_refused - n_before
        for text in refusals:
            self.tell("message_refused", text, Severity.WARNING, burst=BURST)
        if decoder.n_sound > n_sound:
            channel.heard_s = now.steady_s
            self._altitude_m = decoder.altitude_m
        return self._usable(channel, messages, now)

    def _usable(self, channel: Channel, messages: list[Message], now: Now) -> list[Message]:
        """Return messages of a connection that count, in the time of the run."""
        heard = self._of_one_place(channel.place, messages, now)
        return self._in_run_time(self._limited(heard, now), now)

    def _of_one_place(self, place: Place, messages: list[Message], now: Now) -> list[Message]:
        """Return messages without those of instruments that are heard from elsewhere, told."""
        passed = []
        refused: dict[str, Place] = {}
        for message in messages:
            heard = self._places.hear(place, message, now.steady_s)
            passed += heard.passed
            self._n_refused += heard.n_refused
            if heard.instead is not None:
                refused[called(message)] = heard.instead
        for kind, other in refused.items():
            text = f"{kind} from {place.name} refused: they come from {other.name}, which was heard"
            text += " first; a vehicle has one of each instrument"
            self.tell("second_source", text, Severity.WARNING)
        return passed

    def _in_run_time(self, messages: list[Message], now: Now) -> list[Message]:
        """Return messages in the time of the run, without those of strange clocks, which is told.

        Messages that waited come with the one that lets them in.
        """
        passed, untold = self._clocks.settle(self.name, now)
        for message in messages:
            clock = self._clocks.of(self.name, message)
            sifted = clock.sift(message, now)
            passed += sifted.passed
            untold += sifted.untold
            if sifted.refused:
                off_s = clock.off_s(sifted.refused[0])
                self._n_refused += len(sifted.refused)
                text = f"{len(sifted.refused)} {called(message)} of another clock, stamped "
                text += f"{off_s:+.6g} s off those that go on: refused"
                self.tell("clock_refused", text, Severity.WARNING)
            if sifted.set_by_s:
                text = f"the clock of {called(message)} was set by {sifted.set_by_s:+.6g} s: they "
                text += "go on as before"
                self.tell("clock_set", text, Severity.WARNING)
        if untold:
            self._n_refused += len(untold)
            text = f"{len(untold)} {called(untold[0])} refused: the vehicle's clock was set, and "
            text += f"delays left open for {DOUBT_S:g} s whether their stamps follow it"
            self.tell("clock_refused", text, Severity.WARNING)
        return passed

    def stood_still(self, span_s: float) -> None:
        """Have what came within a time in which nobody listened, s, not be too much at once."""
        for bucket in self._buckets.values():
            bucket.grant(span_s)

    def catch_up(self) -> None:
        """Have what comes from now on be limited as ever."""
        for bucket in self._buckets.values():
            bucket.catch_up()

    def idle(self, channel: Channel, now: Now) -> list[Message]:
        """Return what the decoder releases where nothing has come for a second."""
        return self.take(channel, b"", now) if now.steady_s - channel.fed_s >= IDLE_S else []

    def held(self, channel: Channel, now: Now) -> list[Readings]:
        """Return complete messages that a decoder holds, as they would be read now."""
        waiting, place = channel.decoder.waiting(), channel.place
        heard = [one for one in waiting if self._places.is_heard(place, type(one))]
        heard += self._places.waiting(place)
        return [self._clocks.of(self.name, one).readings(one, now) for one in heard]

    def end(self, channel: Channel, now: Now) -> list[Message]:
        """Return what the decoder of a connection that is over still gives."""
        messages = self.take(channel, b"\n", now)
        left = channel.decoder.take_waiting()
        return messages + self._usable(channel, left, now)

    def is_over(self, now: Now) -> bool:
        """Return whether it has sent so many bytes that it has to wait."""
        return self._free_s - now.steady_s > AHEAD_S

    @property
    def silence(self) -> str:
        """What is wrong with a connection that :meth:`is_silent`, in words."""
        return f"no sound message for {self.limits.stall_s:g} s"

    def is_silent(self, channel: Channel, now: Now) -> bool:
        """Return whether nothing sound has come from a connection for too long."""
        return now.steady_s - channel.heard_s > self.limits.stall_s

    def tell(self, kind: str, text: str, severity: Severity, *, burst: int = 1) -> None:
        """Note an event about this source."""
        self._events.note(self.name, kind, text, severity, burst=burst)

    def status(self, state: LinkState, now: Now) -> SourceStatus:
        """Return the counts."""
        if now.steady_s - self._marked_s >= 1.0:
            elapsed_s = now.steady_s - self._marked_s
            self._rate_hz = (self._n_messages - self._n_marked) / elapsed_s
            self._marked_s, self._n_marked = now.steady_s, self._n_messages
        return SourceStatus(
            self.name,
            self.address,
            state,
            n_bytes=self._n_bytes,
            n_messages=self._n_messages,
            n_refused=self._n_refused,
            n_limited=self._n_limited,
            n_reconnects=self.n_reconnects,
            rate_hz=self._rate_hz,
            age_s=now.steady_s - self._last_s,
            altitude_m=self._altitude_m,
        )

    @property
    def _n_limited(self) -> int:
        return sum(bucket.n_refused for bucket in self._buckets.values())

    def _bucket(self, kind: type[Message]) -> TokenBucket:
        if kind not in self._buckets:
            share = 1.0 if kind is ImuSample else OTHERS_SHARE
            rate, burst = share * self.limits.messages_per_s, share * self.limits.burst
            self._buckets[kind] = TokenBucket(rate_per_s=rate, burst=max(1, round(burst)))
        return self._buckets[kind]

    def _limited(self, messages: list[Message], now: Now) -> list[Message]:
        kept = [m for m in messages if self._bucket(type(m)).admit(now.steady_s)]
        if len(kept) < len(messages):
            self.tell(
                "rate_limited",
                f"expected at most {self.limits.messages_per_s:g} inertial samples/s and "
                f"{OTHERS_SHARE * self.limits.messages_per_s:g} messages/s of any other kind, got "
                f"more; {self._n_limited} were left out so far",
                Severity.WARNING,
            )
        if kept:
            self._n_messages += len(kept)
            self._last_s = now.steady_s
        return kept
