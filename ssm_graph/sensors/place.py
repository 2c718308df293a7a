"""Positions on Earth as columns of a table and keys of a section, whoever says them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from ssm_graph.base.frames import BodyAxes
from ssm_graph.base.frozen import Array, FrozenArrays, Vector, shaped
from ssm_graph.base.settings import number_key
from ssm_graph.base.tables import Table
from ssm_graph.base.units import DEGREE
from ssm_graph.sensors.depth import DEEPEST_M
from ssm_graph.sensors.instrument import ENU, SMALLEST_SIGMA, Column, Instrument
from ssm_graph.sensors.messages import Message

LONGITUDES_DEG: Final = (-180.0, 360.0)
"""Receivers count either way from Greenwich, or east alone."""
LATITUDES_DEG: Final = (-90.0, 90.0)
HEIGHTS_M: Final = (-DEEPEST_M, 20000.0)

_SWAPPED: Final = "latitude or longitude out of range: degrees?"
LAT: Final = Column("lat", "lat_deg", limits=LATITUDES_DEG, told=_SWAPPED, unit=DEGREE)
LON: Final = Column(
    "lon",
    "lon_deg",
    limits=LONGITUDES_DEG,
    expected="expected degrees from {:g} to {:g}".format(*LONGITUDES_DEG),
    told=_SWAPPED,
    unit=DEGREE,
    wraps=True,
)
HEIGHT: Final = Column(
    "height",
    "height_m",
    limits=HEIGHTS_M,
    expected="expected metres, up; is it in mm?",
    told="height {:g} m: a wrong unit?",
)
SIGMA_ENU: Final = Column(
    "sigma_enu",
    "sigma_{}_m",
    ENU,
    limits=(SMALLEST_SIGMA, 1e7),
    expected="expected a standard deviation above 0, in metres; delete fixes of unknown quality",
    told="sigmas {} m, expected above zero",
)
POSITION: Final = (LAT, LON, HEIGHT)
PLACE_KEYS: Final = {
    "lat_deg": number_key(
        "lat", *LATITUDES_DEG, "are latitude and longitude swapped?", unit=DEGREE
    ),
    "lon_deg": number_key(
        "lon", *LONGITUDES_DEG, "longitude is in degrees", unit=DEGREE, wraps=True
    ),
    "height_m": number_key("height", *HEIGHTS_M, "height is in metres above the ellipsoid, up"),
}


@dataclass(frozen=True, slots=True, eq=False)
class PositionLog(FrozenArrays):
    """Positions on Earth as an instrument found them."""

    time_s: Array = shaped("N")
    """(N,) s as stamped, strictly increasing."""
    lat: Array = shaped("N")
    """(N,) rad"""
    lon: Array = shaped("N")
    """(N,) rad"""
    height: Array = shaped("N")
    """(N,) m above the ellipsoid"""
    sigma_enu: Array = shaped("N", 3)
    """(N, 3) m, east, north, up, above zero."""
    lever_arm_b: Array = shaped(3)
    """(3,) body origin to antenna or transponder, m."""


@dataclass(frozen=True, slots=True)
class PositionMessage(Message):
    """One position."""

    lat: float
    """rad"""
    lon: float
    """rad"""
    height: float
    """m above the ellipsoid"""
    sigma_enu: Vector
    """m"""


class PositionInstrument(Instrument):
    """The way of receivers: codes for no fix, radians."""

    def check(self, table: Table, bare: Any, axes: BodyAxes) -> list[str]:
        """Refuse what is no place on Earth, then as for any other table."""
        notes = check_positions(table)
        return notes + super().check(table, bare, axes)


def check_positions(table: Table) -> list[str]:
    """Check the ranges of positions, and whether they are codes or radians; return the notes."""
    lat, lon = table["lat_deg"], table["lon_deg"]
    nowhere = (lat == 0.0) & (lon == 0.0)
    if nowhere.any():
        raise table.fault(
            int(np.argmax(nowhere)),
            "latitude and longitude are exactly 0; receivers write that when they have no fix: "
            "delete such rows",
        )
    swapped = np.all(np.abs(lon) <= 90.0) and np.all(np.abs(lat) <= 360.0)
    hint = "latitude and longitude seem swapped" if swapped else "is it an integer coding?"
    replace(LAT, expected=f"expected degrees from -90 to 90; {hint}").beyond(table)
    LON.beyond(table)
    HEIGHT.beyond(table)
    if np.all(np.abs(lat) <= 0.5 * np.pi) and np.all(np.abs(lon) <= np.pi):
        return [
            f"{table.label}: all positions lie within 3.2 degrees of 0 N, 0 E; if they are in "
            "radians, multiply them by 180/pi"
        ]
    return []
