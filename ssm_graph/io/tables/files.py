"""Tables in files, CSV or Parquet: which format, reading with every defect named, writing.

A log that is written while the vehicle is under way ends where the process was killed, and goes on
in the next line: its rows stand in order of arrival. What such a log cannot help having, late,
repeated and torn rows, is put right or left out, and counted; what would mean another unit or
another format is refused as in any other table.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from functools import partial
from importlib import import_module
from itertools import islice
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from ssm_graph.base.errors import ConfigError, DataError, MissingExtraError
from ssm_graph.base.frozen import Array
from ssm_graph.base.tables import (
    LARGEST_TIME_S,
    Table,
    TableFile,
    TableSpec,
    check_finite,
    check_increasing,
    check_names,
    is_repeated,
)
from ssm_graph.io.tables.csv_tables import (
    NUMBER,
    CsvFile,
    check_is_text,
    check_last_line,
    read_csv_header,
    read_csv_values,
    write_csv,
)

_CHUNK = 65536
_SET_BACK_S: Final = 2.0
"""Rows may come so late; a clock that falls by more ..."""
_SET_BACK_ROWS: Final = 20
"""... and goes on steadily from there for so many rows, as it did before, was set back."""
_FEW = 10
"""So many bad rows are left out even where they are most of the table."""


class TableFormat(Enum):
    """File format of a table; the value is the ending of its name."""

    CSV = ".csv"
    PARQUET = ".parquet"


@dataclass(frozen=True, slots=True, eq=False)
class ParquetFile(TableFile):
    """One Parquet file."""

    path: Path

    def cell(self, row: int, column: str) -> str:  # noqa: D102
        value = (
            pyarrow_module("pyarrow.parquet")
            .read_table(self.path, columns=[column])[0][row]
            .as_py()
        )
        return "null" if value is None else str(value)


def read_table(path: Path, label: str, spec: TableSpec) -> Table:
    """Read one table and check what needs no knowledge of the sensor.

    Raises :class:`DataError` for a file that is no table, a missing, unknown or repeated column, a
    cell that is no finite number, and times that do not increase; the message names the line.

    The ending of ``path`` decides the format; ``label`` is its name in messages.
    """
    table = _read(path, label, spec, _read_csv)
    check_finite(table, spec)
    check_increasing(table, spec)
    return table


def _read(
    path: Path, label: str, spec: TableSpec, read_csv: Callable[[Path, str, TableSpec], Table]
) -> Table:
    read = read_csv if table_format(path, label) is TableFormat.CSV else read_parquet
    try:
        return read(path, label, spec)
    except OSError as error:
        raise DataError(f"{label}: cannot be read: {error.strerror or error}") from error


def table_format(path: Path, label: str) -> TableFormat:
    """Return the format of a table by the ending of its name."""
    try:
        return TableFormat(path.suffix.lower())
    except ValueError:
        raise ConfigError(
            f"{label}: expected a name that ends in .csv or .parquet, got {path.suffix!r}; "
            "convert the table"
        ) from None


def write_table(path: Path, columns: dict[str, Array]) -> None:
    """Write columns to CSV or Parquet, by the ending of ``path``, without loss of a bit."""
    if TableFormat(path.suffix) is TableFormat.CSV:
        write_csv(path, columns)
    else:
        table = pyarrow_module("pyarrow").table({name: np.array(v) for name, v in columns.items()})
        pyarrow_module("pyarrow.parquet").write_table(table, path)


def _read_csv(path: Path, label: str, spec: TableSpec) -> Table:
    file = CsvFile(label, path)
    check_is_text(file)
    names = read_csv_header(file)
    check_names(f"{label}:1", names, spec)
    values = read_csv_values(file, names, blank=spec.may_be_blank)
    note = check_last_line(file) if len(values) else None
    columns = {name: values[:, index] for index, name in enumerate(names)}
    return Table(file, columns, (note,) if note else ())


def read_parquet(path: Path, label: str, spec: TableSpec) -> Table:
    """Read a Parquet table, whatever its numbers; raise where it is none of this kind."""
    arrow, parquet = pyarrow_module("pyarrow"), pyarrow_module("pyarrow.parquet")
    try:
        schema = parquet.read_schema(path)
        check_names(label, schema.names, spec)
        for field in schema:
            kind = arrow.types
            if not (kind.is_integer(field.type) or kind.is_floating(field.type)):
                raise DataError(
                    f"{label}: column {field.name!r} holds values of type {field.type}; "
                    "expected numbers; write it as double"
                )
        data = parquet.read_table(path)
        columns = {
            name: np.asarray(data[name].cast(arrow.float64(), safe=False).to_numpy())
            for name in schema.names
        }
    except MemoryError as error:  # Arrow's is one of its exceptions too
        raise DataError(
            f"{label}: there is not enough memory for this table ({error}); cut the mission into "
            "parts, or use a computer with more of it"
        ) from error
    except arrow.ArrowException as error:
        raise DataError(
            f"{label}: expected a Parquet table, got a file that cannot be read as one: "
            f"{' '.join(str(error).split())[:200]}"
        ) from error
    return Table(ParquetFile(label, path), columns)


@dataclass(frozen=True, slots=True, eq=False)
class PickedRows(TableFile):
    """The file of a table whose rows are some of the file's, in another order."""

    file: TableFile
    rows: NDArray[np.int64]
    """(N,) the row of the file for each of the table."""

    def place(self, row: int) -> str:  # noqa: D102
        return self.file.place(int(self.rows[row]))

    def cell(self, row: int, column: str) -> str:  # noqa: D102
        return self.file.cell(int(self.rows[row]), column)


