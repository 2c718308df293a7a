"""A bathymetric map in the plane of a navigation frame, and the DVL's ranges to compare with it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Final, NamedTuple

import numpy as np

from ssm_graph.base.earth import LocalFrame
from ssm_graph.base.errors import DataError
from ssm_graph.base.frozen import Array, FrozenArrays, optional_shaped, shaped
from ssm_graph.sensors.dvl import DvlLog

_LEAST_WAY_M: Final = 0.05
"""A vehicle that hardly moves sees the same cell again: its pings count no less than this way."""
_MET_AGAIN: Final = 2.0
"""What beams ahead met, beams astern meet again."""


@dataclass(frozen=True, slots=True)
class MapErrors:
    """How far a map, and the ranges that are compared with it, may be off; 1 sigma, all heights."""

    sigma_m: float = 0.2
    """Of each cell for itself; where the map has a sigma of its own, that counts."""
    smooth_sigma_m: float = 0.3
    """Of what is alike over ``smooth_m``: sound speed, tide and motion of the survey."""
    smooth_m: float = 200.0
    bias_sigma_m: float = 1.0
    """Of what is alike everywhere: datum and tide, against the depth sensor."""
    bias_correlation_s: float = 21600.0
    """Of so long before, 37 percent of it are left: the tide turns."""
    range_noise_m: float = 0.1
    """Of a range, beside ..."""
    range_noise_share: float = 0.005
    """... this share of it."""

    def cell_factor(self, cell_m: float, way_m: Array) -> Array:
        """Return by how much the variance of a cell counts more: several pings meet the same one.

        ``way_m`` (...) is the way since the ping before.
        """
        return np.maximum(1.0, _MET_AGAIN * cell_m / np.maximum(way_m, _LEAST_WAY_M))

    def smooth_factor(self, way_m: Array) -> Array:
        """Return the same of the map's smooth errors, where nothing models them."""
        return np.maximum(1.0, 2.0 * self.smooth_m / np.maximum(way_m, _LEAST_WAY_M))

    def range_sigma(self, range_m: Array) -> Array:
        """Return the standard deviations of ranges, m."""
        return np.hypot(self.range_noise_m, self.range_noise_share * range_m)


class Surface(NamedTuple):
    """The seabed under points, leading axes (...); NaN where the map has none."""

    height: Array
    """(...) m above the ellipsoid"""
    slope: Array
    """(..., 2) of the height, towards x and y, m/m"""


