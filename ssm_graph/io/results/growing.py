"""A result folder that grows while the run goes on."""

from __future__ import annotations

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
from ssm_graph.io.tables.append_file import TORN_ROW, AppendFile
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
        self._files: dict[str, AppendFile] = {}
        try:
            folder.mkdir(parents=True, exist_ok=True)
            (folder / SUMMARY_NAME).unlink(missing_ok=True)
            beside = CURRENT_COLUMNS if has_current else ()
            for name, columns in (HEADERS | {TRAJECTORY_NAME: TRAJECTORY_COLUMNS + beside}).items():
                file = self._files[name] = AppendFile(folder / name, ending=TORN_ROW)
                file.cut((sizes or {}).get(name, 0))
                if file.size == 0:
                    file.append((",".join(columns) + "\n").encode())
        except OSError as error:
            self.close()
            raise DataError(f"{folder}: cannot write results: {error.strerror or error}") from error

    def sizes(self) -> dict[str, int]:
        """Return how large the files are, bytes, for a checkpoint."""
        return {name: file.size for name, file in self._files.items()}

    def append(
        self, trajectory: Trajectory, beams: BeamTable, current: CurrentTrack | None = None
    ) -> None:
        """Add rows; what the disk does not take waits for the next time."""
        self._waiting[TRAJECTORY_NAME] += _rows(
            trajectory_columns(trajectory) | current_columns(current)
        )
        self._waiting[BEAMS_NAME] += _rows(beam_columns(beams))
        self._write_waiting()

    def _write_waiting(self) -> None:
        self.problem = None
        for name, text in self._waiting.items():
            try:
                if text:
                    self._files[name].append(text.encode())
                    self._waiting[name] = ""
            except OSError as error:
                path = self._folder / name
                self.problem = f"{path}: cannot be written: {error.strerror or error}"

    def finish(self, summary: Mapping[str, Any]) -> None:
        """Write what waits, and ``summary.json``, which makes the folder complete.

        Raises
        ------
        DataError
            It cannot be written.
        """
        self._write_waiting()
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

    def close(self) -> None:
        """Close the files; a second time does nothing."""
        for file in self._files.values():
            file.close()


def _rows(columns: Columns) -> str:
    return format_table(columns).partition("\n")[2]
