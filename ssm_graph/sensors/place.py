"""Positions on Earth as columns of a table and keys of a section, whoever says them."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np

from ssm_graph.base.settings import Key
from ssm_graph.base.tables import Table
from ssm_graph.base.units import DEGREE
from ssm_graph.sensors.depth import DEEPEST_M
from ssm_graph.sensors.instrument import ENU, SMALLEST_SIGMA, Column

LONGITUDES_DEG: Final = (-180.0, 360.0)
"""Receivers count either way from Greenwich, or east alone."""
LATITUDES_DEG: Final = (-90.0, 90.0)
HEIGHTS_M: Final = (-DEEPEST_M, 20000.0)

_SWAPPED: Final = "latitude or longitude out of range: degrees?"
LAT: Final = Column(
    "lat",
    "lat_deg",
    low=LATITUDES_DEG[0],
    high=LATITUDES_DEG[1],
    told=_SWAPPED,
    unit=DEGREE,
)
LON: Final = Column(
    "lon",
    "lon_deg",
    low=LONGITUDES_DEG[0],
    high=LONGITUDES_DEG[1],
    expected="expected degrees from {:g} to {:g}".format(*LONGITUDES_DEG),
    told=_SWAPPED,
    unit=DEGREE,
    wraps=True,
)
HEIGHT: Final = Column(
    "height",
    "height_m",
    low=HEIGHTS_M[0],
    high=HEIGHTS_M[1],
    expected="expected metres, up; is it in mm?",
    told="height {:g} m: a wrong unit?",
)
SIGMA_ENU: Final = Column(
    "sigma_enu",
    "sigma_{}_m",
    ENU,
    low=SMALLEST_SIGMA,
    high=1e7,
    expected="expected a standard deviation above 0, in metres; delete fixes of unknown quality",
    told="sigmas {} m, expected above zero",
)
POSITION: Final = (LAT, LON, HEIGHT)
PLACE_KEYS: Final = {
    "lat_deg": Key(
        "lat",
        low=LATITUDES_DEG[0],
        high=LATITUDES_DEG[1],
        hint="are latitude and longitude swapped?",
        unit=DEGREE,
    ),
    "lon_deg": Key(
        "lon",
        low=LONGITUDES_DEG[0],
        high=LONGITUDES_DEG[1],
        hint="longitude is in degrees",
        unit=DEGREE,
        wraps=True,
    ),
    "height_m": Key(
        "height",
        low=HEIGHTS_M[0],
        high=HEIGHTS_M[1],
        hint="height is in metres above the ellipsoid, up",
    ),
}


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
