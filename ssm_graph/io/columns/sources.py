"""Tables of anyone: named columns of CSV, Parquet, MAT and HDF5, and where each cell stands.

Columns of CSV are texts until a quantity asks for them; the others are arrays as stored. What is
deeper in a file has a path, ``nav/imu/gyro``; of a matrix each column has a number,
``nav/imu/gyro[0]``.
"""

from __future__ import annotations

import codecs
import csv
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from ssm_graph.base.errors import DataError, MissingExtraError, nearest_hint
from ssm_graph.base.progress import told
from ssm_graph.io.file_kind import CSV_ENDINGS
from ssm_graph.io.tables.csv_tables import MISSING, TAIL_LINES, is_cut_off, open_end
from ssm_graph.io.tables.files import pyarrow_module

_HDF5: Final = (".h5", ".hdf5", ".nc")
"""NetCDF 4 is HDF5."""
ENDINGS: Final = (*CSV_ENDINGS, ".parquet", ".mat", *_HDF5)
_DELIMITERS: Final = ",;\t|"
_BLANK: Final = " "
"""Any number of them, where none of the above is there."""
_WIDEST: Final = 64
"""Columns of a matrix; a longer side is its rows."""
_LARGEST: Final = 1 << 31
"""Bytes of one matrix of HDF5, whose file states its size whatever is in it."""
_MARKS: Final = ("#", "%", "//")
"""Begin a line of remarks, or a header."""


@dataclass(frozen=True, slots=True, eq=False)
class Source:
    """One file of columns."""

    label: str
    """Its name in messages."""
    columns: Mapping[str, Any]
    """Texts (a list) or an array (N,), by name."""
    lines: Sequence[int] = field(default_factory=tuple)
    """(N,) line of each row in a text; empty where rows are counted."""
    has_decimal_commas: bool = False
    """Numbers may be written 1,5, in a column without points."""
    notes: tuple[str, ...] = ()
    """What is odd about the file."""

    def place(self, row: int) -> str:
        """Return where a row is: its line in a text, else its number, counted from 1."""
        return f"{self.label}:{self.lines[row]}" if self.lines else f"{self.label}: row {row + 1}"

    def column(self, name: str, asked: str) -> Any:
        """Return a column; ``asked`` is where its name stands, for the message where there is none.

        Raises :class:`DataError` for an unknown name.
        """
        if name not in self.columns:
            raise DataError(
                f"{asked}: {self.label} has no column {name!r}; {nearest_hint(name, self.columns)}"
            )
        return self.columns[name]

    def numbers(self, name: str, asked: str) -> NDArray[np.float64]:
        """Return a column as numbers (N,), NaN for an empty cell; raise for a cell that is none.

        Words for a reading that is missing, such as NULL or N/A, count as empty cells.
        """
        cells = self.column(name, asked)
        if not isinstance(cells, list):
            if cells.dtype.kind not in "biuf":
                raise DataError(
                    f"{asked}: column {name!r} of {self.label} holds {cells.dtype}; expected "
                    'numbers; times that are texts or dates have the unit "iso"'
                )
            return np.asarray(cells, np.float64)
        if self.has_decimal_commas and not any("." in cell for cell in cells):
            cells = [cell.replace(",", ".") for cell in cells]
        words = {"": "nan", "true": "1", "false": "0"} | dict.fromkeys(MISSING, "nan")
        cells = [words.get(cell.lower(), cell) for cell in cells]
        try:
            return np.array(cells, np.float64)
        except ValueError:
            row = next(i for i, cell in enumerate(cells) if "," in cell or not _is_number(cell))
            raise DataError(
                f"{self.place(row)}: column {name!r} holds {cells[row]!r}; expected a number or "
                "an empty cell"
            ) from None

    def cell(self, row: int, name: str) -> str:
        """Return the content of a cell as it stands there."""
        return str(self.columns[name][row])


