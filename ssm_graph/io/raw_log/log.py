"""The log of everything that a live estimator receives, written before it is used.

The folder is a mission folder in order of arrival (``mission.toml`` and its tables) with one file
more, ``arrivals``: a letter per row, in the order in which the rows of all tables came. Where a
process went on with the log of another, ``arrivals`` holds a line with the sizes of the tables at
that moment, so that a row that was written without its letter shifts no other. What has come and
waits to be told its time stands in ``waiting`` until it has a row (`waiting.WaitingFile`).
"""

from __future__ import annotations

import contextlib
from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Self

from ssm_graph.base.errors import ConfigError
from ssm_graph.io.mission_folder.toml import TOML_NAME
from ssm_graph.io.mission_folder.vehicle import check_same_vehicle, write_vehicle
from ssm_graph.io.raw_log.kinds import RowKind, row_kinds
from ssm_graph.io.raw_log.rows import ALWAYS, ARRIVALS, check_columns, replay
from ssm_graph.io.raw_log.waiting import WAITING, WaitingFile, left_waiting
from ssm_graph.io.tables.append_file import TORN_ROW, AppendFile, sync_path
from ssm_graph.mission.vehicle import Vehicle
from ssm_graph.sensors.messages import Message, Readings

__all__ = ["RawLog", "replay"]

_RETRY_S: Final = 1.0
_BATCH: Final = 1000
"""Rows that one append may write of those that waited, so that it takes no longer than 10 ms."""


@dataclass(slots=True)
class _Row:
    """A record on its way to a table and its letter on the way to ``arrivals``."""

    table: AppendFile
    record: bytes
    letter: bytes
    is_in_table: bool = False


