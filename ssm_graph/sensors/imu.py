"""Inertial sensors: gyro and accelerometer readings and their noise.

Like all values of :mod:`ssm_graph.sensors`: SI units, radians, body axes forward-right-down; arrays
are copied in, checked for shape and made read-only; times are seconds on one clock.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import Enum
from typing import Any, Final, NamedTuple

import numpy as np

from ssm_graph.base.errors import DataError
from ssm_graph.base.frames import BodyAxes, to_frd
from ssm_graph.base.frozen import Array, FrozenArrays, Vector, shaped
from ssm_graph.base.settings import FILE_KEY, Key, Settings, optional_key, sigma_key
from ssm_graph.base.tables import Table
from ssm_graph.base.times import usual_interval
from ssm_graph.base.units import DEG_PER_H, DEGREE, MICRO_G, PER_SQRT_H
from ssm_graph.sensors.frozen import USUALLY_EQUAL, frozen_runs
from ssm_graph.sensors.imu_calibration import CALIBRATED, ImuCalibration, calibration_keys
from ssm_graph.sensors.instrument import XYZ, Column, Instrument, Lists
from ssm_graph.sensors.messages import Message

OF_INSTABILITY: Final = 0.3
"""Random walk, per square root of a second, that wanders in 100 s as far as flicker noise whose
Allan deviation has a floor of 1. The variance of flicker's increments grows with the logarithm of
time, some ``2 s^2`` a decade with ``s = 1.29`` of the floor (IEEE Std 952, annex C); biases are
told apart over minutes."""


@dataclass(frozen=True, slots=True)
class ImuNoise:
    """Noise of the inertial sensors, as continuous-time densities."""

    gyro_density: float
    """Angular random walk, rad/s/sqrt(Hz)."""
    accel_density: float
    """Velocity random walk, m/s^2/sqrt(Hz)."""
    gyro_bias_sigma: float
    """Turn-on gyro bias, 1 sigma, rad/s."""
    accel_bias_sigma: float
    """Turn-on accelerometer bias, 1 sigma, m/s^2."""
    gyro_bias_density: float = 0.0
    """Random walk of the gyro bias, rad/s/sqrt(s)."""
    accel_bias_density: float = 0.0
    """Random walk of the accelerometer bias, m/s^2/sqrt(s)."""
    gyro_bias_instability: float = 0.0
    """Floor of the gyros' Allan deviation, rad/s."""
    accel_bias_instability: float = 0.0
    """Floor of the accelerometers' Allan deviation, m/s^2."""

    @property
    def gyro_bias_walk(self) -> float:
        """Random walk that covers walk and instability of the gyro bias, rad/s/sqrt(s)."""
        return math.hypot(self.gyro_bias_density, OF_INSTABILITY * self.gyro_bias_instability)

    @property
    def accel_bias_walk(self) -> float:
        """Random walk that covers walk and instability of the accelerometer bias, m/s^2/sqrt(s)."""
        return math.hypot(self.accel_bias_density, OF_INSTABILITY * self.accel_bias_instability)


@dataclass(frozen=True, slots=True, eq=False)
class ImuLog(FrozenArrays):
    """Gyro and accelerometer readings, each the mean over its interval.

    Sample ``k`` covers ``(time_s[k-1], time_s[k]]``; the first begins at ``start_s``.
    """

    start_s: float
    """Begin of the first averaging interval, s."""
    noise: ImuNoise
    time_s: Array = shaped("N")
    """(N,) end of each averaging interval, s, strictly increasing."""
    gyro_b: Array = shaped("N", 3)
    """(N, 3) body rate relative to inertial space, rad/s."""
    accel_b: Array = shaped("N", 3)
    """(N, 3) specific force, m/s^2; at rest (0, 0, -9.8)."""
    calibration: ImuCalibration = ImuCalibration()

    @property
    def calibrated(self) -> ImuLog:
        """The log with what is known of delay, scale, misalignment, g-sensitivity taken off.

        The sigmas of what is left are kept, the values are none: once more changes nothing.
        """
        known, late_s = self.calibration, self.calibration.time_offset_s
        if not (known.is_stated or late_s):
            return self
        gyro_b, accel_b = known.taken_off(self.gyro_b, self.accel_b)
        return replace(
            self,
            start_s=self.start_s - late_s,
            time_s=self.time_s - late_s,
            gyro_b=gyro_b,
            accel_b=accel_b,
            calibration=known.exact(),
        )


@dataclass(frozen=True, slots=True)
class ImuSample(Message):
    """One inertial sample, the mean over its interval; its time is the interval's end."""

    gyro_b: Vector
    """Body rate relative to inertial space, rad/s."""
    accel_b: Vector
    """Specific force, m/s^2; at rest (0, 0, -9.8)."""


