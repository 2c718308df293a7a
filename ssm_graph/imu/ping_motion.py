"""What the inertial sensors read at a ping, and between a ping and its keyframe."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from factors import so3
from factors.dvl_calibration import Motion
from ssm_graph.base.frozen import Array
from ssm_graph.base.times import Indices, last_readings, usual_interval
from ssm_graph.sensors.imu import ImuLog

PING_WINDOW_S = 0.1
"""The gyro reading at a ping is the mean over this window: a ping takes time, and so does noise
to average out."""


def mean_gyro(imu: ImuLog, time_s: Array) -> Array:
    """Return the mean gyro reading (M, 3) over the ping window about each time, rad/s.

    Near the ends of the data the window shrinks, to no less than one sample.
    """
    edges, angle = _angles(imu)
    sample = usual_interval(edges)
    room = np.minimum(time_s - edges[0], edges[-1] - time_s)
    half = np.clip(room, 0.5 * sample, 0.5 * max(PING_WINDOW_S, sample))
    centre = np.clip(time_s, edges[0] + half, edges[-1] - half)
    turned = [
        np.interp(centre + half, edges, axis) - np.interp(centre - half, edges, axis)
        for axis in angle.T
    ]
    return np.asarray(np.stack(turned, axis=-1) / (2.0 * half[:, None]))


def turn_between(imu: ImuLog, begin_s: Array, end_s: Array) -> Array:
    """Return how far the gyros say the body turned from one time to another (M, 3), rad.

    Rates are summed as they are, along the body's own axes: for a second or less.
    """
    edges, angle = _angles(imu)
    turned = [np.interp(end_s, edges, axis) - np.interp(begin_s, edges, axis) for axis in angle.T]
    return np.asarray(np.stack(turned, axis=-1))


def last_readings_led(
    imu: ImuLog, keyframe_s: Array, time_s: Array
) -> tuple[Indices, Indices, Array]:
    """Return keyframes (M,) with a reading since the one before, the last of each, and its way.

    The third is the rotation (M, 3, 3) of body axes at the reading to those at the keyframe, by the
    gyros: ``R_nb`` of the keyframe times it is the attitude at the reading.
    """
    keyframe, reading = last_readings(keyframe_s, time_s)
    turn_b = turn_between(imu, time_s[reading], keyframe_s[keyframe])
    return keyframe, reading, so3.exp(-turn_b)


def _angles(imu: ImuLog) -> tuple[Array, Array]:
    """Return the ends (N + 1,) of the inertial samples, and the gyros summed up to each."""
    edges = np.concatenate([[imu.start_s], imu.time_s])
    steps = imu.gyro_b * np.diff(edges)[:, None]
    return edges, np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])


class MotionBefore:
    """Inertial readings shortly before given times, wherever a clock may have been wrong.

    Between the ends of the inertial data; beyond them nothing is known and nothing moves.
    """

    def __init__(self, imu: ImuLog, time_s: Array) -> None:
        """Take the inertial data, and the times (P,) of the keyframes, s."""
        self.time_s = time_s
        self._edges = np.concatenate([[imu.start_s], imu.time_s])
        spans = np.diff(self._edges)[:, None]
        readings = np.hstack([imu.gyro_b, imu.accel_b])
        self._integral = np.concatenate([np.zeros((1, 6)), np.cumsum(readings * spans, axis=0)])
        self._sample_s = usual_interval(self._edges)
        self._half_s = 0.5 * max(PING_WINDOW_S, self._sample_s)

    def at(self, late_s: float, pings: slice | NDArray[np.intp] = np.s_[:]) -> Motion:
        """Return the motion (P, ...) of pings taken ``late_s`` before their keyframes."""
        time_s = self.time_s[pings]
        ping_s = time_s - late_s
        between = self._at(time_s) - self._at(ping_s)
        turn_b, gain_b = between[:, :3], between[:, 3:]
        window_s = 2.0 * self._half_s
        mean, before, behind = (
            self._mean(ping_s + shift, self._half_s) for shift in (0.0, -window_s, window_s)
        )
        return Motion(
            turn_b=turn_b,
            # Each force along the axes at the keyframe, as if it and the rate were constant.
            gain_b=gain_b - 0.5 * so3.cross(turn_b, gain_b),
            gyro_b=mean[:, :3],
            accel_b=mean[:, 3:],
            gyro_rate_b=(behind - before)[:, :3] / (2.0 * window_s),
        )

    def in_thirds(self, late_s: float) -> tuple[tuple[Motion, Motion, Motion], float]:
        """Return the readings in three parts about each ping, one after the other.

        What is white in them is so much larger, in variance, than in their mean over the ping
        window: the second number. Each part is two samples long or more.
        """
        whole, half_s = self.at(late_s), max(self._half_s / 3.0, self._sample_s)
        ping_s = self.time_s - late_s
        parts = []
        for shift in (-2.0 * half_s, 0.0, 2.0 * half_s):
            mean = self._mean(ping_s + shift, half_s)
            parts.append(whole._replace(gyro_b=mean[:, :3], accel_b=mean[:, 3:]))
        return (parts[0], parts[1], parts[2]), self._half_s / half_s

    def _mean(self, time_s: Array, half_s: float) -> Array:
        """Return the mean readings (P, 6) from ``half_s`` before to ``half_s`` after each time."""
        centre = np.clip(time_s, self._edges[0] + half_s, self._edges[-1] - half_s)
        passed = self._at(centre + half_s) - self._at(centre - half_s)
        return np.asarray(passed / (2.0 * half_s))

    def _at(self, time_s: Array) -> Array:
        """Return the integrals (P, 6) of the readings up to each time."""
        edges = self._edges
        sample = np.clip(np.searchsorted(edges, time_s) - 1, 0, len(edges) - 2)
        begin, end = edges[sample], edges[sample + 1]
        share = np.clip((time_s - begin) / (end - begin), 0.0, 1.0)[:, None]
        return np.asarray(
            self._integral[sample] + share * (self._integral[sample + 1] - self._integral[sample])
        )
