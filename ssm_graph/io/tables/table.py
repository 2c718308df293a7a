"""Sensor tables of a mission folder, CSV or Parquet, with every defect named by file and line."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from enum import Enum
from importlib import import_module
from pathlib import Path
from typing import Any, Final, Protocol

import numpy as np
from numpy.typing import NDArray

from ssm_graph.base.errors import ConfigError, DataError, MissingExtraError, nearest_hint
from ssm_graph.base.frozen import Array
from ssm_graph.io.tables.csv_tables import (
    CsvFile,
    check_is_text,
    check_last_line,
    read_csv_header,
    read_csv_values,
    write_csv,
)

LARGEST_TIME_S = 1e20


class TableFormat(Enum):
    """File format of a table; the value is the ending of its name."""

    CSV = ".csv"
    PARQUET = ".parquet"


class Order(Enum):
    """How the rows of a mission's tables follow each other."""

    TIME = "time"
    """Times increase strictly."""
    ARRIVAL = "arrival"
    """As they came: late, repeated and torn rows are possible."""


TIME: Final = "time_s"
POSITION: Final = ("lat_deg", "lon_deg", "height_m")
POSITION_SIGMA: Final = ("sigma_east_m", "sigma_north_m", "sigma_up_m")
"""Columns that several tables have."""


@dataclass(frozen=True, slots=True)
class TableSpec:
    """The columns of one kind of table."""

    required: tuple[str, ...]
    optional: tuple[str, ...] = ()
    blank: frozenset[str] = frozenset()
    """Required columns whose cells may be empty or NaN; the optional ones always may."""
    key: tuple[str, ...] = ()
    """Columns that tell rows of one time apart; without them every time is there once."""

    @property
    def may_be_blank(self) -> frozenset[str]:
        """All columns that may hold NaN."""
        return self.blank | frozenset(self.optional)


@dataclass(frozen=True, slots=True)
class ParquetFile:
    """One Parquet file: where it is, and how messages call it."""

    path: Path
    label: str

    def place(self, row: int) -> str:
        """Return file and row, counted from 1."""
        return f"{self.label}: row {row + 1}"

    def cell(self, row: int, column: str) -> str:
        """Return the value of one cell as text."""
        value = _pyarrow("pyarrow.parquet").read_table(self.path, columns=[column])[0][row].as_py()
        return "null" if value is None else str(value)


class TableFile(Protocol):
    """Where the rows of a table stand."""

    @property
    def label(self) -> str:
        """How messages call the file."""

    def place(self, row: int) -> str:
        """Return file and line of a row."""

    def cell(self, row: int, column: str) -> str:
        """Return the content of a cell."""


@dataclass(frozen=True, slots=True, eq=False)
class Table:
    """The columns of one sensor table, in the units of the file."""

    file: TableFile
    columns: dict[str, Array]
    notes: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.time_s)

    def __getitem__(self, name: str) -> Array:
        return self.columns[name]

    def __contains__(self, name: str) -> bool:
        return name in self.columns

    @property
    def label(self) -> str:
        """The file's name as ``mission.toml`` gives it."""
        return self.file.label

    @property
    def time_s(self) -> Array:
        """(N,) the column ``time_s``."""
        return self.columns[TIME]

    def stack(self, names: Sequence[str]) -> Array:
        """Return columns side by side, (N, len(names)); NaN where the table has no such column."""
        missing = np.full(len(self), np.nan)
        return np.column_stack([self.columns.get(name, missing) for name in names])

    def fault(self, row: int, text: str) -> DataError:
        """Return an error that names the line of ``row``."""
        return DataError(f"{self.file.place(row)}: {text}")

    def cell_fault(self, row: int, column: str, text: str) -> DataError:
        """Return an error that names line, column and content of a cell."""
        return self.fault(row, f"column {column!r} holds {self.file.cell(row, column)}; {text}")


def read_table(path: Path, label: str, spec: TableSpec) -> Table:
    """Read one table and check what needs no knowledge of the sensor.

    Parameters
    ----------
    path : the file; its ending decides the format.
    label : its name in messages.
    spec : the columns it must and may have.

    Raises
    ------
    DataError
        For a file that is no table, a missing, unknown or repeated column, a cell that is no
        finite number, and times that do not increase; the message names the line.
    """
    read = _read_csv if table_format(path, label) is TableFormat.CSV else read_parquet
    try:
        table = read(path, label, spec)
    except OSError as error:
        raise DataError(f"{label}: cannot be read: {error.strerror or error}") from error
    check_finite(table, spec)
    _check_increasing(table, spec)
    return table


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
        table = _pyarrow("pyarrow").table({name: np.array(v) for name, v in columns.items()})
        _pyarrow("pyarrow.parquet").write_table(table, path)