class FrozenAxis(NamedTuple):
    """One axis of gyros or accelerometers that gives the same reading for long."""

    is_gyro: bool
    axis: int
    """From 0, of the body"""
    begin_s: float
    end_s: float

    def __str__(self) -> str:
        where = "about" if self.is_gyro else "along"
        return f"one reading again and again {where} {'xyz'[self.axis]}"


FROZEN_S: Final = 1.0
FROZEN_SAMPLES: Final = 20
"""So many equal readings in a row, for so long, are none: noise alone changes them."""


def frozen_axes(log: ImuLog) -> list[FrozenAxis]:
    """Return where an axis repeats one reading, in the order of axes, gyros first."""
    if len(log.time_s) <= FROZEN_SAMPLES or log.time_s[-1] - log.time_s[0] < FROZEN_S:
        return []
    return [
        FrozenAxis(axis < 3, axis % 3, float(log.time_s[begin]), float(log.time_s[end]))
        for axis, values in enumerate(np.hstack([log.gyro_b, log.accel_b]).T)
        for begin, end in frozen_runs(
            log.time_s, values[:, None], least_s=FROZEN_S, least_count=FROZEN_SAMPLES
        )
    ]


def frozen_now(rows: Array) -> list[FrozenAxis]:
    """Return the axes that give one reading for long up to the last of the rows (N, 7).

    Rows are time, s, gyros, accelerometers. An axis whose readings were often equal before, or
    always, is none of them: resolution makes them so, or rest.
    """
    last = rows[-1 - FROZEN_SAMPLES :, 1:]
    if len(last) <= FROZEN_SAMPLES:
        return []
    found = []
    for axis in np.flatnonzero((last == last[-1]).all(axis=0)).tolist():
        changed = np.flatnonzero(np.diff(rows[:, 1 + axis]))
        begin = int(changed[-1]) + 1 if len(changed) else 0
        is_usual = begin - len(changed) >= USUALLY_EQUAL * begin
        begin_s, end_s = float(rows[begin, 0]), float(rows[-1, 0])
        if end_s - begin_s >= FROZEN_S and not is_usual:
            found.append(FrozenAxis(axis < 3, axis % 3, begin_s, end_s))
    return found


def imu_gaps(imu: ImuLog) -> tuple[Array, Array]:
    """Return begin and end of every gap: an interval far longer than the usual one, s."""
    edges = np.concatenate([[imu.start_s], imu.time_s])
    spacing = np.diff(edges)
    is_gap = spacing > max(NOTED_GAP_S, 5.0 * usual_interval(edges))
    return edges[:-1][is_gap], edges[1:][is_gap]


class Stamp(Enum):
    """The instant of the averaging interval that an IMU time stamp names."""

    START = "start"
    MIDDLE = "middle"
    END = "end"


LARGEST_RATE: Final = 35.0
"""rad/s: 2000 deg/s, the widest range of gyros that are built for vehicles."""
LARGEST_FORCE: Final = 200.0
"""m/s^2: 20 g; accelerometers of vehicles end at 16 g."""
RATE_RANGE_HZ: Final = (5.0, 20000.0)
"""A slower IMU cannot carry a vehicle's motion between pings; a faster one has other units."""
LONGEST_GAP_S: Final = 10.0
NOTED_GAP_S: Final = 0.1
NOTED_JITTER: Final = 0.1
"""Scatter of the steps between samples, of their median; an instrument's own clock has no more."""
FORCE_RANGE: Final = (9.3, 10.3)
"""m/s^2: no bias or scale error of a usable accelerometer leads out of it."""
FASTEST_TURN: Final = 6.0
"""rad/s, of 99 % of the samples: no vehicle turns once a second for long."""
_HALF_G: Final = 4.9
_REPEATED_SHARE: Final = 0.2
FORCE_UNITS: Final = (
    (1.0, "g", "multiply them by 9.80665"),
    (1e3, "mg", "multiply them by 0.00980665"),
    (1e6, "ug", "multiply them by 9.80665e-6"),
    (32.174, "ft/s^2", "multiply them by 0.3048"),
    (980.665, "cm/s^2", "divide them by 100"),
    (9806.65, "mm/s^2", "divide them by 1000"),
)
_STEP_UNITS: Final = ((1e3, "milliseconds"), (1e6, "microseconds"), (1e9, "nanoseconds"))
_WALK: Final = "the unit is that of the data sheet"

