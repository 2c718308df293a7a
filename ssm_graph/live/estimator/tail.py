"""From the newest keyframe to the last inertial sample: what control asks for at once."""

from __future__ import annotations

from typing import NamedTuple

import gtsam
import numpy as np

from factors.imu_errors import taken_off
from ssm_graph.base.earth import LocalFrame
from ssm_graph.base.frozen import Array
from ssm_graph.engine.states import States
from ssm_graph.graph.inertial_rows import InertialRows
from ssm_graph.imu.preintegration import Preintegrated, Unseen, imu_params, intervals_of
from ssm_graph.sensors.imu import ImuNoise
from ssm_graph.smoothers.keyframe import Keyframe

LONGEST_S = 0.1
"""A longer step from sample to sample is a gap of the inertial data."""


class Newest(NamedTuple):
    """State and covariance at the last inertial sample."""

    time_s: float
    states: States
    """(1, ...)"""
    covariance: Array
    """(n, n)"""


class Tail:
    """Integrates the samples since the newest keyframe."""

    def __init__(
        self,
        keyframe: Keyframe,
        states: States,
        covariance: Array,
        *,
        noise: ImuNoise,
        frame: LocalFrame,
        inertial: InertialRows,
    ) -> None:
        """Begin at a keyframe with its states (1, ...) and covariance (n, n)."""
        self._begin_s = self._end_s = keyframe.time_s
        self._states, self._covariance = states, covariance
        self._noise, self._frame = noise, frame
        self._gap_s = 0.0
        self._last: Array | None = None
        bias = gtsam.imuBias.ConstantBias(states.bias[0, :3], states.bias[0, 3:])
        params = imu_params(noise, g_n=np.zeros(3), frame=frame)
        self._measured = Preintegrated(params, bias)
        self._inertial = inertial
        self._errors, _ = inertial.sensor_errors(states)

    def add(self, samples: Array) -> None:
        """Integrate samples (N, 7): end of the interval s, gyro rad/s, specific force m/s^2.

        Of the sensors' errors what is known is taken off, what the keyframe has found is not.
        """
        if self._errors is not None:
            found = taken_off(self._errors, samples[:, 1:4], samples[:, 4:])
            samples = np.column_stack([samples[:, 0], *found])
        for time_s, *row in samples.tolist():
            dt = time_s - self._end_s
            if dt <= 0.0:
                self._last = np.array(row)
                continue
            self._gap_s = max(self._gap_s, dt if dt > LONGEST_S else 0.0)
            reading, here = np.array(row), np.array(row)
            if self._last is not None and dt > LONGEST_S:
                here = 0.5 * (self._last + reading)
            gyro_b, accel_b, self._last = here[:3], here[3:], reading
            self._measured.integrateMeasurement(accel_b, gyro_b, dt)
            self._end_s = time_s

    @property
    def end_s(self) -> float:
        """Time of the last sample integrated, s."""
        return self._end_s

    def newest(self) -> Newest:
        """Return where the vehicle is now; the keyframe itself if nothing came since."""
        if self._end_s <= self._begin_s:
            return Newest(self._begin_s, self._states, self._covariance)
        begun = self._covariance + self._unseen() if self._gap_s else self._covariance
        ahead = self._inertial.predict(intervals_of([self._measured], self._frame), self._states)
        return Newest(self._end_s, ahead.states, ahead.covariance(begun))

    def _unseen(self) -> Array:
        """Return the covariance (n, n) of what may have happened where samples are missing.

        The noise of what is integrated already stands, so the whole is integrated with more of it
        from the next keyframe on; until then the gap's own share is added to the keyframe's.
        """
        span = self._end_s - self._begin_s
        noisy = imu_params(
            self._noise, g_n=np.zeros(3), frame=self._frame, unseen=Unseen(self._gap_s), span_s=span
        )
        extra = np.zeros_like(self._covariance)
        gyro = noisy.getGyroscopeCovariance() * span
        accel = noisy.getAccelerometerCovariance() * span
        extra[:3, :3], extra[6:9, 6:9] = gyro, accel
        extra[3:6, 3:6] = accel * span**2 / 3.0
        return extra
