"""Recordings in public layouts: EuRoC ASL, TUM RGB-D, KITTI, 7-Scenes, a folder, a video."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Final

import numpy as np

from ssm_graph.base.errors import DataError
from ssm_graph.base.frozen import Array
from ssm_graph.systems.visual_ranges.camera import Camera
from ssm_graph.systems.visual_ranges.ranges import Ranges, screened_ranges
from ssm_graph.systems.visual_ranges.readers.calibration import (
    flat_yaml,
    make_camera,
    read_camera,
)
from ssm_graph.systems.visual_ranges.readers.images import (
    ENDINGS,
    VideoFrames,
    WatchedImages,
    image_files,
)
from ssm_graph.systems.visual_ranges.readers.options import ReadOptions
from ssm_graph.systems.visual_ranges.readers.range_text import read_ranges
from ssm_graph.systems.visual_ranges.readers.times import image_seconds, increasing
from ssm_graph.systems.visual_ranges.readers.truth import (
    number_rows,
    read_euroc_path,
    read_kitti_path,
    read_pose_files,
    read_tum_path,
)
from ssm_graph.systems.visual_ranges.sequence import PathTruth, Sequence

RANGE_NAMES: Final = ("ranges.csv", "uwb.csv", "ranges.txt", "uwb.txt")
CAMERA_NAMES: Final = ("camera.yaml", "sensor.yaml", "calib.txt", "camera.txt", "intrinsics.txt")
SCENES_RATE_HZ: Final = 30.0
"""7-Scenes: Kinect colour, 640 x 480."""
SCENES_FOCAL_PX: Final = 525.0
"""Of the Kinect's colour camera at 640 x 480; 585 in ``camera-intrinsics.txt`` is the depth
camera's."""
FREIBURG: Final = {
    "freiburg1": ((517.3, 516.5, 318.6, 255.3), (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)),
    "freiburg2": ((520.9, 521.0, 325.1, 249.7), (0.2312, -0.7849, -0.0033, -0.0001, 0.9172)),
    "freiburg3": ((535.4, 539.2, 320.1, 247.6), ()),
}
"""Calibration that TUM publishes for the colour cameras of its RGB-D benchmark."""


def read_euroc(folder: Path, options: ReadOptions) -> Sequence:
    """Read the ASL layout: ``mav0/cam0/data.csv``, ``sensor.yaml``, ``uwb0/data.csv``."""
    mav = folder / "mav0" if (folder / "mav0").is_dir() else folder
    own = mav / f"cam{options.camera_number}"
    table = own / "data.csv"
    rows = _named_images(table, own / "data")
    time_s, paths, notes = _timed(rows, str(table), options)
    sensor = own / "sensor.yaml"
    camera, size = _camera_of(options, sensor, paths)
    found = (
        flat_yaml(sensor.read_text(encoding="utf-8")).get("T_BS.data") if sensor.is_file() else 0
    )
    T_bc = np.reshape(found, (4, 4)) if isinstance(found, list) and len(found) == 16 else np.eye(4)
    reference = mav / "state_groundtruth_estimate0" / "data.csv"
    truth = read_euroc_path(reference, T_bc) if reference.is_file() else None
    ranges = _ranges_of(options, [mav / "uwb0" / "data.csv"], time_s)
    return _sequence(folder, camera, time_s, paths, size, ranges, truth, notes, options)


def read_tum(folder: Path, options: ReadOptions) -> Sequence:
    """Read TUM RGB-D: ``rgb.txt``, ``groundtruth.txt``, ranges from ``uwb.txt``."""
    rows = _named_images(folder / "rgb.txt", folder)
    time_s, paths, notes = _timed(rows, str(folder / "rgb.txt"), options)
    own = _first_file(folder, CAMERA_NAMES)
    known = next((name for name in FREIBURG if name in folder.name), None)
    if options.camera is None and own is None and known is not None:
        intrinsics, distortion = FREIBURG[known]
        size = _size_of(paths)
        camera = make_camera(known, size, intrinsics, "radtan", distortion)
        notes.append(f"camera: the calibration that TUM publishes for {known}")
    else:
        camera, size = _camera_of(options, own, paths)
    reference = folder / "groundtruth.txt"
    truth = read_tum_path(reference) if reference.is_file() else None
    ranges = _ranges_of(options, [folder / name for name in RANGE_NAMES], time_s)
    return _sequence(folder, camera, time_s, paths, size, ranges, truth, notes, options)


def read_kitti(folder: Path, options: ReadOptions) -> Sequence:
    """Read KITTI odometry: ``image_0``, ``times.txt``, ``calib.txt``, ``poses.txt``."""
    images = folder / f"image_{options.camera_number}"
    paths = image_paths(images)
    times = number_rows(folder / "times.txt", (1,))[:, 0]
    if len(times) < len(paths):
        raise DataError(
            f"{folder / 'times.txt'}: expected a time for each of {len(paths)} images, got "
            f"{len(times)}"
        )
    rows = list(zip(times.tolist(), paths, strict=False))
    time_s, paths, notes = _timed(rows, str(folder / "times.txt"), options)
    camera, size = _camera_of(options, folder / "calib.txt", paths)
    reference = folder / "poses.txt"
    truth = read_kitti_path(reference, times) if reference.is_file() else None
    ranges = _ranges_of(options, [folder / name for name in RANGE_NAMES], time_s)
    return _sequence(folder, camera, time_s, paths, size, ranges, truth, notes, options)


