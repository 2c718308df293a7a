"""NMEA 0183: GNSS fixes and depths in, answers out as GGA, VTG and HDT of integrated navigation."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from typing import Final, NamedTuple

import numpy as np

from ssm_graph.base.errors import ConfigError
from ssm_graph.base.frozen import Array, Vector
from ssm_graph.live.protocols.decoder import Clock, Decoder, RefusedError, Stamper, number, shown
from ssm_graph.live.protocols.framing import LineFramer
from ssm_graph.mission.navigation import Health, Navigation
from ssm_graph.sensors.depth import DEEPEST_M, DepthReading
from ssm_graph.sensors.gnss import Fix
from ssm_graph.sensors.messages import Message

TALKER: Final = "IN"
USABLE: Final = frozenset({Health.GOOD, Health.DEGRADED})
"""What may be steered by; with any other health the fields of a sentence are empty."""
_KNOTS = 3600.0 / 1852.0
_DAY_MS = 86_400_000
_MINUTE = 1_000_000
"""Parts of a minute of arc that are written: 2 mm."""
ABOVE_SURFACE_M: Final = 100.0
"""m: a pressure sensor in air, and tides"""
PLACE: Final = "nmea"
MAX_SENTENCE: Final = 1024
"""Bytes; the standard allows 82, makers write longer ones."""
PASCAL_PER_DBAR: Final = 1e4
STANDARD_GRAVITY: Final = 9.80665
"""m/s^2"""
_FIXES = {"1", "2", "3", "4", "5", "9"}
_NO_FIX = {"", "0"}
DAY_S: Final = 86400.0
_NUMBER = re.compile(r"[+-]?(?:\d{1,12}(?:\.\d{0,12})?|\.\d{1,12})", re.ASCII)
_ANGLE = re.compile(r"(\d{2,3})(\d{2}(?:\.\d{0,12})?)", re.ASCII)
_TIME = re.compile(r"(\d{2})(\d{2})(\d{2}(?:\.\d{0,9})?)", re.ASCII)
_CHECKSUM = re.compile(r"[0-9A-Fa-f]{2}", re.ASCII)


class DepthSentence(Enum):
    """Sentences that may hold the vehicle's depth; the text is shown to the user."""

    PRVAT = "$PRVAT: altimeter range and pressure in dBar (Valeport VA500)"
    PIPS = "$PIPS: pressure in dBar or depth in m (Valeport miniIPS)"
    PVIPS2 = "$PVIPS2: pressure in dBar, and a depth that is not read (Valeport miniIPS2)"
    DPT = "$--DPT: water below a transducer; vehicle depth only if your sensor writes it so"
    DBT = "$--DBT: water below a transducer; vehicle depth only if your sensor writes it so"


PRESSURE_SENTENCES: Final = frozenset(
    {DepthSentence.PRVAT, DepthSentence.PIPS, DepthSentence.PVIPS2}
)


@dataclass(frozen=True, slots=True)
class NmeaOptions:
    """What the sentences themselves do not say."""

    clock: Clock = Clock.INSTRUMENT
    """INSTRUMENT: UTC of day of GGA, joined to the day of the arrival. Depths have no time."""
    max_clock_error_s: float = 5.0
    """A time further from the arrival is not believed."""
    user_range_error_m: float = 5.0
    """Times HDOP: sigma of east and of north, where there is no GST; twice that of the height."""
    geoid_separation_m: float | None = None
    """Geoid above ellipsoid where GGA leaves its field empty; None refuses such a fix."""
    depth_sentences: frozenset[DepthSentence] = PRESSURE_SENTENCES
    """What is taken for vehicle depth; all others are ignored."""
    air_pressure_dbar: float = 10.1325
    """Subtracted from every pressure; 0 for a sensor that is tared or sealed at the surface."""
    water_density_kg_per_m3: float = 1025.0
    """Mean over the column above the sensor."""
    surface_height_m: float = 0.0
    """Ellipsoidal height of the water's surface: depth messages count from the ellipsoid."""
    gst_wait_s: float = 0.5
    """How long a fix waits for its GST, where the last one came after its GGA."""

    def __post_init__(self) -> None:
        positive = ("max_clock_error_s", "user_range_error_m", "water_density_kg_per_m3")
        for name in (*positive, "air_pressure_dbar", "surface_height_m", "gst_wait_s"):
            value = getattr(self, name)
            if not math.isfinite(value) or (name in positive and value <= 0.0):
                wanted = "a number above 0" if name in positive else "a finite number"
                raise ConfigError(f"NmeaOptions.{name}: expected {wanted}, got {value}")
        if self.geoid_separation_m is not None and not math.isfinite(self.geoid_separation_m):
            raise ConfigError(
                f"NmeaOptions.geoid_separation_m: expected a finite number or None, "
                f"got {self.geoid_separation_m}"
            )