def read_source(path: Path) -> Source:
    """Read a file of columns, by the ending of its name.

    Raises :class:`DataError` for a file that is no table, :class:`MissingExtraError` where the
    package that reads it is not installed.
    """
    ending = path.suffix.lower()
    try:
        if ending in CSV_ENDINGS:
            return _csv(path)
        if ending == ".parquet":
            return _parquet(path)
        if ending == ".mat":
            return _mat(path)
        if ending in _HDF5:
            return Source(path.name, _hdf5(path))
    except OSError as error:
        raise DataError(f"{path}: cannot be read: {error.strerror or error}") from error
    except csv.Error as error:
        raise DataError(
            f"{path}: expected a table of columns, got: {error}; is a quotation mark not closed?"
        ) from error
    raise DataError(
        f"{path}: expected a table that ends in {', '.join(ENDINGS)}, got {path.suffix!r}"
    )


def _csv(path: Path) -> Source:
    """Read a text whose header is its first line of several words that are no numbers."""
    text = _text(path)
    lines = text.splitlines()
    cut_off = "" if text.endswith(("\n", "\r")) else lines[-1].strip()
    cut_off = "" if cut_off.startswith(_MARKS) else cut_off
    at, delimiter = _header(path, lines)
    if delimiter == _BLANK:
        lines = [line.strip() for line in lines]
    head = lines[at].lstrip("".join({c for mark in _MARKS for c in mark}))
    heads = csv.reader([head], delimiter=delimiter, skipinitialspace=True)
    names = [name.strip() for name in next(heads)]
    _check_names(path, at + 1, names)
    rows, numbers = list[list[str]](), list[int]()
    reader = csv.reader(lines[at + 1 :], delimiter=delimiter, skipinitialspace=True)
    number = at + 1
    for row in told(reader, len(lines) - at):
        before, number = number, at + 1 + reader.line_num
        if number > before + 1:
            raise DataError(
                f"{path.name}:{before + 1}: a quotation mark opens and the line does not end it; "
                "correct or delete the line"
            )
        if not any(row) or row[0].startswith(_MARKS):
            continue
        if len(row) != len(names):
            if number == len(lines) and cut_off:
                continue  # told below
            raise DataError(
                f"{path.name}:{number}: {len(row)} cells, expected {len(names)} as in the header "
                f"of line {at + 1}; correct or delete the line"
            )
        if len(rows) == 1 and _is_of_units(rows[0], row):
            rows, numbers = [], []
        rows.append(row)
        numbers.append(number)
    notes: tuple[str, ...] = ()
    if cut_off:
        has_all = numbers[-1:] == [len(lines)]
        if has_all and not is_cut_off(cut_off, lines[at + 1 : -1][-TAIL_LINES:], delimiter):
            notes = (open_end(path.name),)
        else:
            notes = (f"{path.name}:{len(lines)}: the file ends within this line: left out",)
            rows, numbers = rows[: len(rows) - has_all], numbers[: len(numbers) - has_all]
    if not rows:
        raise _no_rows(path)
    columns = {
        name: [cell.strip() for cell in cells]
        for name, cells in zip(names, zip(*rows, strict=True), strict=True)
        if name
    }
    return Source(path.name, columns, numbers, delimiter != ",", notes)


def _text(path: Path) -> str:
    """Return the text of a file: UTF-16 with its mark, UTF-8, else the code page of Windows."""
    data = path.read_bytes()
    if not data.strip():
        raise DataError(
            f"{path.name}: the file is empty; expected a header row and one row per sample; was "
            "the recording or the copy interrupted?"
        )
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):  # a shell of Windows
        text = data.decode("utf-16", errors="replace")
    else:
        try:
            text = data.decode("utf-8-sig")
        except UnicodeDecodeError:
            text = data.decode("cp1252", errors="replace")
    if "\0" in text[:4096]:
        raise DataError(f"{path.name}: expected a text of columns, got bytes that are none")
    return text


def _no_rows(path: Path) -> DataError:
    return DataError(f"{path.name}: a header and no rows; was the recording interrupted?")


def _header(path: Path, lines: list[str]) -> tuple[int, str]:
    """Return the line of the header and what stands between its names."""
    for at, line in enumerate(lines[:200]):
        below = next((b for b in lines[at + 1 :] if b.strip() and not b.startswith(_MARKS)), "")
        for delimiter in (*sorted(_DELIMITERS, key=line.count, reverse=True), _BLANK):
            between = None if delimiter == _BLANK else delimiter
            words = [word.strip() for word in line.strip("#%/ ").split(between)]
            is_header = len(words) > 1 and not any(map(_is_number, words))
            if is_header and not below:
                raise _no_rows(path)
            if is_header and len(below.split(between)) == len(line.split(between)):
                return at, delimiter
    raise DataError(
        f"{path.name}: no line of names above rows of numbers, with one of comma, semicolon, tab, "
        "bar or blanks between them; add a header"
    )


