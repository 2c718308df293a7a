"""Checkpoints written aside, so that a slow disk does not hold up who navigates."""

from __future__ import annotations

import contextlib
import copy
import os
import threading
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ssm_graph.base.frozen import Array
from ssm_graph.io.tables.checkpoint import CHECKPOINT_NAME, write_checkpoint


class CheckpointWriter:
    """Writes one checkpoint at a time in a thread of its own.

    Parameters
    ----------
    folder : where they go.
    synced : files that have to be on the disk before the checkpoint that counts on them.
    """

    def __init__(self, folder: Path, synced: Sequence[Path] = ()) -> None:
        self._path = folder / CHECKPOINT_NAME
        self._synced = synced
        self._thread: threading.Thread | None = None
        self._error: Exception | None = None

    @property
    def is_busy(self) -> bool:
        """Whether the last one is still on its way to the disk."""
        return self._thread is not None and self._thread.is_alive()

    def write(self, arrays: Mapping[str, Array], meta: Mapping[str, Any]) -> None:
        """Begin to write a checkpoint; what it holds is copied first. Not while busy."""
        assert not self.is_busy
        own = {name: np.array(array) for name, array in arrays.items()}
        self._thread = threading.Thread(
            target=self._write, args=(own, copy.deepcopy(dict(meta))), name="checkpoint"
        )
        self._thread.start()

    def wait(self) -> None:
        """Wait for the disk."""
        if self._thread is not None:
            self._thread.join()
            self._thread = None

    def take_error(self) -> Exception | None:
        """Return why the last one could not be written, once."""
        error, self._error = self._error, None
        return error

    def _write(self, arrays: dict[str, Array], meta: dict[str, Any]) -> None:
        try:
            for path in self._synced:
                _sync(path)
            write_checkpoint(self._path, arrays, meta)
        except Exception as error:  # told by the thread that navigates
            self._error = error


def _sync(path: Path) -> None:
    with contextlib.suppress(FileNotFoundError):
        file = os.open(path, os.O_RDONLY)
        try:
            os.fsync(file)
        finally:
            os.close(file)
