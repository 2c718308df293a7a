"""What a live estimator accepts: finite, plausible, of a sound clock, and once.

Nothing here depends on the estimate. A message that is refused is told, counted and left out.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from typing import Final

import numpy as np

from ssm_graph.live.estimator.buffers import Buffers
from ssm_graph.mission.events import EventLog
from ssm_graph.mission.navigation import Severity
from ssm_graph.mission.vehicle import Vehicle
from ssm_graph.sensors.dvl import Ping
from ssm_graph.sensors.dvl_readings import STUCK_PINGS, stuck_beams
from ssm_graph.sensors.imu import ImuSample
from ssm_graph.sensors.messages import Message, bad_number
from ssm_graph.sensors.registry import BY_MESSAGE

AHEAD_S: Final = 5.0
"""Messages further ahead of the inertial data than this belong to another clock."""
NEXT_S: Final = 2.5
"""A gap of the inertial data so long is taken at once, a longer one when the samples go on."""
SKIPPED: Final = 3.0
"""More sampling intervals than this without a sample are told: a clock of the inertial data that is
set forward by less moves a vehicle at 2 m/s and 100 Hz by 6 cm."""
CLOCK_SAMPLES: Final = 20
"""So many inertial samples in a row on another time make it the new one."""


class Intake:
    """Checks messages, mends the clock, and fills the buffers."""

    def __init__(self, vehicle: Vehicle, events: EventLog) -> None:
        self.buffers = Buffers(vehicle)
        self.counts: Counter[str] = Counter()
        """How many messages of each kind were refused, and why."""
        self.shift_s = 0.0
        """Added to the vehicle's clock since it was set back."""
        self.horizon_s = -np.inf
        """What is older is refused."""
        self._events = events
        self._elsewhere: list[ImuSample] = []

    def accept(self, message: Message) -> float | None:
        """Take a message; return the time that it adds to, None if it was refused."""
        now_s = self.buffers.imu.last_s
        problem = self._problem(message)
        if problem is not None:
            kind, text = problem
            self._refuse(message, now_s, kind, text)
            return None
        if self.shift_s:
            message = replace(message, time_s=message.time_s + self.shift_s)
        if isinstance(message, ImuSample):
            return self._accept_sample(message, now_s)
        time_s = self.buffers.time_of(message)
        if time_s < self.horizon_s:
            late_s = now_s - time_s
            self._refuse(message, now_s, "too_late", f"{late_s:.1f} s old, older than the lag")
            return None
        if time_s > now_s + AHEAD_S:
            ahead_s = time_s - now_s
            self._refuse(
                message, now_s, "clock", f"{ahead_s:.1f} s ahead of the inertial data: wrong clock?"
            )
            return None
        message = self._sifted(message, time_s, now_s)
        if not self._add(message):
            return None
        return self._since_stuck(message, time_s) if isinstance(message, Ping) else time_s

    def _since_stuck(self, ping: Ping, time_s: float) -> float:
        """Return the time of the first ping that this one shows to be of a stuck beam, or its own.

        A ping that ends a row of equal readings, or comes late into one, changes what that was.
        """
        rows = self.buffers.pings.all
        at = self.buffers.pings.index(time_s)
        first = max(at - STUCK_PINGS, 0)
        near = rows[first : at + STUCK_PINGS, self.buffers.speeds]
        known = np.delete(near, at - first, axis=0)
        was = np.insert(stuck_beams(known), at - first, False, axis=0)
        now = stuck_beams(near)
        changed = (was != now).any(axis=1)
        for beam in np.flatnonzero(now[at - first]).tolist():
            self._events.tell(
                ping.time_s,
                Severity.WARNING,
                f"beam_{beam + 1}_stuck",
                f"beam {beam + 1} repeats {ping.speed[beam]:g} m/s in every ping: left out",
            )
        return float(rows[first + np.argmax(changed), 0]) if changed.any() else time_s

    def _problem(self, message: Message) -> tuple[str, str] | None:
        name = bad_number(message)
        if name is not None:
            return "not_finite", f"{name} is not a finite number"
        one, bare = BY_MESSAGE[type(message)], self.buffers.bare(message)
        if bare is None:
            return "undeclared", f"the vehicle file has no [{one.section}]"
        if isinstance(message, Ping) and message.is_water and self.buffers.vehicle.current is None:
            return "water_track", "off the water, and the vehicle file has no [current]"
        text = one.problem(message, bare)
        return None if text is None else ("implausible", text)

    def _sifted(self, message: Message, time_s: float, now_s: float) -> Message:
        """Return a message without what its instrument cannot have measured, told and counted."""
        rows = self.buffers.rows[_name(message)]
        at = rows.index(time_s)
        near = rows.all[max(at - 1, 0) : at + 2]
        one, bare = BY_MESSAGE[type(message)], self.buffers.bare(message)
        sifted, fault = one.sifted(message, near[near[:, 0] != time_s], bare)
        if fault is not None:
            self._refuse(message, now_s, *fault)
        return sifted

    def _accept_sample(self, sample: ImuSample, now_s: float) -> float | None:
        """Take an inertial sample where one may be: next, after a gap, or in one."""
        time_s, period_s = self.buffers.time_of(sample), self.buffers.period_s
        if self.buffers.has(sample):
            self.counts["imu repeated"] += 1
            return None
        is_next = now_s < time_s <= now_s + max(NEXT_S, 20.0 * period_s)
        if is_next or now_s == -np.inf:
            self._elsewhere.clear()
            usual_s = self.buffers.shortest_period_s  # infinite while not known
            if SKIPPED * usual_s < time_s - now_s - usual_s < np.inf:
                self._tell_skipped(sample, time_s - now_s - usual_s)
            return time_s if self._add(sample) else None
        if self.horizon_s <= time_s < now_s and self._is_missing(time_s, period_s):
            return time_s if self._add(sample) else None
        return self._meet_another_clock(sample, now_s, period_s)

    def _tell_skipped(self, sample: ImuSample, skipped_s: float) -> None:
        """Tell that samples are missing, which nothing tells from a clock that was set forward."""
        text = (
            f"no inertial sample for {skipped_s:.3g} s: lost, late, or their clock was set forward "
            "by so much and is ahead of all others from now on"
        )
        self._events.tell(sample.time_s, Severity.INFO, "imu_skipped", text)

    def _is_missing(self, time_s: float, period_s: float) -> bool:
        """Return whether a late sample has room of its own."""
        rows = self.buffers.imu
        at = rows.index(time_s)
        before_s = rows.all[at - 1, 0] if at else time_s - period_s
        return bool(min(time_s - before_s, rows.all[at, 0] - time_s) > 0.5 * period_s)

    def _meet_another_clock(self, sample: ImuSample, now_s: float, period_s: float) -> float | None:
        """Wait for more of a time that is not ours; a whole row of samples makes it so."""
        row = self._elsewhere
        if row and not 0.0 < sample.time_s - row[-1].time_s < max(1.0, 20.0 * period_s):
            row.clear()
        row.append(sample)
        if len(row) < CLOCK_SAMPLES:
            self._refuse(
                *(sample, now_s, "clock"),
                f"stamped {self.buffers.time_of(sample) - now_s:+.2f} s off the last one",
            )
            return None
        samples, off_s = row.copy(), self.buffers.time_of(row[0]) - now_s
        row.clear()
        if off_s < 0.0:
            self.shift_s += period_s - off_s
            samples = [replace(s, time_s=s.time_s + period_s - off_s) for s in samples]
            what = "set_back", f"the clock was set back by {-off_s:.2f} s: it goes on as before"
        else:
            what = "gap", f"the inertial data begin again after {off_s:.2f} s"
        self._events.tell(samples[-1].time_s, Severity.WARNING, f"clock_{what[0]}", what[1])
        for waiting in samples:
            self._add(waiting)
        return self.buffers.time_of(samples[0])

    def _add(self, message: Message) -> bool:
        is_new = self.buffers.add(message)
        if not is_new and self.buffers.has(message):
            self.counts[f"{_name(message)} repeated"] += 1
        elif not is_new:
            text = (
                "another one of its time came first, with other numbers: two of them at one port?"
            )
            self._refuse(message, message.time_s, "contrary", text)
        return is_new

    def _refuse(self, message: Message, now_s: float, kind: str, text: str) -> None:
        name = _name(message)
        self.counts[f"{name} {kind}"] += 1
        at_s = now_s if np.isfinite(now_s) else 0.0
        self._events.tell(
            at_s, Severity.WARNING, f"{name}_{kind}", f"{name} message refused: {text}"
        )


def _name(message: Message) -> str:
    return BY_MESSAGE[type(message)].section
