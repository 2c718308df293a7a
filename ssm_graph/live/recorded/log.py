"""Recorded output of one instrument, Water Linked or NMEA 0183, as tables of a mission folder.

The decoders are those that listen to the instruments. The time of arrival, which a recording does
not have, is made of what the reports say of time: the centre of the ping or the sum of the times
between reports of a DVL, date and time of day of a receiver.
"""

from __future__ import annotations

import calendar
import codecs
import csv
import math
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from ssm_graph.base.errors import DataError
from ssm_graph.base.progress import told
from ssm_graph.base.times import UNIX_FROM_S
from ssm_graph.io.nortek.nortek import read_nortek
from ssm_graph.io.nortek.packets import is_nortek
from ssm_graph.io.raw_log.kinds import RowKind
from ssm_graph.io.recording import whole
from ssm_graph.io.tables.append_file import write_through
from ssm_graph.io.teledyne.ensembles import is_pd0
from ssm_graph.io.teledyne.pd0 import read_pd0
from ssm_graph.io.teledyne.short_formats import is_pd6, is_pd45, read_pd6, read_pd45
from ssm_graph.live.protocols.decoder import RefusedError, parse_object
from ssm_graph.live.protocols.framing import MAX_LENGTH, SentenceFramer
from ssm_graph.live.protocols.nmea import MAX_SENTENCE, PREFERRED_S, NmeaDecoder, NmeaOptions
from ssm_graph.live.protocols.nmea_fields import (
    DAY_S,
    HEADINGS,
    POSITIONS,
    split_sentence,
    utc_seconds,
)
from ssm_graph.live.protocols.waterlinked import WaterLinkedDecoder
from ssm_graph.live.protocols.waterlinked_serial import SERIAL, ReportFramer
from ssm_graph.live.recorded.water_linked_table import SIGN, rows_of
from ssm_graph.sensors.compass import HeadingReading
from ssm_graph.sensors.depth import DepthReading
from ssm_graph.sensors.dvl import DvlMount, Ping, empty_dvl
from ssm_graph.sensors.gnss import Fix
from ssm_graph.sensors.messages import Message
from ssm_graph.sensors.registry import BY_MESSAGE

_SET_BACK_S: Final = 1.0
_SNIFFED: Final = 1 << 16
_MANY_REFUSALS: Final = 3
_NOON_S: Final = 0.5 * DAY_S - 1e-6
_SHORTEST_S: Final = 1e-3
"""From one report to the next."""
_ANY_CLOCK_S: Final = 1e12
_SENTENCE = re.compile(rb"[$!][A-Z]{2}[A-Z0-9]{2,},")
_PYTHON: Final = {
    b"'": b'"',
    b"True": b"true",
    b"False": b"false",
    b"None": b"null",
    b"nan": b"null",
}
_OF_PYTHON = re.compile(rb"'|\b(?:True|False|None|nan)\b")
_NO_NUMBER = re.compile(rb"(?<=[:\[,\s])(?:NaN|-?Infinity)(?=[\s,}\]])")
"""What programs write into JSON that has no words for them"""
_BINARY: Final[Sequence[tuple[Callable[[bytes], bool], Callable[[Path], Any]]]] = (
    (is_pd0, read_pd0),
    (is_nortek, read_nortek),
    (is_pd45, read_pd45),
    (is_pd6, read_pd6),
)
"""Makers' own formats: by the first bytes whether a file is of one, and what reads it."""
_COUNTED: Final[Mapping[type[Message], str]] = {
    Ping: "pings",
    Fix: "positions",
    DepthReading: "depths",
    HeadingReading: "headings",
}


@dataclass(frozen=True, slots=True)
class Recorded:
    """What a recording holds."""

    about: str
    """Its format, and how many reports of what."""
    messages: tuple[Message, ...]
    notes: tuple[str, ...]
    """What was left out or assumed, one sentence each."""

    @property
    def told(self) -> tuple[str, ...]:
        """What it is, then what was left out or assumed."""
        return self.about, *self.notes


