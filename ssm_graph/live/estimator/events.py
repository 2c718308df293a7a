"""A log of events that repeats itself as little as a person on watch would like."""

from __future__ import annotations

from collections import deque
from typing import Final

from ssm_graph.mission.navigation import Event, Severity

QUIET_S: Final = 10.0
"""An event of one kind is told at most so often; those between are counted."""
MOST: Final = 1000
"""Events kept until somebody takes them; the oldest go first."""


class EventLog:
    """Collects events until they are taken."""

    def __init__(self) -> None:
        self._events: deque[Event] = deque(maxlen=MOST)
        self._told_s: dict[str, float] = {}
        self._untold: dict[str, int] = {}

    def tell(self, time_s: float, severity: Severity, kind: str, text: str) -> None:
        """Note an event, unless one of its kind was told shortly before."""
        if abs(time_s - self._told_s.get(kind, -1e300)) < QUIET_S:
            self._untold[kind] = self._untold.get(kind, 0) + 1
            return
        more = self._untold.pop(kind, 0)
        self._told_s[kind] = time_s
        self._events.append(
            Event(time_s, severity, kind, f"{text} (and {more} more since)" if more else text)
        )

    def take(self) -> tuple[Event, ...]:
        """Return what has not been taken yet."""
        taken = tuple(self._events)
        self._events.clear()
        return taken
