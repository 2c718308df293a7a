"""What a mission folder may contain of further aids: sections, lists, limits and columns.

Columns of positions are those of GNSS.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Final

from ssm_graph.io.tables.settings import (
    FILE_KEY,
    LEVER_ARM_KEY,
    PLACE_KEYS,
    Key,
    optional_key,
    sigma_key,
)
from ssm_graph.io.tables.table import POSITION, POSITION_SIGMA, TIME, TableSpec

_DEGREES: Final = "the unit is degrees"

AID_SECTIONS: Final[Mapping[str, Mapping[str, Key]]] = {
    "usbl": {"file": FILE_KEY, "lever_arm_m": LEVER_ARM_KEY},
    "ranges": {"file": FILE_KEY, "noise_m": sigma_key(1000.0), "lever_arm_m": LEVER_ARM_KEY},
    "heading": {
        "file": FILE_KEY,
        "noise_deg": sigma_key(90.0, _DEGREES),
        "declination_deg": optional_key(-180.0, 180.0, _DEGREES),
        "offset_sigma_deg": optional_key(0.0, 180.0, _DEGREES),
        "rate_sigma_deg_per_h": optional_key(0.0, 1e4, "the unit is degrees per hour"),
        "walk_sigma_deg": optional_key(0.0, 90.0, _DEGREES),
        "correlation_s": Key(positive=True, high=1e6, required=False, hint="the unit is seconds"),
        "one_cycle_sigma_deg": optional_key(0.0, 90.0, _DEGREES),
        "two_cycle_sigma_deg": optional_key(0.0, 90.0, _DEGREES),
    },
}
LISTS: Final[Mapping[str, Mapping[str, Key]]] = {
    "beacon": {
        "number": Key(low=0.0, high=1e6, hint="it is what column 'beacon' of [ranges] calls it"),
        **PLACE_KEYS,
        "position_sigma_m": Key(
            shape=(3,),
            positive=True,
            high=1e5,
            required=False,
            hint="east, north and up; leave the key out where the place is known",
        ),
    },
    "standstill": {
        "begin_s": Key(),
        "end_s": Key(),
        "sigma_m_per_s": Key(positive=True, high=10.0, required=False, hint="the unit is m/s"),
    },
}
"""Sections that may come several times, ``[[beacon]]``."""

AID_TABLES: Final[Mapping[str, TableSpec]] = {
    "usbl": TableSpec((TIME, *POSITION, *POSITION_SIGMA), ("delay_s",)),
    "ranges": TableSpec((TIME, "beacon", "range_m"), ("sigma_m",), key=("beacon",)),
    "heading": TableSpec((TIME, "heading_deg")),
}
AID_LIMITS: Final[Mapping[str, tuple[float, float]]] = {
    "delay_s": (0.0, 3600.0),
    "beacon": (0.0, 1e6),
    "range_m": (0.0, 20000.0),
    "sigma_m": (math.ulp(0.0), 1e4),
}