def read_recorded(log: Path, options: NmeaOptions | None = None) -> Recorded | None:
    """Return the messages of a recording, None for a file of another kind.

    Raises :class:`DataError` for a file that cannot be read, holds nothing of use, or whose clock
    was set back.

    ``options`` are those of NMEA: what of its depths is the vehicle's, and the water's surface.
    """
    data = _in_utf8(whole(log))
    head = data[:_SNIFFED]
    binary = next((read for is_it, read in _BINARY if is_it(head)), None)
    if binary is not None:
        read = binary(log)
        found = Recorded(read.about, read.messages, read.notes)
    elif b"'transducers'" in head and b'"' not in head:  # as Python prints what it has parsed
        found = _water_linked(_OF_PYTHON.sub(lambda found: _PYTHON[found[0]], data))
    elif b'"transducers"' in head or (head.lstrip()[:1] in (b"{", b"[") and b'"' in head):
        found = _water_linked(data)
    elif SERIAL.search(head):
        found = _water_linked(data, "Water Linked, serial protocol")
    elif SIGN in head.partition(b"\n")[0]:
        found = _water_linked_table(data)
    elif _SENTENCE.search(head):
        found = _nmea(data, options or NmeaOptions())
    else:
        return None
    if not found.messages:
        said = "; ".join(found.notes) or "the file ends within the first one"
        raise DataError(f"{log}: {found.about}, not one report that is read; {said}")
    pings = [message for message in found.messages if isinstance(message, Ping)]
    if pings and not any(math.isfinite(speed) for ping in pings for speed in ping.speed):
        said = f"{len(pings)} pings and not one speed along a beam: the bottom was never in range?"
        found = replace(found, notes=(said, *found.notes))
    return _in_order(log, _of_one_dvl(found))


def _of_one_dvl(found: Recorded) -> Recorded:
    """Return a recording without pings of another number of beams than most have."""
    counts = Counter(len(one.speed) for one in found.messages if isinstance(one, Ping))
    if len(counts) < 2:
        return found
    (n_beams, n_pings), *others = counts.most_common()
    said = " and ".join(f"{count} of {n}" for n, count in others)
    note = f"{n_pings} pings are of {n_beams} beams; {said} were left out: of another instrument?"
    kept = [one for one in found.messages if not isinstance(one, Ping) or len(one.speed) == n_beams]
    return Recorded(found.about, tuple(kept), (*found.notes, note))


def _in_utf8(data: bytes) -> bytes:
    """Return a text that a shell or editor of Windows wrote as other programs do."""
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return data.decode("utf-16", "replace").encode()
    return data.removeprefix(codecs.BOM_UTF8)


def write_tables(folder: Path, messages: Iterable[Message]) -> dict[str, int]:
    """Write messages as the tables of a mission folder; return their files and numbers of rows."""
    kinds: dict[type[Message], RowKind] = {}
    rows: dict[type[Message], list[bytes]] = {}
    for message in messages:
        kind = type(message)
        if kind not in kinds:
            kinds[kind] = RowKind(BY_MESSAGE[kind], _bare(message))
            rows[kind] = [kinds[kind].header]
        rows[kind].append(kinds[kind].row(message))
    folder.mkdir(parents=True, exist_ok=True)
    for kind, lines in rows.items():
        write_through(folder / kinds[kind].file, b"".join(lines))
    return {kinds[kind].file: len(lines) - 1 for kind, lines in rows.items()}


def _bare(message: Message) -> Any:
    """Return a DVL of as many beams as a ping has; other instruments need not be known."""
    speed = getattr(message, "speed", None)
    if speed is None:
        return None
    mount = DvlMount(np.tile([0.0, 0.0, 1.0], (len(speed), 1)), np.eye(3), np.zeros(3))
    return empty_dvl(mount)


def _in_order(log: Path, found: Recorded) -> Recorded:
    """Return the messages with increasing times in each table."""
    last: dict[type[Message], float] = {}
    times = set[tuple[type[Message], float]]()
    kept, n_late = list[Message](), 0
    for message in found.messages:
        before = last.get(type(message), -math.inf)
        if message.time_s < before - _SET_BACK_S:
            raise DataError(
                f"{log}: the instrument's clock was set back by {before - message.time_s:.4g} s at "
                f"{before:.3f} s; expected one clock: split the file there"
            )
        if (type(message), message.time_s) in times:
            continue
        times.add((type(message), message.time_s))
        n_late += message.time_s < before
        last[type(message)] = max(before, message.time_s)
        kept.append(message)
    n_twice = len(found.messages) - len(kept)
    notes = [
        text
        for text, count in (
            (f"{n_twice} reports of a time that an earlier one has were left out.", n_twice),
            (f"{n_late} reports out of order were sorted by time.", n_late),
        )
        if count
    ]
    kept.sort(key=lambda message: message.time_s)
    return Recorded(found.about, tuple(kept), (*found.notes, *notes))


