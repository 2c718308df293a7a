"""Clocks that are set while a run goes on: its own time never is, and stamps are brought to it.

The vehicle's clock (Unix time) may be set under a running program, and so may that of an
instrument. A steady clock tells the two from a time in which nothing came: what is stamped half a
minute later than the message before, and arrives a hundredth of a second after it, was stamped by a
clock that was set.
"""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from typing import Final, NamedTuple

from ssm_graph.live.sockets.doubt import Arrival, Doubt, Lags, Setting, Told
from ssm_graph.sensors.imu import ImuSample
from ssm_graph.sensors.messages import Message, Readings
from ssm_graph.sensors.registry import BY_MESSAGE

SET_S: Final = 0.02
"""A step of the vehicle's clock that is smaller is no matter; a slewed clock makes none."""
PREEMPTED_S: Final = 0.005
"""Two clocks that were read further apart than this are not compared."""
SAME_CLOCK_S: Final = 2.5
"""Stamps of one clock may be so far behind what was expected: delays of a link."""
FOLLOWED_S: Final = 0.1
"""A stamp so soon after the last one is of the same clock, whenever it comes."""
BACK_S: Final = 0.4
"""Inertial samples may come so much out of order."""
AHEAD_S: Final = 0.2
"""Nothing comes before it was measured: stamps further ahead of their arrival than all before them
are of a clock that was set."""
LEAD_DECAY: Final = 1e-3
"""s/s, how fast it is forgotten how little messages were delayed: clocks drift by less."""
STRANGER_S: Final = 1.0
"""A clock that is silent for so long may have been set."""
SILENT_TIMES: Final = 3.0
"""And for so many of its usual intervals."""
LONGEST_INTERVAL_S: Final = 1.5
"""No clock is waited for longer than three of these."""
MOST_STRANGERS: Final = 5000
"""Messages of another clock that may wait; with more the other clock is believed."""
FOLLOWS_S: Final = 10.0
"""So long after the vehicle's clock was set inertial samples may begin to follow it."""
N_SETTINGS: Final = 32
"""So often a clock is set before an instrument that is silent is taken to follow the last."""
RIGHT_S: Final = 5.0
"""An instrument's clock that is further off that of the vehicle was never set."""


class Now(NamedTuple):
    """One moment on both clocks."""

    wall_s: float
    """The vehicle's clock, which stamps arrivals."""
    steady_s: float
    """A clock that is never set, for rates and patience."""


def boot_s() -> float:
    """Return a time that is never set and goes on while the computer sleeps, s."""
    return time.clock_gettime(_BOOT)


_BOOT: Final[int] = getattr(time, "CLOCK_BOOTTIME", getattr(time, "CLOCK_MONOTONIC", 1))


class RunClock:
    """The time of a run: the vehicle's clock at the begin, whatever that is set to later.

    Parameters
    ----------
    wall_s : the vehicle's clock.
    steady_s : one that is never set.
    set_by_s : by how much the vehicle's clock has been set since the run began, s.
    """

    def __init__(
        self, wall_s: Callable[[], float], steady_s: Callable[[], float], set_by_s: float = 0.0
    ) -> None:
        self._wall_s, self._steady_s = wall_s, steady_s
        self.set_by_s = set_by_s
        """By how much the vehicle's clock is ahead of the time of the run, s."""
        self.set_at_s = -math.inf
        """When it was set last, s on the steady clock."""
        self.unread_s = 0.0
        """For how long nobody had looked when it was read last, s."""
        self.n_set = 0
        """How often it was set."""
        self._settings: deque[Setting] = deque(maxlen=N_SETTINGS)
        self.has_begun = False
        """Whether a message has come; before, a clock that is set is the time of the run."""
        self._known: Now | None = None
        self._read_s = steady_s()
        self.read()

    def begin(self) -> None:
        """Take note that a message has come."""
        self.has_begun = True

    def settings(self, n_known: int) -> list[Setting]:
        """Return how it was set since it had been so many times."""
        return list(self._settings)[-(self.n_set - n_known) :] if self.n_set > n_known else []

    @property
    def time_s(self) -> float:
        """The time of the run, s."""
        return self._wall_s() - self.set_by_s

    def read(self) -> tuple[Now, float]:
        """Return both clocks, and by how much the vehicle's was set since the last call, s."""
        before_s = self._steady_s()
        now = Now(self._wall_s(), self._steady_s())
        self.unread_s, self._read_s = now.steady_s - self._read_s, now.steady_s
        if now.steady_s - before_s > PREEMPTED_S:
            return now, 0.0
        known, self._known = self._known, now
        if known is None:
            return now, 0.0
        step_s = (now.wall_s - known.wall_s) - (now.steady_s - known.steady_s)
        if not abs(step_s) > SET_S:
            return now, 0.0
        if self.has_begun:
            self.set_by_s += step_s
            self.set_at_s = now.steady_s
            self.n_set += 1
            end_s = now.wall_s - self.set_by_s
            begin_s = end_s - (now.steady_s - known.steady_s)
            self._settings.append(Setting(begin_s, end_s, self.set_by_s))
        return now, step_s


