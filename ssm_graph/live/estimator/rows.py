"""Rows in order of time that come in any order: appended fast, inserted where they are late."""

from __future__ import annotations

from typing import Final

import numpy as np

from ssm_graph.base.frozen import Array

_SPARE: Final = 1024


class TimedRows:
    """Rows of numbers sorted by the first one, the time; no time twice.

    ``width`` numbers stand beside the time; the first ``n_key`` tell rows of one time apart.
    """

    def __init__(self, width: int, *, n_key: int = 0) -> None:
        self._rows = np.empty((_SPARE, 1 + width))
        self._key = slice(0, 1 + n_key)
        self._begin = self._end = 0
        self.last_s = -np.inf
        """Time of the last row, minus infinity if there is none."""

    def __len__(self) -> int:
        return self._end - self._begin

    @property
    def all(self) -> Array:
        """All rows (N, 1 + width), time first."""
        return self._rows[self._begin : self._end]

    def add(self, row: Array) -> bool:
        """Add a row (1 + width,); return False, and leave it out, if its time is known."""
        if row[0] > self.last_s:
            self._make_room()
            self._rows[self._end] = row
            self._end += 1
            self.last_s = float(row[0])
            return True
        at, same = self.index(row[0]), self.index(row[0], after=True)
        if np.any(np.all(self.all[at:same, self._key] == row[self._key], axis=1)):
            return False
        self._rows = np.insert(self._rows, self._begin + at, row, axis=0)
        self._end += 1
        return True

    def index(self, time_s: float, *, after: bool = False) -> int:
        """Return how many rows lie before a time, or, with ``after``, not after it."""
        if time_s > self.last_s:
            return self._end - self._begin
        return int(self.all[:, 0].searchsorted(time_s, side="right" if after else "left"))

    def between(self, begin_s: float, end_s: float) -> Array:
        """Return the rows after ``begin_s`` up to and with ``end_s``."""
        return self.all[self.index(begin_s, after=True) : self.index(end_s, after=True)]

    def drop_before(self, time_s: float) -> None:
        """Forget the rows before a time."""
        self._begin += self.index(time_s)
        if self._begin == self._end:
            self.last_s = -np.inf

    def _make_room(self) -> None:
        if self._end < len(self._rows):
            return
        kept = self.all.copy()
        self._rows = np.empty((2 * len(kept) + _SPARE, self._rows.shape[1]))
        self._rows[: len(kept)] = kept
        self._begin, self._end = 0, len(kept)
