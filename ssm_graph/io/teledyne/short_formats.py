"""PD4 and PD5 (binary) and PD6 (text) of Teledyne's DVLs, and of those that imitate them.

They are shorter than PD0: velocities of the vehicle over the bottom with the signs of a vehicle,
where PD0 has those of the bottom. Beams are there only in PD4 and PD5 in beam coordinates; else
there are three components along X, Y, Z of the instrument, which are three beams along its axes.
Ship and earth coordinates are turned by an attitude that cannot be undone, and are refused.
Layouts: Teledyne RDI, "Workhorse Commands and Output Data Format", PD4, PD5, PD6.
"""

from __future__ import annotations

import re
import struct
from collections import Counter
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

import numpy as np

from ssm_graph.base.errors import DataError
from ssm_graph.base.progress import told
from ssm_graph.io.recording import Recording, whole
from ssm_graph.sensors.compass import HeadingReading
from ssm_graph.sensors.dvl import Ping
from ssm_graph.sensors.messages import Message

_SIZES: Final = {0: 47, 1: 88}
"""Bytes of PD4 and PD5 with their checksum, by the number of the structure."""
_SIGN: Final = 0x7D
_BAD: Final = -32768
_BEAM, _INSTRUMENT = 0, 1
_DAY_S: Final = 86_400.0
_HALF_DAY_S: Final = 43_200.0
_SENTENCE: Final = re.compile(rb":(SA|TS|BI|WI|BS|BE|BD|WS|WE|WD|RA),([^\r\n:]{1,200})")
_AXES: Final = (
    "X, Y, Z of the instrument are three beams: of Teledyne with beam 3 forward [dvl] has "
    "beam_vectors = [[0, 1, 0], [1, 0, 0], [0, 0, -1]], of Water Linked [[1, 0, 0], [0, 1, 0], "
    "[0, 0, 1]]"
)


def is_pd45(head: bytes) -> bool:
    """Return whether the first bytes of a file hold a sound PD4 or PD5."""
    return next(_ensembles(head), None) is not None


def is_pd6(head: bytes) -> bool:
    """Return whether the first bytes of a file hold sentences of PD6."""
    kinds = {match[1] for match in _SENTENCE.finditer(head)}
    return b"TS" in kinds and len(kinds) > 1


def read_pd45(path: Path) -> Recording:
    """Return the pings of PD4 or PD5; times are seconds of the first day, they have no date.

    Raises :class:`DataError` for ship and earth coordinates and for settings that change.
    """
    data = whole(path)
    found = list(told(_ensembles(data), len(data), size=len))
    if not found:
        raise DataError(f"{path}: no sound PD4 or PD5; was it transferred as text?")
    (setting, _), *others = Counter((body[1], body[4] >> 6) for body in found).most_common()
    if others:
        raise DataError(
            f"{path}: {1 + len(others)} different formats or coordinates; expected one: split it"
        )
    structure, coordinates = setting
    if coordinates not in (_BEAM, _INSTRUMENT):
        raise DataError(
            f"{path}: {len(found)} ensembles in {('ship', 'earth')[coordinates - 2]} coordinates, "
            "turned by an attitude that cannot be undone; expected beam or instrument coordinates "
            "(command EX00xxx or EX01xxx); a Water Linked always states ship coordinates: take its "
            "JSON, serial lines or PD6 instead"
        )
    messages: list[Message] = []
    last, day_s, known, n_repeats = -np.inf, 0.0, 0, 0
    for body in found:
        hour, minute, second, hundredths = body[35:39]
        time_s = day_s + 3600.0 * hour + 60.0 * minute + second + hundredths / 100.0
        if time_s < last - _HALF_DAY_S:  # past midnight
            day_s, time_s = day_s + _DAY_S, time_s + _DAY_S
        if time_s == last:
            n_repeats += 1
            continue
        if time_s < last:
            raise DataError(
                f"{path}: the clock goes from {last:.2f} to {time_s:.2f} s of the day; expected "
                "increasing times: split the file there"
            )
        last = time_s
        count = 4 if coordinates == _BEAM else 3
        raw = struct.unpack_from("<4h", body, 5)[:count]
        speed = tuple(float("nan") if v == _BAD else v / 1000.0 for v in raw)
        known += any(v != _BAD for v in raw)
        messages.append(Ping(time_s, speed))
        if structure == 1:
            (heading,) = struct.unpack_from("<H", body, 52)
            messages.append(HeadingReading(time_s, float(np.radians(heading / 100.0))))
    n_bytes = sum(len(body) + 2 for body in found)
    notes = ["times are seconds of the first day: the format has no date"]
    notes.append(
        "speeds are taken to be positive along the beam (else --beams-against); Teledyne's beams 1 "
        "to 4 are at azimuths 270, 90, 0, 180 with beam 3 forward"
        if coordinates == _BEAM
        else _AXES
    )
    if n_repeats:
        notes.append(f"{n_repeats} reports of a time that an earlier one has were left out")
    if n_bytes < len(data):
        notes.append(f"{len(data) - n_bytes} bytes of no sound ensemble left out")
    about = (
        f"Teledyne PD{4 + structure}, {len(found)} ensembles, "
        f"{'beam' if coordinates == _BEAM else 'instrument'} coordinates, bottom track in "
        f"{100.0 * known / len(found):.0f} %"
    )
    return Recording(about, tuple(messages), tuple(notes))