def read_scenes(folder: Path, options: ReadOptions) -> Sequence:
    """Read 7-Scenes: ``frame-000000.color.jpg`` (or png) with ``frame-000000.pose.txt``."""
    paths = sorted(p for p in folder.glob("frame-*.color.*") if p.suffix in ENDINGS)
    numbers = [int(re.findall(r"frame-(\d+)", path.name)[0]) for path in paths]
    rate = options.rate_hz or SCENES_RATE_HZ
    all_s = np.array(numbers) / rate + (options.start_s or 0.0)
    rows = list(zip(all_s.tolist(), paths, strict=True))
    time_s, paths, notes = _timed(rows, str(folder), options, unit="s")
    if options.camera is None:
        size = _size_of(paths)
        k = (SCENES_FOCAL_PX, SCENES_FOCAL_PX, (size[0] - 1) / 2, (size[1] - 1) / 2)
        camera = make_camera(str(folder), size, k)
        notes.append("camera: focal length 525 pixels, that of the Kinect's colour camera")
    else:
        camera, size = _camera_of(options, None, paths)
    poses = [path.with_name(path.name.split(".")[0] + ".pose.txt") for path in paths]
    truth = read_pose_files(poses, time_s) if all(p.is_file() for p in poses) else None
    ranges = _ranges_of(options, [folder / name for name in RANGE_NAMES], time_s)
    return _sequence(folder, camera, time_s, paths, size, ranges, truth, notes, options)


def read_image_folder(folder: Path, options: ReadOptions) -> Sequence:
    """Read a folder of images in the order of their names.

    Times are those of ``times.txt`` or ``times.csv``, else names that are times in ns, else they
    follow from the rate.
    """
    inner = folder / "images"
    paths = image_paths(inner if inner.is_dir() else folder)
    table = _first_file(folder, ("times.txt", "times.csv"))
    unit = ""
    if table is not None:
        values = number_rows(table, (1, 2))[:, -1]
        if len(values) != len(paths):
            raise DataError(
                f"{table}: expected a time for each of {len(paths)} images, got {len(values)}"
            )
    elif options.rate_hz:
        values, unit = np.arange(len(paths)) / options.rate_hz + (options.start_s or 0.0), "s"
    elif all(path.stem.isdigit() and len(path.stem) >= 16 for path in paths):
        values, unit = np.array([float(path.stem) for path in paths]), "ns"
    else:
        raise DataError(
            f"{folder}: images without times; give --rate-hz, or a times.txt with one time a line"
        )
    rows = list(zip(values.tolist(), paths, strict=True))
    time_s, paths, notes = _timed(rows, str(table or folder), options, unit=unit)
    camera, size = _camera_of(options, _first_file(folder, CAMERA_NAMES), paths)
    reference = _first_file(folder, ("groundtruth.txt", "truth.tum"))
    truth = read_tum_path(reference) if reference else None
    ranges = _ranges_of(options, [folder / name for name in RANGE_NAMES], time_s)
    return _sequence(folder, camera, time_s, paths, size, ranges, truth, notes, options)


def read_video(path: Path, options: ReadOptions) -> Sequence:
    """Read a video; ranges come from a table beside it or from the one that was given."""
    frames = VideoFrames(path)
    rate = options.rate_hz or frames.rate_hz
    if not 0.1 <= rate <= 1000.0:
        raise DataError(f"{path}: the video says {rate:g} frames a second; give --rate-hz")
    chosen = chosen_images(frames.n_frames, options)
    time_s = chosen / rate + (options.start_s or 0.0)
    own = _first_file(path.parent, (f"{path.stem}.yaml", f"{path.stem}.txt", *CAMERA_NAMES))
    camera = _camera_file(options, own, str(path), frames.size)
    images = WatchedImages(
        lambda k: frames(int(chosen[k])), *frames.size, lambda k: f"frame {chosen[k]}"
    )
    _check_size(camera, frames.size, str(path))
    beside = [path.with_suffix(ending) for ending in (".csv", ".ranges.csv")]
    ranges = _ranges_of(options, [*beside, *(path.parent / n for n in RANGE_NAMES)], time_s)
    lever = options.lever_arm_m or (0.0, 0.0, 0.0)
    notes = (f"{path.name}: {frames.n_frames} frames at {rate:g} a second", *ranges.notes)
    return Sequence(path.stem, camera, time_s, images, ranges, lever, notes=notes)


