"""GeoPackage: the track as a line and its rows as points with all their numbers, for QGIS and GDAL.

Layout: OGC 12-128r18, GeoPackage 1.3; heights are above the ellipsoid.
"""

from __future__ import annotations

import sqlite3
import struct
from collections.abc import Iterable
from contextlib import closing
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

import numpy as np

from ssm_graph.base.frozen import Array
from ssm_graph.base.progress import told
from ssm_graph.io.export.columns import wide_columns
from ssm_graph.io.export.maps import degrees, lines
from ssm_graph.io.export.track import Track

_APPLICATION: Final = 0x47504B47
"""The letters GPKG."""
_VERSION: Final = 10300
_SRS: Final = 4326
_POINT_Z, _LINE_Z, _MULTILINE_Z = 1001, 1002, 1005
"""Of well-known binary."""
_WGS84: Final = (
    'GEOGCS["WGS 84",DATUM["WGS_1984",SPHEROID["WGS 84",6378137,298.257223563,AUTHORITY["EPSG",'
    '"7030"]],AUTHORITY["EPSG","6326"]],PRIMEM["Greenwich",0,AUTHORITY["EPSG","8901"]],UNIT['
    '"degree",0.0174532925199433,AUTHORITY["EPSG","9122"]],AUTHORITY["EPSG","4326"]]'
)
_SCHEMA: Final = f"""
PRAGMA application_id = {_APPLICATION};
PRAGMA user_version = {_VERSION};
CREATE TABLE gpkg_spatial_ref_sys (srs_name TEXT NOT NULL, srs_id INTEGER PRIMARY KEY,
  organization TEXT NOT NULL, organization_coordsys_id INTEGER NOT NULL, definition TEXT NOT NULL,
  description TEXT);
CREATE TABLE gpkg_contents (table_name TEXT NOT NULL PRIMARY KEY, data_type TEXT NOT NULL,
  identifier TEXT UNIQUE, description TEXT DEFAULT '', last_change DATETIME NOT NULL,
  min_x DOUBLE, min_y DOUBLE, max_x DOUBLE, max_y DOUBLE, srs_id INTEGER,
  CONSTRAINT fk_gc_r_srs_id FOREIGN KEY (srs_id) REFERENCES gpkg_spatial_ref_sys(srs_id));
CREATE TABLE gpkg_geometry_columns (table_name TEXT NOT NULL, column_name TEXT NOT NULL,
  geometry_type_name TEXT NOT NULL, srs_id INTEGER NOT NULL, z TINYINT NOT NULL,
  m TINYINT NOT NULL, CONSTRAINT pk_geom_cols PRIMARY KEY (table_name, column_name),
  CONSTRAINT uk_gc_table_name UNIQUE (table_name),
  CONSTRAINT fk_gc_tn FOREIGN KEY (table_name) REFERENCES gpkg_contents(table_name),
  CONSTRAINT fk_gc_srs FOREIGN KEY (srs_id) REFERENCES gpkg_spatial_ref_sys (srs_id));
CREATE TABLE track (fid INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL, geom BLOB, name TEXT,
  about TEXT);
"""


def write_geopackage(track: Track, path: Path) -> None:
    """Write the tables ``track`` (one line) and ``keyframes`` (a point a row)."""
    path.unlink(missing_ok=True)
    points, columns = degrees(track), wide_columns(track)
    for name in ("lat_deg", "lon_deg", "height_m"):
        del columns[name]
    kinds = {name: "TEXT" if isinstance(of, list) else "DOUBLE" for name, of in columns.items()}
    with closing(sqlite3.connect(path)) as base, base:
        base.executescript(_SCHEMA)
        declared = ", ".join(f'"{name}" {kind}' for name, kind in kinds.items())
        base.execute(
            "CREATE TABLE keyframes (fid INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL, "
            f"geom BLOB, {declared})"
        )
        undefined = ((-1, "cartesian"), (0, "geographic"))
        systems: list[tuple[Any, ...]] = [
            (f"Undefined {what} SRS", number, "NONE", number, "undefined", "")
            for number, what in undefined
        ]
        systems.append(("WGS 84 geodetic", _SRS, "EPSG", _SRS, _WGS84, "longitude, latitude"))
        base.executemany("INSERT INTO gpkg_spatial_ref_sys VALUES (?, ?, ?, ?, ?, ?)", systems)
        now = datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%S.000Z")
        box = (*points[:, :2].min(axis=0).tolist(), *points[:, :2].max(axis=0).tolist())
        # Table names are this file's own: two of one mission may lie in one project.
        for table, kind in (("track", "MULTILINESTRING"), ("keyframes", "POINT")):
            content = (table, "features", table, f"{track.name}: {track.about}", now, *box, _SRS)
            marks = ", ".join("?" * len(content))
            base.execute(f"INSERT INTO gpkg_contents VALUES ({marks})", content)
            geometry = (table, "geom", kind, _SRS, 1, 0)
            base.execute("INSERT INTO gpkg_geometry_columns VALUES (?, ?, ?, ?, ?, ?)", geometry)
        base.execute(
            "INSERT INTO track (geom, name, about) VALUES (?, ?, ?)",
            (_geometry(_multiline(lines(points))), track.name, track.about),
        )
        named = ", ".join(f'"{name}"' for name in ("geom", *kinds))
        marks = ", ".join("?" * (len(kinds) + 1))
        values = [of if isinstance(of, list) else _without_nan(of) for of in columns.values()]
        geometries = [_geometry(struct.pack("<BIddd", 1, _POINT_Z, *p)) for p in points.tolist()]
        rows = told(zip(geometries, *values, strict=True), len(geometries))
        base.executemany(f"INSERT INTO keyframes ({named}) VALUES ({marks})", rows)


def _without_nan(values: Array) -> list[float | None]:
    return [value if np.isfinite(value) else None for value in values.tolist()]


def _geometry(body: bytes) -> bytes:
    """Return a geometry with its head: little endian, no envelope."""
    return struct.pack("<2sBBi", b"GP", 0, 1, _SRS) + body


def _multiline(parts: Iterable[Array]) -> bytes:
    of_parts = [
        struct.pack("<BII", 1, _LINE_Z, len(part)) + np.ascontiguousarray(part, "<f8").tobytes()
        for part in parts
    ]
    return struct.pack("<BII", 1, _MULTILINE_Z, len(of_parts)) + b"".join(of_parts)
