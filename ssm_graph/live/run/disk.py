"""What the thread that navigates does not wait for: threads that bring files to the disk."""

from __future__ import annotations

import contextlib
import copy
import ctypes
import sys
import threading
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ssm_graph.base.frozen import Array
from ssm_graph.io.tables.append_file import sync_path
from ssm_graph.io.tables.checkpoint import CHECKPOINT_NAME, write_checkpoint

_TRIM = getattr(ctypes.CDLL(None), "malloc_trim", None) if sys.platform == "linux" else None


class _DiskThread:
    """Does one thing at a time in a thread of its own."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._thread: threading.Thread | None = None
        self._error: Exception | None = None

    @property
    def is_busy(self) -> bool:
        """Whether the last thing is still on its way to the disk."""
        return self._thread is not None and self._thread.is_alive()

    def wait(self) -> None:
        """Wait for the disk."""
        if self._thread is not None:
            self._thread.join()
            self._thread = None

    def take_error(self) -> Exception | None:
        """Return why the last thing could not be done, once."""
        error, self._error = self._error, None
        return error

    def _begin(self, work: Callable[[], None]) -> None:
        assert not self.is_busy
        self._thread = threading.Thread(target=self._do, args=(work,), name=self._name)
        self._thread.start()

    def _do(self, work: Callable[[], None]) -> None:
        try:
            work()
        except Exception as error:  # told by the thread that navigates
            self._error = error


class Syncer(_DiskThread):
    """Brings all files of a folder to the disk: a power failure takes what came since."""

    def __init__(self, folder: Path) -> None:
        super().__init__("sync")
        self._folder = folder

        self.problem: str | None = None
        """Why the disk did not take all the last time, if so."""

    def begin(self) -> None:
        """Begin, unless the disk is not done with the last time."""
        if not self.is_busy:
            error = self.take_error()
            self.problem = None if error is None else f"the disk does not confirm the log ({error})"
            self._begin(lambda: _sync(_files(self._folder)))


class CheckpointWriter(_DiskThread):
    """Writes checkpoints to a folder.

    The files of ``log``, and others that are ``synced``, have to be on the disk before a checkpoint
    that counts on them. What memory is free after one is given back to the system: glibc would keep
    what floods and checkpoints took for a moment, which is several MB after an hour of storms.
    """

    def __init__(self, folder: Path, log: Path, synced: Iterable[Path]) -> None:
        super().__init__("checkpoint")
        self._path, self._log, self._synced = folder / CHECKPOINT_NAME, log, list(synced)

    def write(self, arrays: Mapping[str, Array], meta: Mapping[str, Any]) -> None:
        """Begin to write a checkpoint; what it holds is copied first. Not while busy."""
        own = {name: np.array(array) for name, array in arrays.items()}
        own_meta = copy.deepcopy(dict(meta))

        def work() -> None:
            _sync([*_files(self._log), *self._synced])
            write_checkpoint(self._path, own, own_meta)
            own.clear()
            if _TRIM is not None:
                _TRIM(0)

        self._begin(work)


def _files(folder: Path) -> list[Path]:
    """Return the files of a folder; none where it was removed."""
    try:
        return [path for path in sorted(folder.iterdir()) if path.is_file()]
    except FileNotFoundError:
        return []


def _sync(paths: Iterable[Path]) -> None:
    for path in paths:
        with contextlib.suppress(FileNotFoundError):
            sync_path(path)
