"""Where a live estimator begins: at a given state, or where the first minutes lead."""

from __future__ import annotations

from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np

from ssm_graph.base.earth import LocalFrame
from ssm_graph.base.errors import SsmGraphError
from ssm_graph.engine.error_state import InitialMoments
from ssm_graph.engine.extras import with_extras
from ssm_graph.live.estimator.asked import extras_of_vehicle
from ssm_graph.live.estimator.buffers import Buffers
from ssm_graph.mission.calibration import windowed
from ssm_graph.mission.events import EventLog
from ssm_graph.mission.mission import InitialState
from ssm_graph.mission.navigation import Severity
from ssm_graph.mission.problem import ProblemConfig, build_problem
from ssm_graph.mission.start.alignment import SAFE_HEADING_SIGMA
from ssm_graph.mission.start.moments import initial_moments
from ssm_graph.mission.vehicle import Vehicle
from ssm_graph.smoothers.fixed_lag import run_fixed_lag
from ssm_graph.smoothers.fixed_lag_config import FixedLagConfig
from ssm_graph.smoothers.mission import smooth

SETTLE_S: Final = 1.0
"""So much inertial data is waited for, since the first samples may come late as well."""
TRY_EVERY_S: Final = 5.0
LONGEST_S: Final = 300.0
"""Data to align with are kept for so long."""
STALE_S: Final = 60.0
"""A given initial state may be so much older than the data."""


class Beginning(NamedTuple):
    """Time and state to begin with."""

    time_s: float
    moments: InitialMoments
    frame: LocalFrame


class Starter:
    """Finds the beginning as soon as the data allow."""

    def __init__(self, vehicle: Vehicle, config: ProblemConfig, events: EventLog) -> None:
        self._vehicle, self._config, self._events = vehicle, config, events
        self._next_try_s = -np.inf
        self.reason = "waiting for inertial data"
        self._initial = vehicle.initial

    def find(self, buffers: Buffers) -> Beginning | None:
        """Return the beginning, None while there is none."""
        imu = buffers.imu
        if len(imu) < 3 or imu.last_s - imu.all[0, 0] < SETTLE_S:
            return None
        if self._initial is not None:
            return self._given(self._initial, buffers)
        now_s = buffers.imu.last_s
        buffers.drop_before(now_s - LONGEST_S)
        if now_s < self._next_try_s:
            return None
        self._next_try_s = now_s + TRY_EVERY_S
        try:
            return self._aligned(buffers)
        except (SsmGraphError, np.linalg.LinAlgError) as error:
            self._wait(now_s, f"not aligned yet: {error}")
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
            self._initial = None
            self._wait(
                last_s,
                f"[initial] is {time_s - initial.time_s:.0f} s older than the data: left out",
            )
            return None
        frame = self._frame(buffers)
        assert frame is not None  # an initial state has a place
        moved = replace(initial, time_s=time_s)
        return Beginning(time_s, self._moments(moved, frame), frame)

    def _moments(self, start: InitialState, frame: LocalFrame) -> InitialMoments:
        noise = self._vehicle.imu_noise
        bias_sigma = np.repeat([noise.accel_bias_sigma, noise.gyro_bias_sigma], 3)
        moments = initial_moments(start, frame, bias_sigma=bias_sigma)
        return with_extras(moments, extras_of_vehicle(self._vehicle))

    def _aligned(self, buffers: Buffers) -> Beginning | None:
        """Smooth what there is; begin at its end if that may be believed."""
        frame, now_s = self._frame(buffers), buffers.imu.last_s
        if frame is None:
            self._wait(now_s, "waiting for a GNSS fix, or an initial state")
            return None
        mission = buffers.mission(frame)
        estimate = smooth(mission, problem_config=self._config)
        sigma = float(estimate.trajectory.attitude_sigma[-1, 2])
        if not estimate.status.is_good or sigma > SAFE_HEADING_SIGMA:
            self._wait(
                now_s,
                f"heading sigma {np.degrees(sigma):.0f} deg: {estimate.reason}; move while GNSS "
                "is there",
            )
            return None
        problem = build_problem(mission, self._config, start=estimate.start)
        newest = run_fixed_lag(problem, FixedLagConfig(0.0, tolerance=1e-3)).newest
        found = newest.states.take(np.s_[-1:]).moments(newest.covariance[-1])
        moments = with_extras(found, extras_of_vehicle(self._vehicle), windowed(problem.extras))
        self._events.tell(
            now_s, Severity.INFO, "aligned", "; ".join(estimate.notes) or "heading found"
        )
        return Beginning(float(newest.time_s[-1]), moments, frame)

    def _frame(self, buffers: Buffers) -> LocalFrame | None:
        if self._vehicle.frame is not None:
            return self._vehicle.frame
        if self._initial is not None:
            return LocalFrame(self._initial.lat, self._initial.lon, self._initial.height)
        if len(buffers.fixes) == 0:
            return None
        _, lat, lon, height, *_ = buffers.fixes.all[0].tolist()
        return LocalFrame(lat, lon, height)

    def _wait(self, now_s: float, reason: str) -> None:
        self.reason = reason
        self._events.tell(now_s, Severity.INFO, "aligning", reason)
