"""A file that grows by whole records and never keeps half of one between two others."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path
from typing import Final

TORN_ROW: Final = b",torn\n"
"""Ends a torn row of a table: with a word in it, no number of cells makes it a whole one."""
_BLOCK: Final = 65536


class AppendFile:
    """Append records without any buffer of this process: what is appended survives ``kill -9``.

    A record that the system takes only in part (disk full) is taken back. Where that is refused
    too, and where another process was killed amid its last record, the next record is preceded by
    ``ending``, which must make a line of what was torn that nobody takes for a whole one.
    """

    def __init__(self, path: Path, *, ending: bytes) -> None:
        self._file = os.open(path, os.O_RDWR | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC, 0o644)
        self._ending = ending
        self.name = path.name
        self.size = os.fstat(self._file).st_size
        """Bytes in the file."""
        self._is_torn = self.size > 0 and os.pread(self._file, 1, self.size - 1) != b"\n"

    def append(self, record: bytes) -> None:
        """Append the whole record with one write, or raise :class:`OSError` and append nothing."""
        data = self._ending + record if self._is_torn else record
        written = 0
        try:
            while written < len(data):  # the second round of a short write says why it was short
                written += os.write(self._file, data[written:] if written else data)
        except OSError:
            self._take_back()
            raise
        self.size += written
        self._is_torn = False

    def cut(self, size: int) -> None:
        """Delete what is beyond a size, bytes, and the record that would be torn there."""
        size = min(size, self.size)
        while size > 0:
            begin = max(size - _BLOCK, 0)
            whole = os.pread(self._file, size - begin, begin).rfind(b"\n") + 1
            size = begin + whole
            if whole > 0:
                break
        os.ftruncate(self._file, size)
        self.size, self._is_torn = size, False

    def sync(self) -> None:
        """Wait until the content is on the disk."""
        os.fsync(self._file)

    def close(self) -> None:
        """Close the file; a second time does nothing."""
        if self._file >= 0:
            os.close(self._file)
            self._file = -1

    def _take_back(self) -> None:
        with contextlib.suppress(OSError):
            os.ftruncate(self._file, self.size)
        with contextlib.suppress(OSError):
            size = os.fstat(self._file).st_size
            self._is_torn = self._is_torn or size != self.size
            self.size = size


def write_through(path: Path, content: bytes) -> None:
    """Write a file; it is on the disk when this returns."""
    with path.open("wb") as stream:
        stream.write(content)
        stream.flush()
        os.fsync(stream.fileno())


def sync_path(path: Path) -> None:
    """Wait until a file's content, or the names of a folder's files, are on the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