def _said(refusals: list[str], n_refused: int) -> list[str]:
    """Return the kinds of refusals as notes."""
    shown = refusals[:_MANY_REFUSALS]
    more = n_refused - len(shown)
    return [*shown, *((f"{more} more were refused",) if more > 0 else ())]


def _water_linked(data: bytes, name: str = "Water Linked JSON") -> Recorded:
    decoder = WaterLinkedDecoder(heading=True, max_clock_error_s=_ANY_CLOCK_S)
    torn: list[str] = []
    framer = ReportFramer(torn.append, max_length=MAX_LENGTH)
    messages: list[Message] = []
    time_s, last_s, before, has_clock = 0.0, -math.inf, dict[str, Any](), True
    n_unset = 0
    for text in told(framer.feed(_NO_NUMBER.sub(b"null", data) + b"\n"), len(data), size=len):
        report = _object(text)
        stated_s = _stated(report, time_s)
        if messages and time_s < UNIX_FROM_S <= stated_s:  # what came before gets that clock too
            begin_s = stated_s - (_between(report) if "time_of_validity" in report else 0.0)
            messages = [replace(one, time_s=one.time_s + begin_s - time_s) for one in messages]
            n_unset = len(messages) if has_clock else 0
        time_s = stated_s
        if "time_of_validity" not in report and "transducers" in report:
            has_clock = False
            if report != before:
                time_s = max(time_s + _between(report), last_s + _SHORTEST_S)
            before, last_s = report, max(time_s, last_s)
        messages += decoder.feed(text.encode() + b"\n", arrival_s=time_s)
    notes = _said([*torn, *decoder.take_refusals()], len(torn) + decoder.n_refused)
    if decoder.n_repeats:
        notes.append(f"{decoder.n_repeats} reports came again and were left out.")
    if n_unset:
        notes.append(
            f"{n_unset} reports came before the instrument's clock was set: they are timed back "
            "from the first after it."
        )
    if not has_clock:
        notes.append(
            "Reports before format json_v3 have no clock: time_s is the sum of the times between "
            "them, from the first one on or from the stamps of the dead reckoning beside them; add "
            "what makes it the vehicle's."
        )
    return Recorded(_about(name, messages), tuple(messages), tuple(notes))


def _water_linked_table(data: bytes) -> Recorded:
    decoder = WaterLinkedDecoder(max_clock_error_s=_ANY_CLOCK_S)
    messages: list[Message] = []
    torn: list[str] = []
    try:
        for report, arrival_s in told(rows_of(data), data.count(b"\n")):
            messages += decoder.feed(report, arrival_s=arrival_s)
    except csv.Error as error:
        torn.append(f"water linked: no table from there on: {error}")
    notes = _said([*torn, *decoder.take_refusals()], len(torn) + decoder.n_refused)
    if decoder.n_repeats:
        notes.append(f"{decoder.n_repeats} reports came again and were left out.")
    about = _about("Water Linked, reports in a table", messages)
    return Recorded(about, tuple(messages), tuple(notes))


def _about(name: str, messages: Iterable[Message]) -> str:
    """Return a format, and how many messages of which kind there are."""
    counts = Counter(_COUNTED.get(type(message), "others") for message in messages)
    return ", ".join([name, *(f"{count} {what}" for what, count in counts.items())])


def _object(text: str) -> dict[str, Any]:
    try:
        return parse_object(text)
    except RefusedError:
        return {}  # which the decoder refuses and tells


def _between(report: Mapping[str, Any]) -> float:
    """Return the time since the report before, s; 0 where it is not said."""
    value: Any = report.get("time")
    is_sound = isinstance(value, (int, float)) and not isinstance(value, bool)
    return 1e-3 * float(value) if is_sound and 0.0 <= value < 1e6 else 0.0


def _stated(report: Mapping[str, Any], time_s: float) -> float:
    """Return the time that a report states, s, or the one before.

    Unix time; of a centre of ping also that of a clock that was never set, until another one was.
    """
    for key, unit in (("time_of_validity", 1e-6), ("ts", 1.0)):
        value = report.get(key)
        if isinstance(value, (int, float)) and not isinstance(value, bool):
            stated_s = float(value) * unit
            is_of_ping = key == "time_of_validity" and stated_s > 0.0 and time_s < UNIX_FROM_S
            if stated_s > UNIX_FROM_S or is_of_ping:
                return stated_s
    return time_s


