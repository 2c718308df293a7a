"""What lies, from when to when and by how much: drawn anew for every seed."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ssm_graph.base.frozen import Array
from ssm_graph.simulation import Fault, FaultShape, Sensor

Rng = np.random.Generator
Size = float | tuple[float, ...]
Draw = Callable[[Rng, float], Fault | tuple[Fault, ...]]
"""Faults of a mission of so many seconds."""

INERTIAL = ("IMU", "gyro", "accelerometer")
GPS_S = 18.0
"""GPS time less UTC since 2017."""


class Lie(NamedTuple):
    """A kind of lasting fault."""

    draw: Draw
    named: tuple[str, ...]
    """Words of which the verdict has to use one, to name the right sensor"""
    with_gnss: bool | None = None
    """Whether the mission has fixes all the time; None for every other seed"""
    with_compass: bool = False
    """Whether it has a compass"""


def _window(rng: Rng, end_s: float, shortest: float, longest: float) -> tuple[float, float]:
    length = rng.uniform(shortest, longest)
    begin = rng.uniform(0.1 * end_s, max(0.9 * end_s - length, 0.11 * end_s))
    return begin, begin + length


def _onset(rng: Rng, end_s: float) -> float:
    return float(rng.uniform(0.3, 0.7) * end_s)


def _level(rng: Rng, low: float, high: float) -> Array:
    """Return a horizontal vector of a size between these."""
    angle = rng.uniform(0.0, 2.0 * math.pi)
    return rng.uniform(low, high) * np.array([math.cos(angle), math.sin(angle), 0.0])


def _size(vector: Array) -> tuple[float, ...]:
    return tuple(float(x) for x in vector)


def two_opposite(rng: Rng, end_s: float) -> Fault:
    """Draw two opposite beams that are off by as much, one up, one down."""
    begin, end = _window(rng, end_s, 100.0, 200.0)
    beam, off = int(rng.integers(2)), float(rng.uniform(0.03, 0.08))
    return Fault((beam, beam + 2), begin, end, (off, -off))


def two_beams(rng: Rng, end_s: float) -> Fault:
    """Draw two adjacent beams that are off by as much."""
    begin, end = _window(rng, end_s, 60.0, 150.0)
    beam, off = int(rng.integers(4)), float(rng.uniform(0.04, 0.1))
    return Fault((beam, (beam + 1) % 4), begin, end, off)


def one_beam(rng: Rng, end_s: float) -> Fault:
    """Draw a beam that is two of its sigmas of 5 mm/s off, all the time."""
    return Fault((int(rng.integers(4)),), 0.0, end_s, float(rng.choice([-0.01, 0.01])))


def spikes(rng: Rng, end_s: float) -> Fault:  # noqa: ARG001
    """Draw a beam of whose pings three in ten are two to five sigmas high."""
    beam = (int(rng.integers(4)),)
    return Fault(beam, shape=FaultShape.SPIKES, share=0.3, size=(2.0, 5.0))


def false_bottom(rng: Rng, end_s: float) -> Fault:
    """Draw a layer that moves, and hides the bottom for a while."""
    begin, end = _window(rng, end_s, 40.0, 100.0)
    size = _size(_level(rng, 0.1, 0.3))
    return Fault(start_s=begin, end_s=end, shape=FaultShape.MOVING_BOTTOM, size=size)


def drifting_bottom(rng: Rng, end_s: float) -> Fault:
    """Draw a bottom that moves from some time on."""
    size = _size(_level(rng, 0.04, 0.1))
    return Fault(start_s=_onset(rng, end_s), shape=FaultShape.MOVING_BOTTOM, size=size)


def water(rng: Rng, end_s: float) -> Fault:  # noqa: ARG001
    """Draw a current that all pings are relative to, unmarked."""
    return Fault(shape=FaultShape.MOVING_BOTTOM, size=_size(_level(rng, 0.2, 0.4)))


def mounting(rng: Rng, end_s: float) -> Fault:
    """Draw an instrument that turns in its clamp."""
    angle = math.radians(float(rng.uniform(2.0, 6.0)) * rng.choice([-1.0, 1.0]))
    return Fault(start_s=_onset(rng, end_s), shape=FaultShape.SLIP, size=(0.0, 0.0, angle))


def scale(rng: Rng, end_s: float) -> Fault:
    """Draw a scale that jumps."""
    size = float(1.0 + rng.uniform(0.02, 0.05))
    return Fault(start_s=_onset(rng, end_s), shape=FaultShape.SCALE, size=size)


def zeros(rng: Rng, end_s: float) -> Fault:
    """Draw zeros in all beams for a lost bottom."""
    begin, end = _window(rng, end_s, 40.0, 60.0)
    return Fault(start_s=begin, end_s=end, shape=FaultShape.ZERO)


def _gnss(shape: FaultShape, begin: float, end: float = math.inf, size: Size = ()) -> Fault:
    return Fault(sensor=Sensor.GNSS, shape=shape, start_s=begin, end_s=end, size=size)


def fixes_off(rng: Rng, end_s: float) -> Fault:
    """Draw fixes that are off for a minute or two."""
    begin, end = _window(rng, end_s, 60.0, 150.0)
    return _gnss(FaultShape.CONSTANT, begin, end, _size(_level(rng, 2.0, 5.0)))


def fixes_pulled(rng: Rng, end_s: float) -> Fault:
    """Draw fixes that are led away."""
    return _gnss(FaultShape.RAMP, _onset(rng, end_s), size=_size(_level(rng, 0.02, 0.06)))


def fixes_coasting(rng: Rng, end_s: float) -> Fault:
    """Draw a receiver that goes on as it went."""
    return _gnss(FaultShape.COASTING, *_window(rng, end_s, 50.0, 80.0))


def fixes_step(rng: Rng, end_s: float) -> Fault:
    """Draw fixes that step by three of their sigmas."""
    return _gnss(FaultShape.CONSTANT, _onset(rng, end_s), size=_size(_level(rng, 1.5, 1.5)))


def fixes_on_gps_time(rng: Rng, end_s: float) -> Fault:  # noqa: ARG001
    """Stamp the first minute's fixes by another clock."""
    return _gnss(FaultShape.LATE, 0.0, 60.0, GPS_S)


