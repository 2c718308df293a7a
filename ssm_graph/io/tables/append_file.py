"""A file that grows by whole records and never keeps half of one between two others."""

from __future__ import annotations

import contextlib
import errno
import os
import stat
from itertools import count
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
        self.path, self.name, self._ending = path, path.name, ending
        self.problem: str | None = None
        """Why it could not be gone on with where it was removed or replaced, if so."""
        self._begin(_opened(path))

    def _begin(self, file: int) -> None:
        self._file = file
        self.size = os.fstat(file).st_size
        """Bytes in the file."""
        self._is_torn = self.size > 0 and os.pread(file, 1, self.size - 1) != b"\n"

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

    def regain(self, head: bytes = b"") -> str | None:
        """Go on in what is at the path now, where somebody removed, replaced or changed the file.

        Return what was done to it, None where nothing was. What does not begin with ``head``, and
        what is no file, is renamed, ``imu.csv.aside``. Where that cannot be either, records go on
        into the file that was there before, and :attr:`problem` says so.
        """
        self.problem = None
        what = self._altered()
        if what is None:
            return None
        try:
            if not _begins(self.path, head):
                aside = free_name(self.path)
                self.path.rename(aside)
                what += f", what was found there is {aside.name} now"
            file = _opened(self.path)
        except OSError as error:
            self.problem = f"{self.path} {what}, and cannot be gone on with: {error.strerror}"
            return None
        os.close(self._file)
        self._begin(file)
        return f"{self.path} {what}; from now on it is written from {self.size} bytes on"

    def _altered(self) -> str | None:
        """Return what somebody did to the file, None where it is as it was left."""
        own = os.fstat(self._file)
        try:
            found = os.stat(self.path)
        except OSError as error:
            gone = "was removed or moved" if error.errno == errno.ENOENT else "cannot be reached"
            return f"{gone} at {self.size} bytes"
        if (found.st_dev, found.st_ino) != (own.st_dev, own.st_ino):
            return f"was replaced by another file at {self.size} bytes"
        if own.st_size != self.size:
            return f"was changed by somebody else, from {self.size} to {own.st_size} bytes"
        return None

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


def _begins(path: Path, head: bytes) -> bool:
    """Return whether there is nothing, or a file that begins so."""
    try:
        if not stat.S_ISREG(path.stat().st_mode):
            return False
    except FileNotFoundError:
        return True
    with path.open("rb") as stream:
        return head.startswith(stream.read(len(head)))


def free_name(path: Path) -> Path:
    """Return a name beside a path for what stands in its way."""
    names = (path.with_name(f"{path.name}.aside{k or ''}") for k in count())
    return next(name for name in names if not name.exists())


def _opened(path: Path) -> int:
    """Return a file to append to, made if it is not there; what is no regular file is refused."""
    flags = os.O_RDWR | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC | getattr(os, "O_NONBLOCK", 0)
    file = os.open(path, flags, 0o644)
    if not stat.S_ISREG(os.fstat(file).st_mode):
        os.close(file)
        raise OSError(errno.EINVAL, "expected a regular file", str(path))
    return file


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