@dataclass(frozen=True, slots=True, eq=False)
class SeabedGrid(FrozenArrays):
    """Heights of the seabed on a square raster over the plane of a navigation frame.

    A point of the raster is x east and y north of the frame's origin in its own axes (that touch
    the Earth there); its height is above the ellipsoid, so that the Earth's curvature is in it.
    """

    name: str
    frame: LocalFrame
    x0_m: float
    """Of the first column."""
    y0_m: float
    """Of the first row, the southernmost."""
    cell_m: float
    height: Array = shaped("R", "C")
    """(R, C) m above the ellipsoid, rows to the north, columns to the east; NaN where unknown."""
    sigma: Array | None = optional_shaped("R", "C")
    """(R, C) m, of each cell for itself; None for that of the map's errors."""

    def __post_init__(self) -> None:
        super(SeabedGrid, self).__post_init__()
        if min(self.height.shape) < 4:
            raise DataError(
                f"{self.name}: expected a raster of at least 4 by 4 cells, got "
                f"{self.height.shape[0]} by {self.height.shape[1]}; take a larger piece of the map"
            )
        if not np.isfinite(self.height).any():
            raise DataError(f"{self.name}: no cell has a height; is the no-data value right?")

    @property
    def middle(self) -> Array:
        """(2,) m."""
        n_y, n_x = self.height.shape
        return np.array([self.x0_m, self.y0_m]) + 0.5 * self.cell_m * np.array([n_x - 1, n_y - 1])

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """West, east, south and north edge of the cells' middles, m."""
        n_y, n_x = self.height.shape
        east = self.x0_m + self.cell_m * (n_x - 1)
        return self.x0_m, east, self.y0_m, self.y0_m + self.cell_m * (n_y - 1)

    def _cells(self, x: Array, y: Array) -> tuple[Array, Array]:
        return (y - self.y0_m) / self.cell_m, (x - self.x0_m) / self.cell_m

    def height_at(self, x: Array, y: Array) -> Array:
        """Return heights (...) between four cells each, bilinear; NaN off the map."""
        return self.between(self.height, x, y)

    def sigma_at(self, x: Array, y: Array, errors: MapErrors) -> Array:
        """Return the standard deviations (...) of single cells; that of the errors off the map."""
        if self.sigma is None:
            return np.full(np.shape(x), errors.sigma_m)
        found = self.between(self.sigma, x, y)
        return np.where(np.isfinite(found), found, errors.sigma_m)

    def between(self, values: Array, x: Array, y: Array) -> Array:
        """Return values (R, C) of the cells at points (...), bilinear; NaN off the map."""
        from scipy.ndimage import map_coordinates

        rows, columns = self._cells(x, y)
        found = map_coordinates(values, [rows, columns], order=1, mode="constant", cval=np.nan)
        return np.asarray(found, dtype=np.float64)

    def surface_at(self, x: Array, y: Array) -> Surface:
        """Return heights and slopes between sixteen cells each: cubic convolution (Keys, 1981).

        The slope has no jumps, which Gauss-Newton needs.
        """
        rows, columns = self._cells(np.asarray(x, float), np.asarray(y, float))
        n_y, n_x = self.height.shape
        inside = (rows >= 1) & (rows <= n_y - 2) & (columns >= 1) & (columns <= n_x - 2)
        row = np.clip(np.nan_to_num(rows).astype(np.int64), 1, n_y - 3)
        column = np.clip(np.nan_to_num(columns).astype(np.int64), 1, n_x - 3)
        of_y, along_y = _keys(np.where(inside, rows - row, 0.0))
        of_x, along_x = _keys(np.where(inside, columns - column, 0.0))
        step = np.arange(-1, 3)
        part = self.height[row[..., None, None] + step[:, None], column[..., None, None] + step]
        part = np.where(inside[..., None, None], part, np.nan)
        over_x = (part * of_x[..., None, :]).sum(-1)
        slope_x = ((part * along_x[..., None, :]).sum(-1) * of_y).sum(-1) / self.cell_m
        slope_y = (over_x * along_y).sum(-1) / self.cell_m
        return Surface((over_x * of_y).sum(-1), np.stack([slope_x, slope_y], axis=-1))

    def inside(self) -> Array:
        """Return 1 for cells (R, C) whose heights and slopes are known all about, and 0 for others.

        Bilinear between the cells it is 0 from where :meth:`surface_at` ends.
        """
        from scipy.ndimage import binary_erosion

        known = binary_erosion(np.isfinite(self.height), np.ones((3, 3)), iterations=2)
        return np.asarray(known, dtype=np.float64)

    def relief(self, x_y: Array, half_m: float) -> float:
        """Return the standard deviation of the heights within a square, its plane taken off, m."""
        side = np.linspace(-half_m, half_m, 41)
        x, y = np.meshgrid(x_y[0] + side, x_y[1] + side)
        height = self.height_at(x, y).ravel()
        known = np.isfinite(height)
        if known.sum() < 4:
            return float("nan")
        plane = np.column_stack([np.ones(known.sum()), x.ravel()[known], y.ravel()[known]])
        left = height[known] - plane @ np.linalg.lstsq(plane, height[known])[0]
        return float(left.std())


