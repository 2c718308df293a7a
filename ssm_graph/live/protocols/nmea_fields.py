"""Fields of NMEA 0183 sentences: checksums, numbers, angles, times; positions, headings, depths."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from enum import Enum
from typing import Final, NamedTuple, Protocol

from ssm_graph.base.units import STANDARD_GRAVITY
from ssm_graph.io.nmea_sentences import checksum
from ssm_graph.live.protocols.decoder import RefusedError, number, shown

PASCAL_PER_DBAR: Final = 1e4
DAY_S: Final = 86400.0
_MEASURED: Final = frozenset("ADFPR")
"""Modes of a measured fix: autonomous, differential, float and fixed RTK, precise."""
_QUALITIES: Final = frozenset("123459")
_NO_FIX: Final = frozenset({"", "0"})
_NUMBER = re.compile(r"[+-]?(?:\d{1,12}(?:\.\d{0,12})?|\.\d{1,12})", re.ASCII)
_ANGLE = re.compile(r"(\d{0,3})(\d{2}(?:\.\d{0,12})?)", re.ASCII)
"""Some do not write zeros before the degrees."""
_TIME = re.compile(r"(\d{2})(\d{2})(\d{2}(?:\.\d{0,9})?)", re.ASCII)
_CHECKSUM = re.compile(r"[0-9A-Fa-f]{2}", re.ASCII)


class DepthSentence(Enum):
    """Sentences that may hold the vehicle's depth; the text is shown to the user."""

    PRVAT = "$PRVAT: altimeter range and pressure in dBar (Valeport VA500)"
    PIPS = "$PIPS: pressure in dBar or depth in m (Valeport miniIPS)"
    PVIPS2 = "$PVIPS2: pressure in dBar, and a depth that is not read (Valeport miniIPS2)"
    DPT = "$--DPT: water below a transducer; vehicle depth only if your sensor writes it so"
    DBT = "$--DBT: water below a transducer; vehicle depth only if your sensor writes it so"


class Water(Protocol):
    """What turns a pressure into a depth."""

    @property
    def air_pressure_dbar(self) -> float:
        """Subtracted from every pressure."""

    @property
    def water_density_kg_per_m3(self) -> float:
        """Mean over the column above the sensor."""


class Position(NamedTuple):
    """What a sentence says of a measured position."""

    utc: str
    """Time of day as written, perhaps empty."""
    lat: float
    """rad"""
    lon: float
    """rad"""
    altitude: float | None = None
    """m above the geoid"""
    separation: float | None = None
    """m, geoid above ellipsoid"""
    hdop: float | None = None


def _gga(fields: list[str]) -> Position | None:
    if len(fields) < 11:
        raise RefusedError(f"expected 14 fields, got {len(fields)}")
    quality = fields[5]
    if quality in _NO_FIX:
        return None
    if quality not in _QUALITIES:
        raise RefusedError(f"expected a measured fix, got quality {shown(quality)}")
    return _with_height(fields, separation=fields[10])


def _gns(fields: list[str]) -> Position | None:
    if len(fields) < 10:
        raise RefusedError(f"expected 12 fields, got {len(fields)}")
    return _with_height(fields, separation=fields[9]) if _is_measured(fields[5]) else None


def is_beside(kind: str, fields: list[str]) -> bool:
    """Return whether a GNS says of one system of satellites only how many count beside another's.

    It has neither a place nor a mode: a receiver without a fix states a mode.
    """
    if kind != "GNS" or len(fields) < 7 or fields[1] or fields[5]:
        return False
    return fields[6].isdecimal() and fields[6].isascii() and int(fields[6][:3]) > 0


def _with_height(fields: list[str], *, separation: str) -> Position:
    """Return a position of GGA or GNS, which begin alike."""
    return Position(
        fields[0],
        *_place(fields[1:5]),
        optional_number(fields[8], "altitude"),
        optional_number(separation, "geoid separation"),
        optional_number(fields[7], "HDOP"),
    )


