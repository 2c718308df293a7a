"""The witness beside a live estimator: its set is led on as the data come, block by block.

It begins with the estimator's first answer and its sigmas, and takes nothing else of it. A block
is worked on some seconds after its end, when nothing of it comes late any more, an edge with every
message: no message is held up by more than that.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, Final, NamedTuple, Protocol

import numpy as np

from ssm_graph.base.errors import ConfigError, SsmGraphError
from ssm_graph.base.frozen import Array
from ssm_graph.base.stepwise import Steps
from ssm_graph.mission.estimate import Found
from ssm_graph.mission.events import EventLog
from ssm_graph.mission.mission import InitialState, Mission
from ssm_graph.mission.navigation import Event, Health, Navigation, Severity
from ssm_graph.sensors.imu import ImuSample
from ssm_graph.sensors.messages import Message
from ssm_graph.systems.sensor_network.integrity import APART_S, RIVALS, against
from ssm_graph.systems.sensor_network.track import LATEST_END_S, Edges, VelocityWalk, block_edges
from ssm_graph.systems.sensor_network.witness import (
    LONGEST_GAP_S,
    BoundAlarm,
    PlaceWalk,
    Witness,
    WitnessBounds,
)

LATE_S: Final = 2.0
"""What comes later than this after the end of a block is not used by the witness."""
MARGIN_S: Final = 1.0
"""Of inertial data before and after a block, for means about its pings."""
_DONE_S: Final = LATEST_END_S + LATE_S + MARGIN_S
"""After the end of a block that was waited for, all of it has come."""
ANSWER_EVERY_S: Final = 0.5
"""Answers are kept so often, to be compared at the end of a block."""


class Watched(Protocol):
    """A live estimator: :class:`ssm_graph.live.estimator.FixedLagSmoother`."""

    @property
    def shift_s(self) -> float: ...  # noqa: D102
    def received(self, begin_s: float, end_s: float) -> Mission | None: ...  # noqa: D102
    def push(self, message: Message) -> None: ...  # noqa: D102
    def newest(self) -> Navigation | None: ...  # noqa: D102
    def found(self) -> Found: ...  # noqa: D102
    def status(self) -> tuple[Health, str]: ...  # noqa: D102
    def take_events(self) -> Sequence[Event]: ...  # noqa: D102
    def take_delayed(self) -> Sequence[Any]: ...  # noqa: D102
    def finish(self) -> Sequence[Any]: ...  # noqa: D102
    def checkpoint(self) -> tuple[Mapping[str, Array], Mapping[str, Any]]: ...  # noqa: D102


class Said(NamedTuple):
    """What the witness said last, on the clock of the states."""

    time_s: float
    radius_m: float
    up_m: float
    outside: str
    """A sentence if the answer was outside the set, else empty."""


def start_of(answer: Navigation, time_s: float) -> InitialState:
    """Return an answer as the start of a set, with its sigmas; all that a witness takes of it."""
    roll, pitch, heading = (float(angle) for angle in answer.roll_pitch_heading)
    return InitialState(
        time_s,
        answer.lat,
        answer.lon,
        answer.height,
        roll,
        pitch,
        heading,
        velocity_enu=answer.velocity_enu.copy(),
        position_sigma_enu=answer.position_sigma_enu.copy(),
        velocity_sigma_enu=answer.velocity_sigma_enu.copy(),
        attitude_sigma=answer.attitude_sigma.copy(),
    )


class Witnessed:
    """An estimator with a witness beside it; used as the estimator itself.

    Answers carry ``witness_m`` and its fellows; an alarm is an event ``bound_false_SENSOR``, an
    answer outside the set ``answer_outside``, and it is no longer GOOD. A checkpoint holds the
    estimator alone: whoever goes on from one begins a new set with the answer of then.
    """

    def __init__(
        self, estimator: Watched, bounds: WitnessBounds | None = None, *, lag_s: float = 30.0
    ) -> None:
        """Take an estimator that keeps what it received for ``lag_s``."""
        self.estimator, self.bounds = estimator, bounds or WitnessBounds()
        least = self.bounds.block_s + LATEST_END_S + LATE_S + 2.0 * MARGIN_S
        if lag_s < least:
            raise ConfigError(
                f"witness: expected a lag of {least:g} s or more for blocks of "
                f"{self.bounds.block_s:g} s, got {lag_s:g} s"
            )
        self.last: Witness | None = None
        """The sets at the end of the block that was judged last, on the clock of the states."""
        self._events = EventLog()
        self._begin_anew()

    def _begin_anew(self) -> None:
        self._walks: tuple[VelocityWalk, PlaceWalk] | None = None
        self._idle_until_s = -np.inf
        self._work: Steps[Witness] | None = None
        self._said: Said | None = None
        self._alarmed: dict[str, tuple[float, float]] = {}
        self._answers: deque[tuple[float, Navigation]] = deque()

    def push(self, message: Message) -> None:
        """Let the estimator take a message, and the witness make a step of its own.

        Its time is that of the inertial data; the other clocks may be ahead.
        """
        self.estimator.push(message)
        if not (isinstance(message, ImuSample) and math.isfinite(message.time_s)):
            return
        now_s = message.time_s + self.estimator.shift_s
        try:
            self._step(now_s)
        except (SsmGraphError, np.linalg.LinAlgError, FloatingPointError) as error:
            self._tell(now_s, Severity.WARNING, "witness_failed", f"{error}; its set begins anew")
            self._begin_anew()

    def newest(self) -> Navigation | None:
        """Return the estimator's answer with what the witness says of it."""
        answer, said = self.estimator.newest(), self._said
        if answer is None or said is None:
            return answer
        told = replace(
            answer,
            witness_m=said.radius_m,
            witness_up_m=said.up_m,
            witness_s=said.time_s - self.estimator.shift_s,
        )
        if said.outside and told.health is Health.GOOD:
            confidence = min(told.confidence, 0.4)
            return replace(told, health=Health.DEGRADED, reason=said.outside, confidence=confidence)
        return told

    def found(self) -> Found:
        """Return what the estimator knows beside the state."""
        return self.estimator.found()

    def status(self) -> tuple[Health, str]:
        """Return the health of the newest answer and one sentence."""
        answer = self.newest()
        return self.estimator.status() if answer is None else (answer.health, answer.reason)

    def take_events(self) -> Sequence[Event]:
        """Return what happened to both since the last call."""
        return (*self.estimator.take_events(), *self._events.take())

    def take_delayed(self) -> Sequence[Any]:
        """Return the estimator's settled states."""
        return self.estimator.take_delayed()

    def finish(self) -> Sequence[Any]:
        """Return the estimator's settled states that are left, and end."""
        return self.estimator.finish()

    def checkpoint(self) -> tuple[Mapping[str, Array], Mapping[str, Any]]:
        """Return the estimator's state; see the class."""
        return self.estimator.checkpoint()

    def _step(self, now_s: float) -> None:
        if self._work is None and now_s < self._idle_until_s:
            return
        if self._walks is None or now_s >= self._answer_due_s:
            answer = self.estimator.newest()
            if answer is None:
                return
            at_s = answer.time_s + self.estimator.shift_s
            if not self._answers or at_s > self._answers[-1][0]:
                self._answers.append((at_s, answer))
            if self._walks is None:
                self._begin(at_s, answer)
        if self._work is None:
            self._work = self._begun(now_s)
        elif self._walks is not None:
            try:
                next(self._work)
            except StopIteration as end:
                self._work = None
                self._judge(end.value)
        if self._walks is not None:
            self._idle_until_s = min(self._answer_due_s, self._end_s + _DONE_S)

    @property
    def _answer_due_s(self) -> float:
        """When an answer is to be kept next, for the end of a block; infinite where none is."""
        last_s = self._answers[-1][0] if self._answers else -np.inf
        due_s = max(last_s + ANSWER_EVERY_S, self._end_s - 2.0 * ANSWER_EVERY_S)
        return due_s if due_s < self._end_s + LATEST_END_S + ANSWER_EVERY_S else np.inf

    @property
    def _end_s(self) -> float:
        """When the block that is waited for ought to end, s."""
        assert self._walks is not None
        return self._walks[0].begin_s + (self._n_blocks + 1) * self.bounds.block_s

    def _begin(self, at_s: float, answer: Navigation) -> None:
        """Begin a set with an answer."""
        mission = self.estimator.received(at_s - MARGIN_S, np.inf)
        if mission is None:
            return
        start = start_of(answer, at_s)
        velocity = VelocityWalk(mission, start, self.bounds)
        self._walks = velocity, PlaceWalk(mission.frame, start, self.bounds)
        self._begin_s, self._n_blocks = velocity.begin_s, 0

    def _begun(self, now_s: float) -> Steps[Witness] | None:
        """Return the work on the next block, if all of it has come."""
        if self._walks is None:
            return None
        end_s = self._end_s
        if now_s < end_s + _DONE_S:
            return None
        mission = self.estimator.received(self._begin_s - MARGIN_S, end_s + LATEST_END_S + MARGIN_S)
        assert mission is not None
        stamps = mission.imu.time_s
        if stamps[-1] < end_s + LATEST_END_S and not self._is_known_until(end_s + LATEST_END_S):
            return None  # the sample that told the time was refused
        stamps = stamps[(stamps >= self._begin_s - MARGIN_S) & (stamps <= end_s + LATEST_END_S)]
        if len(stamps) < 2 or np.max(np.diff(stamps)) > LONGEST_GAP_S:
            text = f"inertial data are missing before {end_s:.0f} s: the set begins anew"
            self._tell(now_s, Severity.INFO, "witness_begun_anew", text)
            self._begin_anew()
            return None
        pings = mission.dvl.of_ground().valid_s
        pings = pings[pings > self._begin_s]
        edges = block_edges(pings, self._begin_s, np.array([end_s]), end_s)
        self._begin_s, self._n_blocks = float(edges.time_s[-1]), self._n_blocks + 1
        return _block_steps(*self._walks, mission, edges)

    def _is_known_until(self, time_s: float) -> bool:
        """Return whether the estimator has come to a time; if so, what is missing is lost."""
        answer = self.estimator.newest()
        return answer is not None and answer.time_s + self.estimator.shift_s >= time_s

    def _judge(self, w: Witness) -> None:
        """Compare the answer of then with the set at the end of a block, and tell alarms."""
        self.last, at_s = w, float(w.time_s[-1])
        for alarm in w.alarms:
            self._alarm(alarm)
        last = [latest for _, latest in self._alarmed.values()]
        first = [begun for begun, _ in self._alarmed.values()]
        if last and at_s - max(last) > APART_S:
            self._alarmed.clear()
        elif last and max(last) - min(first) > APART_S:
            text = f"alarms for more than {APART_S:.0f} s: the set begins anew with the answer"
            self._tell(at_s, Severity.WARNING, "witness_begun_anew", text)
            self._begin_anew()
            return
        found = against(w, self._answer_at(at_s)[None])
        outside = ""
        if not found.is_inside[-1]:
            outside = (
                f"{at_s - self.estimator.shift_s:.0f} s: the answer left the set that "
                f"{self.bounds.sigmas:g} sigmas of all that is stated allow: it is wrong, or a "
                "bound is false"
            )
            if not (self._said and self._said.outside):
                self._tell(at_s, Severity.ERROR, "answer_outside", outside)
        is_void = bool(self._alarmed)
        radius, up = float(found.radius_m[-1]), float(found.up_m[-1])
        self._said = Said(at_s, *((np.inf, np.inf) if is_void else (radius, up)), outside)

    def _alarm(self, alarm: BoundAlarm) -> None:
        known = self._alarmed.get(alarm.sensor)
        self._alarmed[alarm.sensor] = (known[0] if known else alarm.time_s, alarm.time_s)
        if known is None:
            rivals = ", ".join(RIVALS[alarm.sensor])
            text = f"{alarm.sentence}; or that of: {rivals}"
            self._tell(alarm.time_s, Severity.WARNING, f"bound_false_{alarm.sensor}", text)

    def _answer_at(self, time_s: float) -> Array:
        """Return where the answers were at a time (3,), m in the mission's frame; forget older."""
        assert self._walks is not None
        frame = self._walks[1].frame
        while len(self._answers) > 2 and self._answers[1][0] <= time_s:
            self._answers.popleft()
        near = list(self._answers)[:2]
        places = [frame.p_n_from_geodetic(one.lat, one.lon, one.height) for _, one in near]
        return np.array(
            [np.interp(time_s, [t for t, _ in near], axis) for axis in np.transpose(places)]
        )

    def _tell(self, time_s: float, severity: Severity, kind: str, text: str) -> None:
        self._events.tell(time_s - self.estimator.shift_s, severity, kind, text)


def _block_steps(
    velocity: VelocityWalk, place: PlaceWalk, mission: Mission, edges: Edges
) -> Steps[Witness]:
    track = yield from velocity.follow_steps(mission, edges)
    return place.follow(mission, track)