class RawLog:
    """Append-only writer of a log folder.

    A row is on its way to the disk when :meth:`append` returns: it survives the end of the process,
    and after :meth:`sync` a power failure. A disk that is full or fails stops nobody: rows then
    wait in memory, and :meth:`problems` says so.

    Raises :class:`ConfigError` for a folder that holds a mission already. Raises :class:`OSError`
    where the folder and the heads of its tables cannot be written.

    Parameters
    ----------
    folder : made if it does not exist; one that holds a mission is refused.
    vehicle : what ``mission.toml`` says.
    max_waiting : rows that may wait in memory for the disk, 100 000 unless told; those that come
        then are lost.
    retry_every : rows after which the disk is tried again, 500 unless told; at the latest, that
        is, for it is tried after a second of message time as well.
    """

    def __init__(self, folder: Path | str, vehicle: Vehicle, **limits: int) -> None:
        folder = Path(folder)
        folder.mkdir(parents=True, exist_ok=True)
        kinds = row_kinds(vehicle)
        _refuse_content(folder, kinds.values())
        self._vehicle = vehicle
        self._open(folder, kinds, **limits)
        for kind in kinds.values():
            if kind.file in self._tables:
                self._tables[kind.file].append(kind.header)
        self._commit()
        for file in self._files():
            file.sync()
        write_vehicle(folder, vehicle)
        sync_path(folder)

    @classmethod
    def reopen(cls, folder: Path | str, vehicle: Vehicle, **limits: int) -> Self:
        """Go on with a log that another process began, full disk or not.

        Raises :class:`ConfigError` for a folder without a log, and for the log of another vehicle
        or of another version. Raises :class:`OSError` where the files cannot be opened.
        """
        check_same_vehicle(folder, vehicle)
        kinds = row_kinds(vehicle)
        check_columns(folder, kinds.values())
        log = cls.__new__(cls)
        log._vehicle = vehicle
        log._open(Path(folder), kinds, **limits)
        log._go_on()
        log._take_up()
        return log

    def regain(self) -> list[str]:
        """Go on where somebody removed, replaced or changed files; return what was done to them.

        Rows that come from now on are read in order, whatever has become of those before.
        """
        texts = []
        with contextlib.suppress(OSError):  # then the tables cannot be made either, and say so
            if not (self._folder / TOML_NAME).exists():
                self._folder.mkdir(parents=True, exist_ok=True)
                write_vehicle(self._folder, self._vehicle)
                texts.append(f"{self._folder / TOML_NAME} was removed or moved; written again")
        heads = {kind.file: kind.header for kind in self._kinds.values()}
        found = [file.regain(heads.get(file.name, b"")) for file in self._files()]
        altered = [text for text in found if text]
        if altered:
            self._go_on()
        return texts + altered

    def hold(self, waiting: Sequence[Readings]) -> None:
        """Keep messages that wait to be told their times, in place of those that did before.

        They survive the end of the process; :func:`replay` and :meth:`reopen` find those that came
        to no row of their own, read as was likelier then. Raises nothing.
        """
        self._held.keep(waiting)

    def _take_up(self) -> None:
        """Give rows to what waited when the process before ended."""
        for kind, record in left_waiting(self._folder, self._kinds.values()):
            if (table := self._tables.get(kind.file) or self._begin_table(kind)) is not None:
                self._add(_Row(table, record, kind.letter))
        self._write_waiting(len(self._waiting))
        if not self._waiting:
            self._held.clear()

    def _go_on(self) -> None:
        """Note how large the tables are, before all rows that wait: letters count from here on."""
        tables = [self._tables.get(kind.file) for kind in self._kinds.values()]
        sizes = ",".join(str(0 if table is None else table.size) for table in tables)
        first = [_Row(self._arrivals, f"\n@{sizes};\n".encode(), b"")]
        for kind, table in zip(self._kinds.values(), tables, strict=True):
            if table is not None and table.size < len(kind.header):  # a power failure took it
                table.cut(0)
                first.append(_Row(table, kind.header, b""))
        is_begun = bool(self._waiting) and self._waiting[0].is_in_table
        for i, row in enumerate(first, start=int(is_begun)):
            self._waiting.insert(i, row)
        self._commit()
        self._write_waiting(len(first) + is_begun)

    def _open(
        self,
        folder: Path,
        kinds: dict[type[Message], RowKind],
        *,
        max_waiting: int = 100_000,
        retry_every: int = 500,
    ) -> None:
        self._folder, self._kinds = folder, kinds
        self._tables = {
            kind.file: AppendFile(folder / kind.file, ending=TORN_ROW)
            for kind in kinds.values()
            if kind.file in ALWAYS or (folder / kind.file).exists()
        }
        self._arrivals = AppendFile(folder / ARRIVALS, ending=b"\n")
        self._held = WaitingFile(folder, kinds)
        self._offsets: dict[str, int] = {}
        self._waiting: deque[_Row] = deque()
        self._max_waiting, self._retry_every = max_waiting, retry_every
        self._is_blocked = False
        self._tried_s, self._since_tried = 0.0, 0
        self._n_lost, self._reason, self._sync_failure = 0, "", ""

    def append(self, message: Message) -> None:
        """Write one row and its letter; raise nothing where the disk refuses them.

        Every number comes back bit for bit, latitude and longitude, which the table has in degrees,
        to 5e-16 rad; a ping whose sigmas are all NaN comes back with None.
        """
        kind = self._kinds[type(message)]
        table = self._tables.get(kind.file) or self._begin_table(kind)
        if table is None:
            return
        if self._add(_Row(table, kind.row(message), kind.letter)):
            self._retry(message.time_s)
        elif self._waiting:
            self._tried_s, self._since_tried = message.time_s, 0

    def _add(self, row: _Row) -> bool:
        """Write a row, or have it wait; return whether others had waited before it."""
        is_behind = bool(self._waiting)
        if is_behind or not self._write(row):
            self._wait(row)
        return is_behind

    def _begin_table(self, kind: RowKind) -> AppendFile | None:
        """Return the table of an instrument that is heard for the first time; None if refused."""
        try:
            table = AppendFile(self._folder / kind.file, ending=TORN_ROW)
        except OSError as error:
            self._n_lost, self._reason = self._n_lost + 1, error.strerror or str(error)
            return None
        self._tables[kind.file] = table
        self._waiting.append(_Row(table, kind.header, b""))
        self._write_waiting(len(self._waiting))
        return table

    def offsets(self) -> dict[str, int]:
        """Return the size of every file up to the last row that is wholly written, bytes.

        A replay from there gives all later rows. Rows that wait for the disk are not counted: a
        checkpoint that has used them will be given them once more.
        """
        return dict(self._offsets)

    def problems(self) -> str | None:
        """Return one sentence where a row is not on its way to the disk, None if all are."""
        parts = []
        if self._waiting:
            n_rows = sum(bool(row.letter) for row in self._waiting)
            parts.append(f"rows that wait in memory for the disk: {n_rows} ({self._reason})")
        if self._n_lost:
            parts.append(f"rows lost because {self._max_waiting} waited already: {self._n_lost}")
        problems = (*(file.problem for file in self._files()), self._held.problem)
        parts += [problem for problem in problems if problem]
        if self._sync_failure:
            parts.append(f"the disk does not confirm what it was given ({self._sync_failure})")
        return f"raw log: {'; '.join(parts)}" if parts else None

    def sync(self) -> bool:
        """Write what waits and wait until all is on the disk; return whether it is."""
        self._write_waiting(len(self._waiting))
        self._sync_failure = ""
        try:
            for file in self._files():
                file.sync()
        except OSError as error:
            self._sync_failure = error.strerror or str(error)
        return not self._waiting and not self._sync_failure

    def close(self) -> None:
        """Write what waits, as far as the disk takes it, and close the files."""
        self._write_waiting(len(self._waiting))
        for file in self._files():
            file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _files(self) -> list[AppendFile]:
        return [*self._tables.values(), self._arrivals]

    def _commit(self) -> None:
        self._offsets.update({file.name: file.size for file in self._files()})

    def _wait(self, row: _Row) -> None:
        if len(self._waiting) < self._max_waiting:
            self._waiting.append(row)
        else:
            self._n_lost += 1

    def _retry(self, time_s: float) -> None:
        self._since_tried += 1
        is_due = abs(time_s - self._tried_s) >= _RETRY_S or self._since_tried >= self._retry_every
        if is_due or not self._is_blocked:
            self._tried_s, self._since_tried = time_s, 0
            self._write_waiting(_BATCH)

    def _write_waiting(self, limit: int) -> None:
        for _ in range(min(limit, len(self._waiting))):
            if not self._write(self._waiting[0]):
                return
            self._waiting.popleft()

    def _write(self, row: _Row) -> bool:
        """Write what is missing of a row; return whether all of it is written."""
        try:
            if not row.is_in_table:
                row.table.append(row.record)
                row.is_in_table = True
            if row.letter:
                self._arrivals.append(row.letter)
        except OSError as error:
            self._reason, self._is_blocked = error.strerror or str(error), True
            return False
        self._is_blocked = False
        self._offsets[row.table.name] = row.table.size
        self._offsets[ARRIVALS] = self._arrivals.size
        return True


def _refuse_content(folder: Path, kinds: Iterable[RowKind]) -> None:
    """Raise where a folder holds a mission; remove what a start that was cut short left there."""
    heads = {kind.file: kind.header for kind in kinds} | {ARRIVALS: b"", WAITING: b""}
    begun = [folder / name for name in heads if (folder / name).exists()]
    is_used = any(path.stat().st_size > len(heads[path.name]) for path in begun)
    if is_used or (folder / TOML_NAME).exists():
        raise ConfigError(
            f"{str(folder)!r} holds a mission already; expected a folder without one; choose "
            "another folder, or go on with the log that is there (RawLog.reopen)"
        )
    for path in begun:
        path.unlink()
