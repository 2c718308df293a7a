"""NMEA 0183 in: GNSS fixes, depths and headings."""

from __future__ import annotations

import math
import re
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

from ssm_graph.base.errors import ConfigError
from ssm_graph.base.frozen import Vector
from ssm_graph.base.units import SEA_WATER
from ssm_graph.io.nmea_sentences import TALKER, checksum
from ssm_graph.live.protocols.decoder import Clock, Decoder, RefusedError, Stamper, number, shown
from ssm_graph.live.protocols.framing import SentenceFramer
from ssm_graph.live.protocols.nmea_fields import (
    DEPTHS,
    HEADINGS,
    POSITIONS,
    DepthSentence,
    Position,
    is_beside,
    optional_number,
    split_sentence,
    utc_seconds,
)
from ssm_graph.live.protocols.nmea_receivers import Pending, Receivers, Speaker, Told
from ssm_graph.sensors.compass import HeadingReading
from ssm_graph.sensors.depth import DEEPEST_M, DepthReading
from ssm_graph.sensors.gnss import Fix
from ssm_graph.sensors.messages import Message

ABOVE_SURFACE_M: Final = 100.0
"""m: a pressure sensor in air, and tides"""
PLACE: Final = "nmea"
MAX_SENTENCE: Final = 1024
"""Bytes; the standard allows 82, makers write longer ones."""
PREFERRED_S: Final = 5.0
"""So long after a sentence that says more, one that says less is not read."""
IDLE_S: Final = 10.0
"""So long after the last sentence that was read it is told what comes in its place."""
MAX_OTHER: Final = 8192
"""Bytes without a sentence between, of which something is said; binary epochs are shorter."""
ASSUMED_HDOP: Final = 2.0
"""Where neither HDOP nor GST comes: a receiver with half of the sky."""
HEIGHT_SIGMA_M: Final = 100.0
"""Of a height that is not above the ellipsoid, or none: the geoid is up to 107 m away from it."""
_MAX_KINDS: Final = 8
_MOST_WAITING: Final = 200
"""Positions of one sentence: those of PREFERRED_S, at the rates of any receiver."""
_FEW_LETTERS: Final = 16
"""Shorter printable pieces are of binary frames that a line end within cuts up."""
_LIKE_SENTENCE = re.compile(r"[$!]?[A-Z]{2}[A-Z0-9]{2,8},")
_TAG_BLOCK = re.compile(r"\\([\x00-\x5b\x5d-\x7f]*)\*([0-9A-Fa-f]{2})\\\Z", re.ASCII)
_TAG_SOURCE = re.compile(r"(?:\A|,)s:([^,]*)")

PRESSURE_SENTENCES: Final = frozenset(
    {DepthSentence.PRVAT, DepthSentence.PIPS, DepthSentence.PVIPS2}
)


@dataclass(frozen=True, slots=True)
class NmeaOptions:
    """What the sentences themselves do not say."""

    clock: Clock = Clock.INSTRUMENT
    """INSTRUMENT: UTC of day of a position, joined to the day of the arrival. Depths have none."""
    max_clock_error_s: float = 5.0
    """A time further from the arrival is not believed."""
    user_range_error_m: float = 5.0
    """Times HDOP: sigma of east and of north, where there is no GST; twice that of the height."""
    geoid_separation_m: float | None = None
    """Geoid above ellipsoid where a sentence leaves its field empty; None: 0, to 100 m."""
    depth_sentences: frozenset[DepthSentence] = PRESSURE_SENTENCES
    """What is taken for vehicle depth; all others are ignored."""
    air_pressure_dbar: float = 10.1325
    """Subtracted from every pressure; 0 for a sensor that is tared or sealed at the surface."""
    water_density_kg_per_m3: float = SEA_WATER
    """Mean over the column above the sensor."""
    surface_height_m: float = 0.0
    """Ellipsoidal height of the water's surface: depth messages count from the ellipsoid, and
    positions without a height are there, to 100 m."""
    gst_wait_s: float = 0.5
    """How long a fix waits for its GST, where the last one came after its position."""

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


