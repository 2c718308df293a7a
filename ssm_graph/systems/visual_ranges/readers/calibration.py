"""Cameras from the usual calibration files: EuRoC, Kalibr, ORB-SLAM, KITTI, ROS, plain 3 x 3."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

import numpy as np

from ssm_graph.base.errors import DataError
from ssm_graph.base.settings import parse_json
from ssm_graph.systems.visual_ranges.camera import N_COEFFICIENTS, Camera

Scalar = float | str | list[float]
MODELS: Final[Mapping[str, str]] = {
    "pinhole": "pinhole",
    "none": "pinhole",
    "": "pinhole",
    "radtan": "radtan",
    "radial-tangential": "radtan",
    "plumb_bob": "radtan",
    "rational_polynomial": "radtan",
    "brown_conrady": "radtan",
    "opencv": "radtan",
    "equidistant": "equidistant",
    "kannalabrandt8": "equidistant",
    "fisheye": "equidistant",
    "opencv_fisheye": "equidistant",
}
"""Names of distortion models in files, in lower case, and ours."""
_NUMBER: Final = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")


def flat_yaml(text: str) -> dict[str, Scalar]:
    """Return the scalars and number lists of a simple YAML file by dotted path.

    Enough for calibration files: nested mappings by indentation, flow lists of numbers over several
    lines, comments; no anchors, no block lists of mappings.
    """
    found: dict[str, Scalar] = {}
    open_keys: list[tuple[int, str]] = []
    lines = iter(text.splitlines())
    for raw in lines:
        line = raw.split(" #")[0].rstrip()
        match = re.match(r"(\s*)(?:- )?([^\s:#%-][^:]*):(?:\s+(.*))?$", line)
        if match is None:
            continue
        indent, key, value = len(match[1]), match[2].strip(), (match[3] or "").strip()
        open_keys = [pair for pair in open_keys if pair[0] < indent]
        path = ".".join([*(name for _, name in open_keys), key])
        if value.startswith("["):
            while value.count("[") > value.count("]"):
                value += " " + next(lines, "]").split(" #")[0].strip()
            found[path] = [float(x) for x in _NUMBER.findall(value)]
        elif value and not value.startswith("!!"):
            text_value = value.strip("\"'")
            found[path] = float(text_value) if _NUMBER.fullmatch(text_value) else text_value
        else:
            open_keys.append((indent, key))
    return found


def read_camera(path: Path, size: tuple[int, int] | None = None) -> Camera:
    """Return the camera of a calibration file, its kind told by its content.

    Raises :class:`DataError` where it is of no known kind or says what cannot be.

    Parameters
    ----------
    path : ``sensor.yaml`` of EuRoC, a chain of Kalibr, settings of ORB-SLAM, ``camera_info`` of
        ROS, ``calib.txt`` of KITTI, ``calib.json`` of STAR-loc, or a matrix of 3 x 3 numbers.
    size : width and height, pixels, for files that do not say them.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(f"{path}: cannot be read as a calibration: {error}") from error
    if path.suffix == ".json":
        return _of_json(path, text, size)
    if path.suffix in (".yaml", ".yml"):
        return _of_yaml(path, flat_yaml(text), size)
    return _of_numbers(path, text, size)


def make_camera(
    where: str,
    size: tuple[int, int] | None,
    intrinsics: Sequence[float],
    model: str = "pinhole",
    distortion: Sequence[float] = (),
) -> Camera:
    """Return a camera after a look at its numbers; ``where`` begins the message of an error.

    Parameters
    ----------
    size : width and height, pixels.
    intrinsics : fx, fy, cx, cy, pixels.
    model : a name of :data:`MODELS`.
    distortion : coefficients of the model, without those that are zero at the end.
    """
    if size is None:
        raise DataError(
            f"{where}: the size of the images is not known; give width and height, or a first "
            "image that can be read"
        )
    if len(intrinsics) != 4 or not np.all(np.isfinite(intrinsics)):
        raise DataError(f"{where}: expected fx, fy, cx, cy, got {list(intrinsics)}")
    ours = MODELS.get(model.strip().lower())
    if ours is None:
        raise DataError(
            f"{where}: expected a distortion model of {', '.join(sorted(set(MODELS) - {''}))}, "
            f"got {model!r}"
        )
    coefficients = tuple(float(x) for x in distortion)
    while coefficients and coefficients[-1] == 0.0:
        coefficients = coefficients[:-1]
    if ours == "radtan" and not coefficients:
        ours = "pinhole"
    elif ours == "pinhole" and coefficients:
        ours = "radtan"
    wanted = next((n for n in N_COEFFICIENTS[ours] if n >= len(coefficients)), None)
    if wanted is None:
        raise DataError(
            f"{where}: expected at most {max(N_COEFFICIENTS[ours])} coefficients of distortion, "
            f"got {len(coefficients)}; undistort the images before, or calibrate with fewer"
        )
    coefficients = (*coefficients, *([0.0] * (wanted - len(coefficients))))
    (width, height), (fx, fy, cx, cy) = size, (float(x) for x in intrinsics)
    _check(where, width, height, fx, fy, cx, cy)
    return Camera(width, height, fx, fy, cx, cy, ours, coefficients)


