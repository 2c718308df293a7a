"""The files of a study.

One JSON line for every finished run, errors over time beside them, and one table of all.
"""

from __future__ import annotations

import csv
import json
import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from ssm_graph.base.errors import ConfigError, DataError
from ssm_graph.base.frozen import Array
from ssm_graph.io.tables.files import TableFormat, pyarrow_module
from ssm_graph.study.cells import digest
from ssm_graph.study.jobs import JobResult, RunKey
from ssm_graph.study.scoring import COLUMNS, COUNT_COLUMNS, LOST, SERIES_STEP_S, TEXT_COLUMNS, Row

RUNS_NAME: Final = "runs.jsonl"
SERIES_NAME: Final = "series"


class Series(NamedTuple):
    """Errors over time of all runs of one method."""

    time_s: Array
    """(T,) seconds since the begin."""
    horizontal: Array
    """(N, T) m"""
    velocity: Array
    """(N, T) m/s"""
    nees: Array
    """(N, T) of the position, divided by 3"""


class StudyStore:
    """Finished runs on disk; the first line holds the settings that made them."""

    def __init__(self, folder: Path, settings: dict[str, Any], *, fresh: bool = False) -> None:
        """Open or create the files.

        Raises :class:`ConfigError`: the files were made with other settings. Raises
        :class:`DataError`: A line other than the last cannot be read.

        Parameters
        ----------
        folder : where ``runs.jsonl`` is, and the folder ``series``.
        settings : whatever must be the same for all runs of the file.
        fresh : throw old files away.
        """
        self.folder = folder
        self.path = folder / RUNS_NAME
        self.settings = settings
        self._rows: dict[RunKey, Row] = {}
        try:
            if fresh or not self.path.exists() or not self._load():
                self._begin()
        except OSError as error:
            raise ConfigError(
                f"--out: expected a folder that can be written, got {str(folder)!r} "
                f"({error.strerror or error}); try another one"
            ) from error

    def _begin(self) -> None:
        (self.folder / SERIES_NAME).mkdir(parents=True, exist_ok=True)
        for old in (self.folder / SERIES_NAME).glob("*.npz"):
            old.unlink()
        self.path.write_text(_line({"settings": self.settings}), encoding="utf-8")

    def __contains__(self, key: object) -> bool:
        return key in self._rows

    def __getitem__(self, key: RunKey) -> Row:
        return self._rows[key]

    def __len__(self) -> int:
        return len(self._rows)

    def append(self, result: JobResult) -> None:
        """Write what came of a job; it is on disk when this returns."""
        if result.series:
            self._write_series(result)  # first: a row without its series would never get it
        with self.path.open("a", encoding="utf-8") as file:
            file.writelines(_line({"key": list(k), **_plain(r)}) for k, r in result.rows.items())
            file.flush()
            os.fsync(file.fileno())
        self._rows |= {key: _row(_plain(row)) for key, row in result.rows.items()}

    def _write_series(self, result: JobResult) -> None:
        job = result.job
        name = digest(repr((job.source.id, job.grade_name, job.seeds, job.methods)))
        methods = list(result.series)
        header: dict[str, Any] = {"source": job.source.id, "grade": job.grade_name}
        header |= {"seeds": list(job.seeds), "methods": methods}
        arrays: dict[str, Any] = {
            f"m{i}": result.series[method].astype(np.float32) for i, method in enumerate(methods)
        }
        path = self.folder / SERIES_NAME / f"{name}.npz"
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.with_suffix(".part").open("wb") as file:
            np.savez_compressed(file, header=np.array(json.dumps(header)), **arrays)
        path.with_suffix(".part").replace(path)

    def samples(self) -> dict[RunKey, Array]:
        """Return the errors over time (T, 3) of all runs that have any."""
        found: dict[RunKey, Array] = {}
        for path in sorted((self.folder / SERIES_NAME).glob("*.npz")):
            with np.load(path) as file:
                header = json.loads(str(file["header"]))
                for i, method in enumerate(header["methods"]):
                    samples = file[f"m{i}"].astype(np.float64)
                    for seed, sample in zip(header["seeds"], samples, strict=True):
                        found[RunKey(header["source"], header["grade"], seed, method)] = sample
        return {key: sample for key, sample in found.items() if key in self._rows}

    def _load(self) -> bool:
        """Read what is there; False if not even the first line is whole."""
        text = self.path.read_text(encoding="utf-8")
        # What follows the last line break was being written when the study was stopped.
        whole, _, torn = text.rpartition("\n")
        if not whole:
            return False
        header, *lines = [self._parse(i, line) for i, line in enumerate(whole.split("\n"), 1)]
        self._check(header.get("settings"))
        for values in lines:
            key = RunKey(*values.pop("key"))
            if values["status"] != LOST:  # another try may go better
                self._rows[key] = _row(values)
        if torn:
            self.path.write_text(whole + "\n", encoding="utf-8")
        return True

    def _parse(self, number: int, line: str) -> dict[str, Any]:
        try:
            values = json.loads(line)
        except json.JSONDecodeError as error:
            raise DataError(
                f"{self.path}, line {number}: expected a JSON object, got {line[:40]!r}; "
                "only the last line may be damaged, use --fresh to begin anew"
            ) from error
        return dict(values)

    def _check(self, found: dict[str, Any] | None) -> None:
        if found == self.settings:
            return
        found = found or {}
        differing = [
            f"{name}: expected {self.settings.get(name)!r}, got {found.get(name)!r}"
            for name in sorted(found.keys() | self.settings.keys())
            if self.settings.get(name) != found.get(name)
        ]
        raise ConfigError(
            f"{self.path}: made with other settings ({'; '.join(differing)}); "
            "use --fresh to throw it away, or another --out"
        )


def gather_series(
    samples: Mapping[RunKey, Array], rows: Mapping[RunKey, Row]
) -> dict[tuple[str, str, str], Series]:
    """Return the errors over time by case, grade and method, in the order of ``rows``."""
    groups: dict[tuple[str, str, str], list[Array]] = {}
    for key, row in rows.items():
        if key in samples:
            name = (str(row["case"]), key.grade, key.method)
            groups.setdefault(name, []).append(samples[key])
    result = {}
    for name, group in groups.items():
        runs = np.stack(group)
        time_s = SERIES_STEP_S * np.arange(runs.shape[1], dtype=np.float64)
        result[name] = Series(time_s, runs[..., 0], runs[..., 1], runs[..., 2])
    return result


def _plain(row: Row) -> dict[str, Any]:
    """Return values for JSON, None instead of NaN."""
    return {
        name: None if isinstance(value, float) and not math.isfinite(value) else value
        for name, value in row.items()
    }


def _row(values: Mapping[str, Any]) -> Row:
    return {name: math.nan if value is None else value for name, value in values.items()}


def _line(values: dict[str, Any]) -> str:
    return json.dumps(values, allow_nan=False) + "\n"


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
    arrow = pyarrow_module("pyarrow")
    types = {name: arrow.float64() for name in COLUMNS}
    types |= {name: arrow.string() for name in TEXT_COLUMNS}
    types |= {name: arrow.int64() for name in COUNT_COLUMNS}
    columns = {
        name: arrow.array([row[name] for row in rows], types[name], from_pandas=True)
        for name in COLUMNS
    }
    pyarrow_module("pyarrow.parquet").write_table(arrow.table(columns), path)


def _cell(value: str | float) -> str:
    if isinstance(value, float):
        return "" if math.isnan(value) else repr(value)
    return str(value)