class Sifted(NamedTuple):
    """What a clock makes of messages that have arrived."""

    passed: list[Message]
    """In the time of the run."""
    refused: list[Message]
    """Of another clock, as they were stamped."""
    untold: list[Message]
    """Which waited in vain to be told how their stamps are to be read."""
    set_by_s: float
    """By how much the clock that stamps them was found to have been set, s; 0 where it was not."""


class StampClock:
    """The clock that stamps one kind of message: followed where it is set, strangers are refused.

    A message is of the known clock where its stamp goes on from the last one, or is as far from its
    arrival as others were. Those of another clock wait. They are let in, all of them, once they
    have come for a second in which the known clock was silent (it was set, or the instrument was
    exchanged), and refused where it is heard again before. Where the vehicle's own clock was set,
    inertial samples that follow it are known at once, for they follow each other; others wait until
    it is told whether they do.
    """

    def __init__(self, clock: RunClock, *, is_steady: bool) -> None:
        """``is_steady`` says that messages follow each other in order, as inertial samples do."""
        self._clock, self._is_steady = clock, is_steady
        self._shift_s = clock.set_by_s
        self._stamp_s = self._heard_s = math.nan
        self._lag_s, self._lead_s = 0.0, -math.inf
        self._interval_s, self._period_s = 0.0, 0.0
        self._strangers: list[Message] = []
        self._stranger_s = self._met_s = self._come_s = 0.0
        self._found_s = 0.0
        self._n_set = clock.n_set
        self._others_s: tuple[float, ...] = ()
        """What stamps may be ahead by as well, s."""
        self._lags = Lags()
        self._doubt: Doubt | None = None

    def sift(self, message: Message, now: Now) -> Sifted:
        """Return what may pass, in the time of the run, and what was refused."""
        passed: list[Message] = []
        refused: list[Message] = []
        messages = [message]
        self._found_s = 0.0
        if self._strangers and self._clock.set_at_s >= self._met_s:  # they came before it was known
            messages, self._strangers = [*self._strangers, message], []
        self._follow(now)
        for one in messages:
            if self._doubt is not None:
                if self._doubt.wait(one, self._arrival(now), ahead_s=self._ahead_s(now)):
                    self._heard_s = now.steady_s
                    refused += self._strangers
                    self._strangers = []
                else:
                    refused += self._meet(one, now, passed)
                continue
            shift_s = self._shift_of(one.time_s, now)
            if self._is_known(one.time_s - shift_s, now):
                refused += self._strangers
                self._strangers = []
                self._shift_s = shift_s
                passed.append(self._passed(one, now))
            else:
                refused += self._meet(one, now, passed)
        settled, untold = self.settle(now)
        return Sifted([*settled, *passed], refused, untold, self._found_s)

    def settle(self, now: Now) -> tuple[list[Message], list[Message]]:
        """Return messages that waited: those whose stamps can be read by now, and the too late."""
        if self._doubt is None:
            return [], []
        told = self._doubt.tell(self._run_s(now))
        if told is None:
            return [], self._doubt.give_up(self._run_s(now))
        return self._heed(told, now), []

    def waiting(self, now: Now) -> list[Readings]:
        """Return messages whose stamps wait to be read, in the time of the run.

        Strangers are among them once the known clock has missed its turn, as they will be read if
        they are believed: from then on it is likelier that it was set than that it goes on.
        """
        if self._doubt is not None:
            return self._doubt.waiting()
        turn_s = SILENT_TIMES * self._interval_s or STRANGER_S
        has_missed = now.steady_s - self._heard_s > turn_s
        if not (self._strangers and has_missed):
            return []
        shift_s = self._strangers_shift_s()
        return [(replace(one, time_s=one.time_s - shift_s),) for one in self._strangers]

    def end(self, now: Now) -> tuple[list[Message], list[Message]]:
        """Return what waits, read as is likelier now that nothing more comes, and the strangers."""
        passed = [readings[0] for readings in self.waiting(now)]
        refused = self._strangers if self._doubt is not None or not passed else []
        self._doubt, self._strangers = None, []
        return passed, refused

    def readings(self, message: Message, now: Now) -> Readings:
        """Return how a message that is held elsewhere would be read if it came now."""
        if self._doubt is not None:
            return self._doubt.readings(message)
        shift_s = self._shift_of(message.time_s, now)
        return (replace(message, time_s=message.time_s - shift_s),)

    def _heed(self, told: Told, now: Now) -> list[Message]:
        """Read stamps as is told from now on; return what waited for that."""
        self._doubt = None
        self._shift_s = told.shift_s
        self._others_s = () if told.other_s is None else (told.other_s,)
        for message in told.messages:
            self._remember(message.time_s, now)
        return told.messages

    def off_s(self, message: Message) -> float:
        """Return how far a stamp is from the last one of the known clock, s."""
        return message.time_s - self._shift_s - self._stamp_s

    def _follow(self, now: Now) -> None:
        """Take note of how the vehicle's clock was set since the last message."""
        settings = self._clock.settings(self._n_set)
        self._n_set = self._clock.n_set
        if math.isnan(self._stamp_s):
            return
        if self._is_steady:
            if settings:
                was_s = [self._shift_s, *(setting.set_by_s for setting in settings)]
                self._others_s = (*self._others_s, *was_s)[-N_SETTINGS:]
            return
        for setting in settings:
            if self._doubt is None and abs(setting.set_by_s - self._shift_s) > SET_S:
                self._doubt = Doubt(
                    self._shift_s,
                    self._stamp_s,
                    self._period_s,
                    lags=self._lags,
                    least_s=-self._lead(now),
                )
            if self._doubt is not None:
                self._doubt.set(setting)

    def _shift_of(self, stamp_s: float, now: Now) -> float:
        """Return what a stamp is ahead of the time of the run by, s: as before, or newly set."""
        if math.isnan(self._stamp_s):  # of this clock, or of one that never followed it
            shifts = (self._clock.set_by_s, 0.0)
            return min(shifts, key=lambda s: abs(stamp_s - s - self._run_s(now)))
        if self._is_steady:
            if now.steady_s - self._clock.set_at_s > FOLLOWS_S:
                self._others_s = ()
            known = (self._shift_s, *self._others_s)
            return min(known, key=lambda one: self._misfit(stamp_s - one, now))
        if self._is_known(stamp_s - self._shift_s, now):
            return self._shift_s
        fitting = (x for x in self._others_s if self._is_known(stamp_s - x, now))
        return next(fitting, self._shift_s)  # delays had hidden that it is this one

    def _misfit(self, time_s: float, now: Now) -> tuple[bool, float]:
        """Return whether and how far an inertial sample does not follow on the last one, s.

        One that follows at once does, whatever was on its way between the two.
        """
        step_s = time_s - self._stamp_s - self._period_s
        if abs(step_s) <= FOLLOWED_S:
            return False, abs(step_s)
        return True, min(abs(step_s), abs(step_s - (now.steady_s - self._heard_s)))

    def _run_s(self, now: Now) -> float:
        return now.wall_s - self._clock.set_by_s

    def _arrival(self, now: Now) -> Arrival:
        run_s = self._run_s(now)
        return Arrival(run_s - self._clock.unread_s, run_s)

    def _is_known(self, time_s: float, now: Now) -> bool:
        if math.isnan(self._stamp_s):
            return True
        ahead_s = time_s - self._run_s(now)
        if not self._is_steady:
            return not ahead_s > self._ahead_s(now)
        is_ahead = ahead_s > AHEAD_S + self._lead(now)
        step_s = time_s - self._stamp_s
        off_s = step_s - (now.steady_s - self._heard_s)
        if self._strangers and abs(self._off_strangers_s(time_s, now)) < abs(off_s):
            return False
        is_near = min(abs(step_s), abs(off_s)) <= SAME_CLOCK_S
        if -BACK_S < step_s <= FOLLOWED_S:
            return True
        return step_s > 0.0 and is_near and not is_ahead

    def _off_strangers_s(self, time_s: float, now: Now) -> float:
        """Return how far a time is from what would follow on the last stranger's, s."""
        step_s = time_s - (self._strangers[-1].time_s - self._shift_s)
        return step_s - (now.steady_s - self._met_s)

    def _ahead_s(self, now: Now) -> float:
        """Return how far ahead of its arrival a stamp of no inertial sample may be, s."""
        return AHEAD_S + max(self._lead(now), 0.0)

    def _lead(self, now: Now) -> float:
        """Return how far ahead of its arrival a stamp has been lately, s."""
        if math.isnan(self._heard_s):
            return self._lead_s
        return self._lead_s - LEAD_DECAY * (now.steady_s - self._heard_s)

    def _passed(self, message: Message, now: Now) -> Message:
        """Return a message of the known clock in the time of the run; remember it."""
        self._clock.begin()
        time_s = message.time_s - self._shift_s
        self._lag_s = self._run_s(now) - time_s
        self._lead_s = max(self._lead(now), -self._lag_s)
        self._lags.add(time_s, self._arrival(now))
        self._remember(time_s, now)
        return replace(message, time_s=time_s) if self._shift_s else message

    def _remember(self, time_s: float, now: Now) -> None:
        """Take a time for that of the last message."""
        if not math.isnan(self._stamp_s):
            since_s = min(now.steady_s - self._heard_s, LONGEST_INTERVAL_S)
            self._interval_s = max(since_s, 0.9 * self._interval_s)
            step_s = time_s - self._stamp_s
            longest_s = FOLLOWED_S if self._is_steady else math.inf
            self._period_s = step_s if 0.0 < step_s <= longest_s else self._period_s
        self._stamp_s, self._heard_s = time_s, now.steady_s

    def _meet(self, message: Message, now: Now, passed: list[Message]) -> list[Message]:
        """Have a stranger wait, or let all of them in; return those of a third clock."""
        third: list[Message] = []
        waiting = self._strangers
        if waiting and abs(message.time_s - waiting[-1].time_s) > SAME_CLOCK_S + self._interval_s:
            third, self._strangers = waiting, []
        if not self._strangers:
            self._stranger_s, self._come_s = now.steady_s, self._run_s(now)
        self._strangers.append(message)
        self._met_s = now.steady_s
        since_s = now.steady_s - max(self._heard_s, self._stranger_s)
        is_silent = since_s >= max(STRANGER_S, SILENT_TIMES * self._interval_s)
        if is_silent or len(self._strangers) > MOST_STRANGERS:
            if self._doubt is not None:  # of a clock that is no more
                passed += self._heed(self._doubt.likelier(), now)
            was_s, self._shift_s = self._shift_s, self._strangers_shift_s()
            self._found_s = self._shift_s - was_s
            self._lead_s = -math.inf
            waiting, self._strangers = self._strangers, []
            passed += [self._passed(one, now) for one in waiting]
        return third

    def _strangers_shift_s(self) -> float:
        """Return what stamps are ahead by if the strangers' clock is the known one, which was set.

        Time then goes on as it did. Asked again and again the answer is the same.
        """
        gap_s = self._stranger_s - self._heard_s
        first_s = self._strangers[0].time_s
        was_right = abs(self._lag_s) < RIGHT_S
        if not was_right and abs(self._come_s - (first_s - self._clock.set_by_s)) < RIGHT_S:
            return self._clock.set_by_s  # it is right at last
        if self._is_steady:
            period_s = self._period_s or gap_s
            n_periods = max(1, round(gap_s / period_s)) if period_s else 1
            return first_s - (self._stamp_s + n_periods * period_s)
        return first_s - (self._come_s + self._lead_s - LEAD_DECAY * gap_s)


