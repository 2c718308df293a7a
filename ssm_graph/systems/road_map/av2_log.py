"""Poses of an Argoverse 2 log: a real way over a real map."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np

from ssm_graph.base.errors import DataError
from ssm_graph.io.tables.files import pyarrow_module
from ssm_graph.systems.road_map.drive import Poses

POSES: Final = "city_SE3_egovehicle.feather"
MAP: Final = "map.json"
_COLUMNS: Final = ("timestamp_ns", "qw", "qx", "qy", "qz", "tx_m", "ty_m")


def av2_poses(path: Path, rate_hz: float = 10.0) -> Poses:
    """Return the vehicle's poses in the plane of the city, evenly in time, from 0 s on."""
    feather = pyarrow_module("pyarrow.feather")
    try:
        table = feather.read_table(path)
        t, qw, qx, qy, qz, x, y = (np.asarray(table[name], dtype=np.float64) for name in _COLUMNS)
    except (OSError, KeyError, ValueError) as error:
        raise DataError(f"{path}: expected poses of Argoverse 2, got {error}") from error
    time_s = (t - t[0]) * 1e-9
    yaw = np.unwrap(np.arctan2(2.0 * (qw * qz + qx * qy), 1.0 - 2.0 * (qy**2 + qz**2)))
    even = np.arange(0.0, time_s[-1], 1.0 / rate_hz)
    x_y = np.column_stack([np.interp(even, time_s, x), np.interp(even, time_s, y)])
    return Poses(even, x_y, np.interp(even, time_s, yaw))
