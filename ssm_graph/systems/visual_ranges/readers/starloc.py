"""STAR-loc: a hand-held rig with real UWB radios, April tags in stereo pixels, and true places.

References
----------
.. [1] F. Duembgen et al., "STAR-loc: Dataset for STereo And Range-based localization",
   arXiv 2309.05518, 2023.
"""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from scipy.spatial.transform import Rotation

from ssm_graph.base.errors import DataError
from ssm_graph.base.frozen import Array, ShortRepr
from ssm_graph.base.settings import parse_json
from ssm_graph.systems.visual_ranges.camera import Camera
from ssm_graph.systems.visual_ranges.ranges import Ranges, screened_ranges
from ssm_graph.systems.visual_ranges.readers.calibration import make_camera
from ssm_graph.systems.visual_ranges.sequence import PathTruth
from ssm_graph.systems.visual_ranges.tag_rows import TagSightings

SIZE: Final = (1920, 1080)
"""Of the rectified images, pixels."""
_POSE: Final = ("x", "y", "z", "rot_x", "rot_y", "rot_z", "w")


@dataclass(frozen=True, slots=True, eq=False)
class StarLocRun(ShortRepr):
    """One run; camera axes are x right, y down, z ahead, world axes those of the motion capture."""

    name: str
    camera: Camera
    """The left one."""
    ranges: Ranges
    """Of one antenna."""
    lever_arm_m: Array
    """(3,) camera to antenna, camera axes, m: the median of what the truth says"""
    truth: PathTruth
    """Of the left camera."""
    anchor_truth_m: Array
    """(J, 3) m, world"""
    error_m: Array
    """(M,) range less the true one, m"""
    sightings: TagSightings
    """Of the centres of April tags, in both images"""
    tag_truth_m: dict[int, Array]
    """(3,) by tag number, m, world"""


def read_starloc(folder: Path, antenna: int | None = None) -> StarLocRun:
    """Return a run of the folder ``data/NAME``; ``mocap`` and ``dataset_params.json`` lie beside.

    Parameters
    ----------
    antenna : ``from_id`` of the radio on the rig; None: the one with most ranges.

    Raises :class:`DataError` for a file that is missing or of another layout.
    """
    uwb, tags = _table(folder / "uwb.csv"), _table(folder / "apriltag.csv")
    calibration = _json(folder / "calib.json")
    try:
        *k, baseline_m = [float(calibration[name]) for name in ("fu", "fv", "cu", "cv", "b")]
    except (KeyError, TypeError) as error:
        raise DataError(f"{folder / 'calib.json'}: expected fu, fv, cu, cv, b") from error
    camera = make_camera(str(folder / "calib.json"), SIZE, k)
    R_cr, t_cr = _camera_on_rig(folder)
    radios = uwb["from_id"].astype(int)
    if antenna is None:
        antenna = int(np.bincount(radios).argmax())
    own = radios == antenna
    if not own.any():
        known = ", ".join(map(str, np.unique(radios)))
        raise DataError(f"{folder / 'uwb.csv'}: no ranges of antenna {antenna}; there are {known}")
    rows = {name: column[own] for name, column in uwb.items()}
    R_wr = Rotation.from_quat(np.column_stack([rows[x] for x in _POSE[3:]]))
    p_wr = np.column_stack([rows[x] for x in _POSE[:3]])
    at = np.column_stack([rows[f"tag_pos_{x}"] for x in "xyz"])
    lever = R_cr @ np.median(R_wr.inv().apply(at - p_wr), axis=0) + t_cr
    places = _anchors(folder, rows)
    names = [str(int(x)) for x in rows["to_id"]]
    ranges = screened_ranges(rows["time_s"], names, rows["range"], source=f"{folder.name}/uwb.csv")
    wrong = np.empty(len(ranges))
    for j, name in enumerate(ranges.names):
        mine, kept = rows["to_id"].astype(int) == int(name), ranges.anchor == j
        at = np.searchsorted(rows["time_s"][mine], ranges.time_s[kept])
        wrong[kept] = (rows["range"] - rows["gt_range"])[mine][at]
    return StarLocRun(
        folder.name,
        camera,
        ranges,
        lever,
        _path(uwb, R_cr, t_cr),
        np.array([places.get(name, np.full(3, np.nan)) for name in ranges.names]),
        wrong,
        TagSightings(
            camera,
            tags["time_s"],
            tags["apriltag_id"].astype(np.intp),
            np.column_stack([tags["left_u"], tags["left_v"]]),
            np.column_stack([tags["right_u"], tags["right_v"]]),
            baseline_m,
        ),
        _tags(folder),
    )


