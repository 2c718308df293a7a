"""A track as it is handed on: one result folder's trajectory, in SI units, with its calendar."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ssm_graph.base.earth import LocalFrame
from ssm_graph.base.errors import ConfigError, DataError
from ssm_graph.base.frames import R_lb_from_roll_pitch_heading
from ssm_graph.base.frozen import Array, FrozenArrays, optional_shaped, shaped
from ssm_graph.base.projection import Utm, utm
from ssm_graph.base.times import UNIX_FROM_S, UNIX_UNTIL_S
from ssm_graph.io.results.tables import Results

FRD_FROM_FLU: Final = np.diag([1.0, -1.0, -1.0])
_ENU: Final = ("east", "north", "up")


_LATEST_S: Final = 253_370_764_800.0
"""Unix time of the year 9999."""


@dataclass(frozen=True, slots=True, eq=False)
class Track(FrozenArrays):
    """Where the vehicle was, with sigmas; heights are above the ellipsoid."""

    name: str
    """Of the mission."""
    about: str
    """One line: method and status."""
    epoch_s: float | None
    """Unix time of ``time_s`` 0, s; None where nobody knows."""
    is_suspect: NDArray[np.bool_]
    """(N,) where a fault makes the answer doubtful"""
    time_s: Array = shaped("N")
    lat: Array = shaped("N")
    """(N,) rad"""
    lon: Array = shaped("N")
    """(N,) rad"""
    height: Array = shaped("N")
    """(N,) m"""
    velocity_enu: Array = shaped("N", 3)
    """(N, 3) m/s"""
    roll_pitch_heading: Array = shaped("N", 3)
    """(N, 3) rad, heading from north"""
    position_sigma_enu: Array = shaped("N", 3)
    """(N, 3) m"""
    velocity_sigma_enu: Array = shaped("N", 3)
    """(N, 3) m/s"""
    attitude_sigma: Array = shaped("N", 3)
    """(N, 3) rad, of roll, pitch and heading"""
    covariance: Array | None = optional_shaped("N", 9, 9)
    """(N, 9, 9) of position and velocity along east, north, up, and roll, pitch, heading; SI units;
    None if it was not asked for"""

    origin: LocalFrame | None = None
    """Of local metres; None for the first position."""

    @property
    def unix_s(self) -> Array:
        """(N,) Unix time, s; raises :class:`ConfigError` where the epoch is unknown."""
        if self.epoch_s is None:
            raise ConfigError(
                f"--epoch: this format needs UTC, and the times of {self.name!r} begin at "
                f"{self.time_s[0]:g} s, which is no Unix time; try --epoch 2026-05-01T10:00:00Z, "
                "the UTC of time_s = 0"
            )
        unix_s = self.time_s + self.epoch_s
        if not (unix_s[0] >= 0.0 and unix_s[-1] < _LATEST_S):
            raise ConfigError(
                f"--epoch: expected times within the years 1970 to 9998, got {unix_s[0]:.6g} to "
                f"{unix_s[-1]:.6g} s after 1970"
            )
        return unix_s

    @property
    def frame(self) -> LocalFrame:
        """East, north, up at the origin."""
        first = (float(column[0]) for column in (self.lat, self.lon, self.height))
        return self.origin or LocalFrame(*first)

    @property
    def local_enu(self) -> Array:
        """(N, 3) m along east, north and up of `frame`."""
        return self.frame.p_n_from_geodetic(self.lat, self.lon, self.height)

    @property
    def quaternion(self) -> Array:
        """(N, 4) x, y, z, w: turns the body axes forward, left, up (REP 103) into east, north, up.

        East, north, up are those at each position: of a mission's size they are those of `frame`.
        """
        from scipy.spatial.transform import Rotation

        turn = R_lb_from_roll_pitch_heading(*self.roll_pitch_heading.T) @ FRD_FROM_FLU
        return np.asarray(Rotation.from_matrix(turn).as_quat(canonical=True))

    @property
    def utm(self) -> Utm:
        """Easting and northing, all in the zone of the origin."""
        return utm(self.lat, self.lon, of=(self.frame.lat, self.frame.lon))

    def utc(self) -> list[str]:
        """Return ISO 8601 times of UTC with milliseconds."""
        return [
            datetime.fromtimestamp(round(t, 3), UTC).isoformat(timespec="milliseconds")[:-6] + "Z"
            for t in self.unix_s.tolist()
        ]


def track_of(
    results: Results,
    *,
    epoch_s: float | None = None,
    covariance: Array | None = None,
    origin: LocalFrame | None = None,
) -> Track:
    """Return the trajectory of a result folder.

    Parameters
    ----------
    results : as `read_results` returns them.
    epoch_s : Unix time of ``time_s`` 0, s; if None, times of 2001 and later are Unix time already.
    covariance : (N, 9, 9) of every row, see :class:`Track`.
    origin : of local metres and of the UTM zone; the first position when left out.

    Raises :class:`DataError` for a trajectory without a row or with a value that is not finite, and
    :class:`ConfigError` for an epoch beside times that are Unix time.
    """
    check_rows(results)
    rows = results.trajectory
    time_s = rows["time_s"]
    angles = np.radians(np.column_stack([rows[f"{n}_deg"] for n in ("roll", "pitch", "heading")]))
    sigmas = [rows[f"sigma_{name}_deg"] for name in ("roll", "pitch", "heading")]
    summary = results.summary
    return Track(
        name=str(summary.get("mission") or results.folder.name),
        about=f"{summary.get('method')}, {summary.get('status')}: {summary.get('reason')}",
        epoch_s=epoch_of(results, epoch_s),
        is_suspect=rows.get("suspect", np.zeros(len(time_s))) > 0.5,
        time_s=time_s,
        lat=np.radians(rows["lat_deg"]),
        lon=np.radians(rows["lon_deg"]),
        height=rows["height_m"],
        velocity_enu=np.column_stack([rows[f"vel_{name}_m_per_s"] for name in _ENU]),
        roll_pitch_heading=angles,
        position_sigma_enu=np.column_stack([rows[f"sigma_{name}_m"] for name in _ENU]),
        velocity_sigma_enu=np.column_stack([rows[f"sigma_vel_{name}_m_per_s"] for name in _ENU]),
        attitude_sigma=np.radians(np.column_stack(sigmas)),
        covariance=covariance,
        origin=origin,
    )


def check_rows(results: Results) -> None:
    """Raise :class:`DataError` for a trajectory without a row or with a state that is no number."""
    path = results.folder / "trajectory.csv"
    if len(results.trajectory["time_s"]) == 0:
        raise DataError(f"{path}: expected at least one row, found none")
    for name, values in results.trajectory.items():
        bad = np.flatnonzero(~np.isfinite(values))
        if len(bad) and not name.startswith(("sigma_", "current_", "gyro_", "accel_")):
            raise DataError(
                f"{path}:{bad[0] + 2}: {name} is not finite; the run ended as "
                f"{results.summary.get('status')}: smooth the mission again"
            )


def epoch_of(results: Results, stated_s: float | None) -> float | None:
    """Return the Unix time of ``time_s`` 0, s: the stated one, 0 where times are Unix time already.

    Raises :class:`ConfigError` where both are the case.
    """
    begin_s = float(results.trajectory["time_s"][0])
    if not UNIX_FROM_S <= begin_s <= UNIX_UNTIL_S:
        return stated_s
    if stated_s is not None:
        raise ConfigError(
            f"--epoch: the times of {results.folder / 'trajectory.csv'} begin at {begin_s:.3f} s, "
            "which is Unix time; leave the option out"
        )
    return 0.0


def parse_epoch(text: str, where: str = "--epoch") -> float:
    """Return Unix seconds of an ISO 8601 time with its zone, or of a number of Unix seconds.

    Raises :class:`ConfigError`.
    """
    with contextlib.suppress(ValueError):
        epoch_s = float(text)
        if not 0.0 <= epoch_s < _LATEST_S:
            raise ConfigError(
                f"{where}: expected Unix seconds of the years 1970 to 9998, got {epoch_s:g}"
            )
        return epoch_s
    try:
        when = datetime.fromisoformat(text)
    except ValueError:
        when = None
    if when is None or when.tzinfo is None:
        raise ConfigError(
            f"{where}: expected an ISO time with its zone, such as 2026-05-01T10:00:00Z, or Unix "
            f"seconds, got {text!r}"
        )
    return when.timestamp()
