"""What a live estimator has received and may still need, sensor by sensor."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, Final, NamedTuple

import numpy as np

from ssm_graph.base.earth import LocalFrame
from ssm_graph.base.frozen import Array
from ssm_graph.base.times import MIN_SPACING_S, usual_interval
from ssm_graph.graph.aids import AIDS
from ssm_graph.imu.thinned import missing_samples
from ssm_graph.live.estimator.rows import TimedRows
from ssm_graph.mission.mission import Aids, Mission
from ssm_graph.mission.vehicle import Vehicle
from ssm_graph.sensors.depth import DepthLog
from ssm_graph.sensors.dvl import Ping, counted_sigma
from ssm_graph.sensors.dvl_instrument import DVL
from ssm_graph.sensors.dvl_readings import STUCK_PINGS, stuck_beams
from ssm_graph.sensors.gnss import GNSS, GnssLog
from ssm_graph.sensors.imu import IMU, FrozenAxis, ImuLog, ImuSample, frozen_now
from ssm_graph.sensors.messages import Message
from ssm_graph.sensors.registry import BY_LOG, BY_MESSAGE

OFF_WATER: Final = -1
"""Column of a ping's row that is 1 off the water."""
FROZEN_REACH_S: Final = 30.0
"""An axis that has repeated itself for longer is not told from one that always did."""
PERIOD_EVERY: Final = 100
DEFAULT_PERIOD_S: Final = 0.01
"""Sampling interval of the inertial data before there are two samples."""


