"""Write ``docs/instruments.md``: ``SSM_GRAPH_DATA=FOLDER python -m tests.make_instruments_table``.

What is sound in a recording is counted here by a few lines of their own, not by the decoders.
"""

from __future__ import annotations

import csv
import os
import re
import sys
from collections import Counter
from collections.abc import Iterator
from functools import reduce
from pathlib import Path
from typing import NamedTuple

from ssm_graph.base.errors import DataError
from ssm_graph.io.file_kind import kind_of
from ssm_graph.live.protocols.decoder import Clock, Decoder
from ssm_graph.live.protocols.nmea import NmeaDecoder, NmeaOptions
from ssm_graph.live.protocols.waterlinked import WaterLinkedDecoder
from ssm_graph.live.recorded.log import read_recorded
from ssm_graph.sensors.compass import HeadingReading

ROOT = Path(__file__).parents[1]
DOC = ROOT / "docs" / "instruments.md"
DATA = Path(os.environ.get("SSM_GRAPH_DATA", ROOT / "../shared/data"))
FOLDERS = {"waterlinked_a50": "Water Linked A50", "gpsd": "Receivers and plotters, NMEA 0183"}
INTRO = """\
# Recordings of real instruments

How much of them is read. *Sound* is counted by a script of its own: reports of a DVL that differ
from the one before, or, of a receiver, sentences with a right checksum and a position, of the first
kind that the file has of GGA, GNS, RMC, GLL. *Live* is what the decoder of `ssm-graph online` makes
of the bytes, 256 at a time; *convert* is what `ssm-graph convert` writes. Without GGA a live run
waits 5 s for it, and then reads what has come meanwhile. The files are of a Water Linked A50 (a
vehicle in a basin, May and August 2021, December 2021 as a table) and of [gpsd's collection](https://gitlab.com/gpsd/gpsd/-/tree/master/test/daemon);
they are not part of this project.

This page is made by `python -m tests.make_instruments_table`; `tests/unit/test_instruments_page.py`
holds it to today's code.
"""
_SENTENCE = re.compile(rb"\$([A-Z]{2}([A-Z]{3}),([^$*\r\n]*))\*([0-9A-Fa-f]{2})")
_CLOCK = re.compile(
    rb"\$..(?:GGA|GNS|RMC),(\d\d)(\d\d)(\d\d)|\$..GLL,(?:[^,]*,){4}(\d\d)(\d\d)(\d\d)"
)
_CHUNK = 256


class Recording(NamedTuple):
    """What is in a file, and what is read of it."""

    name: str
    what: str
    n_sound: int
    n_live: int
    n_convert: int
    said: str

    @property
    def is_whole(self) -> bool:
        """Whether it is read to the last sound report."""
        is_table = self.name.endswith(".csv")
        return self.n_convert >= self.n_sound and (is_table or self.n_live >= self.n_sound)


def has_position(kind: bytes, fields: list[bytes]) -> bool:
    """Return whether a sentence says where the receiver was, by measurement."""
    place = {b"GGA": 1, b"GNS": 1, b"RMC": 2, b"GLL": 0}[kind]
    if len(fields) < place + 5 or not (fields[place] and fields[place + 2]):
        return False
    if kind == b"GGA":
        return fields[5] in (b"1", b"2", b"3", b"4", b"5", b"9")
    if kind == b"GNS":
        return any(mode in b"ADFPR" for mode in fields[5])
    return fields[{b"RMC": 1, b"GLL": 5}[kind]] == b"A"


def positions(data: bytes) -> tuple[str, int]:
    """Return the first kind of sentence that has positions, and how many of it do."""
    data = b"\n".join(line for line in data.split(b"\n") if not line.startswith(b"#"))
    counts: Counter[bytes] = Counter()
    for text, kind, fields, stated in _SENTENCE.findall(data):
        is_sound = reduce(lambda a, b: a ^ b, text) == int(stated, 16)
        if is_sound and kind in (b"GGA", b"GNS", b"RMC", b"GLL"):
            counts[kind] += has_position(kind, fields.split(b","))
    for kind in (b"GGA", b"GNS", b"RMC", b"GLL"):
        if counts[kind]:
            return kind.decode(), counts[kind]
    return "", 0


