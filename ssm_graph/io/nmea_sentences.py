"""NMEA 0183 sentences of integrated navigation: GGA, VTG and HDT, each ended by CR LF."""

from __future__ import annotations

import math
from typing import Final

TALKER: Final = "IN"
"""Of integrated navigation: our own answers, and those of others."""
_KNOTS = 3600.0 / 1852.0
_DAY_MS = 86_400_000
_MINUTE = 1_000_000
"""Parts of a minute of arc that are written: 2 mm."""


def checksum(body: str) -> str:
    """Return the two hexadecimal digits of a sentence, of what stands between ``$`` and ``*``."""
    result = 0
    for byte in body.encode("ascii"):
        result ^= byte
    return f"{result:02X}"


def gga(
    time_s: float, place: tuple[float, float, float] | None, *, geoid_separation_m: float = 0.0
) -> str:
    """Return a GGA: quality 6, estimated; 0 and empty fields where there is no place.

    UTC is ``time_s`` modulo a day: right where that is Unix time. ``place`` is latitude, longitude
    (rad) and height above the ellipsoid (m). Altitude is the height less ``geoid_separation_m``, so
    that their sum, which readers form, is right whatever the separation.
    """
    if place is None:
        return _sentence("GGA", _utc(time_s), *[""] * 4, "0", "00", *("", "", "M", "", "M", "", ""))
    lat, lon, height = place
    return _sentence(
        "GGA",
        _utc(time_s),
        *_angle(lat, "NS", width=2),
        *_angle(math.remainder(lon, 2.0 * math.pi), "EW", width=3),
        *("6", "00", ""),
        *(f"{height - geoid_separation_m:.3f}", "M", f"{geoid_separation_m:.3f}", "M", "", ""),
    )


def vtg(east_north: tuple[float, float] | None) -> str:
    """Return a VTG: course over ground from true north and speed; mode E, estimated, or N."""
    if east_north is None:
        return _sentence("VTG", "", "T", "", "M", "", "N", "", "K", "N")
    east, north = east_north
    speed = math.hypot(east, north)
    course = _degrees(math.atan2(east, north))
    knots, km_per_h = f"{speed * _KNOTS:.3f}", f"{speed * 3.6:.3f}"
    return _sentence("VTG", course, "T", "", "M", knots, "N", km_per_h, "K", "E")


def hdt(heading: float | None) -> str:
    """Return an HDT: heading (rad) from true north, empty where there is none."""
    return _sentence("HDT", "" if heading is None else _degrees(heading), "T")


def _sentence(kind: str, *fields: str) -> str:
    body = ",".join((TALKER + kind, *fields))
    return f"${body}*{checksum(body)}\r\n"


def _utc(time_s: float) -> str:
    """Return ``hhmmss.sss``; empty where there is no time."""
    if not math.isfinite(time_s):
        return ""
    seconds, ms = divmod(round(time_s % 86400.0 * 1e3) % _DAY_MS, 1000)
    minutes, seconds = divmod(seconds, 60)
    return f"{minutes // 60:02d}{minutes % 60:02d}{seconds:02d}.{ms:03d}"


def _angle(angle: float, sides: str, *, width: int) -> tuple[str, str]:
    """Return ``dddmm.mmmmmm`` and its side; rounded as a whole, so that minutes stay below 60."""
    parts = round(abs(math.degrees(angle)) * 60 * _MINUTE)
    degrees, parts = divmod(parts, 60 * _MINUTE)
    minutes, parts = divmod(parts, _MINUTE)
    return f"{degrees:0{width}d}{minutes:02d}.{parts:06d}", sides[1 if angle < 0.0 else 0]


def _degrees(angle: float) -> str:
    """Return an angle as degrees from 0 to 359.99."""
    hundredths = round(math.degrees(angle) * 100.0) % 36000
    return f"{hundredths // 100}.{hundredths % 100:02d}"
