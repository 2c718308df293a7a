"""The live estimator: messages in, in any order; the newest state out, at once."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import astuple, replace
from typing import Any, Final, Self

import numpy as np

from ssm_graph.base.earth import LocalFrame
from ssm_graph.base.frozen import Array
from ssm_graph.base.times import MIN_SPACING_S
from ssm_graph.live.estimator.answers import Delayed, answer, delayed_of, found_by
from ssm_graph.live.estimator.course import REACH_S, Course, Step
from ssm_graph.live.estimator.guard import Guardian
from ssm_graph.live.estimator.intake import Intake
from ssm_graph.live.estimator.keyframes import KeyframeMaker
from ssm_graph.live.estimator.packing import pack_step, part_of, unpack_step
from ssm_graph.live.estimator.recovery import ASTRAY_TIMES, Reserve, is_astray
from ssm_graph.live.estimator.separation import IntegrityConfig
from ssm_graph.live.estimator.start import Starter, not_calibrated, not_used, sensors_of_vehicle
from ssm_graph.live.estimator.tail import Tail
from ssm_graph.live.estimator.watch import Watch
from ssm_graph.mission.estimate import Found
from ssm_graph.mission.events import EventLog
from ssm_graph.mission.mission import Mission
from ssm_graph.mission.navigation import Event, Health, Navigation, Severity
from ssm_graph.mission.problem import ProblemConfig
from ssm_graph.mission.vehicle import Vehicle
from ssm_graph.sensors.imu import ImuSample
from ssm_graph.sensors.messages import Message
from ssm_graph.smoothers.keyframe import Keyframe, Sensors
from ssm_graph.smoothers.window import FixedLagConfig, Window

ONLINE: Final = FixedLagConfig(
    max_iterations=3,
    tolerance=0.02,
    relinearise_sigmas=0.1,
    relinearise_turn=2e-3,
    reweigh=0.02,
    gate_sigmas=6.0,
    first_estimates=True,
)
"""What a vehicle can afford; `benchmarks/online/` compares it with windows solved to the end."""
LONGEST_GAP_S: Final = 10.0
"""After a longer gap of the inertial data the attitude has to be found anew."""
OWED_S: Final = 0.1
"""Steps that late messages undo are made anew when they are asked for, or after so much data: of
many late messages together each would else have the same steps made."""
CATCH_UP_STEPS: Final = 1
"""Of the keyframes that came while an alignment was worked on so many are made in one push."""


class FixedLagSmoother:
    """Estimates a vehicle's state from messages as they come.

    ::

        smoother = FixedLagSmoother(vehicle)
        for message in messages:
            smoother.push(message)
            navigation = smoother.newest()

    Messages may come late and out of order within the lag, repeated, damaged or not at all: nothing
    raises. Out of order they lead to the same answer as in order. Smoothed states are kept until
    ``take_delayed`` takes them: in a long run call it now and then.
    """

    def __init__(
        self,
        vehicle: Vehicle,
        config: FixedLagConfig | None = None,
        *,
        problem_config: ProblemConfig | None = None,
        integrity: IntegrityConfig | None = None,
    ) -> None:
        """Take a vehicle; ``config`` is :data:`ONLINE` when left out."""
        self.vehicle, self.config = vehicle, config or ONLINE
        self.integrity = integrity or IntegrityConfig()
        self._problem_config = problem_config or ProblemConfig()
        self._events = EventLog()
        self._intake = Intake(vehicle, self._events)
        self._starter = Starter(vehicle, self._problem_config, self._events)
        self._made: Course | None = None
        self._owed_s: float | None = None
        self._frame = vehicle.frame
        self._tail: Tail | None = None
        self._latest_s = -np.inf
        self._cost_s = 0.0
        self._begun_s, self._is_lost = 0.0, False
        self._known: list[Any] = []
        self._finished: list[Delayed] = []

    @property
    def counts(self) -> dict[str, int]:
        """How many messages were refused, by sensor and reason."""
        return dict(self._intake.counts)

    @property
    def shift_s(self) -> float:
        """Added to the vehicle's clock since it was set back, s: the clock of the states."""
        return self._intake.shift_s

    def received(self, begin_s: float, end_s: float) -> Mission | None:
        """Return what is kept of between two times of the states, None before there is a frame."""
        frame, kept = self._frame, self._intake.buffers
        return None if frame is None else kept.mission(frame, begin_s=begin_s, until_s=end_s)

    def push(self, message: Message) -> None:
        """Take one message; nothing that it may hold raises."""
        begin = time.perf_counter()
        newest_s = self._intake.buffers.imu.last_s
        time_s = self._intake.accept(message)
        if time_s is None:
            return
        is_late = time_s < newest_s or not isinstance(message, ImuSample)
        self._latest_s = max(self._latest_s, message.time_s + self._intake.shift_s)
        is_made = self._update(message, time_s, newest_s, is_late=is_late)
        if is_made:
            self._cost_s = time.perf_counter() - begin

    def _update(self, message: Message, time_s: float, newest_s: float, *, is_late: bool) -> bool:
        """Let the answer follow what has come; return whether a keyframe was made.

        ``newest_s`` is the time of the last inertial sample before it came, s.
        """
        course, buffers = self._made, self._intake.buffers
        is_sample = isinstance(message, ImuSample)
        if is_sample and self._is_gap(time_s, newest_s):
            course = self._course
            buffers.drop_before(time_s)
            if course is None:
                self._starter.begin_anew()
            else:
                self._lose(time_s, f"no inertial data for more than {LONGEST_GAP_S:.0f} s")
            return False
        if course is None:
            return self._start()
        undone = is_late and course.rewind(time_s - (REACH_S if is_sample else MIN_SPACING_S))
        if undone and self._owed_s is None:
            self._owed_s = buffers.imu.last_s
        if self._owed_s is None:
            return self._advance(course, is_sample=is_sample, is_late=is_late)
        return buffers.imu.last_s - self._owed_s >= OWED_S and self._make_anew()

    @property
    def _course(self) -> Course | None:
        """The steps, with those that late messages undid."""
        self._make_anew()
        return self._made

    def _make_anew(self) -> bool:
        """Make the steps that late messages undid, once for all of these; return whether any."""
        if self._made is None or self._owed_s is None:
            return False
        self._owed_s = None
        return self._advance(self._made, is_sample=False, is_late=True, undone=True)

    def _advance(
        self, course: Course, *, is_sample: bool, is_late: bool, undone: bool = False
    ) -> bool:
        """Make the steps that the data allow; return whether there were any."""
        is_behind, buffers = self._tail is None, self._intake.buffers
        n_made = course.advance(
            is_sample=not (is_late or is_behind), at_most=CATCH_UP_STEPS if is_behind else np.inf
        )
        self._intake.horizon_s = course.horizon_s
        if is_astray(course.newest.watch):
            reason = f"fixes contradicted the position {ASTRAY_TIMES} times: wrong heading?"
            self._lose(buffers.imu.last_s, reason)
            return True
        if is_behind and n_made == CATCH_UP_STEPS:
            return True
        if undone or n_made or self._tail is None or (is_late and is_sample):
            self._tail = self._tail_of(course.newest)
        elif is_sample:
            self._tail.add(buffers.inertial(buffers.imu.between(self._tail.end_s, np.inf)))
        return n_made > 0

    def _start(self) -> bool:
        beginning = self._starter.find(self._intake.buffers)
        if beginning is None:
            return False
        self._frame, self._begun_s = beginning.frame, beginning.begin_s
        for note in not_calibrated(self.vehicle):
            self._events.tell(beginning.time_s, Severity.INFO, "not_calibrated", note)
        for note in not_used(self.vehicle):
            self._events.tell(beginning.time_s, Severity.WARNING, "not_used", note)
        sensors = sensors_of_vehicle(self.vehicle, self._frame)
        first = Keyframe(beginning.time_s, sensors.beams)
        window = Window(sensors, self.config, first, beginning.moments)
        window.iterate()
        guardian = self._guardian(sensors)
        guard = guardian.begin(window, self._known)
        step = Step(window, Watch(), None, Reserve.of(window), guard)
        self._made = self._course_from(step, guardian)
        return True

    def _guardian(self, sensors: Sensors) -> Guardian:
        return Guardian(sensors, self.integrity)

    def _maker(self) -> KeyframeMaker:
        assert self._frame is not None
        buffers, config = self._intake.buffers, self._problem_config
        return KeyframeMaker(buffers, self._frame, config, begin_s=self._begun_s)

    def _course_from(self, step: Step, guardian: Guardian) -> Course:
        course = Course(step, self._maker(), self._intake.buffers, self._events, guardian)
        self._intake.horizon_s = course.horizon_s
        return course

    def checkpoint(self) -> tuple[dict[str, Array], dict[str, Any]]:
        """Return the state as plain arrays and plain numbers, for :meth:`restore`.

        That is the oldest step that messages may still undo, and everything received since: all
        later steps follow from these, and so does the answer to every late message.
        Delayed states that have not been taken are not in it: take them first.
        """
        intake, course = self._intake, self._course
        arrays = intake.buffers.pack()
        meta: dict[str, Any] = {
            "shift_s": intake.shift_s,
            "counts": dict(intake.counts),
            "frame": None if self._frame is None else [*astuple(self._frame)],
            "is_lost": self._is_lost,
            "begun_s": self._begun_s,
            "alignment": self._starter.pack(),
            "watch": None,
            "contradictions": self._known,
        }
        if course is not None:
            oldest, guardian = course.oldest, course.guardian
            packed, meta["watch"] = pack_step(oldest)
            meta["contradictions"] = guardian.plain(oldest.guard)
            arrays |= packed | {f"guard_{name}": array for name, array in oldest.guard.pack()}
        return arrays, meta

    @classmethod
    def restore(
        cls,
        vehicle: Vehicle,
        config: FixedLagConfig | None,
        arrays: Mapping[str, Array],
        meta: Mapping[str, Any],
        *,
        problem_config: ProblemConfig | None = None,
        integrity: IntegrityConfig | None = None,
    ) -> Self:
        """Return the estimator as it was when ``checkpoint`` was called.

        Lanes that it does not have, of an earlier version, begin anew.
        """
        smoother = cls(vehicle, config, problem_config=problem_config, integrity=integrity)
        intake = smoother._intake
        intake.shift_s = float(meta["shift_s"])
        intake.counts.update(meta["counts"])
        intake.buffers.unpack(arrays)
        smoother._latest_s = intake.buffers.imu.last_s
        smoother._begun_s = meta["begun_s"]
        smoother._known = list(meta.get("contradictions", ()))
        if meta["is_lost"]:
            smoother._start_anew()
        if meta["frame"] is not None:
            smoother._frame = LocalFrame(*meta["frame"])
        if meta["watch"] is None:
            smoother._starter.go_on_from(meta["alignment"], intake.buffers)
        else:
            assert smoother._frame is not None
            sensors = sensors_of_vehicle(vehicle, smoother._frame)
            inertial = smoother._maker().inertial
            packed = arrays, meta["watch"], sensors, smoother.config
            window, watch, left, reserve = unpack_step(*packed, inertial)
            guardian = smoother._guardian(sensors)
            guard = guardian.unpack(part_of(arrays, "guard_"), smoother._known, window)
            step = Step(window, watch, left, reserve, guard)
            smoother._made = course = smoother._course_from(step, guardian)
            course.advance()
            intake.horizon_s = course.horizon_s
            smoother._tail = smoother._tail_of(course.newest)
        return smoother

    def _is_gap(self, time_s: float, newest_s: float) -> bool:
        if newest_s < time_s <= newest_s + LONGEST_GAP_S:
            return False
        samples = self._intake.buffers.imu
        at = samples.index(time_s)
        return bool(at > 0 and time_s - samples.all[at - 1, 0] > LONGEST_GAP_S)

    def _lose(self, time_s: float, reason: str) -> None:
        """Give the answer up, keep what was found, and align anew."""
        self._owed_s = None
        assert self._made is not None
        text = f"{reason}; position and attitude have to be found anew"
        self._events.tell(time_s, Severity.ERROR, "lost", text)
        self._finished += self._take(self._made, all_of_them=True)
        self._known = self._made.guardian.plain(self._made.newest.guard)
        self._made = self._tail = None
        self._intake.horizon_s = time_s
        self._start_anew()

    def _start_anew(self) -> None:
        """Align without the initial state, which is of another time."""
        self._is_lost = True
        vehicle = replace(self.vehicle, initial=None)
        self._starter = Starter(vehicle, self._problem_config, self._events)

    def _tail_of(self, step: Step) -> Tail:
        assert self._frame is not None
        assert self._made is not None
        window, guardian = step.window, self._made.guardian
        tail = Tail(
            window.keyframes[-1],
            window.newest_states,
            guardian.covering(step.guard, window.newest_covariance),
            noise=self.vehicle.imu_noise,
            frame=self._frame,
            inertial=window.inertial,
        )
        buffers, imu = self._intake.buffers, self._intake.buffers.imu
        first = max(imu.index(step.time_s, after=True) - 1, 0)
        tail.add(buffers.inertial(imu.all[first:]))
        return tail

    def newest(self) -> Navigation | None:
        """Return the state at the last inertial sample, None before there is any."""
        course = self._course
        if course is None or self._tail is None:
            return None
        assert self._frame is not None
        return answer(
            self._tail.newest(),
            course.newest.watch,
            course.guarded,
            self._frame,
            latest_s=self._latest_s,
            shift_s=self._intake.shift_s,
            latency_s=self._cost_s,
        )

    def found(self) -> Found:
        """Return what is known by now beside the state of the vehicle."""
        course = self._course
        return Found() if course is None else found_by(course.newest.window, begun_s=self._begun_s)

    def status(self) -> tuple[Health, str]:
        """Return the health of the newest answer and one sentence, also before there is one."""
        navigation = self.newest()
        if navigation is None:
            return Health.ALIGNING, self._starter.reason
        return navigation.health, navigation.reason

    def take_events(self) -> tuple[Event, ...]:
        """Return what happened since the last call."""
        return self._events.take()

    def take_delayed(self) -> list[Delayed]:
        """Return the smoothed states that nothing will change any more, since the last call."""
        course = self._course
        taken, self._finished = self._finished, []
        return taken if course is None else taken + self._take(course)

    def finish(self) -> list[Delayed]:
        """Return all smoothed states that are left, and end."""
        course = self._course
        taken, self._finished = self._finished, []
        if course is not None:
            taken += self._take(course, all_of_them=True)
            self._made = self._tail = None
        return taken

    def _take(self, course: Course, *, all_of_them: bool = False) -> list[Delayed]:
        assert self._frame is not None
        shift_s, extras = self._intake.shift_s, course.newest.window.sensors.extras
        return [
            delayed_of(*settled, self._frame, extras, shift_s=shift_s)
            for settled in course.take_settled(all_of_them=all_of_them)
            if len(settled.stretch.time_s)
        ]
