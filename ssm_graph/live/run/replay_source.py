"""A recorded mission in the place of sockets, at the speed of the clock or as fast as it goes."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Iterator
from itertools import islice
from typing import Final

import numpy as np

from ssm_graph.base.errors import ConfigError
from ssm_graph.base.frozen import Array
from ssm_graph.mission.navigation import Event
from ssm_graph.mission.run_status import LinkState, SourceStatus
from ssm_graph.sensors.imu import ImuSample
from ssm_graph.sensors.messages import Message, Readings

MOST: Final = 1000
"""Messages of one poll."""
RECENT_S: Final = 5.0
"""An older height over the bottom is none."""
_ROUNDING_S = 1e-6


class ReplaySource:
    """Messages in order of time, each when its time has come.

    Parameters
    ----------
    messages : in order of time.
    speed : 1 is as they were recorded, None as fast as they are taken.
    skip : how many were given to an earlier process of the same run.
    name : for people.
    end_s : time of the last message, for the progress.
    altitude : times (N,), s, and heights over the bottom then (N,), m, for people.
    wait : waits so many seconds, and looks after what else there is.
    steady_s : a clock that is never set.
    """

    def __init__(
        self,
        messages: Iterable[Message],
        *,
        speed: float | None = None,
        skip: int = 0,
        name: str = "mission",
        end_s: float = float("nan"),
        altitude: tuple[Array, Array] | None = None,
        wait: Callable[[float], None] = time.sleep,
        steady_s: Callable[[], float] = time.monotonic,
    ) -> None:
        if speed is not None and not 0.0 < speed < float("inf"):
            raise ConfigError(f"speed: expected a number above 0, got {speed}")
        self._messages: Iterator[Message] = islice(iter(messages), skip, None)
        self._speed, self._name, self._end_s = speed, name, end_s
        self._wait, self._steady_s = wait, steady_s
        self._altitude_s, self._altitude_m = altitude or (np.zeros(0), np.zeros(0))
        self._next = next(self._messages, None)
        self._n_messages = 0
        self._begin_s = self.time_s = 0.0 if self._next is None else self._next.time_s
        self._began_s: float | None = None

    @property
    def is_finished(self) -> bool:
        """Whether all messages were given."""
        return self._next is None

    @property
    def elapsed_s(self) -> float:
        """Time of the mission since the first message of this process, s."""
        return self.time_s - self._begin_s

    def waiting(self) -> list[Readings]:
        """Return what has come and waits: nothing does."""
        return []

    def end(self) -> list[Message]:
        """Return what has come and waits when the run ends: nothing does."""
        return []

    def poll(self, timeout_s: float) -> list[Message]:
        """Return the messages whose time has come; wait for the next where there are none.

        Without a speed it is what belongs to one inertial sample, so that answers do not depend on
        how fast this computer is.
        """
        if self._speed is None:
            self._wait(0.0)
            return self._take(self._is_before_next_sample())
        if self._began_s is None:
            self._began_s = self._steady_s()
        due_s = self._begin_s + (self._steady_s() - self._began_s) * self._speed
        messages = self._take(lambda message: message.time_s <= due_s + _ROUNDING_S)
        if messages:
            self._wait(0.0)
        elif self._next is not None:
            self._wait(max(0.0, min(timeout_s, (self._next.time_s - due_s) / self._speed)))
        return messages

    def take_events(self) -> list[Event]:
        """Return none: all goes well here."""
        return []

    def source_status(self) -> tuple[SourceStatus, ...]:
        """Return how far it is."""
        state = LinkState.DONE if self.is_finished else LinkState.REPLAYING
        address = "as fast as it goes" if self._speed is None else f"speed {self._speed:g}"
        if self._end_s > self._begin_s:
            address += f", {100.0 * self.elapsed_s / (self._end_s - self._begin_s):.0f} % done"
        status = SourceStatus(
            self._name,
            address,
            state,
            n_messages=self._n_messages,
            rate_hz=self._n_messages / max(self.elapsed_s, 1.0),  # of the mission's time
            age_s=0.0,
            altitude_m=self._altitude_now(),
        )
        return (status,)

    def _altitude_now(self) -> float:
        """Return the newest height over the bottom that is not old, m; else NaN."""
        begin = np.searchsorted(self._altitude_s, self.time_s - RECENT_S)
        end = np.searchsorted(self._altitude_s, self.time_s, side="right")
        known = self._altitude_m[begin:end][np.isfinite(self._altitude_m[begin:end])]
        return float(known[-1]) if len(known) else math.nan

    def _take(self, is_due: Callable[[Message], bool]) -> list[Message]:
        taken: list[Message] = []
        while self._next is not None and len(taken) < MOST and is_due(self._next):
            taken.append(self._next)
            self.time_s = self._next.time_s
            self._next = next(self._messages, None)
        self._n_messages += len(taken)
        return taken

    def _is_before_next_sample(self) -> Callable[[Message], bool]:
        n_samples = 0

        def is_due(message: Message) -> bool:
            nonlocal n_samples
            n_samples += isinstance(message, ImuSample)
            return n_samples <= 1

        return is_due