_LEFT_OUT: Final = {
    "repeated": ("{} row repeated exactly", "{} rows repeated exactly"),
    "contrary": (
        "{} row whose time an earlier row has with other numbers",
        "{} rows whose times earlier rows have with other numbers",
    ),
    "impossible": ("{} row of impossible numbers", "{} rows of impossible numbers"),
    "torn": ("{} torn line", "{} torn lines"),
    "torn_end": ("the last line, which has no end",) * 2,
}
"""What a table in order of arrival may hold and is left out, once and more often."""


def _note(counts: Counter[str], label: str) -> tuple[str, ...]:
    """Return one sentence on what was put right in a table, none where nothing was."""
    late, parts = counts["late"], []
    if late:
        parts.append(f"{late} row{'s' * (late > 1)} came late and went to their time")
    kinds = [(counts[kind], words) for kind, words in _LEFT_OUT.items() if counts[kind]]
    if kinds:
        parts.append(f"left out: {', '.join(words[n > 1].format(n) for n, words in kinds)}")
    return (f"{label}: {'; '.join(parts)}",) if parts else ()


def read_arrival_table(
    path: Path, label: str, spec: TableSpec, also: tuple[str, ...] = ()
) -> Table:
    """Read a table in order of arrival; return it in order of time, each time once.

    Left out and counted in one note are rows that repeat a time (the first stays), lines that are
    no complete row, a last line without its newline, and rows with numbers that are not finite or
    beyond the limits of the columns. Where they outnumber the good ones the table
    is not torn but of another kind, and is refused like any other.

    Raises :class:`DataError` for a file that is no table, a missing, unknown or repeated column,
    rows most of which cannot be read, and a clock that was begun anew or set back on the way.

    The ending of ``path`` decides the format; ``label`` is its name in messages; ``also`` are lines
    that stand elsewhere and count as the last of a CSV file.
    """
    counts: Counter[str] = Counter()
    table = _read(path, label, spec, partial(_read_csv_as_it_came, counts=counts, also=also))
    table = _without_impossible(table, spec, counts)
    _check_one_clock(table)
    table = _in_order_of_time(table, spec, counts)
    return replace(table, notes=_note(counts, label))


def _read_csv_as_it_came(
    path: Path, label: str, spec: TableSpec, counts: Counter[str], also: tuple[str, ...]
) -> Table:
    file = CsvFile(label, path, errors="replace", also=also)
    check_is_text(file, may_hold_zeros=True)
    names = read_csv_header(file)
    check_names(f"{label}:1", names, spec)
    values, rows = _read_lines(file, names, spec.may_be_blank, counts)
    if _is_too_many(counts["torn"], len(rows)):
        read_csv_values(CsvFile(label, path), names, blank=spec.may_be_blank)  # names the line
    columns = {name: values[:, index] for index, name in enumerate(names)}
    return Table(PickedRows(label, file, rows), columns)


def _read_lines(
    file: CsvFile, names: Sequence[str], blank: frozenset[str], counts: Counter[str]
) -> tuple[Array, NDArray[np.int64]]:
    """Return the numbers (N, columns) that can be read, and the row (N,) of the file of each."""
    found, rows, row = [np.empty((0, len(names)))], [np.empty(0, dtype=np.int64)], 0
    stream = (line for _, line in file.lines())
    while chunk := list(islice(stream, _CHUNK)):
        first, row = row, row + len(chunk)
        n_open = sum(not line.endswith("\n") for line in chunk)
        if n_open:  # the last line of the file
            counts["torn_end"] = n_open
            chunk = [line if line.endswith("\n") else "" for line in chunk]
        values = None if n_open else _numbers(chunk, len(names))
        kept = np.arange(len(chunk), dtype=np.int64)
        if values is None:
            good = list(_good_rows(chunk, names, blank))
            counts["torn"] += len(chunk) - len(good) - n_open
            values = np.array([cells for _, cells in good]).reshape(len(good), len(names))
            kept = np.array([index for index, _ in good], dtype=np.int64)
        found.append(values)
        rows.append(first + kept)
    return np.concatenate(found), np.concatenate(rows)


