"""A drive as a folder: ``drive.toml`` with its tables and its map."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
import tomli_w

from ssm_graph.base.errors import ConfigError, DataError
from ssm_graph.base.frozen import Array
from ssm_graph.base.settings import (
    FILE_KEY,
    Key,
    Settings,
    number_key,
    read_settings,
    read_toml,
)
from ssm_graph.base.tables import Table, TableSpec
from ssm_graph.base.units import DEGREE, wrapped
from ssm_graph.io.tables.files import read_table, write_table
from ssm_graph.systems.road_map.drive import Chassis, Curves, Drive, GnssFixes, Poses
from ssm_graph.systems.road_map.maps.read import read_map
from ssm_graph.systems.road_map.maps.road_map import RoadMap

FILE_NAME: Final = "drive.toml"
DEFAULT_SIGMA_M: Final = 5.0
"""Of a fix whose table says nothing."""
_TEXT: Final = Key(shape=None, required=False)
_DELAY: Final = number_key("delay", -2.0, 2.0, "the unit is seconds", required=False)
SECTIONS: Final[Mapping[str, Mapping[str, Key]]] = {
    "map": {"file": FILE_KEY},
    "gnss": {
        "file": FILE_KEY,
        "delay_s": _DELAY,
        "bias_m": number_key("bias", 0.0, 500.0, "half a side of the square", required=False),
    },
    "chassis": {"file": FILE_KEY, "delay_s": _DELAY},
    "curves": {"file": FILE_KEY, "delay_s": _DELAY},
    "truth": {"file": FILE_KEY},
}
"""Keys of the sections; delays are how much too late the stamps are."""
_DEGREES: Final = ("lat_deg", "lon_deg")
GNSS: Final = TableSpec(
    ("time_s",),
    ("x_m", "y_m", *_DEGREES, "sigma_m", "heading_deg"),
    limits={"lat_deg": (-90.0, 90.0), "lon_deg": (-180.0, 180.0)},
)
CHASSIS: Final = TableSpec(("time_s", "speed_m_per_s", "yaw_rate_deg_per_s"))
CURVES: Final = TableSpec(
    ("time_s", "kind", "side", "c0_m", "c1", "c2_per_m", "c3_per_m2", "x_min_m", "x_max_m"),
    ("sigma_m", "mark"),
    key=("kind", "side", "c0_m"),
)
TRUTH: Final = TableSpec(("time_s", "x_m", "y_m", "heading_deg"))
_SIGMAS_M: Final = np.array([0.08, 0.03])
"""Of the offset of a boundary and of a lane line whose table says nothing."""


def read_drive(folder: Path) -> tuple[Drive, RoadMap]:
    """Return the logs of a drive's folder, and its map.

    Raises :class:`ConfigError` for ``drive.toml`` and :class:`DataError` for a table, with file,
    line and column.
    """
    path = folder / FILE_NAME
    try:
        raw = read_toml(path)
    except FileNotFoundError as error:
        raise ConfigError(
            f"{folder}: expected a folder with {FILE_NAME}, found none; "
            "ssm-graph locate-simulate writes one"
        ) from error
    sections = _sections(raw, str(path))
    road_map = read_map(folder / sections["map"].text("file"))
    tables = {
        name: read_table(folder / s.text("file"), s.text("file"), spec)
        for name, spec in (("gnss", GNSS), ("chassis", CHASSIS), ("curves", CURVES))
        for s in (sections[name],)
    }
    truth = None
    if "truth" in sections:
        file = sections["truth"].text("file")
        truth = _truth(read_table(folder / file, file, TRUTH))
    gnss = _gnss(tables["gnss"], sections["gnss"].number("delay_s"), road_map)
    chassis = _chassis(tables["chassis"], sections["chassis"].number("delay_s"))
    curves = _curves(tables["curves"], sections["curves"].number("delay_s"))
    name = str(raw.get("name", folder.name))
    bias_m = sections["gnss"].number("bias_m")
    return Drive(name, gnss, chassis, curves, truth, gnss_bias_m=bias_m), road_map


def read_curves(path: Path) -> Curves:
    """Return the table of a lane detector, ``curves.csv`` of a drive."""
    return _curves(read_table(path, path.name, CURVES), 0.0)


def _sections(raw: Mapping[str, Any], file: str) -> dict[str, Settings]:
    for name in raw:
        if name != "name" and name not in SECTIONS:
            raise ConfigError(f"{file} {name}: unknown; expected name and {', '.join(SECTIONS)}")
    for name in SECTIONS:
        if name != "truth" and name not in raw:
            raise ConfigError(f"{file}: section [{name}] is missing")
    return {
        name: read_settings(name, raw[name], known=keys, file=file)
        for name, keys in SECTIONS.items()
        if name in raw
    }


def _gnss(table: Table, delay_s: float, road_map: RoadMap) -> GnssFixes:
    if "x_m" in table and "y_m" in table:
        x_y = table.stack(["x_m", "y_m"])
    elif all(name in table for name in _DEGREES):
        if road_map.projection is None:
            raise DataError(
                f"{table.label}: fixes are in degrees and {road_map.name} does not say where its "
                "plane is; give x_m and y_m in the plane of the map"
                + "".join(f" ({note})" for note in road_map.notes if note.startswith("geoRef"))
            )
        lat, lon = np.radians(table["lat_deg"]), np.radians(table["lon_deg"])
        x_y = road_map.projection.forward(lat, lon)
    else:
        raise DataError(f"{table.label}: expected columns x_m and y_m, or lat_deg and lon_deg")
    sigma = table.stack(["sigma_m"])[:, 0]
    yaw = wrapped(np.radians(90.0 - table["heading_deg"])) if "heading_deg" in table else None
    sigma = np.where(np.isfinite(sigma), sigma, DEFAULT_SIGMA_M)
    keep = np.isfinite(x_y).all(axis=1)
    return GnssFixes(
        table.time_s[keep] - delay_s, x_y[keep], sigma[keep], None if yaw is None else yaw[keep]
    )


def _chassis(table: Table, delay_s: float) -> Chassis:
    rate = table["yaw_rate_deg_per_s"] * DEGREE
    return Chassis(table.time_s - delay_s, table["speed_m_per_s"], rate)


def _curves(table: Table, delay_s: float) -> Curves:
    sigma, mark = table.stack(["sigma_m", "mark"]).T
    kind = table["kind"]
    usual = _SIGMAS_M[np.clip(np.nan_to_num(kind), 0, 1).astype(int)]
    return Curves(
        table.time_s - delay_s,
        kind,
        table["side"],
        table.stack(["c0_m", "c1", "c2_per_m", "c3_per_m2"]),
        table.stack(["x_min_m", "x_max_m"]),
        np.where(np.isfinite(sigma), sigma, usual),
        np.where(np.isfinite(mark), mark, 0.0),
    )


def _truth(table: Table) -> Poses:
    yaw = np.radians(90.0 - table["heading_deg"])
    return Poses(table.time_s, table.stack(["x_m", "y_m"]), yaw)


def write_drive(folder: Path, drive: Drive, map_file: Path) -> None:
    """Write a drive; the map is named by its path from the folder."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, columns in _columns(drive).items():
        write_table(folder / f"{name}.csv", columns)
    found = os.path.relpath(map_file.resolve(), folder.resolve())
    raw: dict[str, Any] = {"name": drive.name, "map": {"file": found}}
    raw |= {name: {"file": f"{name}.csv"} for name in ("gnss", "chassis", "curves")}
    raw["gnss"]["bias_m"] = drive.gnss_bias_m
    if drive.truth is not None:
        raw["truth"] = {"file": "truth.csv"}
    (folder / FILE_NAME).write_text(tomli_w.dumps(raw), encoding="utf-8")