class Buffers:
    """Received rows of every instrument of a vehicle, in order of the time they were true.

    A row is that time, and the numbers of the message as the instrument said them.
    """

    def __init__(self, vehicle: Vehicle) -> None:
        self.vehicle = vehicle
        self._bare = {BY_LOG[kind].section: log for kind, log in vehicle.bare_logs.items()}
        self.rows = {
            one.section: TimedRows(one.width(self._bare[one.section]), n_key=len(one.row_key))
            for one in map(BY_LOG.__getitem__, vehicle.bare_logs)
            if one.message is not None
        }
        """By the section of the instrument."""
        self.imu, self.pings, self.fixes = (self.rows[one.section] for one in (IMU, DVL, GNSS))
        asking = (kind for kind in AIDS if kind.asks_for_keyframes and kind.is_live)
        sections = (kind.section.strip("[]") for kind in asking)
        self.asking = [self.fixes, *(self.rows[name] for name in sections if name in self.rows)]
        """Those whose readings ask for keyframes of their own, pings apart."""
        n_beams = vehicle.mount.n_beams
        self.speeds, self.sigmas = slice(1, 1 + n_beams), slice(1 + n_beams, 1 + 2 * n_beams)
        """Columns of a ping's row."""
        self._period_s, self._n_imu = DEFAULT_PERIOD_S, 0
        self.shortest_period_s = np.inf
        """Sampling interval of the inertial data when most of them came, s"""

    def bare(self, message: Message) -> Any | None:
        """Return what is known of a message's instrument; None where the vehicle has none."""
        return self._bare.get(BY_MESSAGE[type(message)].section)

    def time_of(self, message: Message) -> float:
        """Return when a message's content was true, s."""
        return BY_MESSAGE[type(message)].valid_s(message, self.bare(message))

    def add(self, message: Message) -> bool:
        """Take a message; return False if one of its time is known."""
        self._n_imu += isinstance(message, ImuSample)
        return self.rows[BY_MESSAGE[type(message)].section].add(self._row(message))

    def has(self, message: Message) -> bool:
        """Return whether this very message is known, not only one of its time."""
        rows, row = self.rows[BY_MESSAGE[type(message)].section], self._row(message)
        here = slice(rows.index(row[0]), rows.index(row[0], after=True))
        return any(np.array_equal(row, known, equal_nan=True) for known in rows.all[here])

    def _row(self, message: Message) -> Array:
        row = np.array(BY_MESSAGE[type(message)].numbers(message))
        row[0] = self.time_of(message)
        if isinstance(message, Ping):
            row[self.sigmas] = counted_sigma(
                row[self.sigmas],
                message.is_water,
                ground_sigma=self.vehicle.beam_sigma,
                water_sigma=self.vehicle.water_sigma,
            )
        return row

    def logs_between(self, begin_s: float, end_s: float) -> Logs:
        """Return what beside IMU and DVL belongs to a keyframe at ``end_s`` after ``begin_s``.

        Depths are of the way up to it, the others of what stands at one, or is taken for it.
        """

        def log_of(bare: Any, later_s: float = MIN_SPACING_S) -> Any:
            if type(bare) not in BY_LOG:  # of times, not of readings
                return bare
            one = BY_LOG[type(bare)]
            rows = self.rows[one.section].between(begin_s + later_s, end_s + later_s)
            return one.log_of(rows, bare)

        vehicle = self.vehicle
        depth = None if vehicle.depth is None else log_of(vehicle.depth, 0.0)
        return Logs(log_of(vehicle.gnss), depth, Aids(*map(log_of, vehicle.aids)))

    def pings_between(self, begin_s: float, end_s: float) -> Array:
        """Return the pings (P, 2 B + 2) after ``begin_s`` up to and with ``end_s``, as they count.

        Speeds of stuck beams and those of infinite sigma are kept but not used.
        """
        rows = self.pings
        begin, end = (rows.index(t, after=True) for t in (begin_s, end_s))
        first = max(begin - STUCK_PINGS, 0)
        near = rows.all[first : end + STUCK_PINGS]
        is_stuck = stuck_beams(near[:, self.speeds])
        here = slice(begin - first, end - first)
        counting = near[here].copy()
        speed, sigma = counting[:, self.speeds], counting[:, self.sigmas]
        unused = np.isinf(sigma) | is_stuck[here]
        speed[unused], sigma[unused] = np.nan, self.vehicle.beam_sigma
        return counting

    def pack(self) -> dict[str, Array]:
        """Return all rows that were received and kept."""
        return {f"rows_{section}": rows.all.copy() for section, rows in self.rows.items()}

    def unpack(self, arrays: Mapping[str, Array]) -> None:
        """Fill empty buffers with what was packed."""
        for section, rows in self.rows.items():
            for row in arrays[f"rows_{section}"]:
                rows.add(row)

    def drop_before(self, time_s: float) -> None:
        """Forget what is older than a time, but for the pings that tell whether a beam is stuck."""
        for section, rows in self.rows.items():
            if section != DVL.section:
                rows.drop_before(time_s)
        first = max(self.pings.index(time_s) - STUCK_PINGS, 0)
        self.pings.drop_before(self.pings.all[first, 0] if first else -np.inf)

    @property
    def period_s(self) -> float:
        """The usual interval from one inertial sample to the next, s; looked at now and then."""
        if self._n_imu % PERIOD_EVERY == 0 or self._n_imu < PERIOD_EVERY:
            times = self.imu.all[-2 * PERIOD_EVERY :, 0]
            if len(times) > 1:
                self._period_s = usual_interval(times)
                if len(times) > PERIOD_EVERY:
                    self.shortest_period_s = min(self.shortest_period_s, self._period_s)
        return self._period_s

    def missing(self, begin_s: float, end_s: float) -> tuple[float, float]:
        """Return how much of a span is without inertial samples.

        That is the share of the samples due that have not come, and the longest step to one that
        has, s.
        """
        time_s, edge_s = self.imu.between(begin_s, end_s)[:, 0], np.array([begin_s, end_s])
        share, longest_s = missing_samples(time_s, edge_s, self.shortest_period_s)
        return float(share[0]), float(longest_s[0])

    def imu_log(self, begin_s: float, end_s: float, *, margin: int = 3) -> ImuLog:
        """Return the samples that cover a span, and a few on both sides, known errors taken off."""
        rows = self.imu
        first = max(rows.index(begin_s, after=True) - margin, 0)
        last = rows.index(end_s) + 1 + margin
        found = rows.all[first:last]
        start_s = rows.all[first - 1, 0] if first else found[0, 0] - self.period_s
        bare = self._bare[IMU.section]
        log: ImuLog = IMU.log_of(found, bare)
        return replace(log, start_s=float(start_s) + IMU.late_s(bare)).calibrated

    def inertial(self, rows: Array) -> Array:
        """Return inertial rows (N, 7) with what is known of the sensors' errors taken off."""
        known = self.vehicle.imu_calibration
        if not known.is_stated:
            return rows
        return np.column_stack([rows[:, 0], *known.taken_off(rows[:, 1:4], rows[:, 4:])])

    def frozen_until(self, time_s: float) -> list[FrozenAxis]:
        """Return the axes of the inertial sensors that repeat themselves up to a time."""
        return frozen_now(self.imu.between(time_s - FROZEN_REACH_S, time_s))

    def mission(
        self, frame: LocalFrame, *, begin_s: float = -np.inf, until_s: float = np.inf
    ) -> Mission:
        """Return everything, or what is from ``begin_s`` to ``until_s``, as a mission."""
        vehicle = self.vehicle
        dvl = DVL.log_of(self.pings_between(begin_s, until_s), self._bare[DVL.section])
        gnss, depth, aids = self.logs_between(begin_s, until_s)
        end_s = min(self.imu.last_s, until_s)
        return Mission(
            vehicle.name,
            frame,
            self.imu_log(begin_s, end_s, margin=0),
            dvl,
            depth if depth is not None and len(depth.time_s) else None,
            gnss,
            aids,
            local=vehicle.local,
            current=vehicle.current,
        )


class Logs(NamedTuple):
    """Readings of what is beside IMU and DVL."""

    gnss: GnssLog
    depth: DepthLog | None
    """None where there is no sensor"""
    aids: Aids


class Measured(NamedTuple):
    """What belongs to one keyframe."""

    time_s: float
    pings: Array
    """(P, 2 B + 2) time, speeds, sigmas, 1 for off the water"""
    logs: Logs
    """Since the keyframe before"""
