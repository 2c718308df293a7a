"""Last check of a mission before GTSAM sees it: GTSAM takes NaN and zero sigmas without a word."""

from __future__ import annotations

import numpy as np

from ssm_graph.base.errors import DataError
from ssm_graph.base.frozen import Array
from ssm_graph.mission.mission import Aids, Mission
from ssm_graph.sensors.acoustic import RangeLog, UsblLog
from ssm_graph.sensors.compass import HeadingLog


def require_usable(mission: Mission) -> None:
    """Raise :class:`DataError` for a value that no estimator can use, with its name and place.

    The reader of mission folders refuses all of these with file and line; missions made in Python
    come without it.
    """
    imu, dvl = mission.imu, mission.dvl
    _finite("imu.start_s", np.array([imu.start_s]))
    _finite("imu.time_s", imu.time_s)
    _finite("imu.gyro_b", imu.gyro_b)
    _finite("imu.accel_b", imu.accel_b)
    _increasing("imu.time_s", np.concatenate([[imu.start_s], imu.time_s]))
    for name in ("gyro_density", "accel_density", "gyro_bias_sigma", "accel_bias_sigma"):
        _positive(f"imu.noise.{name}", np.array([getattr(imu.noise, name)]))
    _increasing("dvl.time_s", dvl.time_s)
    _finite("dvl.mount.beams_b", dvl.mount.beams_b)
    _finite("dvl.mount.lever_arm_b", dvl.mount.lever_arm_b)
    has_speed = ~np.isnan(dvl.speed)
    _finite("dvl.speed", np.where(has_speed, dvl.speed, 0.0))
    _positive("dvl.sigma", np.where(has_speed, dvl.sigma, 1.0))
    if mission.current is not None:
        _positive("current.sigma", np.array([mission.current.sigma]))
        _positive("current.correlation_s", np.array([mission.current.correlation_s]))
    _require_aids(mission)
    _require_further(mission.aids)


def _require_aids(mission: Mission) -> None:
    depth, gnss, initial = mission.depth, mission.gnss, mission.initial
    if depth is not None:
        _increasing("depth.time_s", depth.time_s)
        _positive("depth.sigma", np.array([depth.sigma]))
        for name in ("depth", "lever_arm_b"):
            _finite(f"depth.{name}", getattr(depth, name))
    if gnss is not None:
        _increasing("gnss.time_s", gnss.time_s)
        _positive("gnss.sigma_enu", gnss.sigma_enu)
        for name in ("lat", "lon", "height", "lever_arm_b"):
            _finite(f"gnss.{name}", getattr(gnss, name))
    if initial is not None:
        for name in ("time_s", "lat", "lon", "height", "roll", "pitch", "heading"):
            _finite(f"initial.{name}", np.array([getattr(initial, name)]))
        _finite("initial.velocity_enu", initial.velocity_enu)
        for name in ("position_sigma_enu", "velocity_sigma_enu", "attitude_sigma"):
            _positive(f"initial.{name}", getattr(initial, name))


def _require_further(aids: Aids) -> None:
    usbl, ranges, heading = aids.get(UsblLog), aids.get(RangeLog), aids.get(HeadingLog)
    if usbl is not None:
        _positive("aids.usbl.sigma_enu", usbl.sigma_enu)
        for name in ("time_s", "delay_s", "lat", "lon", "height", "lever_arm_b"):
            _finite(f"aids.usbl.{name}", getattr(usbl, name))
    if ranges is not None:
        _positive("aids.ranges.sigma", ranges.sigma)
        for name in ("time_s", "range_m", "lever_arm_b"):
            _finite(f"aids.ranges.{name}", getattr(ranges, name))
        for beacon in ranges.beacons:
            place = np.array([beacon.lat, beacon.lon, beacon.height])
            _finite(f"aids.ranges.beacons, number {beacon.number}", place)
            if not beacon.is_known:
                name = f"aids.ranges.beacons, number {beacon.number}, position_sigma_enu"
                _positive(name, beacon.position_sigma_enu)
    if heading is not None:
        _increasing("aids.heading.time_s", heading.time_s)
        _finite("aids.heading.heading", heading.heading)
        _positive("aids.heading.sigma", np.array([heading.sigma]))
        _positive("aids.heading.errors.correlation_s", np.array([heading.errors.correlation_s]))


def _finite(name: str, values: Array) -> None:
    _refuse(name, values, ~np.isfinite(values), "a finite number")


def _positive(name: str, values: Array) -> None:
    _refuse(name, values, ~(np.isfinite(values) & (values > 0.0)), "a finite number above zero")


def _increasing(name: str, times: Array) -> None:
    _finite(name, times)
    wrong = np.zeros(len(times), bool)
    wrong[1:] = ~(np.diff(times) > 0.0)
    _refuse(name, times, wrong, "times that increase strictly")


def _refuse(
    name: str, values: Array, wrong: np.ndarray[tuple[int, ...], np.dtype[np.bool_]], expected: str
) -> None:
    places = np.argwhere(wrong)
    if len(places) == 0:
        return
    at = tuple(int(i) for i in places[0])
    raise DataError(
        f"{name}, row {at[0]}: expected {expected}, got {values[at]:g} ({len(places)} such "
        "values); check where the mission was made"
    )
