"""Sentences of NMEA 0183 and their fields: checksum, numbers, angles, UTC of day."""

from __future__ import annotations

import math
import re
from typing import Final

from ssm_graph.live.protocols.decoder import RefusedError, number, shown

DAY_S: Final = 86400.0
_NUMBER = re.compile(r"[+-]?(?:\d{1,12}(?:\.\d{0,12})?|\.\d{1,12})", re.ASCII)
_ANGLE = re.compile(r"(\d{2,3})(\d{2}(?:\.\d{0,12})?)", re.ASCII)
_TIME = re.compile(r"(\d{2})(\d{2})(\d{2}(?:\.\d{0,9})?)", re.ASCII)
_CHECKSUM = re.compile(r"[0-9A-Fa-f]{2}", re.ASCII)


def checksum(body: str) -> str:
    """Return the two hexadecimal digits of a sentence, of what stands between ``$`` and ``*``."""
    result = 0
    for byte in body.encode("ascii"):
        result ^= byte
    return f"{result:02X}"


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
    degrees = number(float(found[1]) + float(found[2]) / 60.0, key="angle, deg", high=limit_deg)
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