def fixes_late(rng: Rng, end_s: float) -> Fault:  # noqa: ARG001
    """Make fixes a second late throughout."""
    return _gnss(FaultShape.LATE, 0.0, size=1.0)


def fixes_frozen(rng: Rng, end_s: float) -> Fault:
    """Draw a receiver that stays where it was."""
    return _gnss(FaultShape.STUCK, _onset(rng, end_s))


def water_later(rng: Rng, end_s: float) -> Fault:
    """Draw a current that pings are relative to from some time on."""
    return replace(water(rng, end_s), start_s=_onset(rng, end_s))


def _depth(shape: FaultShape, begin: float, end: float = math.inf, size: Size = ()) -> Fault:
    return Fault(sensor=Sensor.DEPTH, shape=shape, start_s=begin, end_s=end, size=size)


def depth_drifts(rng: Rng, end_s: float) -> Fault:
    """Draw a depth that drifts by one to three metres in 900 s."""
    begin = rng.uniform(0.0, 0.25 * end_s)
    return _depth(FaultShape.RAMP, begin, size=float(rng.uniform(1.0, 3.0) / 900.0))


def depth_off(rng: Rng, end_s: float) -> Fault:
    """Draw a depth that is off for a minute or two."""
    begin, end = _window(rng, end_s, 60.0, 150.0)
    return _depth(FaultShape.CONSTANT, begin, end, float(rng.uniform(0.5, 2.0)))


def depth_frozen(rng: Rng, end_s: float) -> Fault:
    """Draw a depth that stays where it was."""
    return _depth(FaultShape.STUCK, *_window(rng, end_s, 60.0, 150.0))


