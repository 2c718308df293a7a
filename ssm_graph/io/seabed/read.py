"""Any map of the seabed by the ending of its file."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np

from ssm_graph.base.earth import LocalFrame
from ssm_graph.base.errors import ConfigError, DataError
from ssm_graph.base.frozen import Array
from ssm_graph.io.seabed.geotiff import read_geotiff
from ssm_graph.io.seabed.netcdf import read_netcdf
from ssm_graph.io.seabed.raster import (
    GEOGRAPHIC,
    Plane,
    Raster,
    frame_of,
    grid_of,
    known,
    plane_of,
)
from ssm_graph.io.seabed.text import read_ascii_grid, read_xyz
from ssm_graph.sensors.seabed import SeabedGrid

_BOTH_SIGNS: Final = 0.01
"""Share of the values beyond which those of the other sign are no tidal flats' edge."""

READERS: Final[dict[str, Callable[[Path], Raster]]] = {
    ".tif": read_geotiff,
    ".tiff": read_geotiff,
    ".nc": read_netcdf,
    ".grd": read_netcdf,
    ".asc": read_ascii_grid,
    ".xyz": read_xyz,
    ".txt": read_xyz,
    ".csv": read_xyz,
}


def read_raster(path: Path) -> Raster:
    """Read a map as its file has it; raise :class:`DataError` or :class:`ConfigError`."""
    reader = READERS.get(path.suffix.lower())
    if reader is None:
        raise ConfigError(
            f"{path.name}: expected a map that ends with {', '.join(READERS)}, got {path.suffix!r}"
        )
    if not path.is_file():
        raise ConfigError(f"{path}: there is no such map")
    return reader(path)


def read_seabed(
    path: Path,
    frame: LocalFrame | None,
    *,
    crs: str = "",
    is_down: bool | None = None,
    datum_m: float = 0.0,
    sigma: Path | None = None,
) -> SeabedGrid:
    """Read a map about a navigation frame, or about its own middle.

    Parameters
    ----------
    path : GeoTIFF, NetCDF, ESRI ASCII grid or XYZ.
    frame : None for one about the map's middle.
    crs : of its coordinates; empty for what the file says.
    is_down : whether its values are depths; None for what the file says, or else their sign.
    datum_m : height of its zero above the ellipsoid, m.
    sigma : a map of the same raster with standard deviations, m.
    """
    raster = read_raster(path)
    raster = replace(raster, values=known(raster.values))
    if not np.isfinite(raster.values).any():
        raise DataError(f"{path.name}: no cell has a height; is the no-data value right?")
    if sigma is not None:
        other = read_raster(sigma)
        if other.values.shape != raster.values.shape:
            raise DataError(
                f"{sigma.name}: expected the raster of {path.name}, "
                f"{' by '.join(map(str, raster.values.shape))}, got "
                f"{' by '.join(map(str, other.values.shape))}"
            )
        off = max(_cells_off(raster.x, other.x), _cells_off(raster.y, other.y))
        if off > 0.5:
            raise DataError(
                f"{sigma.name}: expected the raster of {path.name}, got one that lies up to "
                f"{off:.3g} cells beside it"
            )
        raster = replace(raster, sigma=other.values)
    plane = _plane(raster, crs)
    if plane.is_local and frame is None:
        raise ConfigError(
            f"{path.name}: a map in local metres has no place of its own; give the mission's "
            "[origin], or the map's coordinate system"
        )
    down = raster.is_down if is_down is None else is_down
    if down is None:
        down = _is_down(raster)
    return grid_of(
        raster,
        plane,
        frame or frame_of(raster, plane),
        is_down=down,
        datum_m=datum_m,
    )


def _is_down(raster: Raster) -> bool:
    """Whether values are depths, by their sign; raise :class:`ConfigError` where they have both."""
    heights = raster.values[np.isfinite(raster.values)]
    positive = float(np.mean(heights > 0.0))
    if min(positive, float(np.mean(heights < 0.0))) > _BOTH_SIGNS:
        raise ConfigError(
            f"{raster.name}: {100.0 * positive:.0f} % of the values are above zero and others "
            'below, and the file does not say which way they count; give values = "heights" or '
            '"depths" in [map] of mission.toml'
        )
    return positive > 0.5


def _cells_off(at: Array, other: Array) -> float:
    return float(np.abs(other - at).max() / (at[1] - at[0]))


def _plane(raster: Raster, crs: str) -> Plane:
    """Return the plane that is stated, that of the file, or degrees where numbers look like it."""
    named = crs or raster.crs
    if not named:
        west, east = raster.x[[0, -1]]
        south, north = raster.y[[0, -1]]
        step = float(raster.x[1] - raster.x[0])
        if -180.0 <= west < east <= 360.0 and -90.0 <= south < north <= 90.0 and step < 0.1:
            named = GEOGRAPHIC
        else:
            raise ConfigError(
                f"{raster.name}: the file does not say what its coordinates are, x {west:.6g} to "
                f"{east:.6g}, y {south:.6g} to {north:.6g}; give crs in "
                "[map] of mission.toml, such as EPSG:32633, or local for metres east and north of "
                "the mission's origin"
            )
    return plane_of(named, raster.name)
