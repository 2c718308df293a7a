"""Depths and dead reckoning of a folder of one's own: tables, and their sections of visual.toml."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
from scipy.spatial.transform import Rotation

from ssm_graph.base.frozen import Array
from ssm_graph.base.settings import FILE_KEY, Key, Settings, optional_key
from ssm_graph.io.tables.append_file import write_through
from ssm_graph.systems.visual_ranges.readers.truth import number_rows, read_tum_path
from ssm_graph.systems.visual_ranges.vehicle import (
    DEPTH_SHARE,
    DEPTH_SIGMA_M,
    SCALE_SHARE,
    STEP_M,
    TILT_RAD,
    TURN_RAD,
    DeadReckoning,
    Depths,
    Vehicle,
)

_DEG: Final = np.pi / 180.0


def _arm(hint: str) -> Key:
    return Key(shape=(3,), low=-20.0, high=20.0, required=False, hint=f"{hint}, metres")


DEPTH_KEYS: Final[Mapping[str, Key]] = {
    "file": FILE_KEY,
    "sigma_m": optional_key("", 1e-4, 100.0, "0.05 is a pressure sensor"),
    "lever_arm_m": _arm("camera to sensor, camera axes"),
    "scale_percent": optional_key("", 1e-4, 20.0, "of depth; 3 if the water's salinity is unknown"),
}
RECKONING_KEYS: Final[Mapping[str, Key]] = {
    "file": FILE_KEY,
    "camera_m": _arm("vehicle to camera, vehicle axes"),
    "camera_axes": Key(
        shape=(9,), low=-1.0, high=1.0, required=False,
        hint="rotation matrix, camera to vehicle axes, row by row",
    ),
    "step_m": optional_key("", 1e-5, 10.0, "random walk of the place, m after one second"),
    "turn_deg": optional_key("", 1e-5, 90.0, "random walk of the heading, deg after one second"),
    "tilt_deg": optional_key("", 1e-4, 90.0, "of roll and pitch, degrees"),
    "scale_percent": optional_key("", 1e-4, 20.0, "of the DVL's speed"),
}  # fmt: skip
UP: Final = np.diag([1.0, -1.0, -1.0])
"""Axes whose third is up, as in trajectories, to axes whose third is down; and back."""


def read_vehicle(folder: Path, sections: Mapping[str, Settings], range_share: float) -> Vehicle:
    """Return what the sections ``depth`` and ``dead_reckoning`` name, as far as they are there.

    Raises :class:`ConfigError` and :class:`DataError` with file, line and what to try.
    """
    depths = reckoning = None
    if "depth" in sections:
        own = sections["depth"]
        rows = number_rows(folder / own.text("file"), (2,))
        x, y, z = own.array("lever_arm_m").tolist() if "lever_arm_m" in own else (0.0, 0.0, 0.0)
        sigma_m = own.number("sigma_m") or DEPTH_SIGMA_M
        share = own.number("scale_percent") / 100.0 or DEPTH_SHARE
        depths = Depths(rows[:, 0], rows[:, 1], sigma_m, (x, y, z), share)
    if "dead_reckoning" in sections:
        reckoning = _reckoning(folder, sections["dead_reckoning"])
    return Vehicle(depths, reckoning, range_share)


def _reckoning(folder: Path, own: Settings) -> DeadReckoning:
    path = read_tum_path(folder / own.text("file"))
    R_bc = own.array("camera_axes").reshape(3, 3) if "camera_axes" in own else np.eye(3)
    if np.abs(R_bc @ R_bc.T - np.eye(3)).max() > 1e-3 or np.linalg.det(R_bc) < 0.0:
        raise own.fault("camera_axes", "expected a rotation matrix, camera to vehicle, row by row")
    arm = own.array("camera_m") if "camera_m" in own else np.zeros(3)
    R_ub = Rotation.from_quat(path.quaternion)
    return DeadReckoning(
        path.time_s,
        (path.position_m + R_ub.apply(arm)) @ UP.T,
        (Rotation.from_matrix(UP) * R_ub * Rotation.from_matrix(R_bc)).as_quat(),
        own.number("step_m") or STEP_M,
        own.number("turn_deg") * _DEG or TURN_RAD,
        own.number("tilt_deg") * _DEG or TILT_RAD,
        own.number("scale_percent") / 100.0 or SCALE_SHARE,
    )


def write_vehicle(folder: Path, vehicle: Vehicle) -> dict[str, Any]:
    """Write the tables of a vehicle, and return their sections."""
    sections: dict[str, Any] = {}
    depths, reckoning = vehicle.depths, vehicle.dead_reckoning
    if depths is not None:
        sections["depth"] = {
            "file": "depth.csv",
            "sigma_m": depths.sigma_m,
            "lever_arm_m": list(depths.lever_arm_m),
            "scale_percent": 100.0 * depths.scale_share,
        }
        _write(folder / "depth.csv", "time_s,depth_m", [depths.time_s, depths.depth_m], ",")
    if reckoning is not None:
        sections["dead_reckoning"] = {
            "file": "dead_reckoning.tum",
            "step_m": reckoning.step_m,
            "turn_deg": reckoning.turn_rad / _DEG,
            "tilt_deg": reckoning.tilt_rad / _DEG,
            "scale_percent": 100.0 * reckoning.scale_share,
        }
        turned = Rotation.from_matrix(UP) * Rotation.from_quat(reckoning.quaternion)
        columns = [reckoning.time_s, reckoning.position_m @ UP.T, turned.as_quat()]
        head = "# time_s x_m y_m z_m qx qy qz qw"
        _write(folder / "dead_reckoning.tum", head, columns, " ")
    return sections


def _write(path: Path, head: str, columns: list[Array], between: str) -> None:
    rows = [between.join(f"{x:.9f}" for x in row) for row in np.column_stack(columns)]
    write_through(path, ("\n".join([head, *rows]) + "\n").encode())
