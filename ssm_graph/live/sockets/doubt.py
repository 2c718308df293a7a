"""Whether stamps follow the vehicle's clock where it was set: told by how late they come.

An instrument stamps by the vehicle's clock, or by one of its own. Where the vehicle's is set, a
message may be read in both ways, and one of them makes it later, or earlier, than messages of that
instrument come. On a machine or a link that lags by as much as the clock was set, a single message
does not tell; then messages wait until some together do, and count at the time that is right.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import replace
from typing import Final, NamedTuple

from ssm_graph.sensors.messages import Message, Readings

DOUBT_S: Final = 8.0
"""No message waits longer: a window would not take it any more."""
GUESS_AFTER: Final = 80.0
"""After so many times what the clock was set by the likelier reading is taken: messages come later
than they ever did. The less it was, the less harm a wrong one does."""
EARLY_S: Final = 0.05
"""What comes earlier than all before it by so much is seldom, or was not measured yet."""
UNLIKELY: Final = 1e-3
"""A reading by which messages come as late as they do this seldom is wrong."""
N_LAGS: Final = 64
"""Arrivals that tell how late messages come."""
NOTICED_S: Final = 0.02
"""What a stamp and the moment of a setting may differ by: clocks are not read at once."""


class Setting(NamedTuple):
    """The vehicle's clock was set."""

    begin_s: float
    """Not before, s in the time of the run: it was looked at then."""
    end_s: float
    """Not after."""
    set_by_s: float
    """How far it is ahead of the time of the run since."""


class Arrival(NamedTuple):
    """When a message came, s in the time of the run; nobody looked in between."""

    after_s: float
    by_s: float


class Lags:
    """How late messages come: of each arrival the least, as all that waited was late for that."""

    def __init__(self) -> None:
        self._lags_s: deque[tuple[float, float]] = deque(maxlen=N_LAGS)
        self._by_s = math.nan

    def add(self, time_s: float, arrival: Arrival) -> None:
        """Take note of a message of a time; those that are read at one moment are one arrival."""
        lag_s = (arrival.after_s - time_s, arrival.by_s - time_s)
        if arrival.by_s == self._by_s:
            self._lags_s[-1] = min(self._lags_s[-1], lag_s)
        else:
            self._lags_s.append(lag_s)
        self._by_s = arrival.by_s

    @property
    def least_s(self) -> float:
        """The least that one can have been, s."""
        return min((lag_s for _, lag_s in self._lags_s), default=math.inf)

    def probability(self, other: Lags) -> float:
        """Return how probable it is that other arrivals are as late as they are, or as early.

        Of lateness by Fisher's method; what this process itself was late by, for it did something
        else, says nothing. Times each that comes earlier than any.
        """
        n = len(self._lags_s)
        earliest_s = min((lag_s for lag_s, _ in self._lags_s), default=-math.inf)
        n_early = sum(lag_s < earliest_s - EARLY_S for _, lag_s in other._lags_s)
        n_as_late = (sum(lag_s >= x for lag_s, _ in self._lags_s) for x, _ in other._lags_s)
        surprise = -sum(math.log((1.0 + k) / (1.0 + n)) for k in n_as_late)
        terms = (surprise**k / math.factorial(k) for k in range(len(other._lags_s)))
        late = math.exp(-surprise) * sum(terms) if other._lags_s else 1.0
        return float(late / (1.0 + n) ** n_early)


class _Reading:
    """Stamps read in one way; ``pieces`` are from when to when, s, stamps are ahead by what."""

    def __init__(self, pieces: list[tuple[float, float, float]], last_s: float) -> None:
        self.pieces, self._last_s = pieces, last_s
        self.times_s: deque[float] = deque()
        self.lags = Lags()

    @property
    def shift_s(self) -> float:
        """What stamps are ahead by now, s."""
        return self.pieces[-1][2]

    def read(self, stamp_s: float, period_s: float) -> float:
        """Return the time that a stamp means, s: where it may be several, as messages follow."""
        due_s = self._last_s + period_s
        may_be_s = [
            stamp_s - shift_s
            for begin_s, end_s, shift_s in self.pieces
            if begin_s - NOTICED_S <= stamp_s - shift_s <= end_s + NOTICED_S
        ]
        return min(may_be_s or [stamp_s - self.shift_s], key=lambda time_s: abs(time_s - due_s))

    def keep(self, time_s: float) -> None:
        """Take a time for that of the last message."""
        self.times_s.append(time_s)
        self._last_s = time_s