_GYRO: Final = Column(
    "gyro_b",
    "gyro_{}_rad_per_s",
    XYZ,
    limits=(-LARGEST_RATE, LARGEST_RATE),
    expected="expected rad/s; delete this row",
    told="body rate {} rad/s: degrees?",
    is_body=True,
)
_ACCEL: Final = Column(
    "accel_b",
    "accel_{}_m_per_s2",
    XYZ,
    limits=(-LARGEST_FORCE, LARGEST_FORCE),
    expected="expected m/s^2; delete this row",
    told="specific force {} m/s^2: a wrong unit?",
    is_body=True,
)
_KEYS: Final = {
    "file": FILE_KEY,
    "stamp": Key(shape=None),
    "gyro_random_walk_deg_per_sqrt_h": sigma_key(
        "noise.gyro_density", 1e4, _WALK, unit=DEGREE * PER_SQRT_H
    ),
    "accel_random_walk_ug_per_sqrt_hz": sigma_key("noise.accel_density", 1e7, _WALK, unit=MICRO_G),
    "gyro_bias_deg_per_h": sigma_key("noise.gyro_bias_sigma", 1e6, _WALK, unit=DEG_PER_H),
    "accel_bias_ug": sigma_key("noise.accel_bias_sigma", 1e7, _WALK, unit=MICRO_G),
    "gyro_bias_walk_deg_per_h_per_sqrt_h": optional_key(
        "noise.gyro_bias_density", 0.0, 1e6, _WALK, unit=DEG_PER_H * PER_SQRT_H
    ),
    "accel_bias_walk_ug_per_sqrt_h": optional_key(
        "noise.accel_bias_density", 0.0, 1e7, _WALK, unit=MICRO_G * PER_SQRT_H
    ),
    "gyro_bias_instability_deg_per_h": optional_key(
        "noise.gyro_bias_instability", 0.0, 1e6, _WALK, unit=DEG_PER_H
    ),
    "accel_bias_instability_ug": optional_key(
        "noise.accel_bias_instability", 0.0, 1e7, _WALK, unit=MICRO_G
    ),
    **calibration_keys("calibration"),
}


class _Imu(Instrument):
    """The way of inertial sensors: stamps name any instant of an interval."""

    def empty(self) -> dict[str, Any]:
        return super().empty() | {"start_s": 0.0}

    def bare(self, settings: Settings, lists: Lists) -> ImuLog:
        settings.choice("stamp", Stamp, Stamp.END)
        log: ImuLog = super().bare(settings, lists)
        return log

    def check(self, table: Table, bare: ImuLog, axes: BodyAxes) -> list[str]:
        if len(table) < 2:
            got = f"{len(table)} row" if len(table) else "a header and no rows"
            raise DataError(f"{table.label}: the table has {got}; expected at least 2 samples")
        notes = _times(table)
        _specific_force(table, bare.calibration, axes)
        _turn_rates(table)
        notes += _gravity_direction(table, axes)
        readings = table.stack([*_GYRO.names, *_ACCEL.names])
        same = np.all(np.diff(readings, axis=0) == 0.0, axis=1).mean()
        if same > _REPEATED_SHARE:
            notes.append(
                f"{table.label}: {100 * same:.0f} % of the rows repeat all readings of the row "
                "before; a driver that publishes faster than the sensor measures makes such rows"
            )
        return notes

    def filled(self, table: Table, bare: ImuLog, settings: Settings, axes: BodyAxes) -> ImuLog:
        stamp = settings.choice("stamp", Stamp, Stamp.END)
        start_s, ends = interval_ends(table.time_s, stamp)
        log: ImuLog = super().filled(table, bare, settings, axes)
        return replace(log, start_s=start_s, time_s=ends)

    def settings_of(self, log: ImuLog) -> dict[str, Any]:
        return {"stamp": Stamp.END.value, **super().settings_of(log)}

    def message_of(self, numbers: Sequence[float], bare: ImuLog) -> ImuSample:  # noqa: ARG002
        time_s, gx, gy, gz, ax, ay, az = numbers
        return ImuSample(time_s, (gx, gy, gz), (ax, ay, az))

    def log_of(self, rows: Array, bare: ImuLog) -> ImuLog:
        time_s = rows[:, 0] + self.late_s(bare)
        return replace(bare, time_s=time_s, gyro_b=rows[:, 1:4], accel_b=rows[:, 4:7])


IMU: Final = _Imu(
    "imu",
    ImuLog,
    _KEYS,
    (_GYRO, _ACCEL),
    ImuSample,
    "i",
    late="calibration.time_offset_s",
    calibrated=CALIBRATED,
    is_required=True,
)