class StampClocks:
    """The clocks of all sources.

    One stamps the inertial data, wherever they come from; of every other kind of message each
    source has one.
    """

    def __init__(self, clock: RunClock) -> None:
        self._clock = clock
        self._clocks: dict[tuple[str, type[Message]], StampClock] = {}

    def of(self, source: str, message: Message) -> StampClock:
        """Return the clock that stamps a message of a source."""
        is_steady = isinstance(message, ImuSample)
        key = "" if is_steady else source, type(message)
        if key not in self._clocks:
            self._clocks[key] = StampClock(self._clock, is_steady=is_steady)
        return self._clocks[key]

    def settle(self, source: str, now: Now) -> tuple[list[Message], list[Message]]:
        """Return what waited of a source, as :meth:`StampClock.settle` does."""
        found = [clock.settle(now) for (of, _), clock in self._clocks.items() if of == source]
        return [m for passed, _ in found for m in passed], [m for _, late in found for m in late]

    def waiting(self, now: Now) -> list[Readings]:
        """Return what waits of all sources, as :meth:`StampClock.waiting` does."""
        return [readings for clock in self._clocks.values() for readings in clock.waiting(now)]

    def end(self, now: Now) -> tuple[list[Message], list[tuple[str, list[Message]]]]:
        """Return what waits of all sources, and the strangers of each, where there are any."""
        found = {key: clock.end(now) for key, clock in self._clocks.items()}
        strangers = [(source, left) for (source, _), (_, left) in found.items() if left]
        return [one for passed, _ in found.values() for one in passed], strangers


def called(message: Message) -> str:
    """Return how messages of an instrument are called."""
    if isinstance(message, ImuSample):
        return "inertial samples"
    return f"{BY_MESSAGE[type(message)].section} messages"
