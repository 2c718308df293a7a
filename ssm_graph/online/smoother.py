"""The live estimator: messages in, in any order; the newest state out, at once."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Final

import numpy as np

from ssm_graph.data import Array
from ssm_graph.messages import (
    Event,
    Health,
    ImuSample,
    Message,
    Navigation,
    Severity,
    Vehicle,
)
from ssm_graph.online.course import Course, Step
from ssm_graph.online.delayed import Delayed, delayed_of
from ssm_graph.online.events import EventLog
from ssm_graph.online.intake import Intake
from ssm_graph.online.keyframes import KeyframeMaker, sensors_of_vehicle
from ssm_graph.online.start import Beginning, Starter
from ssm_graph.online.tail import Newest, Tail
from ssm_graph.online.watch import Watch, verdict
from ssm_graph.problem.problem import ProblemConfig
from ssm_graph.problem.trajectory import trajectory_at
from ssm_graph.smoothers.fixed_lag_config import FixedLagConfig
from ssm_graph.smoothers.keyframe import Keyframe
from ssm_graph.smoothers.window import Window

ONLINE: Final = FixedLagConfig(
    max_iterations=3,
    tolerance=0.05,
    relinearise_sigmas=0.3,
    reweigh=0.05,
    gate_sigmas=6.0,
)
"""What a vehicle can afford; `benchmarks/online.py` compares it with windows solved to the end."""
LONGEST_GAP_S: Final = 10.0
"""After a longer gap of the inertial data the attitude has to be found anew."""


class FixedLagSmoother:
    """Estimates a vehicle's state from messages as they come.

    ::

        smoother = FixedLagSmoother(vehicle)
        for message in messages:
            smoother.push(message)
            navigation = smoother.newest()

    Messages may come late and out of order within the lag, repeated, damaged or not at all: nothing
    raises. Out of order they lead to the same answer as in order.
    """

    def __init__(
        self,
        vehicle: Vehicle,
        config: FixedLagConfig | None = None,
        *,
        problem_config: ProblemConfig | None = None,
    ) -> None:
        """Take a vehicle; ``config`` is :data:`ONLINE` when left out."""
        self.vehicle, self.config = vehicle, config or ONLINE
        self._problem_config = problem_config or ProblemConfig()
        self._events = EventLog()
        self._intake = Intake(vehicle, self._events)
        self._starter = Starter(vehicle, self._problem_config, self._events)
        self._course: Course | None = None
        self._frame = vehicle.frame
        self._tail: Tail | None = None
        self._latest_s = -np.inf
        self._cost_s = 0.0
        self._finished: list[Delayed] = []

    @property
    def counts(self) -> dict[str, int]:
        """How many messages were refused, by sensor and reason."""
        return dict(self._intake.counts)

    def push(self, message: Message) -> None:
        """Take one message; nothing that it may hold raises."""
        begin = time.perf_counter()
        time_s = self._intake.accept(message)
        if time_s is None:
            return
        self._latest_s = max(self._latest_s, message.time_s + self._intake.shift_s)
        is_made = self._update(message, time_s)
        if is_made:
            self._cost_s = time.perf_counter() - begin

    def _update(self, message: Message, time_s: float) -> bool:
        """Let the answer follow what has come; return whether a keyframe was made."""
        if self._course is None:
            return self._start()
        course, buffers = self._course, self._intake.buffers
        if isinstance(message, ImuSample) and self._is_gap(time_s):
            self._lose(time_s)
            return False
        undone = time_s <= course.newest.time_s + 0.1 and course.rewind(time_s)
        n_made = course.advance()
        self._intake.horizon_s = course.horizon_s
        if undone or n_made or self._tail is None:
            self._tail = self._tail_of(course.newest)
        elif isinstance(message, ImuSample):
            self._tail.add(buffers.imu.between(self._tail.end_s, np.inf))
        return n_made > 0

    def _start(self) -> bool:
        beginning = self._starter.find(self._intake.buffers)
        if beginning is None:
            return False
        self._begin(beginning)
        return True

    def _begin(self, beginning: Beginning) -> None:
        self._frame, buffers = beginning.frame, self._intake.buffers
        maker = KeyframeMaker(buffers, beginning.frame, self._problem_config)
        first = Keyframe.unmeasured(beginning.time_s, np.zeros(3), None)
        sensors = sensors_of_vehicle(self.vehicle, beginning.frame)
        window = Window(sensors, self.config, first, beginning.moments)
        window.iterate()
        null_b = np.linalg.svd(self.vehicle.mount.beams_b.T)[2][-1]
        step = Step(window, Watch(), None)
        self._course = Course(step, maker, buffers, self._events, null_b)
        self._course.advance()
        self._tail = self._tail_of(self._course.newest)

    def _is_gap(self, time_s: float) -> bool:
        assert self._course is not None
        samples = self._intake.buffers.imu
        at = samples.index(time_s)
        before_s = samples.all[at - 1, 0] if at else -np.inf
        return at == len(samples) - 1 and time_s - before_s > LONGEST_GAP_S

    def _lose(self, time_s: float) -> None:
        """Give the answer up, keep what was found, and align anew."""
        assert self._course is not None
        self._events.tell(
            time_s,
            Severity.ERROR,
            "lost",
            f"no inertial data for more than {LONGEST_GAP_S:.0f} s: position and attitude have to "
            "be found anew",
        )
        self._finished += self._take(self._course, all_of_them=True)
        self._course = self._tail = None
        self._intake.buffers.drop_before(time_s)
        self._intake.horizon_s = time_s
        self._starter = Starter(
            replace(self.vehicle, initial=None), self._problem_config, self._events
        )

    def _tail_of(self, step: Step) -> Tail:
        assert self._frame is not None
        newest = step.window.newest
        tail = Tail(
            step.window.keyframes[-1],
            newest.states,
            newest.covariance[0],
            noise=self.vehicle.imu_noise,
            frame=self._frame,
        )
        tail.add(self._intake.buffers.imu.between(step.time_s, np.inf))
        return tail

    def newest(self) -> Navigation | None:
        """Return the state at the last inertial sample, None before there is any."""
        if self._course is None or self._tail is None:
            return None
        return self._navigation(self._tail.newest(), self._course.newest.watch)

    def _navigation(self, newest: Newest, watch: Watch) -> Navigation:
        assert self._frame is not None
        told = verdict(
            watch, now_s=self._latest_s, imu_s=newest.time_s, covariance=newest.covariance
        )
        at = trajectory_at(
            self._frame,
            np.array([newest.time_s]),
            newest.states,
            newest.covariance[None],
            n_beams=np.zeros(1),
        )
        return Navigation(
            time_s=newest.time_s - self._intake.shift_s,
            lat=float(at.lat[0]),
            lon=float(at.lon[0]),
            height=float(at.height[0]),
            health=told.health,
            reason=told.reason,
            confidence=told.confidence,
            bottom_lock=told.bottom_lock,
            since_aid_s=told.since_aid_s,
            latency_s=self._cost_s,
            velocity_enu=at.velocity_enu[0],
            roll_pitch_heading=at.roll_pitch_heading[0],
            position_sigma_enu=_sigmas(at.position_cov_enu[0]),
            velocity_sigma_enu=at.velocity_sigma_enu[0],
            attitude_sigma=at.attitude_sigma[0],
            gyro_bias=at.gyro_bias[0],
            accel_bias=at.accel_bias[0],
            beam_weights=np.array(watch.beam_weights),
        )

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
        taken, self._finished = self._finished, []
        return taken if self._course is None else taken + self._take(self._course)

    def finish(self) -> list[Delayed]:
        """Return all smoothed states that are left, and end."""
        taken, self._finished = self._finished, []
        if self._course is not None:
            taken += self._take(self._course, all_of_them=True)
            self._course = self._tail = None
        return taken

    def _take(self, course: Course, *, all_of_them: bool = False) -> list[Delayed]:
        assert self._frame is not None
        shift_s = self._intake.shift_s
        return [
            delayed_of(stretch, self._frame, shift_s=shift_s)
            for stretch in course.take_settled(all_of_them=all_of_them)
            if len(stretch.time_s)
        ]


def _sigmas(covariance: Array) -> Array:
    return np.sqrt(np.diagonal(covariance))
