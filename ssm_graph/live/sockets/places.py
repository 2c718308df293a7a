"""Where an instrument is heard: a vehicle has one of each, and it speaks from one place at a time.

A place is a connection, or a sender of datagrams. Of several that send messages of one kind the one
that was heard first counts; the others are refused, which is told, and one of them is heard once
the first has fallen silent. It gives way where the first is back.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

from ssm_graph.sensors.messages import Message

SILENT_S: Final = 1.0
"""A place that is silent for so long may be left for another one."""
SILENT_TIMES: Final = 3.0
"""And for so many of its usual intervals."""
LONGEST_INTERVAL_S: Final = 1.5
"""No place is waited for longer than three of these."""
MOST_PLACES: Final = 16
"""Of one kind of message that are remembered; the newest gives way, for the first ones count."""


@dataclass(slots=True)
class Place:
    """One connection or sender, whatever kinds of messages it sends."""

    name: str
    """For people."""
    host: str = ""
    """Of a client that called: another call from there takes its place."""
    is_left: bool = False
    """Whether the connection is gone."""

    def leave(self) -> None:
        """Nothing more comes from here."""
        self.is_left = True


@dataclass(slots=True)
class _Voice:
    """What is remembered of one kind of message from a place, s on the steady clock."""

    place: Place
    heard_s: float = -math.inf
    interval_s: float = 0.0
    n_heard: int = 0
    """Moments at which it was heard."""
    waits_s: float = -math.inf
    """When it was first refused since the one before it was heard."""

    @property
    def patience_s(self) -> float:
        """How long it has to be silent before another one is heard."""
        return max(SILENT_S, SILENT_TIMES * self.interval_s)

    def hear(self, steady_s: float) -> None:
        """Take note that it speaks."""
        if steady_s > self.heard_s:
            if self.n_heard:
                since_s = min(steady_s - self.heard_s, LONGEST_INTERVAL_S)
                self.interval_s = max(since_s, 0.9 * self.interval_s)
            self.n_heard += 1
        self.heard_s = steady_s

    def move_to(self, place: Place) -> None:
        """Speak from there: the same client has called again."""
        self.place = place

    def waited_s(self, other: _Voice, steady_s: float) -> float:
        """Return for how long it has waited in vain since the other one was heard, s."""
        if self.waits_s < other.heard_s:
            self.waits_s = steady_s
        return steady_s - self.waits_s


class Places:
    """All places of a run, by the kind of message, in the order in which they were heard first."""

    def __init__(self) -> None:
        self._voices: dict[type[Message], list[_Voice]] = {}

    def refused_for(self, place: Place, kind: type[Message], steady_s: float) -> Place | None:
        """Return the place that is heard instead; None where this one is, of which note is taken.

        A sender that spoke once only, as one does that opens a socket for every datagram, keeps
        nobody out.
        """
        voice, before = self._voice(place, kind)
        if before is not None and not self._is_silent(before, voice, steady_s):
            return before.place
        voice.hear(steady_s)
        return None

    def is_heard(self, place: Place, kind: type[Message]) -> bool:
        """Return whether a message of this place would be heard now, as far as is known."""
        others = self._voices.get(kind, [])
        own = next((voice for voice in others if voice.place is place), None)
        newest = max(others, key=lambda voice: voice.heard_s, default=None)
        return own is newest or newest is None or newest.n_heard < 2

    def _voice(self, place: Place, kind: type[Message]) -> tuple[_Voice, _Voice | None]:
        """Return the voice of a place, and that which was heard last of those before it."""
        voices = self._voices.setdefault(kind, [])
        at = next((k for k, voice in enumerate(voices) if voice.place is place), len(voices))
        if at == len(voices):
            at = next((k for k, voice in enumerate(voices) if _follows(place, voice.place)), at)
            if at < len(voices):
                voices[at].move_to(place)
            else:
                at = min(at, MOST_PLACES - 1)
                voices[at:] = [_Voice(place)]
        known = (voice for voice in voices[:at] if voice.n_heard > 1)
        return voices[at], max(known, key=lambda voice: voice.heard_s, default=None)

    @staticmethod
    def _is_silent(before: _Voice, voice: _Voice, steady_s: float) -> bool:
        """Return whether a voice that was heard first has fallen silent for another one.

        That one has to have waited for so long: where nobody has looked for a while, what comes
        first says nothing of who is silent. Of a connection that is gone nothing more can come.
        """
        if before.place.is_left:
            return steady_s - before.heard_s >= before.patience_s
        return voice.waited_s(before, steady_s) >= before.patience_s


def _follows(place: Place, other: Place) -> bool:
    """Return whether a place is that of the same client, which has called again."""
    return bool(other.is_left and place.host and place.host == other.host)
