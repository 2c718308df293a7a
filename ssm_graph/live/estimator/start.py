"""Where a live estimator begins: at a given state, or where the first minutes lead."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any, Final, NamedTuple

import numpy as np

from ssm_graph.base.earth import LocalFrame
from ssm_graph.base.errors import SsmGraphError
from ssm_graph.base.stepwise import Steps
from ssm_graph.engine.error_state import InitialMoments
from ssm_graph.engine.extras import Extras, with_extras
from ssm_graph.graph.aids import AIDS
from ssm_graph.graph.aids.aid import Keyframes
from ssm_graph.live.estimator.buffers import Buffers, Logs
from ssm_graph.live.estimator.keyframes import aids_at
from ssm_graph.mission.calibration import (
    calibration_extras,
    current_extras,
    taken_as_exact,
    windowed,
)
from ssm_graph.mission.estimate import Estimate
from ssm_graph.mission.events import EventLog
from ssm_graph.mission.mission import Aids, InitialState, Mission
from ssm_graph.mission.navigation import Severity
from ssm_graph.mission.problem import Beams, ProblemConfig, build_problem_steps, initial_moments
from ssm_graph.mission.start.alignment import SAFE_HEADING_SIGMA
from ssm_graph.mission.vehicle import Vehicle
from ssm_graph.sensors.depth import DEPTH
from ssm_graph.sensors.imu import ImuLog
from ssm_graph.smoothers.fixed_lag import run_fixed_lag_steps
from ssm_graph.smoothers.keyframe import Sensors
from ssm_graph.smoothers.mission import smooth_steps
from ssm_graph.smoothers.settings import SmootherConfig
from ssm_graph.smoothers.window import FixedLagConfig

SETTLE_S: Final = 1.0
"""So much inertial data is waited for, since the first samples may come late as well."""
TRY_EVERY_S: Final = 5.0
LONGEST_S: Final = 300.0
"""Data to align with are kept for so long."""
SHARE: Final = 0.5
"""Of a laptop's processor, spent on an alignment. It is counted off by the time of the data and the
size of the steps, never by a clock: every replay comes to the same start at the same sample."""
MOST_MS: Final = 10.0
"""So much is worked on it in one push, and to the end of the step that goes beyond."""
STALE_S: Final = 60.0
"""A given initial state may be so much older than the data."""


class Beginning(NamedTuple):
    """Time and state to begin with."""

    time_s: float
    moments: InitialMoments
    frame: LocalFrame
    begin_s: float
    """s; priors hold there, and errors that grow are counted from there"""


class Starter:
    """Finds the beginning as soon as the data allow, by a little work with every sample."""

    def __init__(self, vehicle: Vehicle, config: ProblemConfig, events: EventLog) -> None:
        self._vehicle, self._config, self._events = vehicle, config, events
        self._now_s = self._next_try_s = -np.inf
        self.reason = "waiting for inertial data"
        self._initial = vehicle.initial
        self._work: Steps[Beginning | None] | None = None
        self._begun_s, self._n_steps, self._credit_ms = -np.inf, 0, 0.0

    @property
    def is_working(self) -> bool:
        """Whether an alignment is worked on."""
        return self._work is not None

    def begin_anew(self) -> None:
        """Leave the alignment that is worked on; there are other data now."""
        self._work = None

    def pack(self) -> dict[str, Any]:
        """Return how far it has come as plain values, for :meth:`go_on_from`."""
        work = self._begun_s, self._n_steps, self._credit_ms
        return {
            "reason": self.reason,
            "next_try_s": self._next_try_s if np.isfinite(self._next_try_s) else None,
            "work": work if self.is_working else None,
        }

    def go_on_from(self, packed: Mapping[str, Any], buffers: Buffers) -> None:
        """Come to where another one was; the steps that it had made are made again, at once."""
        self.reason, self._now_s = packed["reason"], buffers.imu.last_s
        if packed["next_try_s"] is not None:
            self._next_try_s = packed["next_try_s"]
        frame = self._frame(buffers)
        if packed["work"] is None or frame is None:
            return
        self._begun_s, self._n_steps, self._credit_ms = packed["work"]
        self._work = self._align_steps(buffers.mission(frame, until_s=self._begun_s))
        for _ in range(self._n_steps):
            next(self._work)

    def find(self, buffers: Buffers) -> Beginning | None:
        """Return the beginning, None while there is none."""
        imu = buffers.imu
        if len(imu) < 3 or imu.last_s - imu.all[0, 0] < SETTLE_S:
            return None
        if self._initial is not None:
            return self._given(self._initial, buffers)
        elapsed_s, self._now_s = imu.last_s - self._now_s, imu.last_s
        if self._work is None:
            buffers.drop_before(self._now_s - LONGEST_S)
            if self._now_s < self._next_try_s:
                return None
            self._next_try_s = self._now_s + TRY_EVERY_S
            frame = self._frame(buffers)
            if frame is None:
                self._wait("waiting for a GNSS fix, or an initial state")
                return None
            self._work = self._align_steps(buffers.mission(frame))
            self._begun_s, self._n_steps, self._credit_ms = self._now_s, 0, 0.0
        self._credit_ms = min(self._credit_ms + 1e3 * SHARE * elapsed_s, MOST_MS)
        return self._go_on(self._work)

    def _go_on(self, work: Steps[Beginning | None]) -> Beginning | None:
        """Work on an alignment for what the time of the data allows; return where it leads."""
        try:
            while self._credit_ms > 0.0:
                self._credit_ms -= next(work)
                self._n_steps += 1
        except StopIteration as end:
            self._work = None
            beginning: Beginning | None = end.value
            return beginning
        except (SsmGraphError, np.linalg.LinAlgError) as error:
            self._work = None
            self._wait(f"not aligned yet: {error}")
        return None

    def _given(self, initial: InitialState, buffers: Buffers) -> Beginning | None:
        # A little inside the first sample, whose begin is known to rounding only.
        first_s = float(buffers.imu.all[0, 0]) - buffers.period_s + 1e-6
        last_s = buffers.imu.last_s
        if last_s < initial.time_s:
            self.reason = f"waiting for the time of the initial state, {initial.time_s:.1f} s"
            return None
        time_s = max(initial.time_s, first_s)
        if time_s - initial.time_s > STALE_S:
            self._initial, self._now_s = None, last_s
            age_s = time_s - initial.time_s
            self._wait(f"[initial] is {age_s:.0f} s older than the data: left out")
            return None
        frame = self._frame(buffers)
        assert frame is not None  # an initial state has a place
        moved = replace(initial, time_s=time_s)
        return Beginning(time_s, self._moments(moved, frame), frame, time_s)

    def _moments(self, start: InitialState, frame: LocalFrame) -> InitialMoments:
        noise = self._vehicle.imu_noise
        bias_sigma = np.repeat([noise.accel_bias_sigma, noise.gyro_bias_sigma], 3)
        moments = initial_moments(start, frame, bias_sigma=bias_sigma)
        return with_extras(moments, extras_of_vehicle(self._vehicle))

    def _align_steps(self, mission: Mission) -> Steps[Beginning | None]:
        """Smooth what there is; begin at its end if that may be believed."""
        yield 1e-3 * len(mission.imu.time_s)  # for the mission itself
        estimate = yield from self._smooth_steps(mission)
        is_surely_wrong = (
            not estimate.status.is_good and _heading_sigma(estimate) <= SAFE_HEADING_SIGMA
        )
        for name, rest in _with_one_less(mission) if is_surely_wrong else ():
            with contextlib.suppress(SsmGraphError, np.linalg.LinAlgError):
                other = yield from self._smooth_steps(rest)
                if _may_begin(other):
                    note = f"without {name}, which contradicts the rest"
                    mission, estimate = rest, replace(other, notes=(*other.notes, note))
                    break
        if not _may_begin(estimate):
            sigma = _heading_sigma(estimate)
            text = f"heading sigma {np.degrees(sigma):.0f} deg: {estimate.reason}; move while GNSS"
            self._wait(f"{text} is there")
            return None
        begin_s = estimate.start.time_s
        problem = yield from build_problem_steps(
            mission, self._config, start=estimate.start, begin_s=begin_s
        )
        run = yield from run_fixed_lag_steps(problem, FixedLagConfig(0.0, tolerance=1e-3))
        newest = run.newest
        found = newest.states.take(np.s_[-1:]).moments(newest.covariance[-1])
        moments = with_extras(found, extras_of_vehicle(self._vehicle), windowed(problem.extras))
        self.reason = "aligned: catching up with what has come meanwhile"
        text = "; ".join(estimate.notes) or "heading found"
        self._events.tell(self._now_s, Severity.INFO, "aligned", text)
        return Beginning(float(newest.time_s[-1]), moments, mission.frame, begin_s)

    def _smooth_steps(self, mission: Mission) -> Steps[Estimate]:
        # Without the search for faults: it goes through all at once, and lanes watch from here on.
        return smooth_steps(mission, SmootherConfig(), problem_config=self._config)

    def _frame(self, buffers: Buffers) -> LocalFrame | None:
        if self._vehicle.frame is not None:
            return self._vehicle.frame
        if self._initial is not None:
            return LocalFrame(self._initial.lat, self._initial.lon, self._initial.height)
        if len(buffers.fixes) == 0:
            return None
        _, lat, lon, height, *_ = buffers.fixes.all[0].tolist()
        return LocalFrame(lat, lon, height)

    def _wait(self, reason: str) -> None:
        self.reason = reason
        self._events.tell(self._now_s, Severity.INFO, "aligning", reason)


def _heading_sigma(estimate: Estimate) -> float:
    """Return that of its end, rad."""
    return float(estimate.trajectory.attitude_sigma[-1, 2])


def _may_begin(estimate: Estimate) -> bool:
    """Return whether an estimate may be believed, and its heading is known, to begin at its end."""
    return estimate.status.is_good and _heading_sigma(estimate) <= SAFE_HEADING_SIGMA


def _with_one_less(mission: Mission) -> Iterator[tuple[str, Mission]]:
    """Yield a mission without each sensor in turn that an answer can begin without, and its name.

    DVL and GNSS it needs.
    """
    if mission.depth is not None:
        yield DEPTH.section, replace(mission, depth=None)
    for log in mission.aids:
        others = (other for other in mission.aids if other is not log)
        yield log.SECTION.strip("[]"), replace(mission, aids=Aids(*others))


def extras_of_vehicle(vehicle: Vehicle) -> Extras:
    """Return what a vehicle asks to find that is carried in each keyframe's state."""
    return windowed(_all_asked_for(vehicle))