def _check(where: str, width: int, height: int, fx: float, fy: float, cx: float, cy: float) -> None:
    if width < 64 or height < 64:
        raise DataError(
            f"{where}: expected images of 64 pixels a side or more, got {width} x {height}"
        )
    if not (0.1 * width < fx < 20 * width and 0.5 < fy / fx < 2.0):
        raise DataError(
            f"{where}: focal lengths {fx:g}, {fy:g} cannot be those of images of {width} x "
            f"{height} pixels; they are in pixels, and scale with the images"
        )
    if not (-0.5 * width < cx < 1.5 * width and -0.5 * height < cy < 1.5 * height):
        raise DataError(
            f"{where}: principal point {cx:g}, {cy:g} is far outside of images of {width} x "
            f"{height} pixels; scale the calibration with the images"
        )


def _of_yaml(path: Path, found: dict[str, Scalar], size: tuple[int, int] | None) -> Camera:
    where = str(path)

    def numbers(*names: str) -> list[float]:
        for name in names:
            value = found.get(name)
            if isinstance(value, list):
                return value
            if isinstance(value, float):
                return [value]
        return []

    def word(*names: str) -> str:
        return next((str(found[name]) for name in names if name in found), "")

    if "Camera.fx" in found or "Camera1.fx" in found:
        lead = "Camera1" if "Camera1.fx" in found else "Camera"
        k = [x for name in ("fx", "fy", "cx", "cy") for x in numbers(f"{lead}.{name}")]
        names = [f"{lead}.{x}" for x in ("k1", "k2", "p1", "p2", "k3")]
        kind = word("Camera.type").lower()
        if "kannala" in kind:
            names = [f"{lead}.k{i}" for i in (1, 2, 3, 4)]
        distortion = [numbers(name)[0] if numbers(name) else 0.0 for name in names]
        own = (numbers("Camera.width"), numbers("Camera.height"))
        size = (int(own[0][0]), int(own[1][0])) if own[0] and own[1] else size
        return make_camera(where, size, k, kind if "kannala" in kind else "radtan", distortion)
    if "camera_matrix.data" in found:
        matrix = numbers("camera_matrix.data")
        own = (numbers("image_width"), numbers("image_height"))
        size = (int(own[0][0]), int(own[1][0])) if own[0] and own[1] else size
        k = [matrix[i] for i in (0, 4, 2, 5)] if len(matrix) == 9 else matrix
        kind = word("distortion_model", "camera_model")
        return make_camera(where, size, k, kind, numbers("distortion_coefficients.data"))
    lead = "cam0." if "cam0.intrinsics" in found else ""
    k = numbers(f"{lead}intrinsics")
    if not k:
        raise DataError(
            f"{where}: expected a calibration of EuRoC or Kalibr (intrinsics), ORB-SLAM "
            "(Camera.fx) or ROS (camera_matrix), found none"
        )
    own_size = numbers(f"{lead}resolution")
    size = (int(own_size[0]), int(own_size[1])) if len(own_size) == 2 else size
    return make_camera(
        where,
        size,
        k,
        word(f"{lead}distortion_model"),
        numbers(f"{lead}distortion_coefficients", f"{lead}distortion_coeffs"),
    )


def _of_json(path: Path, text: str, size: tuple[int, int] | None) -> Camera:
    try:
        found = parse_json(text)
        k = [float(found[name]) for name in ("fu", "fv", "cu", "cv")]
    except (KeyError, TypeError, ValueError) as error:
        raise DataError(f"{path}: expected JSON with fu, fv, cu, cv: {error}") from error
    return make_camera(str(path), size, k)


def _of_numbers(path: Path, text: str, size: tuple[int, int] | None) -> Camera:
    row = next((line for line in text.splitlines() if line.startswith("P0:")), None)
    values = [float(x) for x in _NUMBER.findall(row.partition(":")[2] if row else text)]
    if row is not None and len(values) == 12:
        return make_camera(str(path), size, [values[i] for i in (0, 5, 2, 6)])
    if row is None and len(values) == 9:
        return make_camera(str(path), size, [values[i] for i in (0, 4, 2, 5)])
    if row is None and len(values) in (4, 8, 9):
        return make_camera(str(path), size, values[:4], "radtan", values[4:])
    raise DataError(
        f"{path}: expected a line 'P0:' of 12 numbers (KITTI), a 3 x 3 matrix, or fx fy cx cy and "
        f"coefficients, got {len(values)} numbers"
    )