def _path(uwb: dict[str, Array], R_cr: Array, t_cr: Array) -> PathTruth:
    """Return the left camera's path from the rig's poses that come with the ranges."""
    time_s, first = np.unique(uwb["time_s"], return_index=True)
    R_wr = Rotation.from_quat(np.column_stack([uwb[x][first] for x in _POSE[3:]]))
    p_wr = np.column_stack([uwb[x][first] for x in _POSE[:3]])
    R_rc = Rotation.from_matrix(R_cr.T)
    position = p_wr + R_wr.apply(-R_cr.T @ t_cr)
    return PathTruth(time_s, position, (R_wr * R_rc).as_quat())


def _camera_on_rig(folder: Path) -> tuple[Array, Array]:
    """Return rotation and translation of rig to camera, by the authors' own hand-eye calibration.

    ``tf_cam_rig`` of ``calib.json`` is in other axes; ``apriltag_cal_global.csv`` holds the
    camera's pose beside the rig's in every row, all by one transform; its quaternions take world
    axes into the camera's, those of the rig take rig axes into the world's.
    """
    rows = _table(folder / "apriltag_cal_global.csv")
    R_wr, p_wr = Rotation.from_quat(np.column_stack([rows[x] for x in _POSE[3:]])), _POSE[:3]
    names = ("cam_rot_x", "cam_rot_y", "cam_rot_z", "cam_w")
    R_cw = Rotation.from_quat(np.column_stack([rows[x] for x in names]))
    shift = np.column_stack([rows[f"cam_{x}"] - rows[x] for x in p_wr])
    R_rc, t_rc = (R_cw * R_wr).inv().mean(), np.median(R_wr.inv().apply(shift), axis=0)
    R_cr = R_rc.inv().as_matrix()
    return R_cr, -R_cr @ t_rc


def _table(path: Path) -> dict[str, Array]:
    """Return the columns of a table of numbers; empty cells are NaN."""
    try:
        with path.open(encoding="utf-8-sig", newline="") as stream:
            head, *rows = [row for row in csv.reader(stream) if row]
    except (OSError, UnicodeDecodeError, ValueError) as error:
        raise DataError(f"{path}: cannot be read: {error}") from error
    for number, row in enumerate(rows, 2):
        if len(row) != len(head):
            raise DataError(f"{path}:{number}: expected {len(head)} cells, got {len(row)}")
    try:
        values = np.array([[float(cell or "nan") for cell in row] for row in rows])
    except ValueError as error:
        raise DataError(f"{path}: expected numbers: {error}") from error
    return dict(zip([name or "id" for name in head], values.T, strict=True))


def _json(path: Path) -> dict[str, float]:
    try:
        found = parse_json(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise DataError(f"{path}: cannot be read: {error}") from error
    return dict(found)


def _version(folder: Path) -> str:
    """Return which survey of the arena belongs to a run."""
    path = folder.parent / "dataset_params.json"
    try:
        runs = parse_json(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise DataError(f"{path}: cannot be read: {error}") from error
    found = [run["landmarks"] for run in runs if run["name"] == folder.name]
    if not found:
        raise DataError(f"{path}: expected an entry of {folder.name}, found none")
    return str(found[0])


def _anchors(folder: Path, rows: dict[str, Array]) -> dict[str, Array]:
    """Return the true places (3,) of the anchors by name, of the survey that fits the true ranges.

    ``landmarks`` of ``dataset_params.json`` is that of the tags: the runs with v1 of it have the
    anchors of v2.
    """
    at = np.column_stack([rows[f"tag_pos_{x}"] for x in "xyz"])
    found: list[tuple[float, dict[str, Array]]] = []
    for path in sorted((folder.parent / "mocap").glob("uwb_markers_*.csv")):
        table = _table(path)
        places = {
            int(i): np.array([x, y, z])
            for i, x, y, z in zip(table["id"], table["x"], table["y"], table["z"], strict=True)
        }
        heard = np.isin(rows["to_id"].astype(int), [*places])
        if not heard.any():
            continue
        anchor = np.array([places[int(i)] for i in rows["to_id"][heard]])
        off = np.abs(np.linalg.norm(at[heard] - anchor, axis=1) - rows["gt_range"][heard])
        missing = 1.0 - float(np.mean(heard))
        found.append((float(np.median(off)) + missing, {str(i): p for i, p in places.items()}))
    return min(found, key=lambda one: one[0])[1] if found else {}


def _tags(folder: Path) -> dict[int, Array]:
    table = _table(folder.parent / "mocap" / f"environment_{_version(folder)}.csv")
    rows = zip(table["april_id"], table["x"], table["y"], table["z"], strict=True)
    return {int(i): np.array([x, y, z]) for i, x, y, z in rows if np.isfinite(i)}
