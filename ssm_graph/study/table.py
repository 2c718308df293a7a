"""All runs of a study as one tidy table."""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

from ssm_graph.base.errors import MissingExtraError
from ssm_graph.io.mission_folder.reader import TableFormat
from ssm_graph.study.scoring import COLUMNS, COUNT_COLUMNS, TEXT_COLUMNS, Row


def write_rows(path: Path, rows: Sequence[Row]) -> None:
    """Write one row for every run to CSV or Parquet, by the ending of ``path``.

    Numbers are written without loss of a bit; what does not apply is empty.
    """
    if TableFormat(path.suffix) is TableFormat.CSV:
        with path.open("w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(COLUMNS)
            writer.writerows([_cell(row[name]) for name in COLUMNS] for row in rows)
        return
    arrow = parquet_module("pyarrow")
    types = {name: arrow.float64() for name in COLUMNS}
    types |= {name: arrow.string() for name in TEXT_COLUMNS}
    types |= {name: arrow.int64() for name in COUNT_COLUMNS}
    columns = {
        name: arrow.array([row[name] for row in rows], types[name], from_pandas=True)
        for name in COLUMNS
    }
    parquet_module("pyarrow.parquet").write_table(arrow.table(columns), path)


def parquet_module(name: str) -> Any:
    """Return a module of pyarrow; asked for early, its lack is known before the work is done."""
    try:
        return import_module(name)
    except ImportError as error:
        raise MissingExtraError("pyarrow", extra="parquet", purpose="--format parquet") from error


def _cell(value: str | float) -> str:
    if isinstance(value, float):
        return "" if math.isnan(value) else repr(value)
    return str(value)