def _keys(s: Array) -> tuple[Array, Array]:
    """Return weights (..., 4) of four neighbours at a share s of the way, and their slopes."""
    t = s[..., None]
    of = np.concatenate(
        [
            ((-0.5 * t + 1.0) * t - 0.5) * t,
            (1.5 * t - 2.5) * t * t + 1.0,
            ((-1.5 * t + 2.0) * t + 0.5) * t,
            (0.5 * t - 0.5) * t * t,
        ],
        axis=-1,
    )
    along = np.concatenate(
        [
            (-1.5 * t + 2.0) * t - 0.5,
            (4.5 * t - 5.0) * t,
            (-4.5 * t + 4.0) * t + 0.5,
            (1.5 * t - 1.0) * t,
        ],
        axis=-1,
    )
    return of, along


@dataclass(frozen=True, slots=True, eq=False)
class TerrainLog(FrozenArrays):
    """Ranges of a DVL to a seabed that a map knows: what an estimator needs of both."""

    SECTION: ClassVar[str] = "[map]"

    grid: SeabedGrid
    errors: MapErrors
    time_s: Array = shaped("N")
    """(N,) when the pings were taken, s."""
    range_m: Array = shaped("N", "B")
    """(N, B) along the beams; NaN where there is none."""
    beams_b: Array = shaped("B", 3)
    """(B, 3) directions, of length 1, body axes."""
    lever_arm_b: Array = shaped(3)
    """(3,) body origin to instrument, m."""
    way_m: Array = shaped("N")
    """(N,) gone since the ping before, by the beams' own speeds, m."""
    within_m: float = np.nan
    """The mission began within so much of its stated start, m; NaN where its sigma says it."""

    @property
    def smooth_sigmas(self) -> tuple[float, float]:
        """Sigmas of what the map is off by over a stretch: under all beams, and of differences, m.

        Errors that are alike as ``rho = exp(-(d / smooth_m)^2)`` over the typical distance d of
        two beams' ends have a mean of variance ``rho + (1 - rho) / B`` and differences of
        ``1 - rho``.
        """
        n_beams, sigma = len(self.beams_b), self.errors.smooth_sigma_m
        reach = float(np.nanmedian(self.range_m)) if self.range_m.size else 0.0
        gap = self.beams_b[:, None] - self.beams_b
        apart_sq = float((gap**2).sum()) / max(n_beams * (n_beams - 1), 1) * reach**2
        rho = float(np.exp(-apart_sq / self.errors.smooth_m**2))
        return sigma * float(np.sqrt(rho + (1.0 - rho) / n_beams)), sigma * float(np.sqrt(1 - rho))

    @property
    def speed(self) -> float:
        """m/s, on average; never none."""
        span_s = float(self.time_s[-1] - self.time_s[0]) if len(self.time_s) > 1 else 0.0
        return max(float(self.way_m.sum()) / span_s if span_s > 0.0 else 0.0, 0.05)


def terrain_log(
    grid: SeabedGrid, dvl: DvlLog, errors: MapErrors, *, within_m: float = np.nan
) -> TerrainLog:
    """Return the ranges of a DVL off the ground to be compared with a map.

    Raises :class:`DataError` where there are none.
    """
    dvl = dvl.of_ground()
    if dvl.range_m is None or not np.isfinite(dvl.range_m).any():
        raise DataError(
            "[map]: the DVL has no range along a beam, which a map is compared with; expected "
            f"columns range1_m to range{dvl.mount.n_beams}_m in its table"
        )
    mount = dvl.mount
    speed = np.nan_to_num(dvl.speed) @ np.linalg.pinv(mount.beams_b).T
    way = np.linalg.norm(speed, axis=1) * np.diff(dvl.valid_s, prepend=dvl.valid_s[0])
    heard = np.isfinite(dvl.range_m).any(axis=1)
    # A ping without ranges is part of the way to the next one.
    total = np.cumsum(way)[heard]
    return TerrainLog(
        grid=grid,
        errors=errors,
        time_s=dvl.valid_s[heard],
        range_m=dvl.range_m[heard],
        beams_b=mount.beams_d @ mount.R_bd.T,
        lever_arm_b=mount.lever_arm_b,
        way_m=np.diff(total, prepend=0.0),
        within_m=within_m,
    )