def image_paths(folder: Path) -> list[Path]:
    """Return the images of a folder, ``img2`` before ``img10``."""

    def key(path: Path) -> list[tuple[int, str]]:
        parts = re.split(r"(\d+)", path.name)
        return [(int(part), "") if part.isdigit() else (-1, part) for part in parts]

    found = [path for path in folder.iterdir() if path.suffix.lower() in ENDINGS]
    if not found:
        raise DataError(f"{folder}: expected images ({', '.join(ENDINGS)}), found none")
    return sorted(found, key=key)


def _named_images(table: Path, folder: Path) -> list[tuple[float, Path]]:
    """Return time and path of each row of a table of images; a row that is none is refused."""
    found = []
    try:
        lines = table.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(f"{table}: cannot be read: {error}") from error
    for number, line in enumerate(lines, 1):
        bare = line.split("#")[0].strip()
        cells = [cell.strip() for cell in (bare.split(",") if "," in bare else bare.split())]
        if not bare:
            continue
        try:
            found.append((float(cells[0]), folder / cells[1]))
        except (ValueError, IndexError):
            if number == 1:
                continue  # a header without its mark
            raise DataError(
                f"{table}:{number}: expected a time and the name of an image, got {line[:60]!r}"
            ) from None
    if not found:
        raise DataError(f"{table}: expected a time and the name of an image a line, found none")
    missing = [path for _, path in found if not path.is_file()]
    if len(missing) == len(found):
        raise DataError(f"{table}: none of its images is there, such as {missing[0]}")
    return [pair for pair in found if pair[1].is_file()]


def _timed(
    rows: list[tuple[float, Path]], where: str, options: ReadOptions, unit: str = ""
) -> tuple[Array, list[Path], list[str]]:
    """Return times in seconds that increase, the images of each, and notes."""
    raw = np.array([value for value, _ in rows])
    order, note = increasing(raw, where)
    time_s, unit_note = image_seconds(raw[order], where, unit)
    if options.start_s is not None and not unit:
        time_s = time_s - time_s[0] + options.start_s
    chosen = chosen_images(len(order), options)
    paths = [rows[i][1] for i in order[chosen]]
    return time_s[chosen], paths, [text for text in (note, unit_note) if text]


def chosen_images(n_images: int, options: ReadOptions) -> np.ndarray[tuple[int], np.dtype[np.intp]]:
    """Return the indices (K,) of the images that the options ask for."""
    last = n_images if options.count is None else options.first + options.count
    chosen = np.arange(n_images)[options.first : last]
    if len(chosen) < 2:
        count = "" if options.count is None else f" --count {options.count}"
        raise DataError(
            f"--first {options.first}{count}: expected at least 2 images, the recording has "
            f"{n_images}"
        )
    return chosen


def _size_of(paths: list[Path]) -> tuple[int, int]:
    images = image_files(paths)
    return images.width, images.height


def _camera_of(
    options: ReadOptions, own: Path | None, paths: list[Path]
) -> tuple[Camera, tuple[int, int]]:
    """Return the camera, and the size of the images."""
    where, size = str(paths[0].parent), _size_of(paths)
    camera = _camera_file(options, own, where, size)
    _check_size(camera, size, where)
    return camera, size


def _camera_file(
    options: ReadOptions, own: Path | None, where: str, size: tuple[int, int]
) -> Camera:
    path = options.camera or own
    if path is None or not path.is_file():
        told = f"{path} is not there" if path is not None else "there is no calibration file"
        raise DataError(
            f"{where}: {told}; give one with --camera (EuRoC, Kalibr, ORB-SLAM, ROS, KITTI, or a "
            "text with fx fy cx cy k1 k2 p1 p2)"
        )
    return read_camera(path, size)


def _check_size(camera: Camera, size: tuple[int, int], where: str) -> None:
    if (camera.width, camera.height) != size:
        raise DataError(
            f"{where}: images are {size[0]} x {size[1]} pixels, the calibration is for "
            f"{camera.width} x {camera.height}; scale one of them"
        )


def _first_file(folder: Path, names: tuple[str, ...]) -> Path | None:
    return next((folder / name for name in names if (folder / name).is_file()), None)


def _ranges_of(options: ReadOptions, own: list[Path], time_s: Array) -> Ranges:
    path = options.ranges or next((path for path in own if path.is_file()), None)
    if path is None:
        return screened_ranges([], [], [])
    return read_ranges(
        path,
        time_s,
        sigma_m=options.sigma_m,
        unit=options.range_unit,
        time_unit=options.time_unit,
    )


def _sequence(
    folder: Path,
    camera: Camera,
    time_s: Array,
    paths: list[Path],
    size: tuple[int, int],
    ranges: Ranges,
    truth: PathTruth | None,
    notes: list[str],
    options: ReadOptions,
) -> Sequence:
    images = image_files(paths, size=size, bayer=options.bayer)
    lever = options.lever_arm_m or (0.0, 0.0, 0.0)
    name = folder.resolve().name
    return Sequence(
        name, camera, time_s, images, ranges, lever, truth, notes=(*notes, *ranges.notes)
    )


Reader = Callable[[Path, ReadOptions], Sequence]
