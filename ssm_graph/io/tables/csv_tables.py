"""Number tables in CSV: a fast reader for sound files, and a careful one that finds the bad line.

The careful reader decides what a valid file is; the fast one accepts nothing beyond it.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import TextIO

import numpy as np

from ssm_graph.base.errors import DataError
from ssm_graph.base.frozen import Array
from ssm_graph.base.progress import told
from ssm_graph.base.tables import TableFile

NUMBER = re.compile(
    r"[+-]?(?:(?:\d+\.?\d*|\.\d+)(?:e[+-]?\d+)?|nan|inf|infinity)", re.ASCII | re.IGNORECASE
)
_SIGNATURES = {
    b"\xff\xfe": "UTF-16 text",
    b"\xfe\xff": "UTF-16 text",
    b"PAR1": "a Parquet file (its name should then end in .parquet)",
    b"PK\x03\x04": "a zip archive or a spreadsheet",
    b"\x1f\x8b": "gzip data",
}
TAIL_LINES = 100
"""So many rows tell how long a row is."""
_WITHIN_NUMBER = re.compile(r"(?:\d\.|\d[eE][+-]?|(?:^|[^\w-])[+-]?\.|[+-])$")
"""At the end of a line."""
MISSING = frozenset({"null", "n/a", "na", "#n/a", "<na>", "none", "nil", "-", "--"})
"""What loggers write for a reading that is missing, in small letters"""
_ROWS = 16384
_SHOWN = 40


@dataclass(frozen=True, slots=True, eq=False)
class CsvFile(TableFile):
    """One CSV file."""

    path: Path
    errors: str = "strict"
    """What to do with bytes that are no UTF-8, as in :func:`open`."""
    also: tuple[str, ...] = ()
    """Lines that stand elsewhere and count as the last of the file."""

    def place(self, row: int) -> str:  # noqa: D102
        return f"{self.label}:{self._line(row)[0]}"

    def cell(self, row: int, column: str) -> str:  # noqa: D102
        return self._line(row)[1].split(",")[self.header().index(column)].strip()

    def header(self) -> list[str]:
        """Return the column names, stripped."""
        with self.open() as file:
            return _split_header(file.readline())

    def open(self) -> TextIO:
        """Open as text; a byte order mark of UTF-8 is skipped."""
        return self.path.open(encoding="utf-8-sig", errors=self.errors)

    def lines(self) -> Iterator[tuple[int, str]]:
        """Yield number and text of every line below the header that is not blank."""
        with self.open() as file:
            for number, line in enumerate(chain(file, self.also), start=1):
                if number > 1 and line.strip():
                    yield number, line

    def _line(self, row: int) -> tuple[int, str]:
        for index, found in enumerate(self.lines()):
            if index == row:
                return found
        raise IndexError(row)


def check_is_text(file: CsvFile, *, may_hold_zeros: bool = False) -> None:
    """Raise :class:`DataError` for an empty file and for one that is not UTF-8 text.

    Zero bytes among the rows, which a power failure leaves, may be left to the reader of the rows.
    """
    with file.path.open("rb") as stream:
        head = stream.read(4096)
    if not head.strip():
        raise DataError(
            f"{file.label}: the file is empty; expected a header row and one row per sample; "
            "was the recording or the copy interrupted?"
        )
    found = next((text for mark, text in _SIGNATURES.items() if head.startswith(mark)), None)
    line = 1
    if found is None and b"\0" in (head.split(b"\n")[0] if may_hold_zeros else head):
        found, line = "zero bytes", head[: head.index(b"\0")].count(b"\n") + 1
    if found:
        raise DataError(
            f"{file.label}:{line}: expected a CSV table in UTF-8, got {found}; save it as plain CSV"
        )


def read_csv_header(file: CsvFile) -> list[str]:
    """Return the column names; raise where the first line is no header of a comma table."""
    try:
        names = file.header()
    except UnicodeDecodeError as error:
        raise _not_utf8(file) from error
    if all(NUMBER.fullmatch(name) for name in names):
        raise DataError(
            f"{file.label}:1: expected the column names, got numbers; add the header row"
        )
    for separator, word in ((";", "semicolons"), ("\t", "tabs")):
        if len(names) == 1 and separator in names[0]:
            raise DataError(
                f"{file.label}:1: expected cells separated by commas, got {word}; save it with "
                "commas between the cells and points in the numbers"
            )
    return names


def read_csv_values(file: CsvFile, names: Sequence[str], *, blank: frozenset[str]) -> Array:
    """Return all numbers, (rows, columns); cells of the columns ``blank`` may be empty: NaN."""
    try:
        if next(file.lines(), None) is not None:
            with file.open() as stream:
                stream.readline()
                lines = told(stream, file.path.stat().st_size, size=len)
                values = np.loadtxt(lines, delimiter=",", comments=None, ndmin=2)
            if values.shape[1] == len(names):
                return np.asarray(values, dtype=np.float64)
    except UnicodeDecodeError as error:
        raise _not_utf8(file) from error
    except ValueError:
        pass  # the careful reader names the line
    return _read_carefully(file, names, blank=blank)


def check_last_line(file: CsvFile) -> str | None:
    """Raise where the file was plainly cut off; return a note where it may have been."""
    with file.path.open("rb") as stream:
        size = stream.seek(0, 2)
        stream.seek(max(0, size - 65536))
        tail = stream.read()
    if tail.endswith((b"\n", b"\r")):
        return None
    *before, last = tail.decode(errors="replace").splitlines()[-TAIL_LINES - 1 :]
    if is_cut_off(last, before[1:] if len(before) < TAIL_LINES else before):
        with file.open() as stream:
            number = sum(1 for _ in stream)
        raise DataError(
            f"{file.label}:{number}: the last line is shorter than the others and has no newline; "
            f"expected a complete row, got {_shown(last)}; the file was "
            "cut off: copy it again, or delete its last line"
        )
    return open_end(file.label)


def is_cut_off(last: str, before: Sequence[str], delimiter: str = ",") -> bool:
    """Return whether a last line without its newline plainly ends within a number.

    Parameters
    ----------
    last : the line.
    before : the rows above it.
    delimiter : what stands between the cells.
    """
    is_short = before and not last.endswith(delimiter) and len(last) < min(map(len, before)) - 1
    return bool(is_short or _WITHIN_NUMBER.search(last))


def open_end(label: str) -> str:
    """Return the note of a table whose last line has no newline, and may yet be whole."""
    return f"{label}: the last line has no newline; if the file was cut off, it is incomplete"


def write_csv(path: Path, columns: dict[str, Array]) -> None:
    """Write columns so that reading them gives the same floats, bit for bit."""
    values = np.column_stack(list(columns.values()))
    with path.open("w", encoding="utf-8", newline="\n") as stream:
        stream.write(",".join(columns) + "\n")
        for start in told(range(0, len(values), _ROWS), -(-len(values) // _ROWS)):
            rows = values[start : start + _ROWS].tolist()
            stream.writelines(",".join(map(repr, row)) + "\n" for row in rows)


def _split_header(line: str) -> list[str]:
    try:
        cells = next(csv.reader([line]), [])
    except csv.Error:
        cells = line.split(",")
    return [cell.strip() for cell in cells]


def _read_carefully(file: CsvFile, names: Sequence[str], *, blank: frozenset[str]) -> Array:
    rows = []
    try:
        for number, line in file.lines():
            cells = line.rstrip("\n").split(",")
            if len(cells) != len(names):
                raise _wrong_count(file, number, line, len(names))
            rows.append(
                [
                    _number(cell.strip(), f"{file.label}:{number}", name, blank=blank)
                    for name, cell in zip(names, cells, strict=True)
                ]
            )
    except UnicodeDecodeError as error:
        raise _not_utf8(file) from error
    return np.array(rows, dtype=np.float64).reshape(len(rows), len(names))


def _number(cell: str, place: str, name: str, *, blank: frozenset[str]) -> float:
    if NUMBER.fullmatch(cell):
        return float(cell)
    if not cell and name in blank:
        return float("nan")
    got = f"holds {_shown(cell)}" if cell else "is empty"
    hint = "correct the number, or delete this row"
    if cell.startswith(("'", '"')):
        hint = "write numbers without quotes"
    elif cell.lower() in MISSING and name in blank:
        hint = "leave the cell of a missing reading empty"
    raise DataError(f"{place}: column {name!r} {got}; expected a number; {hint}")


def _wrong_count(file: CsvFile, number: int, line: str, expected: int) -> DataError:
    got = line.count(",") + 1
    if not line.endswith("\n"):
        hint = "the file ends within this line: copy it again, or delete the line"
    elif got == 2 * expected and ";" in line:
        hint = "write decimal points, not decimal commas"
    elif got > expected:
        hint = "look for decimal commas, or two rows run together"
    else:
        hint = "look for a row that was only partly written"
    return DataError(
        f"{file.label}:{number}: the line has {got} cells; the header names {expected}; {hint}"
    )


def _not_utf8(file: CsvFile) -> DataError:
    good = 1
    with file.path.open("rb") as stream:
        for number, line in enumerate(stream, start=1):
            good = number
            try:
                line.decode("utf-8")
            except UnicodeDecodeError:
                break
    return DataError(
        f"{file.label}:{good}: expected UTF-8 text, got bytes that are none; "
        "save the table as plain CSV in UTF-8"
    )


def _shown(text: str) -> str:
    return repr(text if len(text) <= _SHOWN else text[:_SHOWN] + "...")
