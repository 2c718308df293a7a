"""What a raw log holds, read again as it came."""

from __future__ import annotations

import heapq
import math
import re
from collections.abc import Iterable, Iterator, Mapping
from itertools import chain
from pathlib import Path
from typing import Final

import numpy as np

from ssm_graph.base.errors import ConfigError
from ssm_graph.base.frozen import Array
from ssm_graph.io.mission_folder.vehicle import check_same_vehicle
from ssm_graph.io.raw_log.kinds import RowKind, row_kinds
from ssm_graph.io.raw_log.waiting import left_waiting
from ssm_graph.mission.mission import Mission
from ssm_graph.mission.vehicle import Vehicle
from ssm_graph.sensors.messages import Message
from ssm_graph.sensors.registry import INSTRUMENTS

ARRIVALS: Final = "arrivals"
"""The file of a log that has a letter for every row, in order of arrival."""
_FEWEST_TABLES = 4
_SIZES = re.compile(rb"@(\d+(?:,\d+)*);")
ALWAYS: Final = ("imu.csv", "dvl.csv", "depth.csv", "gnss.csv")
"""Tables that every log has, whatever came."""


def messages_of(mission: Mission) -> Iterator[Message]:
    """Yield all messages of a mission in order of time.

    An IMU sample stands at the end of its interval, a ping at its stamp. Of equal times they come
    in the order of the registry: IMU, DVL, depth, GNSS. Rows are turned into messages as they are
    asked for, so that a day of data needs no more memory than the mission itself.
    """
    logs = mission.logs
    streams = [
        one.messages_of(logs[one.log])
        for one in INSTRUMENTS
        if one.message is not None and one.log in logs
    ]
    return heapq.merge(*streams, key=lambda message: message.time_s)


class _Rows:
    """The rows of one table, in order of arrival; torn ones are left out."""

    def __init__(self, path: Path, kind: RowKind, start: int) -> None:
        self._kind = kind
        end = path.stat().st_size if path.exists() else 0
        self._lines = _lines(path, start, end)
        self._next: tuple[int, bytes] | None = next(self._lines, None)

    def take(self, limit: float = math.inf) -> Message | None:
        """Return the next message of a line that starts before ``limit``, None if there is none."""
        while self._next is not None and self._next[0] < limit:
            message = self._kind.parse(self._next[1])
            self._next = next(self._lines, None)
            if message is not None:
                return message
        return None

    def take_all(self, limit: float) -> Iterator[Message]:
        """Yield the messages of all lines that start before ``limit``."""
        while (message := self.take(limit)) is not None:
            yield message


def replay(
    folder: Path | str, vehicle: Vehicle, offsets: Mapping[str, int] | None = None
) -> Iterator[Message]:
    """Return what was logged after a checkpoint, in order of arrival.

    Rows whose letter was not written come last in the log of their process, the tables merged by
    time. What waited to be told its time when the process ended comes last of all. Rows that are
    appended after this call are not among them.

    Raises :class:`ConfigError` for a folder without a log, and for the log of another vehicle or of
    another version.

    ``offsets`` are those of :meth:`RawLog.offsets`; a file that is not named is read from its
    start.
    """
    check_same_vehicle(folder, vehicle)
    kinds = row_kinds(vehicle)
    check_columns(folder, kinds.values())
    starts = offsets or {}
    arrivals = _read_from(Path(folder) / ARRIVALS, starts.get(ARRIVALS, 0))
    tables = {
        kind.letter[0]: _Rows(Path(folder) / kind.file, kind, starts.get(kind.file, 0))
        for kind in kinds.values()
    }
    waited = (row.kind.parse(row.record) for row in left_waiting(Path(folder), kinds.values()))
    return chain(_in_order_of_arrival(arrivals, tables), filter(None, list(waited)))


def check_columns(folder: Path | str, kinds: Iterable[RowKind]) -> None:
    """Raise :class:`ConfigError` for a log whose tables have other columns than ours."""
    for kind in kinds:
        path = Path(folder) / kind.file
        if not path.exists():
            continue
        with path.open("rb") as stream:
            head = stream.readline()
        if head.endswith(b"\n") and head != kind.header:
            raise ConfigError(
                f"{path}: expected the columns {kind.header.decode().strip()}, got "
                f"{head.decode(errors='replace').strip()[:200]}; it is the log of another version: "
                "begin a new one in another folder; ssm-graph smooth and --replay read the old one"
            )


def _in_order_of_arrival(arrivals: bytes, tables: dict[int, _Rows]) -> Iterator[Message]:
    for letters, limits in _runs(arrivals, len(tables)):
        limit_of = dict(zip(tables, limits, strict=True))
        for letter in letters:
            if letter in tables and (message := tables[letter].take(limit_of[letter])) is not None:
                yield message
        rest = [table.take_all(limit_of[letter]) for letter, table in tables.items()]
        yield from heapq.merge(*rest, key=lambda message: message.time_s)


def _runs(arrivals: bytes, n_tables: int) -> list[tuple[bytes, Array]]:
    """Return the letters of each process and the sizes of the tables when it had ended.

    A table that was smaller later on was begun anew: it has nothing of what came before.
    """
    runs, letters = [], b""
    for line in arrivals.split(b"\n"):
        sizes = _SIZES.fullmatch(line)
        limits = tuple(float(size) for size in sizes[1].split(b",")) if sizes else ()
        if _FEWEST_TABLES <= len(limits) <= n_tables:  # there were none of later instruments
            runs.append((letters, limits + (0.0,) * (n_tables - len(limits))))
            letters = b""
        elif not line.startswith(b"@"):  # else a line of sizes that was torn
            letters += line
    runs.append((letters, (math.inf,) * n_tables))
    smallest = np.minimum.accumulate([limits for _, limits in runs][::-1])[::-1]
    return [(letters, limits) for (letters, _), limits in zip(runs, smallest, strict=True)]


def _lines(path: Path, start: int, end: int) -> Iterator[tuple[int, bytes]]:
    """Yield place and text of the whole lines between two places of a file."""
    if start >= end:
        return
    with path.open("rb") as stream:
        if start > 0:  # or to the next begin of a line where that is amid one
            stream.seek(start - 1)
            stream.readline()
        place = stream.tell()
        for line in stream:
            if place + len(line) > end or not line.endswith(b"\n"):
                return
            yield place, line[:-1]
            place += len(line)


def _read_from(path: Path, start: int) -> bytes:
    if not path.exists():
        return b""
    with path.open("rb") as stream:
        stream.seek(start)
        return stream.read()
