"""Where output goes, looked at before the work: can it be written, and does it destroy nothing."""

from __future__ import annotations

import contextlib
import os
import shutil
from pathlib import Path
from typing import Final

from ssm_graph.base.errors import ConfigError
from ssm_graph.io.mission_folder.toml import TOML_NAME

RUN_NAME: Final = "run.json"
"""Makes a folder that of a live run."""
SUMMARY_NAME: Final = "summary.json"
FIGURE_NAME: Final = "figure.png"
PAGE_NAME: Final = "report.html"
"""Of ``ssm-graph report``; new results make an old one untrue, and it goes."""
FIGURES: Final = {kind: f"figure.{kind}" for kind in ("png", "pdf", "svg")}
DRAWN: Final = (*FIGURES.values(), PAGE_NAME)
"""What earlier results may have left, which new ones make untrue."""
_OF_SETS: Final = (".csv", ".parquet", ".toml", ".json", ".jsonl", ".npz")
"""Of tables and settings that belong together."""
LEAST_FREE: Final = 2**20
"""Bytes below which a disk is full."""
_PROBE: Final = ".trajectory.csv.part-4194304"
"""As long as the longest name that is written."""


def check_is_for_results(folder: Path) -> None:
    """Refuse a folder that holds a mission or a live run: results there would be over its files.

    Raises :class:`ConfigError`.
    """
    for name, what in ((TOML_NAME, "a mission"), (RUN_NAME, "a live run")):
        if (folder / name).exists():
            raise ConfigError(
                f"{str(folder)!r}: expected a folder for results, got that of {what} ({name}); "
                "give another folder, or one within it"
            )


def check_output_file(path: Path, *sources: Path) -> None:
    """Refuse a file for output over one that was read, or over one of a mission, run or result.

    Raises :class:`ConfigError`.
    """
    if not path.exists():
        return
    for source in sources:
        if source.exists() and path.samefile(source):
            raise ConfigError(f"--out: {path} is what is read; give another name")
    folder = path.resolve().parent
    sets = ((TOML_NAME, "a mission"), (RUN_NAME, "a live run"), (SUMMARY_NAME, "a result"))
    for name, what in sets:
        if path.suffix in _OF_SETS and (folder / name).exists():
            raise ConfigError(
                f"--out: {path} is there already, a file of {what} ({name} is beside it); give "
                "another name"
            )


def check_place(folder: Path) -> None:
    """Refuse a folder that cannot be made or written, by trying; nothing is left of that.

    Raises :class:`ConfigError`, which names the cause.
    """
    made: list[Path] = []
    try:
        if folder.exists() and not folder.is_dir():
            raise ConfigError(f"--out: expected a folder, got the file {str(folder)!r}")
        _make(folder, made)
        probe = folder / _PROBE
        probe.write_bytes(b"")
        probe.unlink()
        free = shutil.disk_usage(folder).free
    except OSError as error:
        raise ConfigError(
            f"--out: expected a folder that can be written, got {str(folder)!r} "
            f"({error.strerror or error}); give another"
        ) from error
    finally:
        for path in reversed(made):
            with contextlib.suppress(OSError):
                path.rmdir()
    if free < LEAST_FREE:
        raise ConfigError(
            f"--out: {str(folder)!r} is on a disk with {free} bytes left, expected {LEAST_FREE}; "
            "make room, or give another"
        )


def check_result_place(folder: Path) -> None:
    """Look at a folder for results: can it be written, and is it that of nothing else."""
    check_place(folder)
    check_is_for_results(folder)


def check_is_free(folder: Path, *, may_overwrite: bool) -> None:
    """Refuse a folder that has something in it, unless that may be overwritten.

    Raises :class:`ConfigError`; a live run is never overwritten.
    """
    check_place(folder)
    if (folder / RUN_NAME).exists():
        check_is_for_results(folder)
    if folder.is_dir() and os.listdir(folder) and not may_overwrite:
        raise ConfigError(
            f"--out: expected a new or empty folder, got {str(folder)!r} with "
            f"{sorted(os.listdir(folder))[0]!r} in it; give another, or --overwrite"
        )


def _make(folder: Path, made: list[Path]) -> None:
    """Make a folder and those above it; note each."""
    missing = [path for path in (folder, *folder.parents) if not path.exists()]
    for path in reversed(missing):
        path.mkdir()
        made.append(path)
