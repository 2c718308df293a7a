"""The table of formats, and the one door to them: complete files or none."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Final

from ssm_graph.base.errors import ConfigError, DataError, nearest_hint
from ssm_graph.io.export.columns import write_csv, write_kitti, write_parquet, write_tum
from ssm_graph.io.export.geopackage import write_geopackage
from ssm_graph.io.export.maps import write_geojson, write_gpx, write_kml, write_kmz
from ssm_graph.io.export.mcap import write_mcap
from ssm_graph.io.export.netcdf import write_netcdf
from ssm_graph.io.export.nmea import write_nmea
from ssm_graph.io.export.sbet import write_sbet
from ssm_graph.io.export.track import Track


@dataclass(frozen=True, slots=True)
class Format:
    """One format that a track can be written in."""

    suffix: str
    about: str
    """One line for people."""
    write: Callable[[Track, Path], None]
    """Writes a file at a path, and perhaps others beside it."""


_FORMATS: Final = {
    "tum": (".tum", "time, position, quaternion: evo and others", write_tum),
    "kitti": (".kitti", "poses without times: evo and others", write_kitti),
    "csv": (".csv", "all numbers in one table, with UTC, local metres, quaternions", write_csv),
    "parquet": (".parquet", "the same (extra 'parquet')", write_parquet),
    "netcdf": (".nc", "CF-1.11 trajectory: xarray, MATLAB, archives; needs UTC", write_netcdf),
    "geojson": (".geojson", "line and doubtful stretches: QGIS, web maps", write_geojson),
    "geopackage": (".gpkg", "line, and points with all numbers: QGIS, GDAL", write_geopackage),
    "kml": (".kml", "line, times, 3 sigma ellipses: Google Earth", write_kml),
    "kmz": (".kmz", "the same, zipped", write_kmz),
    "gpx": (".gpx", "track with heights, and UTC: plotters, OpenCPN", write_gpx),
    "sbet": (".sbet", "with smrmsg_ accuracy: multibeam, lidar; needs UTC", write_sbet),
    "mcap": (".mcap", "location, pose, scalars: Foxglove (extra 'mcap')", write_mcap),
    "nmea": (".nmea", "GGA, VTG, HDT: chart plotters; needs UTC", write_nmea),
}
FORMATS: Final = MappingProxyType({name: Format(*of) for name, of in _FORMATS.items()})


def check_format(form: str) -> None:
    """Raise :class:`ConfigError` for a format that is not known."""
    if form not in FORMATS:
        raise ConfigError(f"--format: {form!r} is not known, {nearest_hint(form, FORMATS)}")


def export_track(track: Track, form: str, path: Path | str) -> list[Path]:
    """Write a track in a format; return the files, which take their places when all are whole.

    Raises :class:`ConfigError` for an unknown format, an epoch that is missing or a file over the
    result folder's own, :class:`DataError` where the disk refuses.
    """
    check_format(form)
    path = Path(path)
    part = path.parent / f".part-{os.getpid()}"
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        part.mkdir()
        FORMATS[form].write(track, part / path.name)
        written = sorted(part.iterdir())
        return [file.replace(path.parent / file.name) for file in written]
    except OSError as error:
        raise DataError(f"{path}: cannot be written: {error.strerror or error}") from error
    finally:
        if part.is_dir():
            for file in part.iterdir():
                file.unlink()
            part.rmdir()
