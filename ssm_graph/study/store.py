"""The files of a study.

One JSON line for every finished run, errors over time beside them, and one table of all.
"""

from __future__ import annotations

import csv
import io
import json
import math
import os
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from ssm_graph.base.errors import ConfigError
from ssm_graph.base.frozen import Array
from ssm_graph.base.settings import parse_json, shown
from ssm_graph.io.tables.append_file import sync_path, write_through
from ssm_graph.io.tables.files import TableFormat, pyarrow_module
from ssm_graph.study.cells import digest
from ssm_graph.study.jobs import JobResult, RunKey
from ssm_graph.study.json_lines import differing, line_of, object_of, with_nan, without_nan
from ssm_graph.study.scoring import COLUMNS, COUNT_COLUMNS, LOST, SERIES_STEP_S, TEXT_COLUMNS, Row

RUNS_NAME: Final = "runs.jsonl"
SERIES_NAME: Final = "series"
DAMAGED_NAME: Final = "runs.damaged.jsonl"
"""The whole file as it was found, where lines of it were damaged."""
LARGEST: Final = 1e300
"""No number of a run is larger."""


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

        What is damaged is named in :attr:`notes`, kept beside under another name, and counts as
        not done. Raises :class:`ConfigError`: the files were made with other settings, or the line
        that says with which is damaged.

        Parameters
        ----------
        folder : where ``runs.jsonl`` is, and the folder ``series``.
        settings : whatever must be the same for all runs of the file.
        fresh : throw old files away.
        """
        self.folder = folder
        self.path = folder / RUNS_NAME
        self.settings = settings
        self.notes: tuple[str, ...] = ()
        """What was damaged, one sentence each."""
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
        write_through(self.path, line_of({"settings": self.settings}).encode())

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
        rows = {key: without_nan(row) for key, row in result.rows.items()}
        with self.path.open("a", encoding="utf-8") as file:
            file.writelines(line_of({"key": list(key), **row}) for key, row in rows.items())
            file.flush()
            os.fsync(file.fileno())
        self._rows |= {key: with_nan(row) for key, row in rows.items()}

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
        content = io.BytesIO()
        np.savez_compressed(content, header=np.array(json.dumps(header)), **arrays)
        write_through(path.with_suffix(".part"), content.getvalue())
        path.with_suffix(".part").replace(path)
        sync_path(path.parent)

    def samples(self) -> dict[RunKey, Array]:
        """Return the errors over time (T, 3) of all runs that have any."""
        found, _ = self._read_series()
        return {key: sample for key, sample in found.items() if key in self._rows}

    def _read_series(self) -> tuple[dict[RunKey, Array], dict[Path, str]]:
        """Return what all sound files hold, and what is wrong with the others."""
        found: dict[RunKey, Array] = {}
        faults: dict[Path, str] = {}
        read = {}
        for path in sorted((self.folder / SERIES_NAME).glob("*.npz")):
            try:
                read[path] = _samples_of(path)
            except Exception as error:  # whatever a damaged archive makes NumPy raise
                faults[path] = str(error) or type(error).__name__
        lengths = Counter((*key[:2], len(x)) for one in read.values() for key, x in one.items())
        usual: dict[tuple[str, str], int] = {}
        for (source, grade, length), _ in reversed(lengths.most_common()):
            usual[source, grade] = length
        for path, samples in read.items():
            wrong = {len(x) for key, x in samples.items() if len(x) != usual[key[0], key[1]]}
            if wrong:
                faults[path] = f"of {wrong.pop()} times, unlike others of its missions"
            else:
                found |= samples
        return found, faults

    def _load(self) -> bool:
        """Read what is there; False if not even the first line is whole."""
        if not self.path.is_file():
            raise ConfigError(f"{self.path}: expected a file, got something else; remove it")
        content = self.path.read_bytes()
        # What follows the last line break was being written when the study was stopped.
        whole, _, torn = content.rpartition(b"\n")
        begin = b'{"settings": '
        if not whole and torn[: len(begin)] == begin[: len(torn)]:
            return False
        header, *lines = whole.split(b"\n")
        self._check(self._settings_of(header or torn))
        kept, bad = [header], []
        for number, line in enumerate(lines, 2):
            try:
                key, values = _run_of(line)
            except (ValueError, RecursionError) as error:  # of JSON or Unicode too
                bad.append(f"line {number}: {error}")
                continue
            kept.append(line)
            if values["status"] != LOST:  # another try may go better
                self._rows[key] = with_nan(values)
        if bad:
            write_through(self.folder / DAMAGED_NAME, content)
            self.notes += tuple(f"{self.path}, {text}; that run is done again" for text in bad)
        if bad or torn:
            part = self.path.with_name(f"{RUNS_NAME}.part")
            write_through(part, b"\n".join(kept) + b"\n")
            part.replace(self.path)
        self._leave_out_without_series()
        return True

    def _leave_out_without_series(self) -> None:
        """Have runs done again whose errors over time are damaged or gone."""
        found, faults = self._read_series()
        for path, text in faults.items():
            path.replace(path.with_suffix(".damaged"))
            self.notes += (f"{path}: {text}; its runs are done again",)
        gone = [key for key, row in self._rows.items() if not row["failed"] and key not in found]
        for key in gone:
            del self._rows[key]
        if gone and not faults:
            self.notes += (f"{len(gone)} runs whose file in {SERIES_NAME} is gone are done again",)

    def _settings_of(self, line: bytes) -> dict[str, Any]:
        try:
            settings = object_of(line).get("settings")
            if isinstance(settings, dict):
                return settings
        except (ValueError, RecursionError):
            pass
        raise ConfigError(
            f"{self.path}, line 1: expected the settings of a study, got {shown(line)}; without "
            "them nobody knows what the runs are of: use --fresh to throw them away, or another "
            "--out"
        )

    def _check(self, found: dict[str, Any]) -> None:
        if found == self.settings:
            return
        raise ConfigError(
            f"{self.path}: made with other settings ({differing(self.settings, found)}); "
            "use --fresh to throw it away, or another --out"
        )


def _run_of(line: bytes) -> tuple[RunKey, dict[str, Any]]:
    """Return one finished run; raise :class:`ValueError` that says what it lacks."""
    values = object_of(line)
    parts = values.pop("key", None)
    kinds = (str, str, int, str)
    is_key = isinstance(parts, list) and [type(part) for part in parts] == list(kinds)
    if not is_key:
        raise ValueError(f"expected a key of source, grade, seed and method, got {shown(parts)}")
    key = RunKey(*parts)
    for name in COLUMNS:
        value = values.get(name, values)
        if name in TEXT_COLUMNS:
            is_good = isinstance(value, str)
        elif name in COUNT_COLUMNS:
            is_good = type(value) is int
        else:
            is_good = value is None or (type(value) in (int, float) and abs(value) <= LARGEST)
        if not is_good:
            got = "nothing" if value is values else shown(value)
            raise ValueError(f"column {name!r}: expected a value of its kind, got {got}")
    if (values["grade"], values["seed"], values["method"]) != (key.grade, key.seed, key.method):
        raise ValueError(f"the key {shown(parts)} is that of another run")
    return key, values


def _samples_of(path: Path) -> dict[RunKey, Array]:
    """Return the errors over time (T, 3) of the runs of one file; raise where it is damaged."""
    found: dict[RunKey, Array] = {}
    with path.open("rb") as stream, np.load(stream) as file:
        header = parse_json(str(file["header"]))
        for i, method in enumerate(header["methods"]):
            samples = file[f"m{i}"].astype(np.float64)
            if samples.ndim != 3 or samples.shape[2] != 3 or not samples.shape[1]:
                raise ValueError(f"expected arrays (runs, times, 3), got {samples.shape}")
            for seed, sample in zip(header["seeds"], samples, strict=True):
                key = RunKey(header["source"], header["grade"], seed, method)
                if [type(part) for part in key] != [str, str, int, str]:
                    raise ValueError(f"expected names and seeds, got {shown(tuple(key))}")
                found[key] = sample
    return found


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