def depth_drifts_fast(rng: Rng, end_s: float) -> Fault:
    """Draw a depth that drifts by centimetres a second from some time on."""
    return _depth(FaultShape.RAMP, _onset(rng, end_s), size=float(rng.uniform(0.01, 0.03)))


def compass_off(rng: Rng, end_s: float) -> Fault:
    """Draw a compass beside iron for a minute or two."""
    begin, end = _window(rng, end_s, 60.0, 150.0)
    off = math.radians(float(rng.uniform(8.0, 20.0)) * rng.choice([-1.0, 1.0]))
    return Fault(sensor=Sensor.COMPASS, start_s=begin, end_s=end, size=off)


def _imu(sensor: Sensor, shape: FaultShape, *window: float, size: float | None = None) -> Fault:
    axes = (2,) if sensor is Sensor.GYROS and shape is FaultShape.ZERO else ()
    start_s, end_s = window or (0.0, math.inf)
    of = () if size is None else size
    return Fault(sensor=sensor, shape=shape, start_s=start_s, end_s=end_s, size=of, axes=axes)


def gyro_stuck(rng: Rng, end_s: float) -> Fault:
    """Draw 20 s in which the gyro about the vertical reads zero."""
    begin, end = _window(rng, end_s, 20.0, 20.0)
    return _imu(Sensor.GYROS, FaultShape.ZERO, begin, end)


def imu_frozen(rng: Rng, end_s: float) -> Fault:
    """Draw ten seconds of equal rows."""
    return _imu(Sensor.IMU, FaultShape.STUCK, *_window(rng, end_s, 5.0, 10.0))


def imu_low_passed(rng: Rng, end_s: float) -> Fault:  # noqa: ARG001
    """Filter inertial data at 1 Hz."""
    return _imu(Sensor.IMU, FaultShape.LOW_PASS, size=1.0)


def imu_noisy(rng: Rng, end_s: float) -> Fault:  # noqa: ARG001
    """Make inertial data ten times as noisy as stated."""
    return _imu(Sensor.IMU, FaultShape.NOISE, size=10.0)


def gyros_short(rng: Rng, end_s: float) -> Fault:  # noqa: ARG001
    """Let gyros read 0.60 of the turn."""
    return _imu(Sensor.GYROS, FaultShape.SCALE, size=0.6)


def gyro_jumps(rng: Rng, end_s: float) -> Fault:
    """Draw a gyro about the vertical whose bias jumps by 0.02 to 0.1 deg/s."""
    size = math.radians(float(rng.uniform(0.02, 0.1)) * rng.choice([-1.0, 1.0]))
    shape, start_s = FaultShape.CONSTANT, _onset(rng, end_s)
    return Fault(sensor=Sensor.GYROS, shape=shape, start_s=start_s, size=size, axes=(2,))


def any_gyro_jumps(rng: Rng, end_s: float) -> Fault:
    """Draw a gyro whose bias jumps by 0.05 to 2 deg/s."""
    size = math.radians(math.exp(rng.uniform(math.log(0.05), math.log(2.0))))
    size *= float(rng.choice([-1.0, 1.0]))
    axes, start_s = (int(rng.integers(3)),), _onset(rng, end_s)
    return Fault(sensor=Sensor.GYROS, start_s=start_s, size=size, axes=axes)


def imu_clock_set(rng: Rng, end_s: float) -> Fault:
    """Draw a clock of the inertial data that is set forward by 0.05 to 1 s."""
    size = math.exp(rng.uniform(math.log(0.05), math.log(1.0)))
    return _imu(Sensor.IMU, FaultShape.CLOCK, _onset(rng, end_s), math.inf, size=size)


