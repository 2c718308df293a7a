"""What a live estimator has received and may still need, sensor by sensor."""

from __future__ import annotations

from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np

from ssm_graph.base.earth import LocalFrame
from ssm_graph.base.frozen import Array
from ssm_graph.live.estimator.rows import TimedRows
from ssm_graph.mission.mission import Mission
from ssm_graph.mission.vehicle import Vehicle
from ssm_graph.sensors.depth import DepthLog, DepthReading
from ssm_graph.sensors.dvl import N_BEAMS, STUCK_PINGS, DvlLog, Ping, stuck_beams
from ssm_graph.sensors.gnss import Fix, GnssLog
from ssm_graph.sensors.imu import ImuLog, ImuSample
from ssm_graph.sensors.messages import Message

SPEEDS: Final = slice(1, 1 + N_BEAMS)
SIGMAS: Final = slice(1 + N_BEAMS, 1 + 2 * N_BEAMS)
OFF_WATER: Final = 1 + 2 * N_BEAMS
"""Columns of a ping's row, its time first."""
PERIOD_EVERY: Final = 100
DEFAULT_PERIOD_S: Final = 0.01
"""Sampling interval of the inertial data before there are two samples."""


class Buffers:
    """Received rows in order of time; pings at the time they were taken."""

    def __init__(self, vehicle: Vehicle) -> None:
        self.vehicle = vehicle
        self.imu = TimedRows(6)
        self.pings = TimedRows(2 * N_BEAMS + 1)
        self.depths = TimedRows(1)
        self.fixes = TimedRows(6)
        self._period_s, self._n_imu = DEFAULT_PERIOD_S, 0
        self.shortest_period_s = np.inf
        """Sampling interval of the inertial data when most of them came, s"""

    def time_of(self, message: Message) -> float:
        """Return when a message's content was true, s."""
        match message:
            case Ping():
                return message.time_s - self.vehicle.mount.time_offset_s
            case Fix():
                return message.time_s - self.vehicle.gnss_calibration.time_offset_s
        return message.time_s

    def add(self, message: Message) -> bool:
        """Take a message; return False if one of its time is known."""
        row = [self.time_of(message)]
        match message:
            case ImuSample():
                self._n_imu += 1
                return self.imu.add(np.array([*row, *message.gyro_b, *message.accel_b]))
            case Ping():
                columns = (*row, *message.speed, *self._sigma(message), float(message.is_water))
                return self.pings.add(np.array(columns))
            case DepthReading():
                depth = message.depth - self.vehicle.depth_calibration.offset
                return self.depths.add(np.array([*row, depth]))
            case Fix():
                place = message.lat, message.lon, message.height
                return self.fixes.add(np.array([*row, *place, *message.sigma_enu]))

    def _sigma(self, ping: Ping) -> list[float]:
        given, nominal = ping.sigma or (np.nan,) * N_BEAMS, self.vehicle.beam_sigma
        if ping.is_water:
            nominal = self.vehicle.water_sigma or nominal
        return [s if s > 0.0 else nominal for s in given]

    def pings_between(self, begin_s: float, end_s: float) -> Array:
        """Return the pings (P, 10) after ``begin_s`` up to and with ``end_s``, as they count.

        Speeds of stuck beams and those of infinite sigma are kept but not used.
        """
        rows = self.pings
        begin, end = (rows.index(t, after=True) for t in (begin_s, end_s))
        first = max(begin - STUCK_PINGS, 0)
        near = rows.all[first : end + STUCK_PINGS]
        is_stuck = stuck_beams(near[:, 1 : 1 + N_BEAMS])
        here = slice(begin - first, end - first)
        counting = near[here].copy()
        speed, sigma = counting[:, SPEEDS], counting[:, SIGMAS]
        unused = np.isinf(sigma) | is_stuck[here]
        speed[unused], sigma[unused] = np.nan, self.vehicle.beam_sigma
        return counting

    def drop_before(self, time_s: float) -> None:
        """Forget what is older than a time, but for the pings that tell whether a beam is stuck."""
        for rows in (self.imu, self.depths, self.fixes):
            rows.drop_before(time_s)
        first = max(self.pings.index(time_s) - STUCK_PINGS, 0)
        self.pings.drop_before(self.pings.all[first, 0] if first else -np.inf)

    @property
    def period_s(self) -> float:
        """The usual interval from one inertial sample to the next, s; looked at now and then."""
        if self._n_imu % PERIOD_EVERY == 0 or self._n_imu < PERIOD_EVERY:
            times = self.imu.all[-2 * PERIOD_EVERY :, 0]
            if len(times) > 1:
                self._period_s = float(np.median(np.diff(times)))
                if len(times) > PERIOD_EVERY:
                    self.shortest_period_s = min(self.shortest_period_s, self._period_s)
        return self._period_s

    def imu_log(self, begin_s: float, end_s: float, *, margin: int = 3) -> ImuLog:
        """Return the samples that cover a span, and a few on both sides."""
        rows = self.imu
        first = max(rows.index(begin_s, after=True) - margin, 0)
        last = rows.index(end_s) + 1 + margin
        found = rows.all[first:last]
        start_s = rows.all[first - 1, 0] if first else found[0, 0] - self.period_s
        return ImuLog(
            float(start_s), self.vehicle.imu_noise, found[:, 0], found[:, 1:4], found[:, 4:]
        )

    def mission(self, frame: LocalFrame) -> Mission:
        """Return everything as a mission, to align with.

        What is known to be off in stamps, fixes and depths has been taken off.
        """
        vehicle = self.vehicle
        pings = self.pings_between(-np.inf, np.inf)
        depths, fixes = self.depths.all, self.fixes.all
        end_s = self.imu.last_s
        stamps = pings[:, 0] + vehicle.mount.time_offset_s
        return Mission(
            vehicle.name,
            frame,
            self.imu_log(-np.inf, end_s, margin=0),
            DvlLog(
                vehicle.mount,
                stamps,
                pings[:, SPEEDS],
                pings[:, SIGMAS],
                water_track=pings[:, OFF_WATER],
            ),
            depth_of(vehicle, depths) if len(depths) else None,
            gnss_of(vehicle, fixes),
            current=vehicle.current,
        )


def depth_of(vehicle: Vehicle, rows: Array) -> DepthLog | None:
    """Return rows (D, 2) as a log, None without a sensor; the offset has been taken off them."""
    if vehicle.depth_sigma is None:
        return None
    return DepthLog(
        vehicle.depth_sigma,
        rows[:, 0],
        rows[:, 1],
        vehicle.depth_lever_arm_b,
        replace(vehicle.depth_calibration, offset=0.0),
    )


def gnss_of(vehicle: Vehicle, rows: Array) -> GnssLog:
    """Return rows (F, 7) as a log; what is known to be off in the stamps has been taken off."""
    return GnssLog(
        time_s=rows[:, 0],
        lat=rows[:, 1],
        lon=rows[:, 2],
        height=rows[:, 3],
        sigma_enu=rows[:, 4:],
        lever_arm_b=vehicle.gnss_lever_arm_b,
        calibration=replace(vehicle.gnss_calibration, time_offset_s=0.0),
    )


class Measured(NamedTuple):
    """What belongs to one keyframe."""

    time_s: float
    pings: Array
    """(P, 10) time, speeds, sigmas, 1 for off the water"""
    fixes: Array
    """(F, 7) time, latitude, longitude, height, sigmas"""
    depths: Array
    """(D, 2) time, depth"""
