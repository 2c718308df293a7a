"""NetCDF as GEBCO, EMODnet and GMT write it: one variable over two coordinates."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from ssm_graph.base.errors import DataError, MissingExtraError
from ssm_graph.base.frozen import Array
from ssm_graph.io.seabed.raster import GEOGRAPHIC, Raster, known

_X: Final = ("lon", "longitude", "x", "easting")
_Y: Final = ("lat", "latitude", "y", "northing")
_UP: Final = ("elevation", "z", "height", "topo", "altitude", "band1")
_EITHER: Final = ("z", "band1")
"""Names of heights and of depths: the sign of the values tells."""
_DOWN: Final = ("depth", "bathymetry_depth")
_HDF: Final = b"\x89HDF"


def read_netcdf(path: Path) -> Raster:
    """Read the variable of heights or depths; raise :class:`DataError` where there is none."""
    with path.open("rb") as file:
        is_hdf = file.read(4) == _HDF
    found = _of_hdf(path) if is_hdf else _of_classic(path)
    names = {name.lower(): name for name in found}
    x, y = (next((names[n] for n in known if n in names), None) for known in (_X, _Y))
    z = next((names[n] for n in (*_UP, *_DOWN) if n in names), None)
    if x is None or y is None or z is None:
        raise DataError(
            f"{path.name}: expected variables lon, lat (or x, y) and elevation, z or depth, got "
            f"{', '.join(sorted(found)) or 'none'}"
        )
    columns, rows = found[x][0], found[y][0]
    values, attributes, axes = found[z]
    values = values.reshape([n for n in values.shape if n > 1])  # one time, one level
    axes = [name for name in axes if name in (x, y)]
    if axes == [x, y] and values.shape == (len(columns), len(rows)):
        values = values.T
    if columns.ndim != 1 or rows.ndim != 1:
        raise DataError(
            f"{path.name}: expected {x} and {y} of one dimension each, got a grid that is turned "
            "or curved; warp it first, with  gdalwarp -t_srs EPSG:4326"
        )
    if values.shape != (len(rows), len(columns)):
        raise DataError(
            f"{path.name}: expected {z} over rows {y} and columns {x}, {len(rows)} by "
            f"{len(columns)}, got {' by '.join(map(str, values.shape))}"
        )
    if columns[0] > columns[-1]:
        columns, values = columns[::-1], values[:, ::-1]
    if rows[0] > rows[-1]:
        rows, values = rows[::-1], values[::-1]
    positive = str(attributes.get("positive", "")).lower()
    if positive in ("up", "down"):
        is_down: bool | None = positive == "down"
    elif z.lower() in _DOWN:
        heights = known(values)
        is_down = not np.all(heights[np.isfinite(heights)] < 0.0)  # by the name of depths
    else:
        is_down = None if z.lower() in _EITHER else False
    crs = GEOGRAPHIC if x.lower() in _X[:2] else ""
    return Raster(path.name, crs, columns, rows, values, is_down=is_down)


Variables = Mapping[str, tuple[Array, Mapping[str, Any], Sequence[str]]]
"""Numbers by name, scaled, NaN where there are none, with attributes and names of the axes."""


def _of_hdf(path: Path) -> Variables:
    try:
        import h5py
    except ImportError as error:
        raise MissingExtraError("h5py", extra="map", purpose=f"{path.name}, NetCDF 4,") from error
    found = {}
    try:
        with h5py.File(path, "r") as file:
            for name, variable in file.items():
                if (
                    isinstance(variable, h5py.Dataset)
                    and variable.dtype.kind in "iuf"
                    and variable.shape
                ):
                    attributes = {k: _plain(v) for k, v in variable.attrs.items()}
                    axes = [_axis(dimension) for dimension in variable.dims]
                    numbers = _scaled(np.asarray(variable[()]), attributes)
                    found[name] = numbers, attributes, axes
    except (OSError, RuntimeError, KeyError, ValueError) as error:
        raise _damaged(path, error) from error
    return found


def _axis(dimension: Any) -> str:
    """Return the name of the scale of a dimension; empty where there is none."""
    return str(dimension[0].name).lstrip("/") if len(dimension) else ""


def _of_classic(path: Path) -> Variables:
    from scipy.io import netcdf_file

    found = {}
    try:
        with netcdf_file(path, "r", mmap=False) as file:
            for name, variable in file.variables.items():
                if variable.shape:
                    attributes = {k: _plain(v) for k, v in variable._attributes.items()}
                    numbers = _scaled(np.asarray(variable[:]), attributes)
                    found[name] = numbers, attributes, list(variable.dimensions)
    except (TypeError, ValueError, IndexError, KeyError) as error:
        raise _damaged(path, error) from error
    return found


def _damaged(path: Path, error: Exception) -> DataError:
    return DataError(f"{path.name}: expected NetCDF, got {error}; is the file cut off?")


def _plain(value: Any) -> Any:
    """Return an attribute as text or number."""
    if isinstance(value, bytes):
        return value.decode("utf-8", "replace")
    array = np.asarray(value)
    return array.ravel()[0].item() if array.size and array.dtype.kind in "iuf" else value


def _scaled(values: Any, attributes: Mapping[str, Any]) -> Array:
    """Return numbers as CF has them: filled ones missing, scaled and shifted."""
    numbers = np.array(values, dtype=np.float64)
    for key in ("_FillValue", "missing_value"):
        if isinstance(attributes.get(key), int | float):
            numbers[numbers == attributes[key]] = np.nan
    return numbers * float(attributes.get("scale_factor", 1.0)) + float(
        attributes.get("add_offset", 0.0)
    )