def not_calibrated(vehicle: Vehicle) -> tuple[str, ...]:
    """Return the note of what it asks to calibrate and is taken as stated."""
    carried = [block.name for block in extras_of_vehicle(vehicle).blocks]
    return taken_as_exact(_all_asked_for(vehicle).without(carried))


def not_used(vehicle: Vehicle) -> tuple[str, ...]:
    """Return the notes of what it has and answers after the start leave out."""
    has = {log.SECTION for log in vehicle.aids}
    return tuple(
        f"{kind.section}: live answers do not use it, readings are kept in the log; "
        "ssm-graph smooth uses them"
        for kind in AIDS
        if not kind.is_live and kind.section in has
    )


def sensors_of_vehicle(vehicle: Vehicle, frame: LocalFrame) -> Sensors:
    """Return what is the same at all keyframes."""
    at_rest = ImuLog(0.0, vehicle.imu_noise, np.ones(1), np.zeros((1, 3)), np.zeros((1, 3)))
    logs = Logs(vehicle.gnss, vehicle.depth, vehicle.aids)
    aids = (aid.take(np.s_[:0]) for aid in aids_at(logs, Keyframes(frame, at_rest, np.arange(2.0))))
    return Sensors.of(frame, Beams.of_mount(vehicle.mount), aids, extras_of_vehicle(vehicle))


def _all_asked_for(vehicle: Vehicle) -> Extras:
    depth = None if vehicle.depth is None else vehicle.depth.calibration
    of_instruments = calibration_extras(
        vehicle.mount, depth, vehicle.gnss.calibration, vehicle.imu_calibration
    )
    of_aids = (extra for kind in AIDS for extra in kind.variables(vehicle.aids))
    of_water = () if vehicle.current is None else current_extras(vehicle.current)
    return Extras((*of_instruments, *of_aids, *of_water))
