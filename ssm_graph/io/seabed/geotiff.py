"""GeoTIFF with one band of heights, by Pillow, which comes with matplotlib."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any, Final

import numpy as np

from ssm_graph.base.errors import DataError
from ssm_graph.io.seabed.raster import Raster

_SCALE, _TIE, _MATRIX, _KEYS, _NO_DATA = 33550, 33922, 34264, 34735, 42113
"""Tags of the GeoTIFF standard (OGC 19-008), and GDAL's of no data."""
_PIXEL_IS_POINT: Final = 2
_GEOGRAPHIC, _PROJECTED, _RASTER = 2048, 3072, 1025
"""Keys: codes of the coordinate systems, and what a pixel is."""
_USER_DEFINED: Final = 32767


def read_geotiff(path: Path) -> Raster:
    """Read the first band; raise :class:`DataError` for one that has no place."""
    from PIL import Image, UnidentifiedImageError

    try:
        # Of a size that is allowed, and of damage that is told below.
        with warnings.catch_warnings(action="ignore"), Image.open(path) as image:
            tags: Any = getattr(image, "tag_v2", {})
            values = np.array(image, dtype=np.float64)
    except Image.DecompressionBombError as error:
        raise DataError(
            f"{path.name}: expected a map of at most 179 million cells, got more; cut out the "
            "mission's place, with  gdalwarp -te"
        ) from error
    except (UnidentifiedImageError, OSError, ValueError, SyntaxError) as error:
        raise DataError(
            f"{path.name}: expected a TIFF of one band of numbers, got {error}"
        ) from error
    if values.ndim != 2:
        raise DataError(
            f"{path.name}: expected one band of heights, got {values.shape[-1]}, which is a picture"
        )
    dx, dy, west, north = _place(tags, path)
    no_data = str(tags.get(_NO_DATA, "")).strip("\x00 ")
    if no_data:
        try:
            missing = float(no_data)
        except ValueError:
            raise DataError(
                f"{path.name}: expected a number that stands for no data, got {no_data[:40]!r}; "
                "state one, with  gdal_edit.py -a_nodata"
            ) from None
        values = np.where(np.isclose(values, missing, rtol=1e-6), np.nan, values)
    if dy < 0.0:  # rows to the north: the first one is the southernmost
        dy, north, values = -dy, north - dy * len(values), values[::-1]
    keys = _keys(tags)
    middle = 0.0 if keys.get(_RASTER) == _PIXEL_IS_POINT else 0.5
    n_y, n_x = values.shape
    # A projected raster names the degrees that it was projected from as well.
    code = keys.get(_PROJECTED, keys.get(_GEOGRAPHIC, 0))
    return Raster(
        path.name,
        f"EPSG:{code}" if 0 < code < _USER_DEFINED else "",
        np.asarray(west + dx * (np.arange(n_x) + middle)),
        np.asarray(north - dy * (np.arange(n_y)[::-1] + middle)),
        values[::-1],
    )


def _place(tags: Any, path: Path) -> tuple[float, float, float, float]:
    """Return steps to the east and south, and the place of the north-western corner."""
    scale, tie, m = (np.ravel(tags.get(tag, ())).tolist() for tag in (_SCALE, _TIE, _MATRIX))
    if len(scale) >= 2 and len(tie) >= 5:
        dx, dy = scale[:2]
        return dx, dy, tie[3] - tie[0] * dx, tie[4] + tie[1] * dy
    if len(m) >= 8:
        if m[1] == 0.0 and m[4] == 0.0:
            return m[0], -m[5], m[3], m[7]
        raise DataError(
            f"{path.name}: the raster is turned; warp it to the north first, by gdalwarp"
        )
    raise DataError(
        f"{path.name}: the TIFF does not say where it is (no GeoTIFF tags); expected a GeoTIFF, as "
        "gdal_translate -of GTiff  writes"
    )


def _keys(tags: Any) -> dict[int, int]:
    """Return the keys of the directory whose values stand in it."""
    words = [int(word) for word in tags.get(_KEYS, ())]
    rows = (words[i : i + 4] for i in range(4, len(words) - 3, 4))
    return {key: value for key, where, _, value in rows if where == 0}
