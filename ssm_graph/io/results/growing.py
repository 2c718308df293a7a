"""A result folder that grows while the run goes on."""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from ssm_graph.base.errors import DataError
from ssm_graph.io.results.tables import (
    BEAM_COLUMNS,
    BEAMS_NAME,
    CURRENT_COLUMNS,
    SUMMARY_NAME,
    TRAJECTORY_COLUMNS,
    TRAJECTORY_NAME,
    Columns,
    beam_columns,
    current_columns,
    format_table,
    trajectory_columns,
)
from ssm_graph.mission.estimate import BeamTable, CurrentTrack, Trajectory

HEADERS: Final = {TRAJECTORY_NAME: TRAJECTORY_COLUMNS, BEAMS_NAME: BEAM_COLUMNS}


class GrowingResults:
    """Appends to ``trajectory.csv`` and ``beams.csv``; a restart continues where it was kept."""

    def __init__(
        self, folder: Path, *, sizes: Mapping[str, int] | None = None, has_current: bool = False
    ) -> None:
        """Begin in a folder, or go on at the sizes (bytes) that a checkpoint knew.

        With a current ``trajectory.csv`` has its columns, and all rows have one.

        Raises
        ------
        DataError
            The folder cannot be made or written.
        """
        self._folder = folder
        self.problem: str | None = None
        """Why the last rows are not on disk, if they are not."""
        self._waiting: dict[str, str] = dict.fromkeys(HEADERS, "")
        try:
            folder.mkdir(parents=True, exist_ok=True)
            (folder / SUMMARY_NAME).unlink(missing_ok=True)
            beside = CURRENT_COLUMNS if has_current else ()
            for name, columns in (HEADERS | {TRAJECTORY_NAME: TRAJECTORY_COLUMNS + beside}).items():
                size = (sizes or {}).get(name, 0)
                with (folder / name).open("ab") as stream:
                    stream.truncate(min(size, stream.tell()))
                    if stream.seek(0, os.SEEK_END) == 0:
                        stream.write((",".join(columns) + "\n").encode())
        except OSError as error:
            raise DataError(f"{folder}: cannot write results: {error.strerror or error}") from error

    def sizes(self) -> dict[str, int]:
        """Return how large the files are, for a checkpoint."""
        return {name: (self._folder / name).stat().st_size for name in HEADERS}

    def append(
        self, trajectory: Trajectory, beams: BeamTable, current: CurrentTrack | None = None
    ) -> None:
        """Add rows; what the disk does not take waits for the next time."""
        self._waiting[TRAJECTORY_NAME] += _rows(
            trajectory_columns(trajectory) | current_columns(current)
        )
        self._waiting[BEAMS_NAME] += _rows(beam_columns(beams))
        self.problem = None
        for name, text in self._waiting.items():
            if text:
                self._write(name, text)

    def _write(self, name: str, text: str) -> None:
        path, size = self._folder / name, 0
        try:
            size = path.stat().st_size
            with path.open("ab") as stream:
                stream.write(text.encode())
            self._waiting[name] = ""
        except OSError as error:
            self.problem = f"{path}: cannot be written: {error.strerror or error}"
            _truncate(path, size)

    def finish(self, summary: Mapping[str, Any]) -> None:
        """Write ``summary.json``, which makes the folder complete.

        Raises
        ------
        DataError
            It cannot be written.
        """
        text = json.dumps(summary, indent=2, allow_nan=False, ensure_ascii=False) + "\n"
        part = self._folder / f".{SUMMARY_NAME}.part-{os.getpid()}"
        try:
            part.write_text(text, encoding="utf-8")
            part.replace(self._folder / SUMMARY_NAME)
        except OSError as error:
            part.unlink(missing_ok=True)
            raise DataError(
                f"{self._folder / SUMMARY_NAME}: cannot be written: {error.strerror or error}"
            ) from error


def _rows(columns: Columns) -> str:
    return format_table(columns).partition("\n")[2]


def _truncate(path: Path, size: int) -> None:
    """Take back what was written in part."""
    with contextlib.suppress(OSError):  # the reader drops a torn last line
        os.truncate(path, size)
