"""Where an instrument is heard: a vehicle has one of each, and it speaks from one place at a time.

A place is a connection, or a sender of datagrams. Of several that send messages of one kind the one
that was heard first counts; the others are refused, which is told, and one of them is heard once
the first has fallen silent. It gives way where the first is back. What a new one of the same host
sends waits at first: a client may have called again before what it sent by its last call is read.
A process that goes on with the run of another one knows who kept others out there.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Final, NamedTuple

from ssm_graph.sensors.messages import Message

SILENT_S: Final = 1.0
"""A place that is silent for so long may be left for another one."""
SILENT_TIMES: Final = 3.0
"""And for so many of its usual intervals."""
LONGEST_INTERVAL_S: Final = 1.5
"""No place is waited for longer than three of these."""
WAITS_S: Final = 1.0
"""So long messages of a new place wait to be those of the client that was heard so far."""
MOST_WAITING: Final = 1000
"""More are not of a client that has called again."""
MOST_PLACES: Final = 16
"""Of one kind of message that are remembered."""
SETTLED: Final = 3
"""A place that was heard at so many moments keeps others out: fewer may be of sockets that are
opened for every datagram, of which one or the other has by chance the port of one before."""


@dataclass(slots=True)
class Place:
    """One connection or sender, whatever kinds of messages it sends."""

    name: str
    """For people."""
    host: str = ""
    """Of who calls or is called, with the source: another call from there takes its place."""
    is_left: bool = False
    """Whether the connection is gone."""

    def leave(self) -> None:
        """Nothing more comes from here."""
        self.is_left = True

    def is_of_host(self, other: Place) -> bool:
        """Return whether another one may be the same client."""
        return bool(self.host) and self.host == other.host


class Known(NamedTuple):
    """A place that keeps others of its kind of message out."""

    kind: type[Message]
    name: str
    host: str


class Heard(NamedTuple):
    """What becomes of a message, and of those before it that waited."""

    passed: list[Message]
    n_refused: int = 0
    instead: Place | None = None
    """Where the instrument is heard, if any were refused"""


@dataclass(slots=True)
class _Voice:
    """What is remembered of one kind of message from a place, s on the steady clock."""

    place: Place
    heard_s: float = -math.inf
    interval_s: float = 0.0
    n_heard: int = 0
    """Moments at which it was heard."""
    spoke_s: float = -math.inf
    """When it spoke last, heard or not."""
    missed_s: float = math.inf
    """When others first spoke in vain since it was heard."""
    met_s: float = math.inf
    """When it was first not heard at all."""
    waiting: list[Message] = field(default_factory=list)
    is_strange: bool = False
    """Whether it spoke for long while another one was heard."""

    @property
    def is_settled(self) -> bool:
        """Whether it keeps others out."""
        return self.n_heard >= SETTLED

    @property
    def patience_s(self) -> float:
        """How long it has to be silent before another one is heard."""
        return max(SILENT_S, SILENT_TIMES * self.interval_s)

    def hear(self, message: Message, steady_s: float) -> list[Message]:
        """Take note that it speaks; return all that it has to say."""
        if steady_s > self.heard_s:
            if self.n_heard:
                since_s = min(steady_s - self.heard_s, LONGEST_INTERVAL_S)
                self.interval_s = max(since_s, 0.9 * self.interval_s)
            self.n_heard += 1
        self.heard_s = self.spoke_s = steady_s
        self.is_strange = False
        self.met_s = self.missed_s = math.inf
        waiting, self.waiting = self.waiting, []
        return [*waiting, message]

    def wait(self, message: Message, steady_s: float, before: Place) -> int:
        """Have a message wait while it may be of the same client; return how many are refused."""
        self.spoke_s = steady_s
        self.met_s = min(self.met_s, steady_s)
        is_long = steady_s - self.met_s > WAITS_S or len(self.waiting) >= MOST_WAITING
        self.is_strange = self.is_strange or is_long or not before.is_of_host(self.place)
        if not self.is_strange:
            self.waiting.append(message)
            return 0
        n_refused, self.waiting = len(self.waiting) + 1, []
        return n_refused

    def follow(self, place: Place, waiting: list[Message]) -> None:
        """Speak from another place: the same client has called again."""
        self.place, self.waiting = place, waiting

    def is_missed(self, steady_s: float) -> bool:
        """Return whether it has fallen silent for others, one of which speaks now.

        They have to have spoken in vain for so long, whoever they were: where nobody has looked for
        a while, what comes first says nothing of who is silent. Of a connection that is gone
        nothing more can come.
        """
        self.missed_s = min(self.missed_s, steady_s)
        since_s = self.heard_s if self.place.is_left else self.missed_s
        return steady_s - since_s >= self.patience_s


class Places:
    """All places of a run, by the kind of message, in the order in which they were heard first.

    ``known`` kept others out in an earlier process of the run, and do so from ``steady_s`` on, as
    long as any instrument is waited for.
    """

    def __init__(self, known: Iterable[Known] = (), steady_s: float = -math.inf) -> None:
        self._voices: dict[type[Message], list[_Voice]] = {}
        for kind, name, host in known:
            voice = _Voice(Place(name, host, is_left=True), steady_s, LONGEST_INTERVAL_S, SETTLED)
            voices = self._voices.setdefault(kind, [])
            voices += [voice] if len(voices) < MOST_PLACES else []

    def known(self) -> tuple[Known, ...]:
        """Return the places that keep others out, by which a process that follows knows them."""
        return tuple(
            Known(kind, voice.place.name, voice.place.host)
            for kind, voices in self._voices.items()
            for voice in voices
            if voice.is_settled and voice.place.host
        )

    def hear(self, place: Place, message: Message, steady_s: float) -> Heard:
        """Return what may pass now that a message has come from a place, and what is refused.

        A sender that spoke once or twice, as one does that opens a socket for every datagram, keeps
        nobody out.
        """
        voice, before = self._voice(place, type(message))
        if before is None or before.is_missed(steady_s):
            return Heard(voice.hear(message, steady_s))
        n_refused = voice.wait(message, steady_s, before.place)
        return Heard([], n_refused, before.place if n_refused else None)

    def waiting(self, place: Place) -> list[Message]:
        """Return what waits of a place."""
        voices = (voice for voices in self._voices.values() for voice in voices)
        return [message for voice in voices if voice.place is place for message in voice.waiting]

    def is_heard(self, place: Place, kind: type[Message]) -> bool:
        """Return whether a message of this place would be heard now, as far as is known."""
        others = self._voices.get(kind, [])
        own = next((voice for voice in others if voice.place is place), None)
        newest = max(others, key=lambda voice: voice.heard_s, default=None)
        return own is newest or newest is None or not newest.is_settled

    def _voice(self, place: Place, kind: type[Message]) -> tuple[_Voice, _Voice | None]:
        """Return the voice of a place, and that which was heard last of those before it."""
        voices = self._voices.setdefault(kind, [])
        at = next((k for k, voice in enumerate(voices) if voice.place is place), len(voices))
        if at == len(voices):
            if at == MOST_PLACES:
                self._forget_one(voices)
            at = len(voices)
            voices.append(_Voice(place))
        if not voices[at].is_strange:
            others = (voice.place for voice in voices[:at])
            left = (k for k, one in enumerate(others) if one.is_left and one.is_of_host(place))
            before = next(left, at)
            if before < at:
                voices[before].follow(place, voices.pop(at).waiting)
                at = before
        known = (voice for voice in voices[:at] if voice.is_settled)
        return voices[at], max(known, key=lambda voice: voice.heard_s, default=None)

    @staticmethod
    def _forget_one(voices: list[_Voice]) -> None:
        """Forget who spoke longest ago of those that keep nobody out, else the newest."""
        passing = [k for k, voice in enumerate(voices) if not voice.is_settled]
        del voices[min(passing, key=lambda k: voices[k].spoke_s, default=-1)]
