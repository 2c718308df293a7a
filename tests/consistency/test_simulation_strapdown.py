"""Perfect sensors must lead an independent strapdown integration back to the simulated truth.

The integration below works in inertial axes: it knows nothing of local levels, transport rate or
Coriolis terms, and nothing of how the simulator made its samples.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ssm_graph.data import Array, ImuLog
from ssm_graph.earth import (
    EARTH_RATE,
    R_el_from_lat_lon,
    ecef_from_geodetic,
    geodetic_from_ecef,
    normal_gravity,
)
from ssm_graph.simulation import (
    CALM,
    DepthProfile,
    DiveRoute,
    HoverRoute,
    SimulationConfig,
    SpiralRoute,
    SurveyRoute,
    Trajectory,
    TransitRoute,
    simulate,
)

EARTH_AXIS = np.array([0.0, 0.0, EARTH_RATE])


def running_product(steps: Rotation) -> Rotation:
    """Return all products ``steps[0] * ... * steps[k]`` by doubling."""
    quat = steps.as_quat()
    shift = 1
    while shift < len(quat):
        product = Rotation.from_quat(quat[:-shift]) * Rotation.from_quat(quat[shift:])
        quat = np.concatenate([quat[:shift], product.as_quat()])
        shift *= 2
    return Rotation.from_quat(quat)


def previous(increments: Array) -> Array:
    """Return the increment before each one; the first stands in for its own."""
    return np.concatenate([increments[:1], increments[:-1]])


def inertial_steps(imu: ImuLog, R_ib_start: Rotation) -> tuple[Array, Rotation]:
    """Return velocity increments in inertial axes and the attitude after every sample.

    Two-sample coning and sculling: the increments' direction within a sample is taken as linear
    in time.
    """
    dt = np.diff(imu.time_s, prepend=imu.start_s)[:, None]
    angle, speed = imu.gyro_b * dt, imu.accel_b * dt
    turn = angle + np.cross(previous(angle), angle) / 12.0
    push = speed + 0.5 * np.cross(angle, speed)
    push += (np.cross(previous(angle), speed) + np.cross(previous(speed), angle)) / 12.0
    push += np.cross(angle, np.cross(angle, speed)) / 6.0
    R_ib = R_ib_start * running_product(Rotation.from_rotvec(turn))
    before = Rotation.concatenate([R_ib_start, R_ib[:-1]])
    return np.asarray(before.apply(push)), R_ib


def gravitation_i(p_i: Array, time_s: float) -> Array:
    """Return the attraction of the Earth alone, inertial axes, m/s^2."""
    R_ie = Rotation.from_rotvec(EARTH_AXIS * time_s)
    lat, lon, height = geodetic_from_ecef(R_ie.inv().apply(p_i))
    up_i = R_ie.apply(R_el_from_lat_lon(lat, lon)[:, 2])
    centrifugal = -np.cross(EARTH_AXIS, np.cross(EARTH_AXIS, p_i))
    return np.asarray(-normal_gravity(lat, height) * up_i - centrifugal)


def navigate(imu: ImuLog, trajectory: Trajectory, *, every: int) -> tuple[Array, float]:
    """Return the error of position (east, north, up; m) and attitude (rad) at the end.

    Gravitation is evaluated once for ``every`` samples, at the midpoint of that stretch.
    """
    start = trajectory.truth(0.0)
    R_el = R_el_from_lat_lon(start.lat[0], start.lon[0])
    p_i = ecef_from_geodetic(start.lat, start.lon, start.height)[0]
    v_i = R_el @ start.velocity_enu[0] + np.cross(EARTH_AXIS, p_i)
    push_i, R_ib = inertial_steps(imu, trajectory.R_eb(0.0)[0])
    dt = float(imu.time_s[1] - imu.time_s[0])
    span = every * dt
    # Within a stretch each push acts from the middle of its own sample on; the slope of the
    # specific force within a sample moves that point by dt^2 / 12.
    slope = np.gradient(push_i, axis=0)
    lever = (every - 0.5 - np.arange(every))[:, None] * dt
    blocks, slopes = (x.reshape(-1, every, 3) for x in (push_i, slope))
    gained_v = blocks.sum(axis=1)
    gained_p = (blocks * lever).sum(axis=1) - slopes.sum(axis=1) * dt / 12.0
    gravity = gravitation_i(p_i - 0.5 * span * v_i, -0.5 * span)
    for k, (push, shift) in enumerate(zip(gained_v, gained_p, strict=True)):
        middle_i = p_i + 0.5 * span * v_i + 0.25 * shift + 0.125 * gravity * span**2
        before, gravity = gravity, gravitation_i(middle_i, (k + 0.5) * span)
        p_i = p_i + v_i * span + shift + (0.5 * gravity - (gravity - before) / 12.0) * span**2
        v_i = v_i + push + gravity * span
    end_s = float(imu.time_s[-1])
    truth = trajectory.truth(end_s)
    R_ie = Rotation.from_rotvec(EARTH_AXIS * end_s)
    error_e = R_ie.inv().apply(p_i) - ecef_from_geodetic(truth.lat, truth.lon, truth.height)[0]
    R_el = R_el_from_lat_lon(truth.lat[0], truth.lon[0])
    tilt = (R_ie * trajectory.R_eb(end_s)[0]).inv() * R_ib[-1]
    return np.asarray(R_el.T @ error_e), float(tilt.magnitude())


def close_the_loop(config: SimulationConfig, *, every: int) -> tuple[float, float, float]:
    """Return horizontal and vertical error, m, and that of attitude, rad, at the end."""
    error_enu, tilt = navigate(simulate(config).mission.imu, config.trajectory, every=every)
    return math.hypot(error_enu[0], error_enu[1]), abs(error_enu[2]), tilt
