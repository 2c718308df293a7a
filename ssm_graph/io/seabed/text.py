"""Maps in text: ESRI ASCII grids, and soundings as lines of x, y and z."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Final

import numpy as np

from ssm_graph.base.errors import DataError
from ssm_graph.base.frozen import Array
from ssm_graph.io.seabed.raster import Raster, known
from ssm_graph.sensors.seabed import SeabedGrid

_HEADER: Final = ("ncols", "nrows", "xllcorner", "xllcenter", "yllcorner", "yllcenter", "cellsize")
_HEADER_ALSO: Final = ("dx", "dy", "nodata_value")
_NAMES: Final = {
    "x": ("x", "x_m", "lon", "lon_deg", "longitude", "easting", "east"),
    "y": ("y", "y_m", "lat", "lat_deg", "latitude", "northing", "north"),
    "z": ("z", "z_m", "depth", "depth_m", "height", "height_m", "elevation"),
    "sigma": ("sigma", "sigma_m", "uncertainty", "tpu", "std"),
}
_FILLED_CELLS: Final = 3.0
"""Holes between soundings are bridged where one is no farther than so many cells."""
_REGULAR: Final = 0.5
"""Share of the crossings that have a sounding, at least, of a file that is a raster already."""


def read_ascii_grid(path: Path) -> Raster:
    """Read an ESRI ASCII grid; raise :class:`DataError` with the line."""
    header: dict[str, float] = {}
    with path.open(encoding="utf-8-sig", errors="replace") as file:
        lines = file.read().split("\n")
    first = 0
    for first, line in enumerate(lines):
        words = line.split()
        if len(words) != 2 or words[0].lower() not in (*_HEADER, *_HEADER_ALSO):
            break
        header[words[0].lower()] = _number(words[1], path, first + 1)
    missing = {"ncols", "nrows"} - header.keys()
    if "cellsize" not in header and not {"dx", "dy"} <= header.keys():
        missing.add("cellsize")
    missing |= {
        f"{axis}llcorner"
        for axis in "xy"
        if not {f"{axis}llcorner", f"{axis}llcenter"} & set(header)
    }
    if missing:
        raise DataError(
            f"{path.name}, line {first + 1}: expected a header with {', '.join(sorted(missing))}, "
            "as ESRI ASCII grids have; an XYZ file ends with .xyz"
        )
    for name in ("ncols", "nrows"):
        if not (header[name] >= 1.0 and header[name].is_integer()):
            raise DataError(f"{path.name}: {name}: expected a count, got {header[name]:g}")
    n_x, n_y = int(header["ncols"]), int(header["nrows"])
    dx = header.get("cellsize", header.get("dx", 0.0))
    dy = header.get("cellsize", header.get("dy", 0.0))
    words = " ".join(lines[first:]).split()
    if len(words) != n_x * n_y:
        raise DataError(
            f"{path.name}: expected {n_y} rows of {n_x} numbers, {n_x * n_y} in all, got "
            f"{len(words)}; is the file cut off?"
        )
    try:
        values = np.array(words, dtype=np.float64).reshape(n_y, n_x)[::-1]
    except ValueError:
        for number, line in enumerate(lines[first:], first + 1):
            for word in line.split():
                _number(word, path, number)
        raise
    values = np.where(values == header.get("nodata_value", -9999.0), np.nan, values)
    west, south = (
        header[f"{axis}llcenter"]
        if f"{axis}llcenter" in header
        else header[f"{axis}llcorner"] + 0.5 * step
        for axis, step in (("x", dx), ("y", dy))
    )
    return Raster(
        path.name,
        "",
        np.asarray(west + dx * np.arange(n_x)),
        np.asarray(south + dy * np.arange(n_y)),
        values,
    )


def _number(word: str, path: Path, line: int) -> float:
    try:
        return float(word)
    except ValueError:
        raise DataError(f"{path.name}, line {line}: expected a number, got {word[:40]!r}") from None


def write_ascii_grid(path: Path, grid: SeabedGrid, values: Array) -> None:
    """Write values (R, C) of a grid, all digits, in the plane of its frame (``crs = "local"``)."""
    n_y, n_x = values.shape
    lines = [
        *(
            f"ncols {n_x}",
            f"nrows {n_y}",
            f"xllcenter {float(grid.x0_m)!r}",
            f"yllcenter {float(grid.y0_m)!r}",
        ),
        *(f"cellsize {float(grid.cell_m)!r}", "NODATA_value -9999"),
    ]
    shown = np.where(np.isfinite(values), values, -9999.0)[::-1].tolist()
    lines += [" ".join(map(repr, row)) for row in shown]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def read_xyz(path: Path) -> Raster:
    """Read soundings, a raster already or made one; raise :class:`DataError` with the line.

    Columns are x, y, z and, if there is a fourth, the standard deviation of z, m, or what a header
    names; they are parted by blanks, commas, semicolons or tabs.
    """
    columns = {"x": 0, "y": 1, "z": 2, "sigma": 3}
    rows: list[list[float]] = []
    named = False
    for number, line in enumerate(path.read_text("utf-8-sig", errors="replace").split("\n"), 1):
        # Where semicolons part the numbers, commas are those of decimals.
        parted = line.replace(",", ".").replace(";", " ") if ";" in line else line.replace(",", " ")
        words = parted.split()
        if not words or words[0].startswith("#"):
            continue
        if not rows and not named and not _is_number(words[0]):
            columns, named = _columns(words, path, number), True
            continue
        if len(words) <= max(columns["x"], columns["y"], columns["z"]):
            raise DataError(
                f"{path.name}, line {number}: expected x, y and z, got {len(words)} numbers"
            )
        rows.append([_number(word, path, number) for word in words])
        if not all(math.isfinite(rows[-1][columns[axis]]) for axis in "xy"):
            raise DataError(f"{path.name}, line {number}: expected a place, got {line[:40]!r}")
    width = min(map(len, rows), default=0)
    if len(rows) < 16:
        raise DataError(f"{path.name}: expected at least 16 soundings, got {len(rows)}")
    table = np.array([row[:width] for row in rows])
    x, y, z = (table[:, columns[name]] for name in ("x", "y", "z"))
    at = columns.get("sigma", width)
    return _gridded(path.name, x, y, z, table[:, at] if at < width else None)


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _columns(words: list[str], path: Path, line: int) -> dict[str, int]:
    lowered = [word.lower() for word in words]
    found = {}
    for name, usual in _NAMES.items():
        at = [i for i, word in enumerate(lowered) if word in usual]
        if at:
            found[name] = at[0]
    for name in ("x", "y", "z"):
        if name not in found:
            raise DataError(
                f"{path.name}, line {line}: no column is {name}; expected one of "
                f"{', '.join(_NAMES[name])} in the header"
            )
    return found


def _gridded(name: str, x: Array, y: Array, z: Array, sigma: Array | None) -> Raster:
    """Return soundings as a raster: as they lie, or joined by triangles where they lie anyhow."""
    steps = [_step(x), _step(y)]
    shape = [
        round(np.ptp(a) / s) + 1 if s > 0.0 else 0 for a, s in zip((y, x), steps[::-1], strict=True)
    ]
    is_raster = all(n > 3 for n in shape) and len(x) >= _REGULAR * shape[0] * shape[1]
    if is_raster:
        column, row = np.rint((x - x.min()) / steps[0]), np.rint((y - y.min()) / steps[1])
        is_raster = bool(
            np.abs(column * steps[0] + x.min() - x).max() < 0.05 * steps[0]
            and np.abs(row * steps[1] + y.min() - y).max() < 0.05 * steps[1]
        )
    if not is_raster:
        return _triangulated(name, x, y, z, sigma)
    at = row.astype(int), column.astype(int)
    values = np.full(shape, np.nan)
    values[at] = z
    own = None
    if sigma is not None:
        own = np.full(shape, np.nan)
        own[at] = sigma
    columns = x.min() + steps[0] * np.arange(shape[1])
    return Raster(name, "", columns, y.min() + steps[1] * np.arange(shape[0]), values, own)


def _step(at: Array) -> float:
    """Return the smallest distance of columns, 0 where there is but one."""
    distinct = np.unique(at)
    gaps = np.diff(distinct)
    gaps = gaps[gaps > 1e-6 * max(np.ptp(distinct), 1e-12)]
    return float(gaps.min()) if len(gaps) else 0.0


def _triangulated(name: str, x: Array, y: Array, z: Array, sigma: Array | None) -> Raster:
    """Return a raster with about one sounding a cell, small holes bridged by triangles."""
    from scipy.interpolate import LinearNDInterpolator
    from scipy.spatial import Delaunay, QhullError, cKDTree

    there = np.isfinite(known(z))  # between one that is none and a sounding lies nothing
    if there.sum() < 3:
        raise DataError(f"{name}: expected soundings with heights, got {there.sum()} of {len(z)}")
    x, y, z = x[there], y[there], z[there]
    sigma = None if sigma is None else sigma[there]
    on_line = DataError(f"{name}: expected soundings over an area, got them on a line")
    cell = float(np.sqrt(np.ptp(x) * np.ptp(y) / len(x)))
    if not cell > 0.0:
        raise on_line
    try:
        triangles = Delaunay(np.column_stack([x, y]))
    except QhullError as error:
        raise on_line from error
    columns = np.arange(x.min(), x.max() + cell, cell)
    rows = np.arange(y.min(), y.max() + cell, cell)
    at = np.stack(np.meshgrid(columns, rows), axis=-1)
    distance, _ = cKDTree(triangles.points).query(at.reshape(-1, 2))
    far = distance.reshape(at.shape[:2]) > _FILLED_CELLS * cell
    values = np.where(far, np.nan, LinearNDInterpolator(triangles, z)(at))
    own = None if sigma is None else np.asarray(LinearNDInterpolator(triangles, sigma)(at))
    return Raster(name, "", columns, rows, values, own)