LIES = {
    "two opposite beams, ±0.03 to 0.08 m/s, 100 to 200 s": Lie(two_opposite, ("DVL",)),
    "two adjacent beams, 0.04 to 0.1 m/s, 60 to 150 s": Lie(two_beams, ("DVL",)),
    "one beam 2 sigma off, all the time": Lie(one_beam, ("DVL",)),
    "one beam, 30 % of its pings +2 to +5 sigma": Lie(spikes, ("DVL",)),
    "false bottom at 0.1 to 0.3 m/s, 40 to 100 s": Lie(false_bottom, ("DVL",)),
    "bottom that drifts at 0.04 to 0.1 m/s": Lie(drifting_bottom, ("DVL",)),
    "unmarked water track, 0.2 to 0.4 m/s": Lie(water, ("DVL",), with_gnss=True),
    "mounting turns by 2 to 6 deg": Lie(mounting, ("DVL",)),
    "scale of the DVL jumps by 2 to 5 %": Lie(scale, ("DVL",)),
    "zeros in all beams, 40 to 60 s": Lie(zeros, ("DVL", "zero")),
    "GNSS 2 to 5 m off, 60 to 150 s": Lie(fixes_off, ("GNSS",), with_gnss=True),
    "GNSS pulled at 2 to 6 cm/s": Lie(fixes_pulled, ("GNSS",), with_gnss=True),
    "GNSS coasts, 50 to 80 s": Lie(fixes_coasting, ("GNSS",), with_gnss=True),
    "GNSS steps by 1.5 m": Lie(fixes_step, ("GNSS",), with_gnss=True),
    "fixes on GPS time in the first minute": Lie(fixes_on_gps_time, ("GNSS",), with_gnss=True),
    "fixes 1 s late": Lie(fixes_late, ("GNSS",), with_gnss=True),
    "depth drifts by 1 to 3 m in 900 s": Lie(depth_drifts, ("depth",)),
    "depth 0.5 to 2 m off, 60 to 150 s": Lie(depth_off, ("depth",)),
    "depth frozen, 60 to 150 s": Lie(depth_frozen, ("depth",)),
    "gyro about the vertical reads 0 for 20 s": Lie(gyro_stuck, INERTIAL),
    "bias of one gyro jumps by 0.05 to 2 deg/s": Lie(any_gyro_jumps, INERTIAL),
    "equal inertial rows, 5 to 10 s": Lie(imu_frozen, INERTIAL),
    "inertial data low-passed at 1 Hz": Lie(imu_low_passed, (*INERTIAL, "clock")),
    "inertial noise ten times the stated": Lie(imu_noisy, (*INERTIAL, "inertial")),
    "gyros read 0.60 of the turn": Lie(gyros_short, INERTIAL),
}
LIVE = {
    label: LIES[label]
    for label in (
        "mounting turns by 2 to 6 deg",
        "bottom that drifts at 0.04 to 0.1 m/s",
        "GNSS 2 to 5 m off, 60 to 150 s",
        "GNSS pulled at 2 to 6 cm/s",
        "depth frozen, 60 to 150 s",
        "GNSS steps by 1.5 m",
        "scale of the DVL jumps by 2 to 5 %",
        "two opposite beams, ±0.03 to 0.08 m/s, 100 to 200 s",
    )
} | {
    "gyro about the vertical reads 0 for 20 s": Lie(gyro_stuck, (*INERTIAL, "inertial")),
    "depth drifts at 1 to 3 cm/s": Lie(depth_drifts_fast, ("depth",)),
    "GNSS frozen": Lie(fixes_frozen, ("GNSS",), with_gnss=True),
    "water taken for the bottom, 0.2 to 0.4 m/s": Lie(water_later, ("DVL",)),
    "bias of the vertical gyro jumps by 0.02 to 0.1 deg/s": Lie(
        gyro_jumps, (*INERTIAL, "inertial")
    ),
    "clock of the inertial data is set forward by 0.05 to 1 s": Lie(
        imu_clock_set, (*INERTIAL, "inertial", "clock")
    ),
    "compass 8 to 20 deg off, 60 to 150 s": Lie(compass_off, ("compass",), with_compass=True),
}
"""What the estimator on the vehicle is judged by: what begins while it goes."""
