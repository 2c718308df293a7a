"""The path while it comes: a row an image, written at once, so that it is there when killed."""

from __future__ import annotations

from pathlib import Path
from types import TracebackType
from typing import Final, Self

import numpy as np
from scipy.spatial.transform import Rotation

from ssm_graph.io.tables.append_file import AppendFile
from ssm_graph.systems.visual_ranges.result import FrameNow

NAME: Final = "as_it_came.csv"
HEAD: Final = b"time_s,x,y,z,qx,qy,qz,qw,m_per_map_unit\n"


class PathAsItComes:
    """Poses of the camera in map units, camera to map, with the scale as it was known then.

    The file is there from the first row on. Where the disc is full the run goes on, and
    ``failure`` says so.
    """

    def __init__(self, folder: Path) -> None:
        self.path, self.failure = folder / NAME, ""
        self._file: AppendFile | None = None

    def append(self, now: FrameNow) -> None:
        """Write one row."""
        if self.failure:
            return
        centre = -now.R_cw.T @ now.t_cw
        turn = Rotation.from_matrix(now.R_cw.T).as_quat()
        row = np.concatenate([[now.time_s], centre, turn, [now.scale]])
        try:
            if self._file is None:
                self._file = self._begun()
            self._file.append((",".join(f"{x:.9g}" for x in row) + "\n").encode())
        except OSError as error:
            self.failure = error.strerror or str(error)

    def _begun(self) -> AppendFile:
        self.path.parent.mkdir(parents=True, exist_ok=True)
        self.path.unlink(missing_ok=True)
        file = AppendFile(self.path, ending=b"\n")
        file.append(HEAD)
        return file

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._file is not None:
            self._file.close()