def _columns(drive: Drive) -> dict[str, dict[str, Array]]:
    g, c, k, t = drive.gnss, drive.chassis, drive.curves, drive.truth
    gnss = {"time_s": g.time_s, "x_m": g.x_y[:, 0], "y_m": g.x_y[:, 1], "sigma_m": g.sigma_m}
    if g.yaw is not None:
        gnss["heading_deg"] = _heading_deg(g.yaw)
    found = {
        "gnss": gnss,
        "chassis": {
            "time_s": c.time_s,
            "speed_m_per_s": c.speed,
            "yaw_rate_deg_per_s": c.yaw_rate / DEGREE,
        },
        "curves": {
            "time_s": k.time_s,
            "kind": k.kind,
            "side": k.side,
            **dict(zip(("c0_m", "c1", "c2_per_m", "c3_per_m2"), k.cubic.T, strict=True)),
            "x_min_m": k.reach[:, 0],
            "x_max_m": k.reach[:, 1],
            "sigma_m": k.sigma_m,
            "mark": k.mark,
        },
    }
    if t is not None:
        heading = _heading_deg(t.yaw)
        found["truth"] = {
            "time_s": t.time_s,
            "x_m": t.x_y[:, 0],
            "y_m": t.x_y[:, 1],
            "heading_deg": heading,
        }
    return found


def _heading_deg(yaw: Array) -> Array:
    """Return headings clockwise from north, 0 to 360 deg."""
    return np.asarray(np.mod(90.0 - np.degrees(yaw), 360.0))
