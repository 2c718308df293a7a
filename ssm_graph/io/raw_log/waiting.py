"""Messages that have come and wait to be told their times, kept beside the tables of a raw log.

A row of a table has the time of the run. Where it takes seconds to tell which clock stamped a
message, it has no row yet; until then it stands in the file ``waiting``, which is replaced as a
whole whenever that changes: a letter and a row as they would be by what is likelier so far, and
below them, after a bar, the same message read in the other way.

A process that follows finds there what the one before was killed with. What got into its table at
the last moment stands in both and counts once.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Final, NamedTuple

from ssm_graph.io.raw_log.kinds import RowKind
from ssm_graph.io.tables.append_file import free_name
from ssm_graph.sensors.messages import Message, Readings

WAITING: Final = "waiting"
_OTHERWISE: Final = b"|"
_TAIL: Final = 1 << 20
"""Bytes of a table in which a row is looked for: it was written within a turn of the run's loop."""


class WaitingRow(NamedTuple):
    """What waited when a process ended, as it is to be logged."""

    kind: RowKind
    record: bytes


class WaitingFile:
    """The file ``waiting`` of a log that is being written."""

    def __init__(self, folder: Path, kinds: Mapping[type[Message], RowKind]) -> None:
        self._path, self._kinds = folder / WAITING, kinds
        self._content = b""
        self.problem: str | None = None
        """Why the newest state of it is not on the disk, if so."""

    def keep(self, waiting: Sequence[Readings]) -> None:
        """Have the file hold these messages and no others; raise nothing."""
        content = b"".join(self._lines(readings) for readings in waiting)
        if content == self._content and self.problem is None:
            return
        try:
            if self._path.is_dir():
                self._path.rename(free_name(self._path))
            if content:
                part = self._path.with_suffix(".part")
                part.write_bytes(content)
                part.replace(self._path)
            else:
                self._path.unlink(missing_ok=True)
        except OSError as error:
            self.problem = f"{WAITING}: {error.strerror or error}"
            return
        self._content, self.problem = content, None

    def clear(self) -> None:
        """Remove the file: what stood there has rows."""
        self._content = _OTHERWISE  # none that a state of it has: it may be another process's
        self.keep(())

    def _lines(self, readings: Readings) -> bytes:
        kind = self._kinds[type(readings[0])]
        return _OTHERWISE.join(kind.letter + kind.row(message) for message in readings)


def left_waiting(folder: Path, kinds: Iterable[RowKind]) -> list[WaitingRow]:
    """Return what waited when the process before ended and is in no table, in order of arrival."""
    try:
        content = (folder / WAITING).read_bytes()
    except OSError:
        return []
    by_letter = {kind.letter: kind for kind in kinds}
    tails = {letter: _tail(folder / kind.file) for letter, kind in by_letter.items()}
    found: list[WaitingRow] = []
    is_logged = True
    for line in content.splitlines(keepends=True):
        is_first = not line.startswith(_OTHERWISE)
        text = line.removeprefix(_OTHERWISE)
        kind, record = by_letter.get(text[:1]), text[1:]
        if kind is None or not line.endswith(b"\n") or kind.parse(record) is None:
            continue  # a power failure damaged it
        if is_first:
            is_logged = record in tails[kind.letter]
            if not is_logged:
                found.append(WaitingRow(kind, record))
        elif record in tails[kind.letter] and not is_logged:
            is_logged = True
            found.pop()
    return found


def _tail(path: Path) -> frozenset[bytes]:
    """Return the last rows of a table."""
    with contextlib.suppress(OSError), path.open("rb") as stream:
        size = stream.seek(0, 2)
        stream.seek(max(0, size - _TAIL))
        return frozenset(stream.readlines())
    return frozenset()
