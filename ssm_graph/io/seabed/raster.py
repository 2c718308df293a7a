"""A raster as its file has it, and the same about a navigation frame."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from typing import Final

import numpy as np

from ssm_graph.base.earth import LocalFrame
from ssm_graph.base.errors import ConfigError, DataError
from ssm_graph.base.frozen import Array, FrozenArrays, optional_shaped, shaped
from ssm_graph.base.projection import TransverseMercator
from ssm_graph.base.units import DEGREE
from ssm_graph.sensors.seabed import SeabedGrid

LOCAL: Final = "local"
GEOGRAPHIC: Final = "EPSG:4326"
_GEOGRAPHIC_CODES: Final = (4326, 4258, 4979, 4937, 4269)
"""WGS 84, ETRS89 and NAD83, in two dimensions or three: alike within a metre or two."""
_UTM_CODES: Final = ((32600, 60, True), (32700, 60, False), (25800, 60, True), (26900, 23, True))
"""First code less the zone, last zone, and whether it is north: WGS 84, ETRS89, NAD83."""
MOST_CELLS: Final = 6_000_000
"""Of a map about a mission; a larger one is cut, or made coarser."""
FARTHEST_M: Final = 30_000.0
"""From the origin of a frame; what lies beyond is left out."""
DEEPEST_M: Final = 12_000.0
"""No place on Earth is so far from the sea's surface: 1e35, 99999 and -32768 stand for none."""
NO_DATA: Final = (-9999.0, 9999.0)
"""So do these, whole and to the digit."""
_TRY: Final = (
    "expected local, EPSG:4326 (degrees) or a UTM zone as EPSG:326zz, EPSG:327zz or EPSG:258zz; "
    "convert other maps, for example with  gdalwarp -t_srs EPSG:4326"
)


def known(values: Array) -> Array:
    """Return heights, m, with NaN for what stands for none, whether its file says so or not."""
    none = (np.abs(values) > DEEPEST_M) | np.isin(values, NO_DATA)
    return np.where(none, np.nan, values)


@dataclass(frozen=True, slots=True)
class Plane:
    """What the two coordinates of a raster are."""

    crs: str
    """As the user or the file names it."""
    mercator: TransverseMercator | None = None
    """None for degrees of longitude and latitude, and for metres about a frame."""
    y0: float = 0.0
    """Added to northings."""

    @property
    def is_local(self) -> bool:
        """Whether it is metres east and north in the axes of a frame."""
        return self.crs == LOCAL

    def forward(self, lat: Array, lon: Array, x_like: float) -> tuple[Array, Array]:
        """Return x and y (...) of latitudes and longitudes, rad; x as near to one as it can be."""
        if self.mercator is not None:
            x, y = np.moveaxis(self.mercator.forward(lat, lon), -1, 0)
            return x, y + self.y0
        x = lon / DEGREE
        return x + 360.0 * np.round((x_like - x) / 360.0), lat / DEGREE

    def inverse(self, x: Array, y: Array) -> tuple[Array, Array]:
        """Return latitudes and longitudes (...), rad."""
        if self.mercator is not None:
            return self.mercator.inverse(np.stack([x, y - self.y0], axis=-1))
        return np.asarray(y * DEGREE), np.asarray(x * DEGREE)


def plane_of(crs: str, where: str) -> Plane:
    """Return the plane of a coordinate system by its name; raise :class:`ConfigError`."""
    if crs.lower() == LOCAL:
        return Plane(LOCAL)
    found = re.fullmatch(r"(?:EPSG:)?(\d+)", crs.strip(), re.IGNORECASE)
    code = int(found[1]) if found else 0
    if code in _GEOGRAPHIC_CODES:
        return Plane(f"EPSG:{code}")
    for base, last, is_north in _UTM_CODES:
        zone = code - base
        if 1 <= zone <= last:
            middle = TransverseMercator(0.0, (6.0 * zone - 183.0) * DEGREE, 0.9996, 500e3)
            return Plane(f"EPSG:{code}", middle, 0.0 if is_north else 10e6)
    raise ConfigError(f"{where}: the coordinate system {crs!r} is not known here; {_TRY}")


@dataclass(frozen=True, slots=True, eq=False)
class Raster(FrozenArrays):
    """Values at crossings of columns and rows, in the coordinates of their file."""

    name: str
    crs: str
    """Empty where the file does not say."""
    x: Array = shaped("C")
    """(C,) of the columns, evenly spaced, increasing"""
    y: Array = shaped("R")
    """(R,) of the rows, evenly spaced, increasing"""
    values: Array = shaped("R", "C")
    """(R, C) as in the file, m; NaN where it has none"""
    sigma: Array | None = optional_shaped("R", "C")
    """(R, C) m, where the file states it"""
    is_down: bool | None = None
    """Whether values grow downwards; None where the file does not say."""

    def __post_init__(self) -> None:
        super(Raster, self).__post_init__()
        for axis, at in (("columns", self.x), ("rows", self.y)):
            step = np.diff(at)
            if len(at) < 4:
                raise DataError(f"{self.name}: expected at least 4 {axis}, got {len(at)}")
            low, high = float(step.min()), float(step.max())
            # Written so that what is not a number is refused as well.
            if not (low > 0.0 and high - low <= 0.01 * step.mean()):
                raise DataError(
                    f"{self.name}: expected {axis} that increase by even steps, got steps from "
                    f"{low:.6g} to {high:.6g}; grid the soundings again"
                )


