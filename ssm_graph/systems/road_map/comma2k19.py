"""Reader of a comma2k19 segment: CAN speed, gyro, two receivers, reference poses."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from ssm_graph.base.errors import DataError
from ssm_graph.base.frozen import Array
from ssm_graph.base.projection import TransverseMercator
from ssm_graph.systems.road_map.drive import Chassis, Curves, Drive, GnssFixes, Poses
from ssm_graph.systems.road_map.maps.road_map import RoadMap

RECEIVERS: Final = ("ublox", "qcom")
_A: Final = 6378137.0
"""m, WGS 84"""
_E_SQ: Final = 6.69437999014e-3
_NONE: Final = np.zeros(0)
NO_CURVES: Final = Curves(_NONE, _NONE, _NONE, np.zeros((0, 4)), np.zeros((0, 2)), _NONE, _NONE)
"""Of a drive whose camera was not looked at."""


@dataclass(frozen=True, slots=True, eq=False)
class Comma2k19:
    """A segment in a plane about its beginning."""

    chassis: Chassis
    gnss: dict[str, GnssFixes]
    """By receiver, `RECEIVERS`; sigmas are the receivers' own."""
    truth: Poses
    """The reference; its yaw is the course over ground."""
    projection: TransverseMercator


def read_comma2k19(folder: Path) -> Comma2k19:
    """Return a segment that lies as NumPy files in a folder, times from 0 s on.

    Files of the data set's own tree (``processed_log/CAN/speed/t``) are named with underscores
    here: ``processed_log_CAN_speed_t.npy``. The yaw rate is minus the gyro's third axis: the IMU's
    axes are forward, right, down.
    """
    t_can, speed = _of(folder, "processed_log_CAN_speed")
    t_imu, gyro = _of(folder, "processed_log_IMU_gyro")
    began = max(t_can[0], t_imu[0])
    frame_t = _array(folder, "global_pose_frame_times")
    lat, lon = _geodetic(_array(folder, "global_pose_frame_positions"))
    projection = TransverseMercator(float(lat[0]), float(lon[0]))
    x_y = projection.forward(lat, lon)
    d = np.gradient(x_y, axis=0)
    truth = Poses(frame_t - began, x_y, np.unwrap(np.arctan2(d[:, 1], d[:, 0])))
    rate = np.interp(t_can, t_imu, _smoothed(-gyro[:, 2]))
    inside = (t_can >= t_imu[0]) & (t_can <= t_imu[-1])
    inside &= np.concatenate([[True], np.diff(t_can) > 0.0])
    chassis = Chassis(t_can[inside] - began, speed[inside, 0], rate[inside])
    gnss = {}
    for name in RECEIVERS:
        t, values = _of(folder, f"processed_log_GNSS_live_gnss_{name}")
        gnss[name] = _fixes(t - began, values, projection)
    return Comma2k19(chassis, gnss, truth, projection)


def drive_of_comma2k19(
    folder: Path, road_map: RoadMap, *, receiver: str = "ublox", curves: Curves | None = None
) -> Drive:
    """Return a segment as a drive in the plane of a map.

    Parameters
    ----------
    receiver : of `RECEIVERS`, whose fixes are taken.
    curves : what a lane detector saw, times from the begin of the segment; none by default.
    """
    segment = read_comma2k19(folder)
    plane = road_map.projection
    if plane is None:
        raise DataError(
            f"{road_map.name}: expected a map that knows its place on Earth (lanelet2, GeoJSON in "
            "degrees), got one in a plane of its own"
        )

    def moved(x_y: Array) -> Array:
        return plane.forward(*segment.projection.inverse(x_y))

    fixes, truth = segment.gnss[receiver], segment.truth
    ahead = moved(truth.x_y + np.column_stack([np.cos(truth.yaw), np.sin(truth.yaw)]))
    way = ahead - moved(truth.x_y)
    yaw = np.unwrap(np.arctan2(way[:, 1], way[:, 0]))
    return Drive(
        folder.name,
        GnssFixes(fixes.time_s, moved(fixes.x_y), fixes.sigma_m),
        segment.chassis,
        curves or NO_CURVES,
        Poses(truth.time_s, moved(truth.x_y), yaw),
    )


def _of(folder: Path, stem: str) -> tuple[Array, Array]:
    return _array(folder, f"{stem}_t"), _array(folder, f"{stem}_value")


def _array(folder: Path, stem: str) -> Array:
    path = folder / f"{stem}.npy"
    try:
        return np.asarray(np.load(path, allow_pickle=False), dtype=np.float64)
    except (OSError, ValueError) as error:
        raise DataError(f"{path}: expected an array of comma2k19, got {error}") from error


def _smoothed(rate: Array, n: int = 5) -> Array:
    return np.convolve(np.pad(rate, n // 2, mode="edge"), np.full(n, 1.0 / n), mode="valid")


def _fixes(time_s: Array, values: Array, projection: TransverseMercator) -> GnssFixes:
    """Return fixes of rows latitude, longitude [deg], speed, time, altitude, course [deg]."""
    fresh = np.concatenate([[True], np.any(np.diff(values[:, :2], axis=0) != 0.0, axis=1)])
    fresh &= np.concatenate([[True], np.diff(time_s) > 0.0])
    lat, lon = np.radians(values[fresh, :2]).T
    sigma = np.full(int(fresh.sum()), 2.0)
    return GnssFixes(time_s[fresh], projection.forward(lat, lon), sigma)


def _geodetic(ecef: Array) -> tuple[Array, Array]:
    """Return latitude and longitude (N,), rad, of Earth-fixed positions (N, 3), m (Bowring)."""
    x, y, z = ecef.T
    p, b = np.hypot(x, y), _A * np.sqrt(1.0 - _E_SQ)
    theta = np.arctan2(z * _A, p * b)
    second = _E_SQ / (1.0 - _E_SQ)
    lat = np.arctan2(z + second * b * np.sin(theta) ** 3, p - _E_SQ * _A * np.cos(theta) ** 3)
    return lat, np.arctan2(y, x)