def _lines(data: bytes) -> Iterable[str]:
    """Return the lines of a recording of sentences, and tell how many of them are done."""
    framer = SentenceFramer(lambda _: None, max_length=MAX_SENTENCE)
    return told(framer.feed(data + b"\n"), len(data), size=len)


def _sentences(lines: Iterable[str]) -> Iterator[tuple[str, list[str]]]:
    """Yield kind and fields of the sentences that are sound."""
    for text in lines:
        begin = text.rfind("$")
        try:
            name, *fields = split_sentence(text[begin + 1 :] if begin >= 0 else "")
        except RefusedError:
            continue
        yield (name if name.startswith("P") else name[-3:]), fields


def _nmea(data: bytes, options: NmeaOptions) -> Recorded:
    kinds, dated, first = Counter[str](), math.nan, None
    for kind, fields in _sentences(_lines(data)):
        kinds[kind] += _is_read(kind, fields)
        dated = _date(kind, fields) if math.isnan(dated) else dated
        first = _stamp(kind, fields, _NOON_S) if first is None else first
    only = tuple(kind for kind in (*POSITIONS, *HEADINGS) if kinds[kind])
    decoder = NmeaDecoder(replace(options, max_clock_error_s=_ANY_CLOCK_S), only=only)
    messages: list[Message] = []
    time_s = (first or 0.0) if math.isnan(dated) else dated
    for text in _lines(data):
        if text.startswith("#"):  # a comment of who recorded
            continue
        for kind, fields in _sentences([text]):
            stated = _stamp(kind, fields, time_s)
            time_s = time_s if stated is None else stated
        messages += decoder.feed(text.encode("latin-1") + b"\r\n", arrival_s=time_s)
    messages += decoder.feed(b"", arrival_s=math.inf)
    notes = _said(decoder.take_refusals(), decoder.n_refused)
    if decoder.n_without_fix:
        notes.append(f"{decoder.n_without_fix} sentences say that the receiver has no fix.")
    for some in (POSITIONS, HEADINGS):
        first_kind, *others = [kind for kind in some if kind in only] or [""]
        if others:
            where = f"where none of that came for {PREFERRED_S:g} s"
            notes.append(f"{first_kind} read, {', '.join(others)} {where}.")
        elif first_kind:
            notes.append(f"{first_kind} read.")
    if math.isnan(dated):
        notes.append("No sentence states a date: time_s is UTC of the day.")
    if not messages:
        notes.append(
            f"its sentences are {', '.join(sorted(kinds)[:12]) or 'none that begins with $'}"
        )
    if first is None and messages:
        messages, notes = [], ["no sentence states a time, which depths and headings need"]
    return Recorded(_about("NMEA 0183", messages), tuple(messages), tuple(notes))


def _is_read(kind: str, fields: list[str]) -> bool:
    """Return whether a sentence holds a position or a heading."""
    read: Any = POSITIONS.get(kind) or HEADINGS.get(kind)
    try:
        return read is not None and read(fields) is not None
    except (RefusedError, IndexError):
        return False


def _date(kind: str, fields: list[str]) -> float:
    """Return the instant that RMC or ZDA state, Unix s; NaN where there is none."""
    if kind == "RMC" and len(fields) > 8 and len(fields[8]) == 6:
        utc, day, month, year = fields[0], fields[8][:2], fields[8][2:4], fields[8][4:]
        year = f"20{year}" if year < "80" else f"19{year}"
    elif kind == "ZDA" and len(fields) > 3:
        utc, day, month, year = fields[:4]
    else:
        return math.nan
    if not all(part.isdecimal() and part.isascii() for part in (day, month, year)):
        return math.nan
    if not (1 <= int(month) <= 12 and 1 <= int(day) <= 31 and 1980 <= int(year) < 2100):
        return math.nan
    noon = calendar.timegm((int(year), int(month), int(day), 12, 0, 0))
    try:
        of_day = utc_seconds(utc, _NOON_S)
    except RefusedError:
        return math.nan
    return math.nan if of_day is None else noon - 0.5 * DAY_S + of_day % DAY_S


def _stamp(kind: str, fields: list[str], time_s: float) -> float | None:
    """Return the instant that a sentence states, nearest to the one before; None if it has none."""
    dated = _date(kind, fields)
    if not math.isnan(dated):
        return dated
    place = {"GGA": 0, "GNS": 0, "RMC": 0, "GST": 0, "ZDA": 0, "PASHR": 0, "GLL": 4}.get(kind)
    if place is None or len(fields) <= place:
        return None
    try:
        return utc_seconds(fields[place], time_s)
    except RefusedError:
        return None