class _Preference:
    """Which of several sentences with one content is read: the first in order that comes.

    One is read once none before it in order has come for :data:`PREFERRED_S`.
    """

    def __init__(self, order: Iterable[str]) -> None:
        self._order = list(order)
        self._begun_s = math.nan
        self._heard_s: dict[str, float] = {}

    def may_take(self, kind: str) -> bool:
        """Return whether a sentence is one of those of which one is read."""
        return kind in self._order

    def takes(self, kind: str, arrival_s: float) -> bool:
        """Return whether a sentence is read, and take note that it came."""
        if kind not in self._order:
            return False
        self._begun_s = arrival_s if math.isnan(self._begun_s) else self._begun_s
        self._heard_s[kind] = arrival_s
        before = self._order[: self._order.index(kind)]
        since_s = [arrival_s - self._heard_s.get(other, self._begun_s) for other in before]
        return not any(0.0 <= s < PREFERRED_S for s in since_s)


class NmeaDecoder(Decoder):
    """Positions (with GST) to fixes, pressures to depths, headings; other sentences are ignored.

    Of GGA, GNS, RMC and GLL the first that comes is read, of HDT, THS, PASHR and HDG too; ``only``
    names those that are read, whatever comes. ``height`` is that above the geoid plus
    the geoid's separation: above the ellipsoid. Sigmas are those of a GST of the same time of day,
    before or after its position, else from HDOP. A position that is estimated, typed in or
    simulated (quality 6, 7, 8) is refused: dead reckoning is no measurement, it might be our own.

    Bytes of other protocols between sentences (UBX, RTCM) and tag blocks before them are passed
    over; lines end in CR, LF or both.
    """

    def __init__(self, options: NmeaOptions | None = None, *, only: tuple[str, ...] = ()) -> None:
        super().__init__(PLACE)
        self.n_without_fix = 0
        """How many positions said that there is no fix; the first of a row is told."""
        self._options = options or NmeaOptions()
        self._framer = SentenceFramer(self._refuse, max_length=MAX_SENTENCE)
        self._stamper = Stamper(
            self._options.clock,
            max_clock_error_s=self._options.max_clock_error_s,
            refusals=self._refusals,
            place=PLACE,
        )
        self._positions, self._headings = (
            _Preference([kind for kind in kinds if kind in only] or kinds)
            for kinds in (POSITIONS, HEADINGS)
        )
        self._waiting: dict[str, deque[Pending]] = {}
        self._receivers = Receivers(self._options.gst_wait_s, self._say_once)
        self._told: set[str] = set()
        self._n_other = 0
        self._idle_s, self._idle_kinds = math.nan, dict[str, None]()

    def _overdue(self, arrival_s: float) -> list[Message]:
        return self._fixes(self._receivers.overdue(arrival_s))

    def _decode(self, text: str, arrival_s: float) -> list[Message]:
        begin = text.rfind("$")
        is_text = text.isascii() and text.isprintable()
        if begin < 0 or not (is_text or _LIKE_SENTENCE.match(text, begin)):
            if not (is_text and text.startswith(("!", "\\"))):  # which AIS is
                self._pass_over(text)
            return []
        lead, source = self._without_tag(text[:begin].rstrip("$"))
        self._pass_over(lead)
        name, *fields = split_sentence(text[begin + 1 :])
        self._n_other = 0
        self._told.discard("other")
        kind = name if name.startswith("P") else name[-3:]
        speaker = Speaker(source, name.removesuffix(kind))
        messages = self._read(speaker, kind, fields, arrival_s)
        self._watch(kind, arrival_s, is_read=messages is not None)
        return messages or []

    def _read(
        self, speaker: Speaker, kind: str, fields: list[str], arrival_s: float
    ) -> list[Message] | None:
        """Return the messages of a sentence, None for one that is not looked at."""
        if is_beside(kind, fields):
            return []
        if kind in POSITIONS:
            return self._on_position(speaker, kind, fields, arrival_s)
        if kind == "GST":
            return self._on_gst(speaker, fields, arrival_s)
        if kind in HEADINGS and speaker.talker != TALKER:
            return self._on_heading(kind, fields, arrival_s)
        if kind in DEPTHS and DepthSentence[kind] in self._options.depth_sentences:
            below_surface = DEPTHS[kind](fields, self._options)
            depth = number(below_surface, key="depth, m", low=-ABOVE_SURFACE_M, high=DEEPEST_M)
            depth -= self._options.surface_height_m
            return [DepthReading(self._stamper.stamp(None, arrival_s), depth)]
        return None

    def _without_tag(self, lead: str) -> tuple[str, str]:
        """Return what stands before a sentence without a tag block, and the source that it has."""
        found = _TAG_BLOCK.search(lead)
        if not found:
            return lead, ""
        source = _TAG_SOURCE.search(found[1])
        if (expected := checksum(found[1])) != found[2].upper():
            self._refuse(f"expected tag block checksum {expected}, got {found[2]}")
            source = None
        return lead[: found.start()], source[1] if source else ""

    def _pass_over(self, text: str) -> None:
        """Refuse what was to be a sentence or a text; count what is binary."""
        if not text:
            return
        is_text = text.isascii() and text.isprintable() and len(text) >= _FEW_LETTERS
        if is_text or _LIKE_SENTENCE.search(text):
            self._refuse(f"expected a sentence that begins with '$', got {shown(text)}")
            return
        self._n_other += len(text)
        if self._n_other > MAX_OTHER:
            self._say_once(
                "other",
                f"expected sentences, got {MAX_OTHER} bytes that are none ({shown(text[:8])}); "
                "check the baud rate, and that NMEA is switched on at this port",
            )

    def _watch(self, kind: str, arrival_s: float, *, is_read: bool) -> None:
        """Say which sentences come where none of them is read."""
        if is_read:
            self._idle_s = math.nan
            self._idle_kinds.clear()
            self._told.discard("idle")
        elif not arrival_s >= self._idle_s:  # the first, or a clock set back
            self._idle_s = arrival_s
        if not is_read and len(self._idle_kinds) < _MAX_KINDS:
            self._idle_kinds[kind[:8]] = None
        if arrival_s - self._idle_s >= IDLE_S:
            depths = ", ".join(sorted(one.name for one in self._options.depth_sentences))
            self._say_once(
                "idle",
                f"sentences come ({', '.join(self._idle_kinds)}), and for {IDLE_S:g} s none that "
                f"is read; expected a position ({', '.join(POSITIONS)}), a heading "
                f"({', '.join(HEADINGS)}) or a depth ({depths}): switch one on at the instrument",
            )

    def _say_once(self, what: str, text: str) -> None:
        if what not in self._told:
            self._told.add(what)
            self._refuse(text)

    def _on_position(
        self, speaker: Speaker, kind: str, fields: list[str], arrival_s: float
    ) -> list[Message]:
        if not self._positions.takes(kind, arrival_s):
            self._have_wait(speaker, kind, fields, arrival_s)
            return []
        before = self._fixes([*self._receivers.begin(speaker, arrival_s), *self._waited(kind)])
        try:
            place = POSITIONS[kind](fields)
            is_lost = self._receivers.loses_fix(speaker, has_fix=place is not None)
            if place is not None:
                time_s = self._stamper.stamp(utc_seconds(place.utc, arrival_s), arrival_s)
                pending = Pending(speaker, kind, time_s, arrival_s, place)
                return before + self._fixes(self._receivers.take(pending))
            self.n_without_fix += 1
            if is_lost:
                self._refuse(f"{kind}: the receiver has no fix; said once until it has one")
        except RefusedError as error:
            self._refuse(f"{kind}: {error}")
        return before

    def _have_wait(self, speaker: Speaker, kind: str, fields: list[str], arrival_s: float) -> None:
        """Keep a position while it is not known whether a sentence that says more comes."""
        try:
            place = POSITIONS[kind](fields) if self._positions.may_take(kind) else None
            if place is not None and not self._receivers.has_said(place.utc):
                time_s = self._stamper.stamp(utc_seconds(place.utc, arrival_s), arrival_s)
                waiting = self._waiting.setdefault(kind, deque(maxlen=_MOST_WAITING))
                waiting.append(Pending(speaker, kind, time_s, arrival_s, place))
        except RefusedError:  # which is told where it is read
            return

    def _waited(self, kind: str) -> list[Told]:
        """Return positions of a sentence that is read from now on; the others are not needed."""
        waiting = self._waiting.get(kind, ())
        self._waiting = {}
        return [(pending, None) for pending in waiting]

    def _on_gst(self, speaker: Speaker, fields: list[str], arrival_s: float) -> list[Message]:
        if len(fields) < 8:
            raise RefusedError(f"GST: expected 8 fields, got {len(fields)}")
        utc = fields[0]
        north, east, up = (optional_number(field, "GST") for field in fields[5:8])
        if not utc or not east or not north or not up or min(east, north, up) <= 0.0:
            return []  # receivers without a fix write empty fields or zeros
        return self._fixes(self._receivers.hear(speaker, utc, (east, north, up), arrival_s))

    def _on_heading(self, kind: str, fields: list[str], arrival_s: float) -> list[Message]:
        found = HEADINGS[kind](fields)
        if found is None or not self._headings.takes(kind, arrival_s):
            return []
        time_s = self._stamper.stamp(utc_seconds(found.utc, arrival_s), arrival_s)
        return [HeadingReading(time_s, found.heading)]

    def waiting(self) -> list[Message]:
        """Return the fixes that wait, for a GST or for a sentence that says more."""
        return [self._fix(one, None) for one in self._held()]

    def take_waiting(self) -> list[Message]:
        """Return them for good."""
        held = self._held()
        self._receivers.clear()
        self._waiting = {}
        return self._fixes([(pending, None) for pending in held])

    def _held(self) -> list[Pending]:
        """Return positions that wait, one of each moment: of the sentence that says most."""
        found: list[Pending] = []
        for some in (self._receivers.waiting(), *map(self._waiting.get, POSITIONS)):
            said = {one.position.utc for one in found} - {""}
            found += [one for one in some or () if one.position.utc not in said]
        return sorted(found, key=lambda one: one.time_s)

    def _fixes(self, told: Iterable[Told]) -> list[Message]:
        """Return fixes, by HDOP without sigmas; say what is taken where a sentence lacks it."""
        fixes: list[Message] = []
        for pending, sigma_enu in told:
            kind, place = pending.kind, pending.position
            if sigma_enu is None and (not place.hdop or place.hdop < 0.0):
                self._say_once("hdop", f"{kind}: no HDOP, no GST: {ASSUMED_HDOP} is taken")
            if place.altitude is None:
                self._say_once("height", f"{kind}: no height: the water's surface, to 100 m")
            elif self._separation(place) is None:
                self._say_once(
                    "geoid",
                    f"{kind}: geoid separation is empty: heights count to 100 m; set "
                    "NmeaOptions.geoid_separation_m (--geoid-separation)",
                )
            fixes.append(self._fix(pending, sigma_enu))
        return fixes

    def _separation(self, place: Position) -> float | None:
        own = place.separation
        return self._options.geoid_separation_m if own is None else own

    def _fix(self, pending: Pending, sigma_enu: Vector | None) -> Fix:
        place = pending.position
        if sigma_enu is None:
            hdop = place.hdop if place.hdop and place.hdop > 0.0 else ASSUMED_HDOP
            sigma = hdop * self._options.user_range_error_m
            sigma_enu = sigma, sigma, 2.0 * sigma
        separation = self._separation(place)
        if place.altitude is None:
            height = self._options.surface_height_m
        else:
            height = place.altitude + (separation or 0.0)
        if place.altitude is None or separation is None:
            sigma_enu = (*sigma_enu[:2], max(sigma_enu[2], HEIGHT_SIGMA_M))
        return Fix(pending.time_s, place.lat, place.lon, height, sigma_enu)
