"""By how much the vehicle's clock was set, remembered from process to process of a run.

``clock.csv`` has a row for the begin of each process and for every time that the clock was set.
Within one start of the computer its steady clock goes on, so that a process that follows knows the
time of the run whatever the vehicle's clock was set to between the two.
"""

from __future__ import annotations

import contextlib
import math
from pathlib import Path
from typing import Final

from ssm_graph.io.tables.append_file import TORN_ROW, AppendFile

CLOCK_NAME: Final = "clock.csv"
_HEAD: Final = b"time_s,set_by_s,steady_s,boot\n"
_SMALL_S: Final = 0.05
"""What two clocks that are read one after the other may differ by."""
_BOOT_ID: Final = Path("/proc/sys/kernel/random/boot_id")


def boot_id() -> str:
    """Return what names this start of the computer; nothing where the system does not say."""
    with contextlib.suppress(OSError):
        return _BOOT_ID.read_text(encoding="ascii").strip()
    return ""


class ClockFile:
    """The file of one run. Raises nothing: without it the run begins with the vehicle's clock."""

    def __init__(self, folder: Path, boot: str | None = None) -> None:
        """``boot`` names the start of the computer, found out when left out."""
        self._path = folder / CLOCK_NAME
        self._boot = boot_id() if boot is None else boot

    def set_by_s(self, wall_s: float, steady_s: float) -> float:
        """Return how far the vehicle's clock is ahead of the time of the run now, s.

        That is 0 for a new run, and for one of an earlier start of the computer.
        """
        found: float | None = None
        with contextlib.suppress(OSError):
            for line in self._path.read_bytes().splitlines():
                cells = line.decode("ascii", "replace").split(",")
                if len(cells) == len(_HEAD.split(b",")) and cells[3] == self._boot:
                    with contextlib.suppress(ValueError):
                        begun_s = float(cells[0]) - float(cells[2])
                        found = begun_s if math.isfinite(begun_s) else found
        if found is None or not self._boot:
            return 0.0
        ahead_s = wall_s - (steady_s + found)
        return ahead_s if abs(ahead_s) > _SMALL_S else 0.0

    def note(self, time_s: float, set_by_s: float, steady_s: float) -> str | None:
        """Write one row; return why it could not be.

        Parameters
        ----------
        time_s : of the run.
        set_by_s : by how much the vehicle's clock is ahead of it.
        steady_s : on a clock that is never set while the computer runs.
        """
        row = f"{time_s!r},{set_by_s!r},{steady_s!r},{self._boot}\n".encode()
        try:
            file = AppendFile(self._path, ending=TORN_ROW)
            try:  # a power failure ends the start of the computer that it is about: no sync
                file.append(row if file.size else _HEAD + row)
            finally:
                file.close()
        except OSError as error:
            return f"{CLOCK_NAME} cannot be written: {error.strerror or error}"
        return None
