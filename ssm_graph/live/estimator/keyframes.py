"""Which keyframe comes next, and everything a window is told of it.

A keyframe stands at every ping with a beam, at every fix and range, and at a fixed interval after
the last one where all are silent. That depends on what was measured and not on when it came, so
that late messages lead to the same keyframes as punctual ones.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from factors.imu_errors import NONE
from factors.inertial import Intervals
from ssm_graph.base.earth import LocalFrame
from ssm_graph.base.frozen import Array
from ssm_graph.base.times import MIN_SPACING_S
from ssm_graph.graph.aids import AIDS
from ssm_graph.graph.aids.aid import Aid, Keyframes
from ssm_graph.graph.aids.depth import DepthMeans, Depths
from ssm_graph.graph.aids.gnss import Fixes
from ssm_graph.imu.ping_motion import PING_WINDOW_S, mean_gyro
from ssm_graph.imu.preintegration import LIVELY_S, InertialChain, preintegrate
from ssm_graph.live.estimator.buffers import OFF_WATER, Buffers, Logs, Measured
from ssm_graph.mission.problem import Beams, ProblemConfig
from ssm_graph.sensors.imu import ImuLog, imu_gaps
from ssm_graph.smoothers.keyframe import Keyframe


class KeyframeMaker:
    """Makes keyframes of what has been received."""

    def __init__(
        self, buffers: Buffers, frame: LocalFrame, config: ProblemConfig, *, begin_s: float
    ) -> None:
        """Errors that grow are counted from ``begin_s``, s, on."""
        self._buffers, self._frame, self._config = buffers, frame, config
        self._begin_s = begin_s
        vehicle = buffers.vehicle
        self._no_beams = Beams.of_mount(vehicle.mount)
        self._white_beams = vehicle.mount.drift.white
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
        pings = self._usable_pings(last_s + MIN_SPACING_S, at_s + MIN_SPACING_S)
        return Measured(at_s, pings, buffers.logs_between(last_s, at_s))

    def _next_time(self, last_s: float) -> float:
        """Return the time of the keyframe after ``last_s``, as far as is known."""
        begin_s = last_s + MIN_SPACING_S
        at_s = last_s + self._config.keyframe_interval_s
        times: list[float] = [at_s, *self._usable_pings(begin_s, at_s)[:1, 0].tolist()]
        for rows in self._buffers.asking:
            times += rows.between(begin_s, at_s)[:1, 0].tolist()
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
        inertial = None if last_s is None else self._integrate(imu, last_s, at_s).intervals
        gyro_b = mean_gyro(imu, np.array([at_s]))[0]
        times = np.array([begin_s, at_s])
        aids = aids_at(measured.logs, Keyframes(self._frame, imu, times, self._begin_s))
        return Keyframe(
            at_s,
            self._beams(measured.pings, gyro_b),
            {aid.name: aid for aid in aids if len(aid)},
            inertial,
        )

    def inertial(self, begin_s: float, end_s: float) -> Intervals:
        """Return what the inertial sensors say from one time to another."""
        return self.chain(begin_s, end_s).intervals

    def chain(self, begin_s: float, end_s: float) -> InertialChain:
        """Return the same with the samples that it was made of."""
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

    def _integrate(self, imu: ImuLog, begin_s: float, end_s: float) -> InertialChain:
        known = {axis[:2]: axis.end_s for axis in self._buffers.frozen_until(begin_s)}
        frozen = [
            axis._replace(begin_s=known.get(axis[:2], axis.begin_s))
            for axis in self._buffers.frozen_until(end_s)
        ]
        return preintegrate(
            imu,
            np.array([begin_s, end_s]),
            frame=self._frame,
            rate_hz=self._config.merge_rate_hz,
            errors=NONE if self._buffers.vehicle.imu_calibration.is_asked else None,
            frozen=frozen,
            period_s=self._buffers.shortest_period_s,
        )

    def _beams(self, pings: Array, gyro_b: Array) -> Beams:
        speed, sigma = pings[:, self._buffers.speeds], pings[:, self._buffers.sigmas]
        row, beam = np.nonzero(np.isfinite(speed))
        is_water = pings[row, OFF_WATER] > 0.0
        return replace(
            self._no_beams,
            keyframe=np.zeros(len(row), np.intp),
            beam=beam,
            speed=speed[row, beam],
            sigma=sigma[row, beam] * np.where(is_water, 1.0, self._white_beams),
            gyro_b=np.broadcast_to(gyro_b, (len(row), 3)),
            beam_b=self._buffers.vehicle.mount.beams_b[beam],
            ping=row,
            is_water=is_water,
        )


def aids_at(logs: Logs, keyframes: Keyframes) -> Iterator[Aid]:
    """Yield what the logs say at the second of two keyframes, also where it is nothing."""
    gnss, depth, aids = logs
    frame, imu, keyframe_s, _ = keyframes
    fix = np.arange(len(gnss.time_s))
    fixes = Fixes.of_log(
        gnss,
        fix,
        time_s=np.full(len(fix), keyframe_s[1]),
        keyframe=np.ones(len(fix), np.intp),
        frame=frame,
        imu=imu,
    )
    white = gnss.calibration.drift.white
    yield replace(fixes, covariance_n=fixes.covariance_n * white**2)
    if depth is not None:
        readings = Depths.of(depth, imu, keyframe_s)
        readings = replace(readings, sigma=readings.sigma * readings.white_share)
        yield DepthMeans.of_readings(readings, keyframe_s, frame).at(1)
    for kind in AIDS:
        aid = kind.of(aids, keyframes) if kind.is_live else None
        if aid is not None:
            yield aid.at(1)
