"""Trials of any kind, done by processes and kept one by one, so that a long study goes on.

A trial is a key of words and numbers; a function of the key alone makes its row. What is done is a
line of a file at once; the same call again does only what is missing.
"""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import Any

from ssm_graph.base.code_version import code_version
from ssm_graph.base.errors import ConfigError, SsmGraphError
from ssm_graph.base.settings import shown
from ssm_graph.io.tables.append_file import write_through
from ssm_graph.study.jobs import one_blas_thread
from ssm_graph.study.json_lines import differing, line_of, object_of, with_nan, without_nan

Key = tuple[str | int | float, ...]
Row = Mapping[str, Any]
Do = Callable[[Key], Row]
"""Does a trial: a function of a module, so that another process finds it by its name."""
ERROR = "error"
"""Column of a row that came to nothing: what was said."""


class Ledger:
    """Rows of finished trials in a file of JSON lines; the first one holds what made them.

    Lines that are damaged are named in :attr:`notes`, the file as it was is kept beside
    (``.damaged``), and their trials count as not done.
    """

    def __init__(self, path: Path, settings: Mapping[str, Any], *, fresh: bool = False) -> None:
        """Open or create the file.

        Parameters
        ----------
        path : of the file; its folder is made where it is missing.
        settings : whatever must be the same for all trials; the code's version comes to it.
        fresh : throw an old file away.

        Raises :class:`ConfigError` where the file was made with other settings or by other code,
        or cannot be written.
        """
        self.path = path
        self.settings = {**settings, "code": code_version()}
        self.notes: tuple[str, ...] = ()
        self._rows: dict[Key, Row] = {}
        try:
            if path.exists() and not fresh:
                self._load()
            else:
                path.parent.mkdir(parents=True, exist_ok=True)
                write_through(path, line_of({"settings": self.settings}).encode())
        except OSError as error:
            raise ConfigError(
                f"{path}: expected a file that can be written, got {error.strerror or error}; "
                "try another folder"
            ) from error

    def __len__(self) -> int:
        return len(self._rows)

    def __contains__(self, key: object) -> bool:
        return key in self._rows

    def __getitem__(self, key: Key) -> Row:
        return self._rows[key]

    def append(self, key: Key, row: Row) -> None:
        """Write a row; it is on disk when this returns."""
        with self.path.open("a", encoding="utf-8") as file:
            file.write(line_of({"key": list(key), "row": without_nan(row)}))
            file.flush()
            os.fsync(file.fileno())
        self._rows[key] = with_nan(without_nan(row))

    def _load(self) -> None:
        content = self.path.read_bytes()
        whole, _, torn = content.rpartition(b"\n")
        header, *lines = whole.split(b"\n")
        try:
            found = dict(object_of(header)["settings"])
        except (ValueError, TypeError, KeyError, RecursionError) as error:
            raise ConfigError(
                f"{self.path}, line 1: expected the settings of a study, got {shown(header)}; "
                "start afresh to throw it away, or choose another folder"
            ) from error
        if found != self.settings:
            told = differing(self.settings, found)
            raise ConfigError(
                f"{self.path}: made with other settings ({told}); start afresh to throw it away, "
                "or choose another folder"
            )
        kept = [header]
        for number, line in enumerate(lines, 2):
            try:
                values = object_of(line)
                key, row = _key_of(values["key"]), dict(values["row"])
            except (ValueError, TypeError, KeyError, RecursionError):
                self.notes += (f"{self.path}, line {number}: damaged; that trial is done again",)
                continue
            kept.append(line)
            self._rows[key] = with_nan(row)
        if self.notes or torn:
            if self.notes:
                write_through(self.path.with_suffix(".damaged"), content)
            part = self.path.with_suffix(".part")
            write_through(part, b"\n".join(kept) + b"\n")
            part.replace(self.path)


def _key_of(value: object) -> Key:
    """Return a trial's key as it was written; raise :class:`TypeError` for what is none."""
    if not (isinstance(value, list) and all(isinstance(x, str | int | float) for x in value)):
        raise TypeError
    return tuple(value)


def run_trials(
    do: Do,
    keys: Sequence[Key],
    ledger: Ledger,
    *,
    n_jobs: int = 1,
    on_progress: Callable[[int, int, Key], None] | None = None,
) -> dict[Key, Row]:
    """Do the trials that the ledger lacks and return the rows of all keys, in their order.

    A trial that raises an error of this package, or of arithmetic, becomes a row with the column
    `ERROR`; a defect ends the study, what is done is kept.

    Parameters
    ----------
    do : a function of the key alone; it draws its random numbers from what is in the key.
    keys : of all trials.
    n_jobs : processes; 1 does them here.
    on_progress : called after each with the number done, the number wanted and the key.
    """
    missing = [key for key in keys if key not in ledger]
    for count, (key, row) in enumerate(_done(do, missing, n_jobs), 1):
        ledger.append(key, row)
        if on_progress is not None:
            on_progress(count, len(missing), key)
    return {key: ledger[key] for key in keys}


def _attempt(do: Do, key: Key) -> Row:
    try:
        return do(key)
    except (SsmGraphError, ArithmeticError) as error:
        return {ERROR: str(error) or type(error).__name__}


def _done(do: Do, keys: Sequence[Key], n_jobs: int) -> Iterator[tuple[Key, Row]]:
    if n_jobs < 1:
        raise ConfigError(f"--jobs: expected 1 or more processes, got {n_jobs}; try 2")
    if n_jobs == 1 or len(keys) < 2:
        for key in keys:
            yield key, _attempt(do, key)
        return
    context = multiprocessing.get_context("spawn")
    with one_blas_thread(), ProcessPoolExecutor(min(n_jobs, len(keys)), context) as pool:
        futures = {pool.submit(_attempt, do, key): key for key in keys}
        try:
            for future in as_completed(futures):
                yield futures[future], future.result()
        except BrokenProcessPool as error:
            raise SsmGraphError(
                "--jobs: a process ended without a result; is there memory for so many? try "
                "--jobs 1; what is done is kept"
            ) from error
        finally:
            pool.shutdown(wait=False, cancel_futures=True)