def _numbers(lines: list[str], n_columns: int) -> Array | None:
    """Return the numbers of sound lines, None where one of them is not."""
    if not lines:
        return np.empty((0, n_columns))
    try:
        values = np.loadtxt(lines, delimiter=",", comments=None, ndmin=2)
    except ValueError:
        return None
    return values if values.shape == (len(lines), n_columns) else None


def _good_rows(
    lines: list[str], names: Sequence[str], blank: frozenset[str]
) -> Iterator[tuple[int, list[float]]]:
    for index, line in enumerate(lines):
        cells = [cell.strip() for cell in line.split(",")]
        if len(cells) == len(names) and all(
            NUMBER.fullmatch(cell) or (not cell and name in blank)
            for name, cell in zip(names, cells, strict=True)
        ):
            yield index, [float(cell) if cell else np.nan for cell in cells]


def _without_impossible(table: Table, spec: TableSpec, counts: Counter[str]) -> Table:
    bad = np.abs(table.time_s) > LARGEST_TIME_S
    for name, values in table.columns.items():
        bad |= np.isinf(values) if name in spec.may_be_blank else ~np.isfinite(values)
        low, high = spec.limits.get(name, (-np.inf, np.inf))
        bad |= (values < low) | (values > high)
    if spec.nowhere:
        bad |= np.all(table.stack(spec.nowhere) == 0.0, axis=1)  # a code for no fix
    n_bad = int(bad.sum())
    if _is_too_many(n_bad, len(table) - n_bad):
        check_finite(table, spec)
        return table  # the checks of each sensor say what is wrong
    counts["impossible"] = n_bad
    return _picked(table, np.flatnonzero(~bad)) if n_bad else table


def _check_one_clock(table: Table) -> None:
    """Refuse times that fall and go on from there: sorted, two missions would be woven into one.

    A late row is followed by others that go on as before it.
    """
    time_s, n_rows = table.time_s, _SET_BACK_ROWS
    for row in np.flatnonzero(np.diff(time_s) < -_SET_BACK_S) + 1:
        before_s, after_s = time_s[max(row - n_rows, 0) : row], time_s[row : row + n_rows]
        is_steady = np.all(np.diff(before_s) > 0.0) and np.all(np.diff(after_s) > 0.0)
        if min(len(before_s), len(after_s)) == n_rows and is_steady and after_s[-1] < before_s[-1]:
            raise table.fault(
                int(row),
                f"the time falls from {before_s[-1]:.3f} to {after_s[0]:.3f} s and goes on from "
                "there: the clock was begun anew or set back, so these are two missions; cut all "
                "tables there and give each part a folder of its own",
            )


def _in_order_of_time(table: Table, spec: TableSpec, counts: Counter[str]) -> Table:
    time_s = table.time_s
    if len(time_s) == 0 or np.all(np.diff(time_s) > 0.0):
        return table
    counts["late"] = int(np.sum(time_s < np.maximum.accumulate(time_s)))
    keys = [table[name] for name in reversed(spec.key)]
    table = _picked(table, np.lexsort((*keys, time_s)))
    is_first = ~is_repeated(table, spec)
    first_of = np.flatnonzero(is_first)[np.cumsum(is_first) - 1]
    is_same = np.ones(len(table), dtype=bool)
    for values in table.columns.values():
        is_same &= (values == values[first_of]) | (np.isnan(values) & np.isnan(values[first_of]))
    counts["repeated"] = int(np.sum(is_same & ~is_first))
    counts["contrary"] = int(np.sum(~is_same))
    return _picked(table, np.flatnonzero(is_first))


def _picked(table: Table, rows: NDArray[np.intp]) -> Table:
    columns = {name: values[rows] for name, values in table.columns.items()}
    return Table(PickedRows(table.label, table.file, rows), columns)


def _is_too_many(n_bad: int, n_good: int) -> bool:
    return n_bad > max(_FEW, n_good)


def pyarrow_module(name: str) -> Any:
    """Return a module of pyarrow; asked for early, its lack is known before the work is done."""
    try:
        return import_module(name)
    except ImportError as error:
        purpose = "reading or writing Parquet tables"
        raise MissingExtraError("pyarrow", extra="parquet", purpose=purpose) from error
