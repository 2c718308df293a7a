"""A log of events that repeats itself as little as a person on watch would like."""

from __future__ import annotations

import traceback
from collections import Counter, deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Final

from ssm_graph.mission.navigation import Event, Severity

QUIET_S: Final = 10.0
"""An event of one kind from one place is told at most so often; those between are counted."""
MOST: Final = 1000
"""Events kept until somebody takes them; the oldest go first."""


class EventLog:
    """Collects events until they are taken.

    Parameters
    ----------
    wall_s : the vehicle's clock, which stamps what :meth:`note` is told.
    steady_s : a clock that is never set, which says how long ago that was told.
    """

    def __init__(
        self, wall_s: Callable[[], float] | None = None, steady_s: Callable[[], float] | None = None
    ) -> None:
        self._wall_s, self._steady_s = wall_s, steady_s
        self._events: deque[Event] = deque(maxlen=MOST)
        self._told_s: dict[tuple[str, str], deque[float]] = {}
        self._untold: Counter[tuple[str, str]] = Counter()
        self.n_errors = 0
        """Events of severity ERROR so far, told or not."""

    def tell(self, time_s: float, severity: Severity, kind: str, text: str) -> None:
        """Note an event at a time of the data, s, unless one of its kind was told shortly before.

        Parameters
        ----------
        time_s, severity, kind, text : as in :class:`Event`.
        """
        self._add(Event(time_s, severity, kind, text), "", time_s, burst=1)

    def note(self, place: str, kind: str, text: str, severity: Severity, *, burst: int = 1) -> None:
        """Note an event of this moment, unless too many of its kind and place were told.

        Parameters
        ----------
        place : the source or part that it is about; begins the sentence.
        kind, text, severity : as in :class:`Event`.
        burst : how many may be told within :data:`QUIET_S`, where their texts differ.
        """
        assert self._wall_s is not None
        assert self._steady_s is not None
        event = Event(self._wall_s(), severity, kind, f"{place}: {text}")
        self._add(event, place, self._steady_s(), burst=burst)

    def failure(self, place: str, kind: str, error: BaseException) -> None:
        """Note an exception that nobody expected: its last line, and the line it came from."""
        text = traceback.format_exception_only(error)[-1].strip()
        frames = traceback.extract_tb(error.__traceback__)
        at = f" ({frames[-1].filename}:{frames[-1].lineno})" if frames else ""
        self.note(place, kind, text + at, Severity.ERROR)

    @contextmanager
    def surviving(self, place: str, kind: str) -> Iterator[None]:
        """Go on after what is done here, with a :meth:`failure` where it raises an exception."""
        try:
            yield
        except Exception as error:
            self.failure(place, kind, error)

    def take(self) -> tuple[Event, ...]:
        """Return what has not been taken yet."""
        taken = tuple(self._events)
        self._events.clear()
        return taken

    def _add(self, event: Event, place: str, now_s: float, *, burst: int) -> None:
        self.n_errors += event.severity is Severity.ERROR
        key = place, event.kind
        told_s = self._told_s.setdefault(key, deque(maxlen=burst))
        if len(told_s) == burst and abs(now_s - told_s[0]) < QUIET_S:
            self._untold[key] += 1
            return
        told_s.append(now_s)
        more = self._untold.pop(key, 0)
        text = f"{event.text} (and {more} more since)" if more else event.text
        self._events.append(Event(event.time_s, event.severity, event.kind, text))
