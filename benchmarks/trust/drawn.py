"""Faults of any kind, size, length and onset, one or two at a time, drawn by seed."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from benchmarks.trust.lies import INERTIAL, Rng
from ssm_graph.simulation import (
    AidSettings,
    BeaconSettings,
    CompassSettings,
    Fault,
    FaultShape,
    RangingSettings,
    Sensor,
    UsblSettings,
)

TWO = 0.3
"""Share of the missions that have two faults, of different sensors."""
NAMED = {
    Sensor.DVL: ("DVL",),
    Sensor.GNSS: ("GNSS",),
    Sensor.DEPTH: ("depth",),
    Sensor.USBL: ("USBL",),
    Sensor.COMPASS: ("heading", "compass"),
    Sensor.RANGES: ("range", "beacon"),
}
"""Words of which a verdict has to use one; of other sensors :data:`INERTIAL_NAMES`."""
_VECTOR = 3
_PLANE = 2
DEG = math.radians(1.0)
HALF = 0.5
INERTIAL_NAMES = (*INERTIAL, "inertial", "clock")


class Kind(NamedTuple):
    """What may happen to a sensor: sizes and lengths are drawn evenly in their logarithm."""

    sensor: Sensor
    shape: FaultShape
    low: float = 0.0
    """Least size, in the unit of :attr:`Fault.size`, and"""
    high: float = 0.0
    """largest one; both zero for shapes without"""
    longest_s: float = math.inf
    """It ends before; infinite for what may last to the end, as half of those do"""
    dim: int = 1
    """Of the size: a vector, or one in the horizontal plane"""
    n_beams: int = 0
    """Of the DVL that are hit; 0 for all"""
    has_axis: bool = False
    """Whether one axis of a triad is hit, not all three"""

    @property
    def label(self) -> str:
        """As it stands in the table."""
        beams = f" of {self.n_beams}" if self.n_beams else ""
        axis = " of one axis" if self.has_axis else ""
        return f"{self.sensor.value}{beams} {self.shape.name}{axis}"


S, F = Sensor, FaultShape
KINDS = (
    Kind(S.DVL, F.CONSTANT, 0.01, 0.3, n_beams=1),
    Kind(S.DVL, F.CONSTANT, 0.02, 0.2, n_beams=2),
    Kind(S.DVL, F.DRIFT, 0.03, 0.3, 350.0, n_beams=1),
    Kind(S.DVL, F.COVERED, 0.1, 1.0, 350.0, n_beams=1),
    Kind(S.DVL, F.SCALE, 0.02, 0.1, n_beams=1),
    Kind(S.DVL, F.STUCK, n_beams=1),
    Kind(S.DVL, F.NOISE, 2.0, 8.0, n_beams=1),
    Kind(S.DVL, F.SPIKES, 2.0, 8.0, n_beams=1),
    Kind(S.DVL, F.SCALE, 0.01, 0.1),
    Kind(S.DVL, F.SLIP, 1.0 * DEG, 10.0 * DEG, dim=_VECTOR),
    Kind(S.DVL, F.MOVING_BOTTOM, 0.03, 0.5, dim=_PLANE),
    Kind(S.DVL, F.ZERO, longest_s=60.0),
    Kind(S.DVL, F.LATE, 0.1, 1.0),
    Kind(S.GNSS, F.CONSTANT, 1.0, 10.0, dim=_VECTOR),
    Kind(S.GNSS, F.RAMP, 0.005, 0.1, dim=_PLANE),
    Kind(S.GNSS, F.COASTING, longest_s=100.0),
    Kind(S.GNSS, F.STUCK),
    Kind(S.GNSS, F.LATE, 0.5, 18.0),
    Kind(S.GNSS, F.NOISE, 2.0, 8.0),
    Kind(S.GNSS, F.SPIKES, 2.0, 20.0),
    Kind(S.DEPTH, F.CONSTANT, 0.2, 5.0),
    Kind(S.DEPTH, F.RAMP, 5e-4, 0.05),
    Kind(S.DEPTH, F.STUCK),
    Kind(S.DEPTH, F.LATE, 0.5, 3.0),
    Kind(S.DEPTH, F.SCALE, 0.01, 0.05),
    Kind(S.DEPTH, F.NOISE, 2.0, 8.0),
    Kind(S.DEPTH, F.SPIKES, 2.0, 20.0),
    Kind(S.GYROS, F.CONSTANT, 0.05 * DEG, 2.0 * DEG, has_axis=True),
    Kind(S.GYROS, F.ZERO, longest_s=30.0, has_axis=True),
    Kind(S.GYROS, F.SCALE, 0.01, 0.5),
    Kind(S.ACCELEROMETERS, F.CONSTANT, 0.005, 0.5, has_axis=True),
    Kind(S.ACCELEROMETERS, F.SCALE, 0.002, 0.1),
    Kind(S.IMU, F.STUCK, longest_s=10.0),
    Kind(S.IMU, F.LOW_PASS, 0.5, 5.0),
    Kind(S.IMU, F.NOISE, 3.0, 10.0),
    Kind(S.IMU, F.LATE, 0.05, 0.5),
    Kind(S.IMU, F.CLOCK, 0.05, 1.0),
    Kind(S.USBL, F.CONSTANT, 3.0, 30.0, dim=_VECTOR),
    Kind(S.USBL, F.RAMP, 0.02, 0.3, dim=_PLANE),
    Kind(S.USBL, F.STUCK),
    Kind(S.USBL, F.LATE, 1.0, 10.0),
    Kind(S.USBL, F.NOISE, 2.0, 8.0),
    Kind(S.COMPASS, F.CONSTANT, 2.0 * DEG, 20.0 * DEG),
    Kind(S.COMPASS, F.RAMP, 0.01 * DEG, 0.2 * DEG),
    Kind(S.COMPASS, F.STUCK),
    Kind(S.COMPASS, F.LATE, 0.3, 3.0),
    Kind(S.COMPASS, F.NOISE, 2.0, 8.0),
    Kind(S.RANGES, F.CONSTANT, 0.5, 10.0),
    Kind(S.RANGES, F.RAMP, 0.005, 0.1),
    Kind(S.RANGES, F.SCALE, 0.005, 0.1),
    Kind(S.RANGES, F.SPIKES, 2.0, 20.0),
)
BEACONS = ((90.0, 20.0, -30.0), (-40.0, 110.0, -30.0), (-60.0, -80.0, -30.0))
"""East, north and up of the start, m; three beacons."""
SHORTEST_S = 20.0
"""Of those that may last to the end; others are at least a quarter of what they are at most."""


class Drawn(NamedTuple):
    """A fault of a kind."""

    kind: Kind
    fault: Fault

    @property
    def named(self) -> tuple[str, ...]:
        """Words of which the verdict has to use one."""
        return NAMED.get(self.kind.sensor, INERTIAL_NAMES)


def drawn(rng: Rng, end_s: float) -> list[Drawn]:
    """Draw one fault, or two of different instruments, of a mission of so many seconds."""
    kinds = [KINDS[rng.integers(len(KINDS))]]
    if rng.random() < TWO:
        known = NAMED.get(kinds[0].sensor)
        others = [kind for kind in KINDS if NAMED.get(kind.sensor) != known]
        kinds.append(others[rng.integers(len(others))])
    return [Drawn(kind, _fault(kind, rng, end_s)) for kind in kinds]


def _fault(kind: Kind, rng: Rng, end_s: float) -> Fault:
    size: float | tuple[float, ...] = ()
    offset: float | tuple[float, ...] = 0.0
    share, shape = 0.0, kind.shape
    beams = tuple(sorted(rng.permutation(4)[: kind.n_beams].tolist()))
    signs = rng.choice([-1.0, 1.0], max(len(beams), 1))
    much = math.exp(rng.uniform(math.log(kind.low), math.log(kind.high))) if kind.high else 0.0
    if kind.sensor is S.DVL and shape in (F.CONSTANT, F.DRIFT):
        offset = tuple((much * signs).tolist())
    elif shape is F.COVERED:
        share = much
    elif shape is F.SPIKES:
        share, size = float(rng.uniform(0.1, 0.4)), (much, 2.0 * much)
    elif shape is F.SCALE:
        size = 1.0 + much * float(signs[0])
    elif kind.dim > 1:
        towards = rng.standard_normal(kind.dim)
        towards *= much / np.linalg.norm(towards)
        size = tuple(np.pad(towards, (0, _VECTOR - kind.dim)).tolist())
    elif much:
        size = much * float(signs[0]) if shape in (F.CONSTANT, F.RAMP) else much
    start_s, until_s = _window(kind, rng, end_s)
    axes = (int(rng.integers(3)),) if kind.has_axis else ()
    return Fault(beams, start_s, until_s, offset, shape, share, kind.sensor, size, axes)


def _window(kind: Kind, rng: Rng, end_s: float) -> tuple[float, float]:
    """Draw begin and end, s: of a clock that is set, and of half of what may last, no end."""
    lasts = math.isinf(kind.longest_s)
    longest_s = min(kind.longest_s, 0.8 * end_s)
    shortest_s = SHORTEST_S if lasts else 0.25 * longest_s
    if kind.shape is F.CLOCK or (lasts and rng.random() < HALF):
        return float(rng.uniform(0.0, 0.8) * end_s), math.inf
    length_s = math.exp(rng.uniform(math.log(shortest_s), math.log(longest_s)))
    start_s = float(rng.uniform(0.05 * end_s, 0.95 * end_s - length_s))
    return start_s, start_s + length_s


def aids_of(found: list[Drawn]) -> AidSettings:
    """Return the aids that a mission needs for such faults, and no others."""
    sensors = {one.kind.sensor for one in found}
    beacons = tuple(BeaconSettings(number, place) for number, place in enumerate(BEACONS, 1))
    return AidSettings(
        usbl=UsblSettings() if S.USBL in sensors else None,
        compass=CompassSettings() if S.COMPASS in sensors else None,
        ranging=RangingSettings(beacons) if S.RANGES in sensors else None,
    )
