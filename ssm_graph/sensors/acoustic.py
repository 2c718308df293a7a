"""Acoustic position fixes, and ranges to beacons.

Acoustics err grossly now and then: each of their measurements is weighted as the beams are.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from ssm_graph.base.errors import DataError
from ssm_graph.base.frozen import Array, FrozenArrays, shaped


@dataclass(frozen=True, slots=True, eq=False)
class UsblLog(FrozenArrays):
    """Acoustic position fixes of a transponder on the vehicle: USBL, or LBL as its maker solves it.

    A fix travels: it is stamped when it is known, and was valid ``delay_s`` before.
    """

    SECTION: ClassVar[str] = "[usbl]"

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

    SECTION: ClassVar[str] = "[ranges]"

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
