"""Which GST is about which position: several receivers may share a connection."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, NamedTuple

from ssm_graph.base.frozen import Vector
from ssm_graph.live.protocols.decoder import RefusedError, shown
from ssm_graph.live.protocols.nmea_fields import Position

LATELY_S: Final = 5.0
"""A receiver that says no position for so long is none whose GST might come."""
MOST_RECEIVERS: Final = 16
"""Told apart at one connection. One that writes a GNS for each system of satellites has seven
talkers."""


class Speaker(NamedTuple):
    """Who says a sentence."""

    source: str
    """Of a tag block, perhaps empty"""
    talker: str


class Pending(NamedTuple):
    """A position before its sigmas are known."""

    speaker: Speaker
    kind: str
    time_s: float
    arrival_s: float
    position: Position


Told = tuple[Pending, Vector | None]
"""A position, and its sigmas where a GST says them."""


@dataclass(slots=True)
class _Receiver:
    """What is remembered of one that says positions."""

    heard_s: float
    """When it last did."""
    has_fix: bool = True
    pending: Pending | None = None
    """Waits for its GST."""
    last: Pending | None = None
    gst_follows: bool = False
    twice_s: float = -math.inf
    """When it last said two places of one time: two receivers, or a time without its fractions."""

    def begin(self, arrival_s: float) -> list[Told]:
        """Take note that it says a position; return the last, which still waits."""
        self.heard_s = arrival_s
        return self.release(None)

    def loses_fix(self, *, has_fix: bool) -> bool:
        """Take note of whether it has a fix; return whether it had one before and has none now."""
        is_lost = self.has_fix and not has_fix
        self.has_fix = has_fix
        return is_lost

    def wait(self, pending: Pending) -> None:
        """Have a position wait for its sigmas."""
        place, last = pending.position, self.last and self.last.position
        if last and place.utc == last.utc != "" and place[1:3] != last[1:3]:
            self.twice_s = pending.arrival_s
        self.pending = self.last = pending

    def take(self, utc: str, sigma_enu: Vector) -> list[Told]:
        """Return the position that has waited for the sigmas of this time, if one has."""
        self.gst_follows = self.last is not None and self.last.position.utc == utc
        is_waited_for = self.pending is not None and self.pending.position.utc == utc
        return self.release(sigma_enu) if is_waited_for else []

    def find(self, sigma_enu: Vector) -> list[Told]:
        """Return the position that waits with sigmas that had come before it."""
        self.gst_follows = False
        return self.release(sigma_enu)

    def release(self, sigma_enu: Vector | None) -> list[Told]:
        """Return the position that waits, by now with its sigmas or without any."""
        pending, self.pending = self.pending, None
        if pending is None:
            return []
        self.gst_follows = self.gst_follows and sigma_enu is not None
        return [(pending, sigma_enu)]


class Receivers:
    """Receivers behind one connection, told apart by talkers and by the sources of tag blocks.

    Parameters
    ----------
    gst_wait_s : how long a position waits for its GST, where the last one came after its position.
    say_once : is told a key and a sentence where nothing says whose a GST is.
    """

    def __init__(self, gst_wait_s: float, say_once: Callable[[str, str], None]) -> None:
        self._gst_wait_s, self._say_once = gst_wait_s, say_once
        self._known: dict[Speaker, _Receiver] = {}
        self._gst: dict[Speaker, tuple[str, Vector]] = {}

    def overdue(self, arrival_s: float) -> list[Told]:
        """Return positions that have waited for their GST long enough."""
        return [
            told
            for one in self._known.values()
            if one.pending and not 0.0 <= arrival_s - one.pending.arrival_s < self._gst_wait_s
            for told in one.release(None)
        ]

    def begin(self, speaker: Speaker, arrival_s: float) -> list[Told]:
        """Take note that a receiver says where it is, or that it does not know; return the last.

        Raises :class:`RefusedError` where there are too many.
        """
        known, left = self._known, list[Told]()
        if speaker not in known and len(known) >= MOST_RECEIVERS:
            oldest = min(known, key=lambda one: known[one].heard_s)
            if _is_lately(known[oldest].heard_s, arrival_s):
                raise RefusedError(
                    f"expected positions of at most {MOST_RECEIVERS} receivers at one connection, "
                    f"got those of talker {shown(speaker.talker)} too"
                )
            left = known.pop(oldest).release(None)
        return left + known.setdefault(speaker, _Receiver(arrival_s)).begin(arrival_s)

    def loses_fix(self, speaker: Speaker, *, has_fix: bool) -> bool:
        """Take note of whether a receiver that has begun has a fix; return whether it is lost."""
        return self._known[speaker].loses_fix(has_fix=has_fix)

    def take(self, pending: Pending) -> list[Told]:
        """Return a position with its sigmas, nothing where it waits for them.

        Nothing comes of one whose time another sentence has said already, as where a better one
        begins to be read amid an epoch.
        """
        if self.has_said(pending.position.utc, not_by=pending.kind):
            return []
        receiver = self._known[pending.speaker]
        receiver.wait(pending)
        for speaker, (utc, sigma_enu) in self._gst.items():
            is_of_time = utc == pending.position.utc
            if is_of_time and self._about(speaker, pending.arrival_s) is receiver:
                return receiver.find(sigma_enu)
        return [] if receiver.gst_follows else receiver.release(None)

    def hear(self, speaker: Speaker, utc: str, sigma: Vector, arrival_s: float) -> list[Told]:
        """Return the position that has waited for the sigmas of a GST (east, north, up; m)."""
        if speaker not in self._gst and len(self._gst) >= MOST_RECEIVERS:
            del self._gst[next(iter(self._gst))]
        self._gst[speaker] = utc, sigma
        receiver = self._about(speaker, arrival_s)
        return [] if receiver is None else receiver.take(utc, sigma)

    def has_said(self, utc: str, *, not_by: str = "") -> bool:
        """Return whether the last position of any is of this time, by another sentence than one."""
        lasts = (one.last for one in self._known.values() if one.last is not None)
        return any(last.position.utc == utc != "" and last.kind != not_by for last in lasts)

    def waiting(self) -> list[Pending]:
        """Return the positions that wait."""
        return [one.pending for one in self._known.values() if one.pending is not None]

    def clear(self) -> None:
        """Forget what waits."""
        for one in self._known.values():
            one.release(None)

    def _about(self, speaker: Speaker, arrival_s: float) -> _Receiver | None:
        """Return whose positions a GST is about, None where that cannot be known, which is told.

        Those of its own talker; where it has none, as a receiver may write GPGGA and GNGST, those
        of the only one at the connection, or of the source that its tag block names.
        """
        lately = {
            one: receiver
            for one, receiver in self._known.items()
            if speaker.source in ("", one.source) and _is_lately(receiver.heard_s, arrival_s)
        }
        found = lately.get(speaker)
        if len(lately) == 1:
            (found,) = lately.values()
        is_double = found is not None and _is_lately(found.twice_s, arrival_s)
        if is_double or (lately and found is None):
            what = "two places of one time come" if is_double else "several receivers speak"
            talkers = ", ".join(sorted({one.talker for one in lately}))
            self._say_once(
                "whose",
                f"GST: {what} ({talkers}), and nothing says whose a {speaker.talker}GST is: HDOP "
                "counts instead; give each receiver a port, a talker or a tag block of its own",
            )
        return None if is_double else found


def _is_lately(heard_s: float, arrival_s: float) -> bool:
    """Return whether a time is not long ago; an arrival that is not known is of now."""
    return not arrival_s - heard_s >= LATELY_S