def _read_csv(path: Path, label: str, spec: TableSpec) -> Table:
    file = CsvFile(path, label)
    check_is_text(file)
    names = read_csv_header(file)
    check_names(f"{label}:1", names, spec)
    values = read_csv_values(file, names, blank=spec.may_be_blank)
    note = check_last_line(file) if len(values) else None
    columns = {name: values[:, index] for index, name in enumerate(names)}
    return Table(file, columns, (note,) if note else ())


def read_parquet(path: Path, label: str, spec: TableSpec) -> Table:
    """Read a Parquet table, whatever its numbers; raise where it is none of this kind."""
    arrow, parquet = _pyarrow("pyarrow"), _pyarrow("pyarrow.parquet")
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
    except arrow.ArrowException as error:
        raise DataError(
            f"{label}: expected a Parquet table, got a file that cannot be read as one; "
            "was it cut off, or is it another format?"
        ) from error
    return Table(ParquetFile(path, label), columns)


def _pyarrow(module: str) -> Any:
    try:
        return import_module(module)
    except ImportError as error:
        raise MissingExtraError(
            "pyarrow", extra="parquet", purpose="reading or writing Parquet tables"
        ) from error


def check_names(place: str, names: Iterable[str], spec: TableSpec) -> None:
    """Raise for a column that is repeated, unknown or missing."""
    counts = Counter(names)
    known = (*spec.required, *spec.optional)
    repeated = [name for name, count in counts.items() if count > 1]
    if repeated:
        raise DataError(
            f"{place}: column {repeated[0]!r} appears {counts[repeated[0]]} times; expected once; "
            "delete or rename the others"
        )
    for name in counts:
        if name not in known:
            missing = [column for column in known if column not in counts]
            hint = nearest_hint(name, missing or known)
            raise DataError(f"{place}: unknown column {name!r}; {hint}")
    for name in spec.required:
        if name not in counts:
            raise DataError(
                f"{place}: column {name!r} is missing; expected {', '.join(spec.required)}"
            )


def check_finite(table: Table, spec: TableSpec) -> None:
    """Raise for the first cell that is not finite where it has to be."""
    for name, values in table.columns.items():
        bad = np.isinf(values) if name in spec.may_be_blank else ~np.isfinite(values)
        if bad.any():
            row = int(np.argmax(bad))
            hint = "leave the cell empty" if name in spec.may_be_blank else "delete this row"
            raise table.cell_fault(row, name, f"expected a finite number; {hint}")
    if len(table) and np.abs(table.time_s).max() > LARGEST_TIME_S:
        row = int(np.argmax(np.abs(table.time_s)))
        raise table.cell_fault(row, TIME, "expected seconds; correct or delete this row")


def is_repeated(table: Table, spec: TableSpec) -> NDArray[np.bool_]:
    """Return which rows (N,) have the time, and the key, of an earlier one."""
    rows = table.stack((TIME, *spec.key))
    repeated = np.ones(len(rows), dtype=bool)
    repeated[np.unique(rows, axis=0, return_index=True)[1]] = False
    return repeated


def _check_increasing(table: Table, spec: TableSpec) -> None:
    step = np.diff(table.time_s)
    if np.all(step > 0.0):
        return
    is_wrong = step <= 0.0
    if spec.key:
        is_wrong = (step < 0.0) | is_repeated(table, spec)[1:]
        if not is_wrong.any():
            return
    row = int(np.argmax(is_wrong)) + 1
    count = int(np.sum(is_wrong))
    also = f" ({count} such rows in all)" if count > 1 else ""
    now, before = table.time_s[row], table.time_s[row - 1]
    if now < before:
        raise table.fault(
            row,
            f"time_s goes back from {before:.6f} to {now:.6f}{also}; expected increasing times; "
            "sort the rows by time, and split the mission where the clock was set back",
        )
    rows = np.array([values[row - 1 : row + 1] for values in table.columns.values()])
    same = np.array_equal(rows[:, 0], rows[:, 1], equal_nan=True)
    what = "the row before is repeated" if same else f"time_s repeats {now:.6f}"
    hint = "delete the copies" if same else "write the times with more digits, or delete one"
    raise table.fault(row, f"{what}{also}; expected increasing times; {hint}")