def reports(data: bytes) -> tuple[str, int]:
    """Return how many reports of a DVL differ from the one before."""
    if data.startswith(b"timestamp,"):
        found = [row[1:] for row in csv.reader(data.decode().splitlines())][1:]
        return "reports", sum(a != b for a, b in zip([[], *found], found, strict=False))
    texts = re.findall(rb'\{\s*"time":.*?"transducers":.*?\].*?\}', data, re.DOTALL)
    bare = [re.sub(rb"\s", b"", text) for text in texts]
    return "reports", sum(a != b for a, b in zip([b"", *bare], bare, strict=False))


def heard(decoder: Decoder, data: bytes) -> int:
    """Return how many fixes or pings a decoder makes of a stream, timed by its own sentences."""
    count, day_s, now_s = 0, 1_700_006_400.0, 1_700_006_400.0
    for begin in range(0, len(data), _CHUNK):
        chunk = data[begin : begin + _CHUNK]
        for found in _CLOCK.finditer(chunk):
            h, m, s = (int(part) for part in found.groups() if part is not None)
            now_s = day_s + 3600.0 * h + 60.0 * m + s
        messages = decoder.feed(chunk, arrival_s=now_s)
        count += sum(not isinstance(one, HeadingReading) for one in messages)
    messages = decoder.feed(b"\n", arrival_s=now_s) + decoder.feed(b"", arrival_s=now_s + 60.0)
    return count + sum(not isinstance(one, HeadingReading) for one in messages)


def recording(path: Path) -> Recording:
    """Return what is made of a file."""
    data = path.read_bytes()
    is_dvl = FOLDERS["waterlinked_a50"] == FOLDERS.get(path.relative_to(DATA).parts[0])
    what, n_sound = (reports if is_dvl else positions)(data)
    plain = b"\n".join(line for line in data.split(b"\n") if not line.startswith(b"#"))
    decoder = WaterLinkedDecoder() if is_dvl else NmeaDecoder(NmeaOptions(clock=Clock.ARRIVAL))
    n_live = 0 if data.startswith(b"timestamp,") else heard(decoder, plain)
    try:
        found = read_recorded(path)
        said = "; ".join(found.notes) if found else kind_of(path)
        messages = found.messages if found else ()
    except DataError as error:
        said, messages = str(error).removeprefix(f"{path}: "), ()
    n_convert = sum(not isinstance(one, HeadingReading) for one in messages)
    return Recording(path.name, what, n_sound, n_live, n_convert, said)


def recordings(folder: str) -> Iterator[Recording]:
    """Yield those of a folder, in order."""
    for path in sorted((DATA / folder).rglob("*")):
        if path.is_file() and path.suffix in (".log", ".txt", ".csv", ".json"):
            yield recording(path)


def line_of(one: Recording) -> str:
    """Return a row of the page."""
    said = one.said if len(one.said) <= 160 else one.said[:157] + "..."
    said = said.replace("|", "\\|").replace("`", "'")
    is_table = one.name.endswith(".csv")
    live = "–" if is_table else str(one.n_live)
    what = f"{one.n_sound} {one.what}" if one.n_sound else "no position"
    return f"| {one.name} | {what} | {live} | {one.n_convert} | `{said or 'nothing'}` |"


def make_page() -> str:
    """Return the page."""
    parts = [INTRO]
    for folder, title in FOLDERS.items():
        rows = [line_of(one) for one in recordings(folder)]
        head = ["| file | sound | live | convert | what is said |", "|---|---|---|---|---|"]
        parts.append("\n".join([f"## {title}", "", *head, *rows]) + "\n")
    return "\n".join(parts)


if __name__ == "__main__":
    DOC.write_text(make_page(), encoding="utf-8")
    sys.stdout.write(f"wrote {DOC}\n")
