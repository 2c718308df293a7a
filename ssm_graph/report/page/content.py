"""What a page tells of one result: the tables of its folder, as arrays and plain values."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np

from ssm_graph.base.earth import LocalFrame
from ssm_graph.base.frozen import Array
from ssm_graph.evaluation.errors import ErrorSeries

Z95: Final = 1.9600
"""Half-width that holds 95 % of a normal error, in sigmas."""


@dataclass(frozen=True, slots=True, eq=False)
class Content:
    """A result as the page needs it; columns go by the names of the result's tables."""

    trajectory: Mapping[str, Array]
    beams: Mapping[str, Array]
    summary: Mapping[str, Any]
    aids: Mapping[str, Any]
    """Columns of ``aids.csv``, words as lists; empty where there is none."""
    epoch_s: float | None
    """Unix time of ``time_s`` 0, s; None where nobody knows."""
    protection: Mapping[str, Array] = field(default_factory=dict)
    """Columns of ``protection.csv``, which live runs have; empty for others."""
    altitude: tuple[Array, Array] | None = None
    """Times (P,), s, and heights over the bottom (P,), m; None where nothing says."""
    errors: ErrorSeries | None = None
    """Against the mission's reference; None without one."""
    data: Sequence[tuple[str, ...]] = ()
    """Of each sensor of the mission, in words: name, rows, rate, jitter, gaps, s in gaps, what it
    reads."""

    @property
    def begin_s(self) -> float:
        """Of the trajectory, s on the mission's clock."""
        return float(self.trajectory["time_s"][0])

    @property
    def since_min(self) -> Array:
        """(N,) minutes since the first row."""
        return self.minutes(self.trajectory["time_s"])

    def minutes(self, time_s: Array) -> Array:
        """Return times of the mission's clock as minutes since its trajectory began."""
        return (np.asarray(time_s, dtype=np.float64) - self.begin_s) / 60.0

    @property
    def local_enu(self) -> Array:
        """(N, 3) m east, north and up of the first position."""
        rows = self.trajectory
        lat, lon = np.radians(rows["lat_deg"]), np.radians(rows["lon_deg"])
        frame = LocalFrame(float(lat[0]), float(lon[0]), float(rows["height_m"][0]))
        return frame.p_n_from_geodetic(lat, lon, rows["height_m"])

    @property
    def is_suspect(self) -> Any:
        """(N,) where a fault makes the answer doubtful."""
        return self.trajectory.get("suspect", np.zeros(len(self.since_min))) > 0.5

    @property
    def horizontal_sigma_m(self) -> Array:
        """(N,) root of the mean of the east and north variances: of a circle that is as large."""
        return np.asarray(np.sqrt(0.5) * self._distance_rms_m)

    @property
    def radius_95_m(self) -> Array:
        """(N,) m that hold the horizontal error in 95 % of all cases at least.

        So large is the circle round an error along one line, whose share inside is 95 %. Errors of
        the same mean square in both directions stay inside it in up to 97.9 %: the tables hold
        sigmas along east and north, not how the two errors go together.
        """
        return np.asarray(Z95 * self._distance_rms_m)

    @property
    def _distance_rms_m(self) -> Array:
        rows = self.trajectory
        return np.asarray(np.hypot(rows["sigma_east_m"], rows["sigma_north_m"]))