class _Gga(NamedTuple):
    """A fix before its sigmas are known."""

    utc: str
    time_s: float
    arrival_s: float
    lat: float
    lon: float
    height: float
    hdop: float | None


class NmeaDecoder(Decoder):
    """GGA (with GST) to fixes, pressures to depths; all other sentences are ignored.

    ``height`` is that of GGA above the geoid plus its separation: above the ellipsoid. Sigmas are
    those of a GST of the same time of day, before or after its GGA, else from HDOP. Quality 0 is no
    fix; 6 (estimated), 7 (typed in) and 8 (simulated) are refused: a dead-reckoned position is not
    a measurement, it might be our own.
    """

    def __init__(self, options: NmeaOptions | None = None) -> None:
        super().__init__(PLACE)
        self.n_without_fix = 0
        """How many GGA said that there is no fix; the first of a row is told as a refusal."""
        self._options = options or NmeaOptions()
        self._framer = LineFramer(self._refuse, max_length=MAX_SENTENCE)
        self._stamper = Stamper(
            self._options.clock,
            max_clock_error_s=self._options.max_clock_error_s,
            refusals=self._refusals,
            place=PLACE,
        )
        self._has_fix = True
        self._pending: _Gga | None = None
        self._last_utc = ""
        self._gst: tuple[str, Vector] | None = None
        self._gst_follows = False

    def _overdue(self, arrival_s: float) -> list[Message]:
        """Return the fix that has waited for its GST long enough."""
        waited = self._pending and not (
            0.0 <= arrival_s - self._pending.arrival_s < self._options.gst_wait_s
        )
        return self._release(None) if waited else []

    def _decode(self, text: str, arrival_s: float) -> list[Message]:
        lead, _, body = text.rpartition("$")
        if lead or not text.startswith("$"):
            if text.startswith("!"):
                return []
            self._refuse(f"expected a sentence that begins with '$', got {shown(text)}")
            if not lead:
                return []
        name, *fields = split_sentence(body)
        if name[-3:] == "GGA" and not name.startswith("P"):
            return self._on_gga(fields, arrival_s)
        if name[-3:] == "GST" and not name.startswith("P"):
            return self._on_gst(fields)
        kind = name if name.startswith("P") else name[-3:]
        if kind in _DEPTHS and DepthSentence[kind] in self._options.depth_sentences:
            below_surface = _DEPTHS[kind](fields, self._options)
            depth = number(below_surface, key="depth, m", low=-ABOVE_SURFACE_M, high=DEEPEST_M)
            depth -= self._options.surface_height_m
            return [DepthReading(self._stamper.stamp(None, arrival_s), depth)]
        return []

    def _on_gga(self, fields: list[str], arrival_s: float) -> list[Message]:
        before = self._release(None)
        try:
            gga = self._gga(fields, arrival_s)
        except RefusedError as error:
            self._refuse(f"GGA: {error}")
            return before
        if gga is None:
            return before
        self._pending, self._last_utc = gga, gga.utc
        if self._gst is not None and self._gst[0] == gga.utc and gga.utc:
            self._gst_follows = False
            return before + self._release(self._gst[1])
        return before + ([] if self._gst_follows else self._release(None))

    def _on_gst(self, fields: list[str]) -> list[Message]:
        if len(fields) < 8:
            raise RefusedError(f"GST: expected 8 fields, got {len(fields)}")
        utc = fields[0]
        north, east, up = (optional_number(field, "GST") for field in fields[5:8])
        if not utc or not east or not north or not up or min(east, north, up) <= 0.0:
            return []  # receivers without a fix write empty fields or zeros
        self._gst = utc, (east, north, up)
        self._gst_follows = utc == self._last_utc
        if self._pending is not None and self._pending.utc == utc:
            return self._release(self._gst[1])
        return []

    def _release(self, sigma_enu: Vector | None) -> list[Message]:
        """Return the fix that waits, by HDOP where its sigmas are not known."""
        gga, self._pending = self._pending, None
        if gga is None:
            return []
        if sigma_enu is None:
            self._gst_follows = False
            if not gga.hdop or gga.hdop < 0.0:
                self._refuse("GGA: expected an HDOP above 0 or a GST of the same time, got neither")
                return []
            sigma = gga.hdop * self._options.user_range_error_m
            sigma_enu = sigma, sigma, 2.0 * sigma
        return [Fix(gga.time_s, gga.lat, gga.lon, gga.height, sigma_enu)]

    def _gga(self, fields: list[str], arrival_s: float) -> _Gga | None:
        """Return a fix, None where the receiver has none."""
        if len(fields) < 11:
            raise RefusedError(f"expected 14 fields, got {len(fields)}")
        utc, lat, north, lon, east, quality, _, hdop, altitude, _, separation = fields[:11]
        if quality in _NO_FIX:
            self.n_without_fix += 1
            if self._has_fix:
                self._refuse("GGA: quality 0, the receiver has no fix; said once until it has one")
            self._has_fix = False
            return None
        if quality not in _FIXES:
            raise RefusedError(f"expected a measured fix, got quality {shown(quality)}")
        self._has_fix = True
        geoid_m = optional_number(separation, "geoid separation")
        geoid_m = self._options.geoid_separation_m if geoid_m is None else geoid_m
        if geoid_m is None:
            raise RefusedError("geoid separation is empty; set NmeaOptions.geoid_separation_m")
        time_s = self._stamper.stamp(utc_seconds(utc, arrival_s), arrival_s)
        return _Gga(
            utc,
            time_s,
            arrival_s,
            lat=angle(lat, north, "NS", limit_deg=90.0),
            lon=angle(lon, east, "EW", limit_deg=180.0),
            height=required_number(altitude, "altitude") + geoid_m,
            hdop=optional_number(hdop, "HDOP"),
        )