def _rmc(fields: list[str]) -> Position | None:
    if len(fields) < 9:
        raise RefusedError(f"expected 12 fields, got {len(fields)}")
    modes = _mode(fields, 11)
    is_fix = fields[1] == "A" and _is_measured(modes)
    return Position(fields[0], *_place(fields[2:6])) if is_fix else None


def _gll(fields: list[str]) -> Position | None:
    if len(fields) < 6:
        raise RefusedError(f"expected 7 fields, got {len(fields)}")
    modes = _mode(fields, 6)
    is_fix = fields[5] == "A" and _is_measured(modes)
    return Position(fields[4], *_place(fields[:4])) if is_fix else None


def _mode(fields: list[str], at: int) -> str:
    """Return the mode of a fix; where it is left out, as before NMEA 2.3, the status alone says."""
    return (fields[at] if len(fields) > at else "") or "A"


def _is_measured(modes: str) -> bool:
    """Return whether one of the systems of satellites has a fix; a computed one is refused."""
    if _MEASURED & set(modes):
        return True
    if set(modes) <= {"N"}:
        return False
    raise RefusedError(f"expected a measured fix, got mode {shown(modes)}")


def _place(fields: list[str]) -> tuple[float, float]:
    lat, north, lon, east = fields
    return angle(lat, north, "NS", limit_deg=90.0), angle(lon, east, "EW", limit_deg=180.0)


POSITIONS: Final[dict[str, Callable[[list[str]], Position | None]]] = {
    "GGA": _gga,
    "GNS": _gns,
    "RMC": _rmc,
    "GLL": _gll,
}
"""The position of a sentence, None where the receiver has no fix; what says most comes first."""


class Heading(NamedTuple):
    """What a sentence says of the heading."""

    utc: str
    """Time of day as written; empty where the sentence has none."""
    heading: float
    """rad, clockwise from the compass's north: true, of HDG magnetic"""


def _hdt(fields: list[str]) -> Heading | None:
    return _clockwise(fields[0])


def _ths(fields: list[str]) -> Heading | None:
    mode = fields[1] if len(fields) > 1 else "A"
    if mode not in ("A", "V"):
        raise RefusedError(f"expected a measured heading, got mode {shown(mode)}")
    return _clockwise(fields[0]) if mode == "A" else None


def _pashr(fields: list[str]) -> Heading | None:
    if len(fields) < 3 or fields[2] != "T":  # PASHR,POS and others of the maker
        return None
    return _clockwise(fields[1], utc=fields[0])


def _hdg(fields: list[str]) -> Heading | None:
    """Return the magnetic heading: the deviation is added, the variation is for the declination."""
    value, deviation, side = (*fields, "", "")[:3]
    off = optional_number(deviation, "deviation") or 0.0
    if off and side not in ("E", "W"):
        raise RefusedError(f"expected a deviation to E or W, got {shown(side)}")
    return _clockwise(value, off_deg=off if side == "E" else -off)


def _clockwise(field: str, *, off_deg: float = 0.0, utc: str = "") -> Heading | None:
    read = optional_number(field, "heading")
    if read is None:
        return None
    degrees = number(read, key="heading, deg", low=0.0, high=360.0) + off_deg
    return Heading(utc, math.radians(degrees % 360.0))


HEADINGS: Final[dict[str, Callable[[list[str]], Heading | None]]] = {
    "HDT": _hdt,
    "THS": _ths,
    "PASHR": _pashr,
    "HDG": _hdg,
}
"""The heading of a sentence, None where it holds none; true ones come first."""


def _water_column(pressure: str, unit: str, water: Water) -> float:
    """Return the depth below the surface of a pressure, m, by the mean density above it."""
    if unit.lower() not in ("d", "dbar"):
        raise RefusedError(f"expected a pressure in dBar, got unit {shown(unit)}")
    water_dbar = required_number(pressure, "pressure") - water.air_pressure_dbar
    return water_dbar * PASCAL_PER_DBAR / (water.water_density_kg_per_m3 * STANDARD_GRAVITY)