def _ensembles(data: bytes) -> Iterator[bytes]:
    """Yield ensembles without their checksums, where that is right."""
    at = data.find(_SIGN)
    while at >= 0:
        size = _SIZES.get(data[at + 1], 0) if at + 4 <= len(data) else 0
        body = data[at : at + size - 2]
        is_sound = (
            size > 0
            and at + size <= len(data)
            and struct.unpack_from("<H", data, at + 2)[0] == size - 2
            and struct.unpack_from("<H", data, at + size - 2)[0] == sum(body) & 0xFFFF
        )
        if is_sound:
            yield body
        at = data.find(_SIGN, at + (size if is_sound else 1))


def read_pd6(path: Path) -> Recording:
    """Return the velocities of PD6 in axes of the instrument, and its headings.

    Raises :class:`DataError` for a recording without ``BI``, and a clock that goes back.
    """
    messages: list[Message] = []
    kinds: Counter[str] = Counter()
    heading, time_s, last, n_bad, n_torn = float("nan"), float("nan"), -np.inf, 0, 0
    data = whole(path)
    for match in told(_SENTENCE.finditer(data), len(data), size=_length):
        kind = match[1].decode()
        fields = [field.strip() for field in match[2].decode("ascii", "replace").split(",")]
        kinds[kind] += 1
        try:
            if kind == "SA":
                heading = float(fields[2])
            elif kind == "TS":
                time_s = _instant(fields[0])
            elif kind == "BI" and np.isfinite(time_s):
                if time_s < last:
                    raise DataError(
                        f"{path}: the clock goes from {last:.2f} to {time_s:.2f} s; expected "
                        "increasing times: split the file there"
                    )
                is_good = {"A": True, "V": False}.get(fields[4][:1])
                if is_good is None:
                    raise ValueError(fields[4])
                raw = [float(v) for v in fields[:3]]
                if not np.isfinite(raw).all():
                    raise ValueError(fields)
                n_bad += not is_good
                speed = tuple(v / 1000.0 if is_good and v != _BAD else np.nan for v in raw)
                if time_s > last:
                    messages.append(Ping(time_s, speed))
                    if np.isfinite(heading) and heading != 0.0:
                        messages.append(HeadingReading(time_s, float(np.radians(heading))))
                last, heading = time_s, float("nan")
        except (ValueError, IndexError):
            n_torn += 1
    if not messages:
        raise DataError(
            f"{path}: no bottom track in axes of the instrument (BI with a time TS); it has "
            f"{', '.join(f'{n} {kind}' for kind, n in kinds.most_common()) or 'none'}; set the "
            "instrument to instrument coordinates"
        )
    n_pings = sum(isinstance(message, Ping) for message in messages)
    about = f"PD6, {n_pings} velocities of the instrument, bad in {100.0 * n_bad / n_pings:.0f} %"
    notes = ["times are those of the instrument's clock, taken for UTC", _AXES]
    if n_torn:
        notes.append(f"{n_torn} torn sentences left out")
    return Recording(about, tuple(messages), tuple(notes))


def _length(match: re.Match[bytes]) -> int:
    return match.end() - match.start()


def _instant(text: str) -> float:
    """Return Unix seconds of YYMMDDHHmmsshh."""
    if len(text) != 14 or not text.isdecimal():
        raise ValueError(text)
    year, month, day, hour, minute, second, hundredths = (
        int(text[i : i + 2]) for i in range(0, 14, 2)
    )
    date = datetime(2000 + year, month, day, hour, minute, second, tzinfo=UTC)
    return date.timestamp() + hundredths / 100.0
