"""Which keyframe comes next, and everything a window is told of it.

A keyframe stands at every ping with a beam and at every fix, and at a fixed interval after the last
one where both are silent. That depends on what was measured and not on when it came, so that late
messages lead to the same keyframes as punctual ones.
"""

from __future__ import annotations

import numpy as np

from ssm_graph.base.earth import LocalFrame
from ssm_graph.base.frozen import Array
from ssm_graph.imu.preintegration import LIVELY_S, imu_gaps, preintegrate
from ssm_graph.live.estimator.buffers import OFF_WATER, Buffers, Measured
from ssm_graph.mission.aids import fix_covariance_n
from ssm_graph.mission.ping_motion import PING_WINDOW_S, mean_gyro
from ssm_graph.mission.problem import ProblemConfig
from ssm_graph.mission.timeline import MIN_SPACING_S
from ssm_graph.sensors.drift import Drift
from ssm_graph.sensors.imu import ImuLog
from ssm_graph.smoothers.keyframe import BeamSpeeds, Keyframe, Way


class KeyframeMaker:
    """Makes keyframes of what has been received."""

    def __init__(self, buffers: Buffers, frame: LocalFrame, config: ProblemConfig) -> None:
        self._buffers, self._frame, self._config = buffers, frame, config
        vehicle = buffers.vehicle
        self._white_beams = _white_share(vehicle.mount.drift)
        self._white_fixes = _white_share(vehicle.gnss.calibration.drift)
        self.not_before_s = -np.inf
        """Where the inertial data have to be before asking again is worth while."""

    def next_after(self, last_s: float) -> Measured | None:
        """Return what belongs to the keyframe after ``last_s``; None while it is not covered.

        The inertial data have to reach beyond it: a ping's gyro reading is a mean, and the change
        of the rate within a sample is seen from its neighbours.
        """
        buffers, at_s = self._buffers, self._next_time(last_s)
        self.not_before_s = at_s + 0.5 * PING_WINDOW_S
        if not self._covers(at_s):
            return None
        begin_s, end_s = last_s + MIN_SPACING_S, at_s + MIN_SPACING_S
        return Measured(
            at_s,
            self._usable_pings(begin_s, end_s),
            buffers.fixes.between(begin_s, end_s),
            buffers.depths_between(last_s, at_s),
        )

    def _next_time(self, last_s: float) -> float:
        """Return the time of the keyframe after ``last_s``, as far as is known."""
        begin_s = last_s + MIN_SPACING_S
        at_s = last_s + self._config.keyframe_interval_s
        pings, fixes = self._usable_pings(begin_s, at_s), self._buffers.fixes.between(begin_s, at_s)
        times: list[float] = [at_s, *pings[:1, 0].tolist(), *fixes[:1, 0].tolist()]
        return min(times)

    def _usable_pings(self, begin_s: float, end_s: float) -> Array:
        pings = self._buffers.pings_between(begin_s, end_s)
        return pings[np.isfinite(pings[:, self._buffers.speeds]).any(axis=1)]

    def _covers(self, time_s: float) -> bool:
        """Return whether the inertial data reach far enough beyond a time."""
        imu = self._buffers.imu
        return len(imu) - imu.index(time_s) >= 3 and imu.last_s >= time_s + 0.5 * PING_WINDOW_S

    def make(self, measured: Measured, *, last_s: float | None) -> Keyframe:
        """Return the keyframe; ``last_s`` is the time of the one before, None for the first."""
        at_s = measured.time_s
        begin_s = at_s if last_s is None else last_s
        imu = self._imu(begin_s, at_s)
        way = None if last_s is None else self._integrate(imu, last_s, at_s)
        gyro_b = mean_gyro(imu, np.array([at_s]))[0]
        fix_n, fix_cov_n = self._fixes(measured.fixes)
        return Keyframe(
            time_s=at_s,
            gyro_b=gyro_b,
            beams=self._beams(measured.pings, gyro_b),
            depth_s=measured.depths[:, 0],
            depth=measured.depths[:, 1],
            fix_n=fix_n,
            fix_cov_n=fix_cov_n,
            way=way,
        )

    def way(self, begin_s: float, end_s: float) -> Way:
        """Return what the inertial sensors say from one time to another."""
        return self._integrate(self._imu(begin_s, end_s), begin_s, end_s)

    def _imu(self, begin_s: float, end_s: float) -> ImuLog:
        """Return the samples that two keyframes and the way between them need.

        Around a gap these are more: they tell how lively the vehicle was.
        """
        half = 0.5 * PING_WINDOW_S
        imu = self._buffers.imu_log(begin_s - half, end_s + half)
        if len(imu_gaps(imu)[0]) == 0:
            return imu
        return self._buffers.imu_log(begin_s - LIVELY_S, end_s + half)

    def _integrate(self, imu: ImuLog, begin_s: float, end_s: float) -> Way:
        chain = preintegrate(
            imu,
            np.array([begin_s, end_s]),
            frame=self._frame,
            rate_hz=self._config.merge_rate_hz,
        )
        return Way(chain.measurements[0], chain.params[0])

    def _beams(self, pings: Array, gyro_b: Array) -> BeamSpeeds:
        speed, sigma = pings[:, self._buffers.speeds], pings[:, self._buffers.sigmas]
        row, beam = np.nonzero(np.isfinite(speed))
        is_water = pings[row, OFF_WATER]
        return BeamSpeeds(
            beam.astype(float),
            speed[row, beam],
            sigma[row, beam] * np.where(is_water > 0.0, 1.0, self._white_beams),
            np.broadcast_to(gyro_b, (len(row), 3)),
            self._buffers.vehicle.mount.beams_b[beam],
            is_water,
        )

    def _fixes(self, fixes: Array) -> tuple[Array, Array]:
        position_n = self._frame.p_n_from_geodetic(fixes[:, 1], fixes[:, 2], fixes[:, 3])
        sigma_enu = fixes[:, 4:] * self._white_fixes
        return position_n, fix_covariance_n(self._frame, position_n, sigma_enu)


def _white_share(drift: Drift) -> float:
    """Return how much of the stated sigmas is white noise, where a drift is carried beside it."""
    return drift.white_share if drift.sigma > 0.0 else 1.0