def _water_column(pressure: str, unit: str, options: NmeaOptions) -> float:
    """Return the depth below the surface of a pressure, m, by the mean density above it."""
    if unit.lower() not in ("d", "dbar"):
        raise RefusedError(f"expected a pressure in dBar, got unit {shown(unit)}")
    water_dbar = required_number(pressure, "pressure") - options.air_pressure_dbar
    return water_dbar * PASCAL_PER_DBAR / (options.water_density_kg_per_m3 * STANDARD_GRAVITY)


def _pressure(fields: list[str], options: NmeaOptions) -> float:
    _, _, pressure, unit = _first(fields, 4)
    return _water_column(pressure, unit, options)


def _pips(fields: list[str], options: NmeaOptions) -> float:
    value, unit = _first(fields, 2)
    return required_number(value, "depth") if unit == "M" else _water_column(value, unit, options)


def _dpt(fields: list[str], _: NmeaOptions) -> float:
    return required_number(_first(fields, 1)[0], "depth")


def _dbt(fields: list[str], _: NmeaOptions) -> float:
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


_DEPTHS: Final[dict[str, Callable[[list[str], NmeaOptions], float]]] = {
    "PRVAT": _pressure,
    "PIPS": _pips,
    "PVIPS2": _pressure,
    "DPT": _dpt,
    "DBT": _dbt,
}
"""Depth below the surface, m, from the fields of each of :class:`DepthSentence`."""


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


##### live/protocols/nmea.py


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