class Told(NamedTuple):
    """How stamps are to be read from now on."""

    messages: list[Message]
    """Those that waited, in the time of the run."""
    shift_s: float
    """What stamps are ahead by from now on, s."""
    other_s: float | None
    """What they are ahead by if that is wrong, s; None where it is sure."""


class Doubt:
    """Messages of one instrument that wait until it is told how to read their stamps.

    Parameters
    ----------
    shift_s : what stamps have been ahead of the time of the run by, s.
    last_s, period_s : when the last message was, and how long after the one before, s.
    lags : how late messages have come.
    least_s : how late at least, s.
    """

    def __init__(
        self, shift_s: float, last_s: float, period_s: float, *, lags: Lags, least_s: float
    ) -> None:
        self._lags, self._least_s, self._period_s = lags, least_s, period_s
        self._own = _Reading([(-math.inf, math.inf, shift_s)], last_s)
        self._following = _Reading([(-math.inf, math.inf, shift_s)], last_s)
        self._waiting: deque[tuple[float, Message]] = deque()
        self._begun_s = math.nan

    def set(self, setting: Setting) -> None:
        """Take note that the clock was set, once more."""
        pieces = self._following.pieces
        begin_s, _, shift_s = pieces[-1]
        pieces[-1] = (begin_s, setting.end_s, shift_s)
        pieces.append((setting.begin_s, math.inf, setting.set_by_s))

    def wait(self, message: Message, arrival: Arrival, *, ahead_s: float) -> bool:
        """Have a message wait; return False where it is of another clock however it is read.

        Stamps may be ahead of the arrival by ``ahead_s``.
        """
        readings = (self._own, self._following)
        times_s = [reading.read(message.time_s, self._period_s) for reading in readings]
        if min(times_s) > arrival.by_s + ahead_s:
            return False
        tells = abs(times_s[0] - times_s[1]) > NOTICED_S
        for reading, time_s in zip(readings, times_s, strict=True):
            reading.keep(time_s)
            if tells:
                reading.lags.add(time_s, arrival)
        self._waiting.append((arrival.by_s, message))
        self._begun_s = arrival.by_s if math.isnan(self._begun_s) else self._begun_s
        return True

    def tell(self, now_s: float) -> Told | None:
        """Return what is known by now, s in the time of the run; None where it is not yet."""
        own, following = (self._probability(x) for x in (self._own, self._following))
        is_told = min(own, following) < UNLIKELY <= max(own, following)
        is_sure = is_told or (own == 0.0) != (following == 0.0)
        off_s = abs(self._following.shift_s - self._own.shift_s)
        patience_s = max(DOUBT_S, GUESS_AFTER * min(off_s, 0.5))
        if not is_sure and not now_s - self._begun_s > patience_s:
            return None
        told = self.likelier()
        return told._replace(other_s=None) if is_sure else told

    def likelier(self) -> Told:
        """Return what seems true so far, where nothing more will come to tell it."""
        return self._read_as(self._likelier_first()[0])

    def waiting(self) -> list[Readings]:
        """Return what waits."""
        likelier, other = self._likelier_first()
        return [
            tuple(replace(message, time_s=time_s) for time_s in times_s)
            for (_, message), *times_s in zip(
                self._waiting, likelier.times_s, other.times_s, strict=True
            )
        ]

    def readings(self, message: Message) -> Readings:
        """Return how a message that has not come here yet would be read."""
        times_s = (way.read(message.time_s, self._period_s) for way in self._likelier_first())
        return tuple(replace(message, time_s=time_s) for time_s in times_s)

    def _likelier_first(self) -> tuple[_Reading, _Reading]:
        own, following = (self._probability(x) for x in (self._own, self._following))
        if following > own:
            return self._following, self._own
        return self._own, self._following

    def _read_as(self, right: _Reading) -> Told:
        wrong = self._own if right is self._following else self._following
        messages = [
            replace(message, time_s=time_s)
            for (_, message), time_s in zip(self._waiting, right.times_s, strict=True)
        ]
        return Told(messages, right.shift_s, wrong.shift_s)

    def give_up(self, now_s: float) -> list[Message]:
        """Return those that have waited too long to be of any use."""
        late: list[Message] = []
        while self._waiting and now_s - self._waiting[0][0] > DOUBT_S:
            late.append(self._waiting.popleft()[1])
            for reading in (self._own, self._following):
                reading.times_s.popleft()
        return late

    def _probability(self, reading: _Reading) -> float:
        if reading.lags.least_s < min(self._least_s, 0.0) - EARLY_S:
            return 0.0  # it was not measured yet
        return self._lags.probability(reading.lags)