def _pressure(fields: list[str], water: Water) -> float:
    _, _, pressure, unit = _first(fields, 4)
    return _water_column(pressure, unit, water)


def _pips(fields: list[str], water: Water) -> float:
    value, unit = _first(fields, 2)
    return required_number(value, "depth") if unit == "M" else _water_column(value, unit, water)


def _dpt(fields: list[str], _: Water) -> float:
    return required_number(_first(fields, 1)[0], "depth")


def _dbt(fields: list[str], _: Water) -> float:
    *_rest, metres, unit = _first(fields, 4)
    if unit != "M":
        raise RefusedError(f"expected metres in the third field, got unit {shown(unit)}")
    return required_number(metres, "depth")


def _first(fields: list[str], count: int) -> list[str]:
    if len(fields) < count:
        raise RefusedError(
            f"expected {count} fields or more, got {len(fields)}; if the sentence holds no depth "
            "of the vehicle, leave it out of NmeaOptions.depth_sentences"
        )
    return fields[:count]


DEPTHS: Final[dict[str, Callable[[list[str], Water], float]]] = {
    "PRVAT": _pressure,
    "PIPS": _pips,
    "PVIPS2": _pressure,
    "DPT": _dpt,
    "DBT": _dbt,
}
"""Depth below the surface, m, from the fields of each of :class:`DepthSentence`."""


def split_sentence(body: str) -> list[str]:
    """Return name and fields of a sentence whose checksum is right."""
    content, star, given = body.rpartition("*")
    if not star or not _CHECKSUM.fullmatch(given):
        raise RefusedError(f"expected a checksum '*hh' at the end, got {shown('$' + body)}")
    if not content.isascii() or not content.isprintable():
        raise RefusedError(
            f"expected printable ASCII, got {shown('$' + body)}; check the baud rate"
        )
    if checksum(content) != given.upper():
        raise RefusedError(
            f"expected checksum {checksum(content)}, got {given} in {shown('$' + body)}"
        )
    return content.split(",")


def optional_number(field: str, key: str) -> float | None:
    """Return a number, None where the field is empty."""
    return required_number(field, key) if field else None


def required_number(field: str, key: str) -> float:
    """Return a number; plain decimals only, whatever Python would take."""
    if not _NUMBER.fullmatch(field):
        raise RefusedError(f"{key}: expected a number, got {shown(field)}")
    return float(field)


def angle(field: str, side: str, sides: str, *, limit_deg: float) -> float:
    """Return ``dddmm.mmm`` with its hemisphere in radians, positive to the first of ``sides``."""
    found = _ANGLE.fullmatch(field)
    if not found or side not in tuple(sides) or float(found[2]) >= 60.0:
        raise RefusedError(
            f"expected an angle as dddmm.mmm,{sides[0]}, got {shown(field)},{shown(side)}"
        )
    degrees = number(
        float(found[1] or 0) + float(found[2]) / 60.0, key="angle, deg", high=limit_deg
    )
    return math.radians(degrees if side == sides[0] else -degrees)


def utc_seconds(field: str, arrival_s: float) -> float | None:
    """Return the instant with this UTC of day that is nearest to the arrival, Unix s."""
    if not field:
        return None
    found = _TIME.fullmatch(field)
    if not found:
        raise RefusedError(f"expected UTC as hhmmss.sss, got {shown(field)}")
    hours, minutes, seconds = float(found[1]), float(found[2]), float(found[3])
    if hours >= 24.0 or minutes >= 60.0 or seconds >= 61.0:
        raise RefusedError(f"expected UTC as hhmmss.sss, got {shown(field)}")
    of_day = 3600.0 * hours + 60.0 * minutes + seconds
    if not math.isfinite(arrival_s):
        return None
    return of_day + DAY_S * round((arrival_s - of_day) / DAY_S)
