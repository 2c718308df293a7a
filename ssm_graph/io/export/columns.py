"""Tables of numbers: TUM and KITTI trajectories, and one wide table as CSV or Parquet."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ssm_graph.base.frozen import Array
from ssm_graph.base.progress import told
from ssm_graph.base.units import DEGREE
from ssm_graph.io.export.track import Track
from ssm_graph.io.tables.files import pyarrow_module

_ENU = ("east", "north", "up")


def write_tum(track: Track, path: Path) -> None:
    """Write ``time x y z qx qy qz qw`` lines: metres of the local frame, body forward-left-up."""
    rows = np.column_stack([track.time_s, track.local_enu, track.quaternion])
    np.savetxt(path, rows, fmt=["%.7f", *["%.6f"] * 3, *["%.9f"] * 4], delimiter=" ")


def write_kitti(track: Track, path: Path) -> None:
    """Write the upper three rows of each pose's 4 by 4 matrix, 12 numbers a line, without times."""
    from scipy.spatial.transform import Rotation

    poses = np.empty((len(track.time_s), 3, 4))
    poses[:, :, :3] = Rotation.from_quat(track.quaternion).as_matrix()
    poses[:, :, 3] = track.local_enu
    np.savetxt(path, poses.reshape(-1, 12), fmt="%.9g", delimiter=" ")


def wide_columns(track: Track) -> dict[str, Array | list[str]]:
    """Return every number of a track by name, with its unit, and UTC where it is known."""
    local, q = track.local_enu, track.quaternion
    degrees, sigmas = np.degrees(track.roll_pitch_heading), np.degrees(track.attitude_sigma)
    angles = ("roll", "pitch", "heading")
    columns: dict[str, Array | list[str]] = {"time_s": track.time_s}
    if track.epoch_s is not None:
        columns["utc"] = track.utc()
    columns |= {
        "lat_deg": np.degrees(track.lat),
        "lon_deg": np.degrees(track.lon),
        "height_m": track.height,
        **{f"{name}_m": local[:, i] for i, name in enumerate(_ENU)},
        "utm_easting_m": track.utm.easting,
        "utm_northing_m": track.utm.northing,
        **{f"vel_{name}_m_per_s": track.velocity_enu[:, i] for i, name in enumerate(_ENU)},
        **{f"{name}_deg": degrees[:, i] for i, name in enumerate(angles)},
        **{f"q{name}": q[:, i] for i, name in enumerate("xyzw")},
        **{f"sigma_{name}_m": track.position_sigma_enu[:, i] for i, name in enumerate(_ENU)},
    }
    columns |= {
        f"sigma_vel_{name}_m_per_s": track.velocity_sigma_enu[:, i] for i, name in enumerate(_ENU)
    }
    columns |= {f"sigma_{name}_deg": sigmas[:, i] for i, name in enumerate(angles)}
    return columns | _covariances(track) | {"suspect": track.is_suspect.astype(np.float64)}


def _covariances(track: Track) -> dict[str, Array | list[str]]:
    """Return the covariances of every two of nine numbers, where they were asked for."""
    if track.covariance is None:
        return {}
    unit = np.repeat([1.0, 1.0, DEGREE], 3)
    names = [f"{name}_m" for name in _ENU] + [f"vel_{name}_m_per_s" for name in _ENU]
    names += [f"{name}_deg" for name in ("roll", "pitch", "heading")]
    return {
        f"cov_{names[i]}_{names[j]}": track.covariance[:, i, j] / (unit[i] * unit[j])
        for i in range(9)
        for j in range(i)
    }


def write_csv(track: Track, path: Path) -> None:
    """Write one wide table; nothing of a number is lost."""
    columns = wide_columns(track)
    cells = [c if isinstance(c, list) else [repr(v) for v in c.tolist()] for c in columns.values()]
    with path.open("w", encoding="utf-8") as file:
        file.write(",".join(columns) + "\n")
        rows = told(zip(*cells, strict=True), len(track.time_s))
        file.writelines(",".join(row) + "\n" for row in rows)


def write_parquet(track: Track, path: Path) -> None:
    """Write the same table as Parquet, with names and units in its metadata."""
    arrow: Any = pyarrow_module("pyarrow")
    table = arrow.table(wide_columns(track)).replace_schema_metadata(
        {"mission": track.name, "about": track.about, "utm": track.utm.name}
    )
    pyarrow_module("pyarrow.parquet").write_table(table, path)
