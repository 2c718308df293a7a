"""What the way between sockets and estimator has to say: often enough, and not without end."""

from __future__ import annotations

import traceback
from collections import deque
from collections.abc import Callable
from typing import Final

from ssm_graph.live.protocols.framing import TokenBucket
from ssm_graph.mission.navigation import Event, Severity

QUIET_S: Final = 10.0
"""An event of one kind from one place is told at most so often; those between are counted."""
BURST: Final = 5
"""Events that may come at once where their texts differ."""
MOST: Final = 1000
"""Events kept until somebody takes them; the oldest go first."""


class Notices:
    """Collects events until they are taken.

    Parameters
    ----------
    wall_s : the vehicle's clock, which stamps the events.
    steady_s : a clock that is never set, which says how long ago one was told.
    """

    def __init__(self, wall_s: Callable[[], float], steady_s: Callable[[], float]) -> None:
        self._wall_s, self._steady_s = wall_s, steady_s
        self._events: deque[Event] = deque(maxlen=MOST)
        self._buckets: dict[tuple[str, str], TokenBucket] = {}
        self._untold: dict[tuple[str, str], int] = {}
        self.n_errors = 0
        """Events of severity ERROR so far, told or not."""

    def tell(self, place: str, kind: str, text: str, severity: Severity, *, burst: int = 1) -> None:
        """Note an event, unless of its kind and place there were too many shortly before.

        Parameters
        ----------
        place : the source or part that it is about; begins the sentence.
        kind : as in :class:`Event`.
        text : the sentence.
        severity : how much it matters.
        burst : how many may come at once.
        """
        self.n_errors += severity is Severity.ERROR
        key = place, kind
        if key not in self._buckets:
            self._buckets[key] = TokenBucket(rate_per_s=burst / QUIET_S, burst=burst)
        if not self._buckets[key].admit(self._steady_s()):
            self._untold[key] = self._untold.get(key, 0) + 1
            return
        more = self._untold.pop(key, 0)
        said = f"{place}: {text}" + (f" (and {more} more like it before)" if more else "")
        self._events.append(Event(self._wall_s(), severity, kind, said))

    def failure(self, place: str, kind: str, error: BaseException) -> None:
        """Note an exception that nobody expected, with the place it came from."""
        self.tell(place, kind, described(error), Severity.ERROR)

    def take(self) -> list[Event]:
        """Return what has not been taken yet."""
        taken = list(self._events)
        self._events.clear()
        return taken


def described(error: BaseException) -> str:
    """Return the last line of a traceback and the line of code that it points to."""
    text = traceback.format_exception_only(error)[-1].strip()
    frames = traceback.extract_tb(error.__traceback__)
    return f"{text} ({frames[-1].filename}:{frames[-1].lineno})" if frames else text
