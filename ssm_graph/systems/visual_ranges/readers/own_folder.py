"""A folder of one's own recording: ``visual.toml``, images or a video, ranges, truth if known."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
import tomli_w
from numpy.typing import NDArray

from ssm_graph.base.errors import ConfigError, DataError
from ssm_graph.base.frozen import Array
from ssm_graph.base.settings import (
    FILE_KEY,
    Key,
    Settings,
    number_key,
    optional_key,
    read_settings,
    read_toml,
)
from ssm_graph.io.tables.append_file import write_through
from ssm_graph.systems.visual_ranges.camera import Camera
from ssm_graph.systems.visual_ranges.extras import opencv
from ssm_graph.systems.visual_ranges.ranges import Ranges, at_the_anchor, screened_ranges
from ssm_graph.systems.visual_ranges.readers.calibration import make_camera, read_camera
from ssm_graph.systems.visual_ranges.readers.images import (
    VideoFrames,
    WatchedImages,
    image_files,
)
from ssm_graph.systems.visual_ranges.readers.layouts import chosen_images, image_paths
from ssm_graph.systems.visual_ranges.readers.options import ReadOptions, Vector
from ssm_graph.systems.visual_ranges.readers.range_text import read_ranges
from ssm_graph.systems.visual_ranges.readers.times import increasing
from ssm_graph.systems.visual_ranges.readers.truth import number_rows, read_tum_path
from ssm_graph.systems.visual_ranges.readers.vehicle_files import (
    DEPTH_KEYS,
    RECKONING_KEYS,
    read_vehicle,
    write_vehicle,
)
from ssm_graph.systems.visual_ranges.sequence import Sequence

TOML_NAME: Final = "visual.toml"
FORMAT: Final = 1
_TEXT: Final = Key(shape=None, required=False)
CAMERA_KEYS: Final[Mapping[str, Key]] = {
    "file": _TEXT,
    "width": optional_key("", 64, 20000, "pixels"),
    "height": optional_key("", 64, 20000, "pixels"),
    "fx": optional_key("", 1, 1e5, "pixels"),
    "fy": optional_key("", 1, 1e5, "pixels"),
    "cx": optional_key("", -1e5, 1e5, "pixels"),
    "cy": optional_key("", -1e5, 1e5, "pixels"),
    "model": _TEXT,
    "distortion": Key(shape=((1, 8),), low=-100.0, high=100.0, required=False),
}
IMAGE_KEYS: Final[Mapping[str, Key]] = {
    "folder": _TEXT,
    "video": _TEXT,
    "times": _TEXT,
    "rate_hz": optional_key("", 0.01, 1000.0, "images a second"),
    "start_s": optional_key("", -1e12, 1e12, "seconds, on the clock of the ranges"),
    "bayer": _TEXT,
}
RANGE_KEYS: Final[Mapping[str, Key]] = {
    "file": FILE_KEY,
    "sigma_m": optional_key("", 1e-4, 100.0, "0.1 is a Decawave radio in line of sight"),
    "unit": _TEXT,
    "time_unit": _TEXT,
    "lever_arm_m": Key(
        shape=(3,), low=-10.0, high=10.0, required=False, hint="camera to antenna, metres"
    ),
    "lever_arm_sigma_m": optional_key("", 1e-3, 5.0, "0.05 by eye, left out where measured"),
    "anchors": _TEXT,
    "travel": _TEXT,
    "sound_speed_m_per_s": optional_key("", 1000.0, 2000.0, "1500 in the sea"),
    "sound_speed_sigma_m_per_s": optional_key("", 0.01, 200.0, "15 is one per cent"),
}
TRUTH_KEYS: Final[Mapping[str, Key]] = {"path": FILE_KEY, "anchors": _TEXT}
TOP_KEYS: Final[Mapping[str, Key]] = {"format": number_key("", FORMAT, FORMAT)}
SECTIONS: Final = {
    "camera": CAMERA_KEYS,
    "images": IMAGE_KEYS,
    "ranges": RANGE_KEYS,
    "truth": TRUTH_KEYS,
    "depth": DEPTH_KEYS,
    "dead_reckoning": RECKONING_KEYS,
}
SOUND_SPEED: Final = 1500.0
"""m/s, where the file does not say."""


def read_own_folder(folder: Path, options: ReadOptions) -> Sequence:
    """Read ``visual.toml`` and what it names; what the options say goes before it.

    Raises :class:`ConfigError` and :class:`DataError` with file, line and what to try.
    """
    sections = _sections(folder)
    wanted = _images(folder, sections["images"], options)
    time_s, images, size, notes = wanted
    camera = _camera(folder, sections["camera"], options, size)
    if (camera.width, camera.height) != size:
        raise DataError(
            f"{folder / TOML_NAME} [camera]: images are {size[0]} x {size[1]} pixels, the "
            f"calibration is for {camera.width} x {camera.height}; scale one of them"
        )
    ranges, lever = _ranges(folder, sections.get("ranges"), options, time_s)
    ranges, share = _acoustic(ranges, sections.get("ranges"))
    truth, places = None, None
    if "truth" in sections:
        truth = read_tum_path(folder / sections["truth"].text("path"))
        if "anchors" in sections["truth"]:
            found = read_places(folder / sections["truth"].text("anchors"))
            unknown = np.full(3, np.nan)
            rows = [found.get(name, unknown) for name in ranges.names]
            places = np.array(rows).reshape(-1, 3)
    return Sequence(
        folder.resolve().name,
        camera,
        time_s,
        images,
        ranges,
        options.lever_arm_m or lever,
        truth,
        places,
        (*notes, *ranges.notes),
        read_vehicle(folder, sections, share),
        sections["ranges"].number("lever_arm_sigma_m") if "ranges" in sections else 0.0,
    )


def _sections(folder: Path) -> dict[str, Settings]:
    path = folder / TOML_NAME
    try:
        raw = read_toml(path)
    except FileNotFoundError:
        raise ConfigError(f"{folder}: expected a folder with {TOML_NAME}, found none") from None
    camera = raw.get("camera")
    if isinstance(camera, dict) and camera.get("distortion") == []:
        del camera["distortion"]
    top = {key: value for key, value in raw.items() if key not in SECTIONS}
    read_settings("", top, known=TOP_KEYS, file=TOML_NAME)
    return {
        name: read_settings(name, raw.get(name, {}), known=keys, file=TOML_NAME)
        for name, keys in SECTIONS.items()
        if name in raw or name in ("camera", "images")
    }


def _camera(
    folder: Path, settings: Settings, options: ReadOptions, size: tuple[int, int]
) -> Camera:
    if options.camera is not None:
        return read_camera(options.camera, size)
    if "file" in settings:
        return read_camera(folder / settings.text("file"), size)
    missing = [k for k in ("width", "height", "fx", "fy", "cx", "cy") if k not in settings]
    if missing:
        raise settings.fault(missing[0], "the key is missing; or name a calibration: file = ...")
    own_size = int(settings.number("width")), int(settings.number("height"))
    intrinsics = [settings.number(k) for k in ("fx", "fy", "cx", "cy")]
    model = settings.text("model") if "model" in settings else "pinhole"
    distortion = settings.array("distortion").tolist() if "distortion" in settings else []
    return make_camera(f"{TOML_NAME} [camera]", own_size, intrinsics, model, distortion)


def _images(
    folder: Path, settings: Settings, options: ReadOptions
) -> tuple[Array, WatchedImages, tuple[int, int], list[str]]:
    """Return times, images, their size and notes."""
    load: Callable[[int], NDArray[Any] | None]
    if "video" in settings:
        frames = VideoFrames(folder / settings.text("video"))
        n_images, rate = frames.n_frames, frames.rate_hz
        paths: list[Path] = []
    else:
        name = settings.text("folder") if "folder" in settings else "images"
        if not (folder / name).is_dir():
            raise settings.fault("folder", f"expected a folder of images, found none at {name!r}")
        paths = image_paths(folder / name)
        n_images, rate = len(paths), 0.0
    rate = options.rate_hz or settings.number("rate_hz") or rate
    start = options.start_s if options.start_s is not None else settings.number("start_s")
    if "times" in settings:
        table = folder / settings.text("times")
        values = number_rows(table, (1, 2))[:, 0]
        if len(values) != n_images:
            raise DataError(
                f"{table}: expected a time for each of {n_images} images, got {len(values)}"
            )
    elif rate > 0.0:
        values = np.arange(n_images) / rate + start
    else:
        raise settings.fault("times", "the key is missing; name a table of times, or give rate_hz")
    order, note = increasing(values, TOML_NAME)
    order = order[chosen_images(len(order), options)]
    bayer = options.bayer or (settings.text("bayer") if "bayer" in settings else "")
    if paths:
        images = image_files([paths[i] for i in order], bayer=bayer)
    else:
        load = lambda k: frames(int(order[k]))  # noqa: E731
        images = WatchedImages(load, *frames.size, lambda k: f"frame {order[k]}", bayer)
    return values[order], images, (images.width, images.height), [note] if note else []


def _ranges(
    folder: Path, settings: Settings | None, options: ReadOptions, time_s: Array
) -> tuple[Ranges, Vector]:
    """Return the ranges and the lever arm."""
    if settings is None and options.ranges is None:
        return screened_ranges([], [], []), (0.0, 0.0, 0.0)
    if settings is None:
        settings = Settings("ranges", {}, TOML_NAME, RANGE_KEYS)
    path = options.ranges or folder / settings.text("file")
    sigma = options.sigma_m or settings.number("sigma_m") or None
    known = read_places(folder / settings.text("anchors")) if "anchors" in settings else None
    texts = {key: settings.text(key) if key in settings else "" for key in ("unit", "time_unit")}
    ranges = read_ranges(
        path,
        time_s,
        sigma_m=sigma,
        unit=options.range_unit or texts["unit"],
        time_unit=options.time_unit or texts["time_unit"],
        known=known,
    )
    lever = settings.array("lever_arm_m") if "lever_arm_m" in settings else np.zeros(3)
    return ranges, (float(lever[0]), float(lever[1]), float(lever[2]))


def _acoustic(ranges: Ranges, settings: Settings | None) -> tuple[Ranges, float]:
    """Return the ranges at the times of the sound at the anchor, and how well its speed is known.

    The latter is a share; 0 for radio, for which nothing changes.
    """
    if settings is None:
        return ranges, 0.0
    speed = settings.number("sound_speed_m_per_s") or SOUND_SPEED
    share = settings.number("sound_speed_sigma_m_per_s") / speed
    if "travel" not in settings:
        return ranges, share
    if settings.text("travel") != "two-way":
        raise settings.fault("travel", f"expected two-way, got {settings.text('travel')!r}")
    return at_the_anchor(ranges, speed)[0], share


def read_places(path: Path) -> dict[str, Array]:
    """Return the places (3,) of anchors by name from a table name, x, y, z in metres."""
    found: dict[str, Array] = {}
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(f"{path}: cannot be read: {error}") from error
    for number, line in enumerate(lines, 1):
        cells = [cell.strip() for cell in line.split("#")[0].split(",")]
        if cells == [""]:
            continue
        try:
            found[cells[0]] = np.array([float(cell) for cell in cells[1:4]])
            is_good = len(cells) >= 4 and bool(np.isfinite(found[cells[0]]).all())
        except ValueError:
            if number == 1:
                continue
            is_good = False
        if not is_good:
            raise DataError(f"{path}:{number}: expected a name and x, y, z in metres, got {line!r}")
    return found


def write_own_folder(folder: Path, sequence: Sequence) -> Iterator[int]:
    """Write a recording as a folder that `read_own_folder` reads; yield images as they are done."""
    cv2 = opencv()
    (folder / "images").mkdir(parents=True, exist_ok=True)
    for index in range(len(sequence)):
        path = folder / "images" / f"{index:06d}.png"
        is_done, png = cv2.imencode(".png", sequence.images(index))
        if not is_done:
            raise DataError(f"{path}: the image could not be encoded")
        path.write_bytes(png.tobytes())
        yield index
    names = ("width", "height", "fx", "fy", "cx", "cy", "model", "distortion")
    values = {name: getattr(sequence.camera, name) for name in names}
    sections: dict[str, Any] = {
        "format": FORMAT,
        "camera": {**values, "distortion": list(sequence.camera.distortion)},
        "images": {"folder": "images", "times": "times.csv"},
    }
    _write_text(folder / "times.csv", "time_s", [f"{t:.9f}" for t in sequence.time_s])
    ranges = sequence.ranges
    if len(ranges):
        sections["ranges"] = {"file": "ranges.csv", "lever_arm_m": list(sequence.lever_arm_m)}
        if sequence.lever_arm_sigma_m:
            sections["ranges"]["lever_arm_sigma_m"] = sequence.lever_arm_sigma_m
        share = sequence.vehicle.range_scale_share
        if share:
            sections["ranges"]["sound_speed_sigma_m_per_s"] = share * SOUND_SPEED
        columns = (ranges.time_s, ranges.anchor, ranges.range_m, ranges.sigma_m)
        rows = [
            f"{t:.9f},{ranges.names[j]},{r:.6f},{s:.6f}"
            for t, j, r, s in zip(*columns, strict=True)
        ]
        _write_text(folder / "ranges.csv", "time_s,anchor,range_m,sigma_m", rows)
    if ranges.is_known.any():
        sections["ranges"]["anchors"] = "known_anchors.csv"
        _write_places(folder / "known_anchors.csv", ranges.names, ranges.known_position)
    sections |= write_vehicle(folder, sequence.vehicle)
    if sequence.truth is not None:
        sections["truth"] = {"path": "truth.tum"}
        t = sequence.truth
        rows = [
            " ".join(f"{x:.9f}" for x in row)
            for row in np.column_stack([t.time_s, t.position_m, t.quaternion])
        ]
        _write_text(folder / "truth.tum", "# time_s x_m y_m z_m qx qy qz qw", rows)
        if sequence.anchor_truth_m is not None:
            sections["truth"]["anchors"] = "true_anchors.csv"
            _write_places(folder / "true_anchors.csv", ranges.names, sequence.anchor_truth_m)
    write_through(folder / TOML_NAME, tomli_w.dumps(sections).encode())


def _write_places(path: Path, names: tuple[str, ...], places: Array) -> None:
    rows = [
        f"{name},{place[0]:.6f},{place[1]:.6f},{place[2]:.6f}"
        for name, place in zip(names, places, strict=False)
        if np.isfinite(place).all()
    ]
    _write_text(path, "anchor,x_m,y_m,z_m", rows)


def _write_text(path: Path, head: str, rows: list[str]) -> None:
    write_through(path, ("\n".join([head, *rows]) + "\n").encode())
