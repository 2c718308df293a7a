"""Tables in files, CSV or Parquet: which format, reading with every defect named, writing."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from ssm_graph.base.errors import ConfigError, DataError, MissingExtraError
from ssm_graph.base.frozen import Array
from ssm_graph.base.tables import Table, TableSpec, check_finite, check_increasing, check_names
from ssm_graph.io.tables.csv_tables import (
    CsvFile,
    check_is_text,
    check_last_line,
    read_csv_header,
    read_csv_values,
    write_csv,
)


class TableFormat(Enum):
    """File format of a table; the value is the ending of its name."""

    CSV = ".csv"
    PARQUET = ".parquet"


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
    check_increasing(table, spec)
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
