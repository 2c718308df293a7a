"""NMEA 0183 out: answers as GGA, VTG and HDT of integrated navigation."""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from ssm_graph.base.frozen import Array
from ssm_graph.live.protocols.nmea_fields import TALKER, checksum
from ssm_graph.mission.navigation import Health, Navigation

USABLE: Final = frozenset({Health.GOOD, Health.DEGRADED})
"""What may be steered by; with any other health the fields of a sentence are empty."""
_KNOTS = 3600.0 / 1852.0
_DAY_MS = 86_400_000
_MINUTE = 1_000_000
"""Parts of a minute of arc that are written: 2 mm."""


def encode_nmea(navigation: Navigation, *, geoid_separation_m: float = 0.0) -> bytes:
    """Return GGA, VTG and HDT, each ended by CR LF."""
    altitude_m = {"geoid_separation_m": geoid_separation_m}
    sentences = encode_gga(navigation, **altitude_m), encode_vtg(navigation), encode_hdt(navigation)
    return "".join(sentences).encode("ascii")


def encode_gga(navigation: Navigation, *, geoid_separation_m: float = 0.0) -> str:
    """Return a GGA: quality 6, estimated; 0 and empty fields where the answer is not usable.

    UTC is ``time_s`` of the vehicle's clock modulo a day: right where that clock is Unix time.
    Altitude is the height above the ellipsoid less ``geoid_separation_m``, so that their sum, which
    readers form, is right whatever the separation.
    """
    geodetic = np.array([navigation.lat, navigation.lon, navigation.height, navigation.time_s])
    if not _is_usable(navigation, geodetic):
        empty = (*[""] * 4, "0", "00", "", "", "M", "", "M", "", "")
        return _sentence("GGA", _utc(navigation.time_s), *empty)
    altitude_m = navigation.height - geoid_separation_m
    return _sentence(
        "GGA",
        _utc(navigation.time_s),
        *_angle(navigation.lat, "NS", width=2),
        *_angle(math.remainder(navigation.lon, 2.0 * math.pi), "EW", width=3),
        *("6", "00", ""),
        *(f"{altitude_m:.3f}", "M", f"{geoid_separation_m:.3f}", "M", "", ""),
    )


def encode_vtg(navigation: Navigation) -> str:
    """Return a VTG: course over ground from true north and speed; mode E, estimated, or N."""
    if not _is_usable(navigation, navigation.velocity_enu[:2]):
        return _sentence("VTG", "", "T", "", "M", "", "N", "", "K", "N")
    east, north = navigation.velocity_enu[:2]
    speed = math.hypot(east, north)
    course = _degrees(math.atan2(east, north))
    knots, km_per_h = f"{speed * _KNOTS:.3f}", f"{speed * 3.6:.3f}"
    return _sentence("VTG", course, "T", "", "M", knots, "N", km_per_h, "K", "E")


def encode_hdt(navigation: Navigation) -> str:
    """Return an HDT: heading from true north; empty where the answer is not usable."""
    heading = navigation.roll_pitch_heading[2:]
    is_usable = _is_usable(navigation, heading)
    return _sentence("HDT", _degrees(float(heading[0])) if is_usable else "", "T")


def _is_usable(navigation: Navigation, values: Array) -> bool:
    return navigation.health in USABLE and bool(np.isfinite(values).all())


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
