"""True paths: TUM files, EuRoC's estimates of its reference, poses of KITTI."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from ssm_graph.base.errors import DataError
from ssm_graph.base.frozen import Array
from ssm_graph.systems.visual_ranges.sequence import PathTruth


def number_rows(path: Path, n_columns: tuple[int, ...]) -> Array:
    """Return the rows (N, columns) of a text of numbers, commas or spaces, ``#`` comments.

    Raises :class:`DataError` with the line where a row has another count or is no number.
    """
    rows: list[list[float]] = []
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(f"{path}: cannot be read: {error}") from error
    for number, line in enumerate(text.splitlines(), 1):
        bare = line.split("#")[0].replace(",", " ").split()
        if not bare:
            continue
        try:
            row = [float(cell) for cell in bare]
        except ValueError:
            if not rows:
                continue  # a header
            raise DataError(f"{path}:{number}: expected numbers, got {line[:60]!r}") from None
        wanted = (len(rows[0]),) if rows else n_columns
        if len(row) not in wanted:
            expected = " or ".join(map(str, wanted))
            raise DataError(f"{path}:{number}: expected {expected} numbers, got {len(row)}")
        rows.append(row)
    if not rows:
        raise DataError(f"{path}: expected rows of numbers, found none")
    return np.array(rows)


def read_tum_path(path: Path) -> PathTruth:
    """Return a path of rows time, x, y, z, qx, qy, qz, qw (s, m)."""
    return path_of(number_rows(path, (8,)), str(path))


def path_of(rows: Array, where: str) -> PathTruth:
    """Return the path of rows (N, 8) as in TUM files; times that do not increase are left out."""
    kept = np.r_[True, np.diff(np.maximum.accumulate(rows[:, 0])) > 0.0]
    rows = rows[kept & np.isfinite(rows).all(axis=1)]
    norm = np.linalg.norm(rows[:, 4:8], axis=1)
    if len(rows) == 0 or np.any(np.abs(norm - 1.0) > 0.01):
        raise DataError(f"{where}: expected unit quaternions in the order x, y, z, w")
    return PathTruth(rows[:, 0], rows[:, 1:4], rows[:, 4:8] / norm[:, None])


def read_euroc_path(path: Path, T_bc: Array) -> PathTruth:
    """Return the camera's path of EuRoC's reference: ns, p (m), q (w, x, y, z) of the body.

    ``T_bc`` (4, 4) takes camera axes into those of the body.
    """
    rows = number_rows(path, (8, 17))
    R_wb = Rotation.from_quat(rows[:, [5, 6, 7, 4]])
    position = rows[:, 1:4] + R_wb.apply(T_bc[:3, 3])
    quaternion = (R_wb * Rotation.from_matrix(T_bc[:3, :3])).as_quat()
    return path_of(np.column_stack([rows[:, 0] * 1e-9, position, quaternion]), str(path))


def read_kitti_path(path: Path, time_s: Array) -> PathTruth:
    """Return the path of poses of 12 numbers a row (camera to world), or 13 with a time before."""
    rows = number_rows(path, (12, 13))
    n = min(len(rows), len(time_s))
    times = rows[:n, 0] if rows.shape[1] == 13 else time_s[:n]
    pose = rows[:n, -12:].reshape(n, 3, 4)
    quaternion = Rotation.from_matrix(pose[:, :, :3]).as_quat()
    return path_of(np.column_stack([times, pose[:, :, 3], quaternion]), str(path))


def read_pose_files(paths: list[Path], time_s: Array) -> PathTruth:
    """Return the path of one file a frame, each a matrix (4, 4), camera to world."""
    poses = np.stack([number_rows(path, (4,)) for path in paths])
    if poses.shape[1:] != (4, 4):
        raise DataError(
            f"{paths[0].parent}: expected poses of 4 x 4 numbers, got {poses.shape[1:]}"
        )
    quaternion = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
    rows = np.column_stack([time_s, poses[:, :3, 3], quaternion])
    return path_of(rows, str(paths[0].parent))
