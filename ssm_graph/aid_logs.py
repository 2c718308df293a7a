"""Measurements that only the batch smoother uses: acoustic positions and ranges, heading, rest.

Frozen values as in :mod:`ssm_graph.data`. Acoustics and compasses err grossly now and then: each of
their measurements is weighted as the beams are.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ssm_graph.errors import DataError
from ssm_graph.frozen import Array, FrozenArrays, shaped


@dataclass(frozen=True, slots=True, eq=False)
class UsblLog(FrozenArrays):
    """Acoustic position fixes of a transponder on the vehicle: USBL, or LBL as its maker solves it.

    A fix travels: it is stamped when it is known, and was valid ``delay_s`` before.
    """

    time_s: Array = shaped("N")
    """(N,) s as stamped, strictly increasing."""
    delay_s: Array = shaped("N")
    """(N,) s, how much older than its stamp each fix is."""
    lat: Array = shaped("N")
    """(N,) rad"""
    lon: Array = shaped("N")
    """(N,) rad"""
    height: Array = shaped("N")
    """(N,) m above the ellipsoid"""
    sigma_enu: Array = shaped("N", 3)
    """(N, 3) m, east, north, up, above zero."""
    lever_arm_b: Array = shaped(3)
    """(3,) body origin to transponder, m."""

    @property
    def valid_s(self) -> Array:
        """(N,) when the vehicle was there, s."""
        return np.asarray(self.time_s - self.delay_s)


@dataclass(frozen=True, slots=True, eq=False)
class Beacon(FrozenArrays):
    """A transponder on the seabed or at a buoy that stays where it is."""

    number: int
    """What the ranges call it."""
    lat: float
    """rad"""
    lon: float
    """rad"""
    height: float
    """m above the ellipsoid"""
    position_sigma_enu: Array = shaped(3)
    """(3,) m, prior sigmas east, north, up; above zero asks to estimate it, zero is exact."""

    @property
    def is_known(self) -> bool:
        """Whether its place is taken as stated."""
        return not self.position_sigma_enu.any()


@dataclass(frozen=True, slots=True, eq=False)
class RangeLog(FrozenArrays):
    """Acoustic ranges from the vehicle's transducer to beacons."""

    beacons: tuple[Beacon, ...]
    time_s: Array = shaped("N")
    """(N,) s, increasing; ranges to several beacons may have one time."""
    beacon: Array = shaped("N")
    """(N,) number of the beacon."""
    range_m: Array = shaped("N")
    """(N,) m, one way."""
    sigma: Array = shaped("N")
    """(N,) m, above zero."""
    lever_arm_b: Array = shaped(3)
    """(3,) body origin to transducer, m."""

    def __post_init__(self) -> None:
        super(RangeLog, self).__post_init__()
        numbers = [beacon.number for beacon in self.beacons]
        unknown = np.setdiff1d(self.beacon, numbers)
        if len(unknown) or len(set(numbers)) < len(numbers):
            raise DataError(
                f"RangeLog.beacon: expected numbers of the beacons {numbers}, each of them once, "
                f"got {unknown.tolist()} besides"
            )


@dataclass(frozen=True, slots=True)
class HeadingErrors:
    """Errors of a compass beside its noise, as prior sigmas in rad; zero is none.

    A heading gyro that seeks no north, a directional gyro, has an offset of pi and a rate.
    """

    offset_sigma: float = 0.0
    """Of what is constant: mounting, declination."""
    rate_sigma: float = 0.0
    """Of a constant drift since the first reading, rad/s."""
    walk_sigma: float = 0.0
    """Of what comes and goes, a Gauss-Markov process."""
    correlation_s: float = 600.0
    """Within this time it is forgotten, s."""
    one_cycle_sigma: float = 0.0
    """Of the sine and of the cosine of the heading: hard iron."""
    two_cycle_sigma: float = 0.0
    """Of the sine and of the cosine of twice the heading: soft iron."""


@dataclass(frozen=True, slots=True, eq=False)
class HeadingLog(FrozenArrays):
    """Readings of a magnetic or any other compass, or of a directional gyro."""

    sigma: float
    """Standard deviation of a reading, rad."""
    time_s: Array = shaped("N")
    """(N,) s, strictly increasing."""
    heading: Array = shaped("N")
    """(N,) rad as read, clockwise from the compass's north."""
    declination: float = 0.0
    """rad, of the compass's north from true north, positive east."""
    errors: HeadingErrors = HeadingErrors()


@dataclass(frozen=True, slots=True)
class Standstill:
    """A time in which the vehicle did not go anywhere: on deck, moored, on the bottom."""

    begin_s: float
    end_s: float
    sigma: float = 0.05
    """m/s, of each component of its velocity: it sways."""

    def __post_init__(self) -> None:
        if not (math.isfinite(self.begin_s) and self.begin_s < self.end_s < math.inf):
            raise DataError(
                f"Standstill: expected a begin before its end, got {self.begin_s} and "
                f"{self.end_s} s"
            )
        if not 0.0 < self.sigma < math.inf:
            raise DataError(f"Standstill.sigma: expected m/s above zero, got {self.sigma}")


@dataclass(frozen=True, slots=True, eq=False)
class AidLogs:
    """All of them; what a mission does not have is None or empty."""

    usbl: UsblLog | None = None
    ranges: RangeLog | None = None
    heading: HeadingLog | None = None
    standstills: tuple[Standstill, ...] = ()

    @property
    def sections(self) -> tuple[str, ...]:
        """Sections of ``mission.toml`` that hold what there is."""
        present = {
            "[usbl]": self.usbl is not None,
            "[ranges]": self.ranges is not None,
            "[heading]": self.heading is not None,
            "[[standstill]]": bool(self.standstills),
        }
        return tuple(name for name, is_there in present.items() if is_there)


NO_AIDS = AidLogs()