def frame_of(raster: Raster, plane: Plane) -> LocalFrame:
    """Return a frame about the middle of a raster that says where on Earth it is."""
    x, y = 0.5 * (raster.x[0] + raster.x[-1]), 0.5 * (raster.y[0] + raster.y[-1])
    lat, lon = plane.inverse(np.array(x), np.array(y))
    return LocalFrame(float(lat), float(lon), 0.0)


def grid_of(
    raster: Raster,
    plane: Plane,
    frame: LocalFrame,
    *,
    is_down: bool,
    datum_m: float,
) -> SeabedGrid:
    """Return a raster as heights about a navigation frame, up to 30 km from its origin each way.

    Parameters
    ----------
    is_down : whether its values are depths, positive down.
    datum_m : height of its zero above the ellipsoid, m.

    Raises :class:`DataError` where the raster lies elsewhere.
    """
    height = datum_m + (-raster.values if is_down else raster.values)
    if plane.is_local:
        step, step_y = (float(np.ptp(at)) / (len(at) - 1) for at in (raster.x, raster.y))
        if abs(step_y - step) < 1e-6 * step:
            return SeabedGrid(
                *(raster.name, frame, float(raster.x[0]), float(raster.y[0]), step, height),
                raster.sigma,
            )
    x_m, y_m, cell = _wanted(raster, plane, frame)
    row, column = _rows_and_columns(raster, plane, frame, x_m, y_m, float(np.nanmedian(height)))
    found = _interpolated(height, row, column)
    if not np.isfinite(found).any():
        raise DataError(
            f"{raster.name}: the map has no heights within the square about the mission; is it of "
            "another place?"
        )
    sigma = None if raster.sigma is None else _interpolated(raster.sigma, row, column)
    return SeabedGrid(raster.name, frame, float(x_m[0]), float(y_m[0]), cell, found, sigma)


def _wanted(raster: Raster, plane: Plane, frame: LocalFrame) -> tuple[Array, Array, float]:
    """Return columns and rows of the raster that is made, and its cell, m."""
    if plane.is_local:
        x_edge, y_edge = raster.x[[0, -1]], raster.y[[0, -1]]
        cell = float(min(np.diff(raster.x[:2])[0], np.diff(raster.y[:2])[0]))
    else:
        along = np.linspace(0.0, 1.0, 21)
        x_at = raster.x[0] + along * np.ptp(raster.x)
        y_at = raster.y[0] + along * np.ptp(raster.y)
        lat, lon = plane.inverse(*np.meshgrid(x_at, y_at))
        p_n = frame.p_n_from_geodetic(lat, lon, 0.0)
        distance = float(np.linalg.norm(p_n, axis=-1).min())
        x_edge = np.array([p_n[..., 0].min(), p_n[..., 0].max()])
        y_edge = np.array([p_n[..., 1].min(), p_n[..., 1].max()])
        if distance > 10.0 * FARTHEST_M:
            raise DataError(
                f"{raster.name}: the map is {distance / 1e3:.0f} km from the mission; expected one "
                "of the same place; are latitude and longitude, or easting and northing, swapped?"
            )
        middle = p_n[10:12, 10:12].reshape(-1, 3)
        steps = np.linalg.norm(middle[1:3] - middle[0], axis=1) * 20.0
        cell = float(min(steps[0] / (len(raster.x) - 1), steps[1] / (len(raster.y) - 1)))
    low = np.maximum([x_edge[0], y_edge[0]], -FARTHEST_M)
    high = np.minimum([x_edge[1], y_edge[1]], FARTHEST_M)
    if np.any(high - low < 3.0 * cell):
        raise DataError(
            f"{raster.name}: the map covers {x_edge[0]:.0f} to {x_edge[1]:.0f} m east and "
            f"{y_edge[0]:.0f} to {y_edge[1]:.0f} m north of the mission's origin; expected it to "
            f"lie within {FARTHEST_M:.0f} m"
        )
    cell = max(cell, math.sqrt(float(np.prod(high - low)) / MOST_CELLS))
    return np.arange(low[0], high[0], cell), np.arange(low[1], high[1], cell), cell


def _rows_and_columns(
    raster: Raster, plane: Plane, frame: LocalFrame, x_m: Array, y_m: Array, height: float
) -> tuple[Array, Array]:
    """Return where points of the frame's plane lie in a raster, in rows and columns from 0."""
    x, y = np.meshgrid(x_m, y_m)
    if not plane.is_local:
        # Up in n until the point has the seabed's height: a hundred metres turn by 1.6 mm at 10 km.
        up = np.zeros_like(x)
        for _ in range(2):
            lat, lon, above = frame.geodetic_from_p_n(np.stack([x, y, up], axis=-1))
            up = up + height - above
        lat, lon, _ = frame.geodetic_from_p_n(np.stack([x, y, up], axis=-1))
        x, y = plane.forward(lat, lon, float(raster.x.mean()))
    step_x = float(np.ptp(raster.x)) / (len(raster.x) - 1)
    step_y = float(np.ptp(raster.y)) / (len(raster.y) - 1)
    return (y - raster.y[0]) / step_y, (x - raster.x[0]) / step_x


def _interpolated(values: Array, row: Array, column: Array) -> Array:
    """Return values between cells by cubic splines; NaN beside a cell that has none."""
    from scipy.ndimage import distance_transform_edt, map_coordinates

    missing = ~np.isfinite(values)
    if missing.any():
        nearest = distance_transform_edt(missing, return_distances=False, return_indices=True)
        values = values[tuple(nearest)]
    found = map_coordinates(values, [row, column], order=3, mode="constant", cval=np.nan)
    near = map_coordinates(missing.astype(float), [row, column], order=1, mode="constant", cval=1.0)
    return np.where(near > 1e-6, np.nan, found)