def interval_ends(time_s: Array, stamp: Stamp) -> tuple[float, Array]:
    """Return the begin of the first averaging interval and the end of each, (N,).

    Intervals touch each other; the one that a stamp leaves open is given the median length.
    """
    median = float(np.median(np.diff(time_s)))
    if stamp is Stamp.END:
        return float(time_s[0]) - median, time_s
    if stamp is Stamp.START:
        return float(time_s[0]), np.append(time_s[1:], time_s[-1] + median)
    middles = time_s[:-1] + 0.5 * np.diff(time_s)
    return float(time_s[0]) - 0.5 * median, np.append(middles, time_s[-1] + 0.5 * median)


def _times(table: Table) -> list[str]:
    steps = np.diff(table.time_s)
    median = float(np.median(steps))
    lowest, highest = RATE_RANGE_HZ
    if not 0.99 * lowest <= 1.0 / median <= highest:
        units = [unit for size, unit in _STEP_UNITS if 5.0 <= size / median <= 5000.0]
        hint = f"are the times in {units[0]}" if units else "are the times not in seconds"
        hint += ", or was the log thinned out?" if 1.0 / median < lowest else "?"
        raise DataError(
            f"{table.label}: the rows are {median:.6g} s apart, {1.0 / median:.6g} Hz; expected "
            f"{lowest:g} to {highest:g} Hz; {hint}"
        )
    row = int(np.argmax(steps))
    if steps[row] > LONGEST_GAP_S:
        raise table.fault(
            row + 1,
            f"no samples for {steps[row]:z.3f} s after {table.time_s[row]:z.3f} s; expected no gap "
            f"longer than {LONGEST_GAP_S:g} s; split the mission there",
        )
    gaps = steps > max(NOTED_GAP_S, 5.0 * median)
    notes = []
    jitter = float(np.std(steps[~gaps])) / median
    if jitter > NOTED_JITTER:
        notes.append(
            f"{table.label}: the steps in time scatter by {100.0 * jitter:.0f} % of their median, "
            f"{median:z.4f} s: times of arrival, not the sensor's own; each reading counts for the "
            "step before it"
        )
    if gaps.any():
        notes.append(
            f"{table.label}: {gaps.sum()} gaps in time, the longest {steps[row]:z.3f} s after "
            f"{table.time_s[row]:z.3f} s; each is bridged by the mean of the readings on both "
            "sides, with larger process noise"
        )
    return notes


def _specific_force(table: Table, known: ImuCalibration, axes: BodyAxes) -> None:
    gyro_b, accel_b = (to_frd(table.stack(names), axes) for names in (_GYRO.names, _ACCEL.names))
    _, force = known.taken_off(gyro_b, accel_b)
    median = float(np.median(_length(force)))
    low, high = FORCE_RANGE
    if not low <= median <= high:
        found = [(u, todo) for size, u, todo in FORCE_UNITS if abs(median / size - 1.0) < 0.06]
        if found:
            hint = f"the readings are in {found[0][0]}: {found[0][1]}"
        elif median < 2.0:
            hint = "was gravity taken out? the specific force with gravity is needed"
        else:
            hint = "check unit and scale of the accelerometer"
        raise DataError(
            f"{table.label}: the accelerometer's readings have a median length of {median:.6g}; "
            f"expected about 9.8 m/s^2; {hint}"
        )
    _ACCEL.beyond(table)


def _turn_rates(table: Table) -> None:
    rate = float(np.percentile(_length(table.stack(_GYRO.names)), 99.0))
    if rate > FASTEST_TURN:
        raise DataError(
            f"{table.label}: 1 % of the turn rates exceed {rate:.4g}; expected rad/s, up to "
            f"{FASTEST_TURN:g} for a vehicle; the readings are in deg/s: multiply them by pi/180"
        )
    _GYRO.beyond(table)


def _gravity_direction(table: Table, body: BodyAxes) -> list[str]:
    force = np.median(to_frd(table.stack(_ACCEL.names), body), axis=0)
    vertical = float(np.median(table[_ACCEL.names[2]]))
    want = "-9.8" if body is BodyAxes.FRD else "+9.8"
    place = f"{table.label}: column {_ACCEL.names[2]!r} has a median of {vertical:+.2f}"
    if force[2] > _HALF_G:
        other = (
            "[frames] body is really FLU or RFU"
            if body is BodyAxes.FRD
            else "[frames] body is really FRD"
        )
        raise DataError(
            f"{place}; expected about {want} in {body.value} axes; the accelerometer's signs are "
            f"reversed, or {other}"
        )
    if force[2] > -_HALF_G:
        return [
            f"{place}, where {want} was expected of a level vehicle in {body.value} axes; gravity "
            "lies along another axis: does the vehicle lie on its side, or are columns swapped?"
        ]
    return []


def _length(vectors: Array) -> Array:
    """Return lengths (N,); numbers beyond any sensor are cut so that squares stay finite."""
    return np.asarray(np.linalg.norm(np.clip(vectors, -1e100, 1e100), axis=1))