def _is_of_units(first: list[str], second: list[str]) -> bool:
    """Return whether a row below the header names units, as the next one has numbers."""
    counts = [sum(_is_number(cell.strip()) for cell in row) for row in (first, second)]
    return counts[0] == 0 and 2 * counts[1] > len(second) and all(cell.strip() for cell in first)


def _check_names(path: Path, line: int, names: list[str]) -> None:
    twice = next((name for name in names if name and names.count(name) > 1), None)
    if twice is not None:
        raise DataError(
            f"{path.name}:{line}: column {twice!r} appears {names.count(twice)} times; expected "
            "once; rename the others"
        )


def _parquet(path: Path) -> Source:
    arrow = pyarrow_module("pyarrow")
    try:
        table = pyarrow_module("pyarrow.parquet").read_table(path)
        return Source(
            path.name,
            {
                name: np.asarray(table[name].to_numpy(zero_copy_only=False))
                for name in table.column_names
            },
        )
    except arrow.ArrowException as error:
        raise DataError(
            f"{path}: expected a Parquet table, got a file that cannot be read as one: "
            f"{' '.join(str(error).split())[:200]}"
        ) from error


def _mat(path: Path) -> Source:
    """Read MATLAB's formats: 5 by SciPy, 7.3 is HDF5."""
    if path.read_bytes()[:512].rstrip(b"\0 ").startswith(b"MATLAB 7.3"):
        return Source(path.name, _hdf5(path))
    loadmat = import_module("scipy.io").loadmat
    try:
        found = loadmat(path, struct_as_record=False, squeeze_me=True)
    except Exception as error:  # of many types, for a file that is none
        raise DataError(f"{path}: expected a MAT file, got: {error}") from error
    items = ((name, value) for name, value in found.items() if not name.startswith("__"))
    return Source(path.name, dict(_flat(items)))


def _flat(items: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the columns (N,) of structures within structures."""
    for name, value in items:
        path = f"{prefix}{name}"
        if hasattr(value, "_fieldnames"):
            inner = [(key, getattr(value, key)) for key in value._fieldnames]
            yield from _flat(inner, f"{path}/")
        else:
            yield from _split(path, np.asarray(value))


def _split(path: str, value: NDArray[Any]) -> Iterator[tuple[str, Any]]:
    """Yield a vector as it is, of a matrix the columns along its longer side."""
    if value.ndim == 2 and 1 in value.shape:
        value = value.ravel()
    if value.ndim == 1:
        yield path, value
    elif value.ndim == 2 and min(value.shape) <= _WIDEST:
        rows = value if value.shape[0] >= value.shape[1] else value.T
        for index in range(rows.shape[1]):
            yield f"{path}[{index}]", rows[:, index]


def _hdf5(path: Path) -> dict[str, Any]:
    try:
        h5py = import_module("h5py")
    except ImportError as error:
        raise MissingExtraError("h5py", extra="columns", purpose="reading HDF5") from error
    found: dict[str, Any] = {}

    def visit(name: str, item: Any) -> None:
        if not isinstance(item, h5py.Dataset) or name.startswith("#"):
            return
        shape = item.shape or (1, 1, 1)
        if len(shape) > 2 or (len(shape) == 2 and min(shape) > _WIDEST):
            return  # images and the like are no columns, and never read
        if item.nbytes > _LARGEST:
            raise DataError(
                f"{path}: {name} states {item.nbytes} bytes; expected columns of at most 2 GiB: "
                "write the file without it"
            )
        if item.dtype.names:  # a table of named fields
            for key in item.dtype.names:
                found.update(_split(f"{name}/{key}", np.asarray(item[key])))
        else:
            found.update(_split(name, np.asarray(item[()])))

    try:
        with h5py.File(path) as file:
            file.visititems(visit)
    except (OSError, RuntimeError, KeyError, TypeError, ValueError) as error:
        raise DataError(f"{path}: expected an HDF5 file, got: {error}") from error
    return found


def _is_number(cell: str) -> bool:
    try:
        float(cell.replace(",", "."))
    except ValueError:
        return False
    return True
