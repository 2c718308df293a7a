"""What the sensors of a mission say of its motion, at any times: for checks of one by another."""

from __future__ import annotations

import numpy as np

from ssm_graph.base.frozen import Array
from ssm_graph.mission.mission import Mission


def difference(time_s: Array, half: float, known_s: Array, values: Array) -> Array:
    """Return ``values(time_s + half) - values(time_s - half)``."""
    later = np.interp(time_s + half, known_s, values)
    return np.asarray(later - np.interp(time_s - half, known_s, values))


def left_over(mission: Mission, speed: Array) -> Array:
    """Return what four beams (..., 4) measure beyond three components of velocity, m/s."""
    return np.asarray(np.abs(speed @ np.linalg.svd(mission.dvl.mount.beams_d)[0][:, 3]))


def velocities(mission: Mission) -> tuple[Array, Array]:
    """Return times (N,) and body velocities (N, 3) by four beams, without most of the outliers."""
    dvl = mission.dvl
    used = np.isfinite(dvl.speed).all(axis=1)
    if not used.any():
        return np.zeros(0), np.zeros((0, 3))
    left = left_over(mission, dvl.speed)
    used &= left <= 3.0 * np.median(left[used])
    return dvl.ping_s[used], dvl.speed[used] @ np.linalg.pinv(dvl.mount.beams_b).T


def force_direction(mission: Mission, time_s: Array, half: float) -> Array:
    """Return the unit vector (N, 3) of the mean specific force around each time."""
    return _unit(_gained(mission, mission.imu.accel_b, time_s, half))


def gravity_direction(
    mission: Mission, time_s: Array, half: float, *, ping_s: Array, velocity: Array
) -> Array:
    """Return the unit vector (N, 3) of the mean specific force less the acceleration.

    ``ping_s`` (P,) and ``velocity`` (P, 3) are those of :func:`velocities`.
    """
    v_b = np.column_stack([np.interp(time_s, ping_s, axis) for axis in velocity.T])
    gained = np.column_stack([difference(time_s, half, ping_s, axis) for axis in velocity.T])
    gravity = _gained(mission, mission.imu.accel_b, time_s, half) - gained
    gravity = gravity - np.cross(_gained(mission, mission.imu.gyro_b, time_s, half), v_b)
    return _unit(gravity)


def turned(mission: Mission, time_s: Array, half: float) -> Array:
    """Return how far the gyros turn (N, 3) around each time, rad."""
    return _gained(mission, mission.imu.gyro_b, time_s, half)


def _gained(mission: Mission, values: Array, time_s: Array, half: float) -> Array:
    """Return the integral (N, 3) of an IMU quantity from ``half`` before to ``half`` after."""
    steps = np.diff(mission.imu.time_s, prepend=mission.imu.start_s)
    sums = np.cumsum(values * steps[:, None], axis=0)
    columns = [difference(time_s, half, mission.imu.time_s, column) for column in sums.T]
    return np.column_stack(columns)


def _unit(vectors: Array) -> Array:
    size = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.asarray(vectors / np.maximum(size, 1e-9))
