"""Faults that last, of any sensor: what goes wrong, from when to when, and by how much.

One vocabulary for simulated missions (``SimulationConfig.faults``), studies (``[[cases.faults]]``)
and recorded ones (:func:`ssm_graph.simulation.with_faults`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ssm_graph.base.frozen import Array
from ssm_graph.simulation import checked

Rows = NDArray[np.intp]


class Sensor(Enum):
    """Who is at fault; the text is its name in the truth record, the section of its log."""

    DVL = "dvl"
    GNSS = "gnss"
    DEPTH = "depth"
    COMPASS = "heading"
    USBL = "usbl"
    RANGES = "ranges"
    GYROS = "gyros"
    ACCELEROMETERS = "accelerometers"
    IMU = "imu"

    @property
    def is_inertial(self) -> bool:
        """Whether its readings are inertial data."""
        return self in _INERTIAL


_INERTIAL = frozenset({Sensor.GYROS, Sensor.ACCELEROMETERS, Sensor.IMU})
_TRIADS = frozenset({Sensor.GYROS, Sensor.ACCELEROMETERS})
_PLACES = frozenset({Sensor.GNSS, Sensor.USBL})
_SCALARS = frozenset({Sensor.DEPTH, Sensor.COMPASS, Sensor.RANGES})
_DVL = frozenset({Sensor.DVL})
_ALL = frozenset(Sensor)


class FaultShape(Enum):
    """What a fault does from its begin on."""

    CONSTANT = "a constant offset"
    DRIFT = "an offset that grows evenly from zero to its size at the end"
    COVERED = "a covered transducer: reads low by a share that grows evenly from zero to its size"
    STUCK = "stays at what it read at the begin; a simulated beam's noise goes on"
    RAMP = "an offset that grows by its size every second"
    ZERO = "reads zero"
    SCALE = "reads its size times too much: a wrong unit, a scale that jumps"
    NOISE = "its noise is its size times that stated"
    SPIKES = "a share of the readings is off by a low to a high number of sigmas"
    LATE = "says what was true its size in seconds before: a clock, GPS time"
    MOVING_BOTTOM = "what reflects moves: a false or a drifting bottom, water taken for the bottom"
    SLIP = "the mounting is turned by a rotation vector"
    COASTING = "goes on with the velocity that it had at the begin"
    FLAT = "depth below the plane that touches the Earth at the origin"
    CLIPPED = "readings end at plus and minus its size"
    LOW_PASS = "readings went through a filter of two poles that ends at its size in hertz"
    CLOCK = "the clock is set forward by its size in seconds, once and for all"


_OFFSETS: Final = (FaultShape.CONSTANT, FaultShape.DRIFT, FaultShape.RAMP)
SENSORS: Final = {
    FaultShape.CONSTANT: _ALL - {Sensor.IMU},
    FaultShape.DRIFT: _ALL - {Sensor.IMU},
    FaultShape.COVERED: _DVL,
    FaultShape.STUCK: _ALL,
    FaultShape.RAMP: _PLACES | _SCALARS | _TRIADS,
    FaultShape.ZERO: _DVL | _TRIADS,
    FaultShape.SCALE: _DVL | _TRIADS | {Sensor.DEPTH, Sensor.RANGES},
    FaultShape.NOISE: _ALL,
    FaultShape.SPIKES: _ALL - _INERTIAL,
    FaultShape.LATE: _ALL - {Sensor.RANGES},
    FaultShape.MOVING_BOTTOM: _DVL,
    FaultShape.SLIP: _DVL,
    FaultShape.COASTING: _PLACES,
    FaultShape.FLAT: frozenset({Sensor.DEPTH}),
    FaultShape.CLIPPED: _TRIADS,
    FaultShape.LOW_PASS: _INERTIAL,
    FaultShape.CLOCK: frozenset({Sensor.IMU}),
}
"""Sensors that each shape befalls."""
_WITHOUT_SIZE: Final = {
    FaultShape.COVERED,
    FaultShape.STUCK,
    FaultShape.ZERO,
    FaultShape.COASTING,
    FaultShape.FLAT,
}
WHOLE_ARRAY: Final = {FaultShape.MOVING_BOTTOM, FaultShape.SLIP, FaultShape.LATE}
"""Shapes of the DVL that befall all beams together."""
_ABOVE: Final = {
    FaultShape.NOISE,
    FaultShape.CLIPPED,
    FaultShape.LOW_PASS,
    FaultShape.CLOCK,
}
"""Shapes whose size is above one, or zero."""
_BEFORE_NOISE: Final = {
    FaultShape.CONSTANT,
    FaultShape.DRIFT,
    FaultShape.COVERED,
    FaultShape.STUCK,
}
_TO_AN_END: Final = {FaultShape.DRIFT, FaultShape.COVERED}


@dataclass(frozen=True, slots=True)
class Fault:
    """A fault of a sensor in ``[start_s, end_s)``.

    ``Fault((1,), 60.0, 90.0, 0.3)`` puts 0.3 m/s on the second beam of the DVL;
    ``Fault(sensor=Sensor.GNSS, start_s=60.0, end_s=180.0, size=(3.0, 0.0, 0.0))`` has fixes 3 m to
    the east.
    """

    beams: tuple[int, ...] = ()
    """Beams of the DVL, from 0; empty for all, and for other sensors."""
    start_s: float = 0.0
    end_s: float = math.inf
    """Infinite: to the end of the mission."""
    offset_m_per_s: float | tuple[float, ...] = 0.0
    """m/s, one for all or one for each of ``beams``; of their CONSTANT and DRIFT."""
    shape: FaultShape = FaultShape.CONSTANT
    share: float = 0.0
    """By how much a COVERED beam reads low in the end, 1 reads zero; of readings with SPIKES."""
    sensor: Sensor = Sensor.DVL
    size: float | tuple[float, ...] = ()
    """Of all but beams' offsets. CONSTANT and DRIFT: m (east, north, up of a place), rad, rad/s or
    m/s^2, one for all or one for each of ``axes``; RAMP: the same every second. SCALE and NOISE: a
    factor. SPIKES: sigmas, low and high. LATE and CLOCK: s. MOVING_BOTTOM: m/s, east, north, up.
    SLIP: rad, instrument axes, as :attr:`DvlSettings.misalignment`. CLIPPED: rad/s or m/s^2.
    LOW_PASS: Hz. None for the others."""
    axes: tuple[int, ...] = ()
    """Of gyros or accelerometers: 0 forward, 1 right, 2 down; empty for all three."""

    def __post_init__(self) -> None:
        checked.require_rule("Fault", checked.WINDOW, (self.start_s, self.end_s))
        name, allowed = self.shape.name, SENSORS[self.shape]
        checked.require(
            self.sensor in allowed,
            "Fault.sensor",
            expected=f"with {name} one of {', '.join(s.name for s in Sensor if s in allowed)}",
            got=self.sensor.name,
            hint="take another shape",
        )
        ends = self.shape in _TO_AN_END
        checked.require(
            math.isfinite(self.end_s) == ends or not (ends or self.shape is FaultShape.CLOCK),
            "Fault.end_s",
            expected=f"{'a time' if ends else 'none'} with {name}",
            got=self.end_s,
            hint="a drift grows until it ends, a clock that was set stays so",
        )
        self._check_beams_and_axes()
        has_share = self.shape in (FaultShape.COVERED, FaultShape.SPIKES)
        of_dvl = self.sensor is Sensor.DVL
        for what, given, is_asked in (
            ("beams", len(self.beams), of_dvl and self.shape not in WHOLE_ARRAY),
            ("axes", len(self.axes), self.sensor in _TRIADS),
            ("offset_m_per_s", self.offset_m_per_s, self.has_offset),
            ("share", self.share, has_share),
        ):
            checked.require(
                is_asked or not np.any(given),
                f"Fault.{what}",
                expected=f"none with {name} of {self.sensor.name}",
                got=getattr(self, what),
                hint="leave it out",
            )
        checked.require(
            0.0 < self.share <= 1.0 or not has_share,
            "Fault.share",
            expected="above 0, at most 1",
            got=self.share,
            hint="write 30 % as 0.3",
        )
        self._check_size()

    def _check_beams_and_axes(self) -> None:
        if self.beams:
            checked.require_rule("Fault.beams", checked.BEAMS, self.beams)
        checked.require(
            set(self.axes) <= {0, 1, 2} and len(set(self.axes)) == len(self.axes),
            "Fault.axes",
            expected="different axes out of 0..2",
            got=self.axes,
            hint="axes are counted from 0",
        )
        checked.require(
            np.size(self.offset_m_per_s) in (1, len(self.beams)),
            "Fault.offset_m_per_s",
            expected=f"1 or {len(self.beams)} offsets",
            got=self.offset_m_per_s,
            hint="give one offset for all beams or one for each",
        )

    def _check_size(self) -> None:
        counts, sizes, name = self._counts(), self.sizes, self.shape.name
        checked.require(
            len(sizes) in counts and bool(np.isfinite(sizes).all()),
            "Fault.size",
            expected=f"{' or '.join(map(str, counts))} finite numbers with {name} of "
            f"{self.sensor.name}",
            got=self.size,
            hint="see Fault.size for what they are",
        )
        least = 1.0 if self.shape is FaultShape.NOISE else 0.0
        checked.require(
            self.shape not in _ABOVE or bool(sizes[0] > least),
            "Fault.size",
            expected=f"more than {least:g} with {name}",
            got=self.size,
            hint="noise cannot be taken off again" if least else "it has no sign",
        )

    def _counts(self) -> tuple[int, ...]:
        """Return how many numbers may be the size."""
        if self.shape in _WITHOUT_SIZE or self.has_offset:
            return (0,)
        if self.shape in (FaultShape.MOVING_BOTTOM, FaultShape.SLIP):
            return (3,)
        if self.shape is FaultShape.SPIKES:
            return (2,)
        if self.shape in _OFFSETS and self.sensor in _PLACES:
            return (3,)
        if self.shape in _OFFSETS and self.sensor in _TRIADS:
            return tuple(dict.fromkeys((1, len(self.axes) or 3)))
        return (1,)

    @property
    def sizes(self) -> Array:
        """The size as a list."""
        return np.atleast_1d(np.asarray(self.size, float))

    @property
    def has_offset(self) -> bool:
        """Whether it has a size in m/s, of beams."""
        return self.sensor is Sensor.DVL and self.shape in (FaultShape.CONSTANT, FaultShape.DRIFT)

    @property
    def is_before_noise(self) -> bool:
        """Whether the simulator adds it to clean speeds of beams, whose noise goes on."""
        return self.sensor is Sensor.DVL and self.shape in _BEFORE_NOISE

    def beams_of(self, n_beams: int) -> Rows:
        """Return the beams that suffer, of so many."""
        return np.array(self.beams or range(n_beams), np.intp)

    def inside(self, time_s: Array) -> Rows:
        """Return the readings, by number, at times inside the fault."""
        return np.flatnonzero((self.start_s <= time_s) & (time_s < self.end_s))

    def offset(self, time_s: Array, reading: Array) -> Array:
        """Return what an offset, COVERED or STUCK adds (N, n) to ``reading`` (N, n).

        The readings at ``time_s`` (N,) are those inside the fault; units are theirs.
        """
        age_s = (time_s - self.start_s)[:, None]
        grown = age_s / (self.end_s - self.start_s)
        if self.shape is FaultShape.STUCK:
            return np.asarray(_first(reading) - reading)
        if self.shape is FaultShape.COVERED:
            return np.asarray(-self.share * grown * reading)
        size = self.offset_m_per_s if self.has_offset else self.sizes
        factor = {FaultShape.DRIFT: grown, FaultShape.RAMP: age_s}.get(self.shape, 1.0)
        return np.asarray(np.broadcast_to(size, reading.shape) * factor)

    def changed(self, time_s: Array, reading: Array) -> Array:
        """Return ``reading`` (N, n) as a fault makes it that nothing but the reading decides."""
        if self.shape is FaultShape.STUCK:
            return np.broadcast_to(_first(reading), reading.shape)
        if self.shape is FaultShape.ZERO:
            return np.where(np.isnan(reading), np.nan, 0.0)
        if self.shape is FaultShape.SCALE:
            return np.asarray(self.sizes[0] * reading)
        if self.shape is FaultShape.CLIPPED:
            return np.clip(reading, -self.sizes[0], self.sizes[0])
        return np.asarray(reading + self.offset(time_s, reading))


def _first(reading: Array) -> Array:
    """Return the first reading of each column that there is, (1, n)."""
    return np.take_along_axis(reading, np.isfinite(reading).argmax(axis=0)[None], 0)
