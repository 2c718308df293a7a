"""A mission as its comparisons need it: inertial data, velocities, and the way by both."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from ssm_graph.base.frozen import Array
from ssm_graph.base.times import is_inside
from ssm_graph.mission.mission import Mission
from ssm_graph.mission.suspects.hypothesis import Hypothesis
from ssm_graph.mission.suspects.motion import STEP_S, Inertial, Velocities
from ssm_graph.mission.suspects.regression import Mask
from ssm_graph.sensors.imu import ImuNoise

GRAVITY: Final = 9.81
"""m/s^2"""
SLOPE: Final = 0.002
"""rad, to which the level axes are known."""
SILENCE_S: Final = 3.0
"""Longer gaps between pings are bridged by the accelerometers alone."""
PROLONGED: Final = 60
"""Steps of the grid at either end that say how the vehicle came and went on."""
FARTHEST_S: Final = 60.0


class Logs:
    """A mission as its parts need it, with the inertial data summed up once for each scale."""

    def __init__(self, mission: Mission) -> None:
        """Take the logs of a mission."""
        self.mission = mission
        self.velocities = Velocities.of(mission.dvl)
        self._as_read = Inertial.of(mission.imu)
        self._inertial: dict[tuple[float, float, float], Inertial] = {}
        self._tracks: dict[tuple[object, ...], Track] = {}

    def inertial(self, of: Hypothesis) -> Inertial:
        """Return the inertial data with the gyros of a hypothesis."""
        if of.gyro not in self._inertial:
            self._inertial[of.gyro] = self._as_read.scaled(np.array(of.gyro))
        return self._inertial[of.gyro]

    def pings(self, of: Hypothesis) -> Velocities:
        """Return the velocities of a hypothesis."""
        stamps = self.velocities.time_s
        scaled = self.velocities.scaled(np.reshape(of.velocity, (3, 3)))
        return scaled.at_times(stamps - of.dvl.at(stamps))

    def track(self, of: Hypothesis) -> Track:
        """Return the track of a hypothesis."""
        key = (of.gyro, of.velocity, of.dvl)
        if key not in self._tracks:
            self._tracks[key] = Track.of(self, of)
        return self._tracks[key]


def track_covariance(time_s: Array, pings: Velocities, noise: ImuNoise, walk: float) -> Array:
    """Return the covariance (n, n) of a track that walks, most of all where pings are missing."""
    gap_s = np.diff(pings.time_s)
    force = noise.accel_bias_sigma + SLOPE * GRAVITY
    lost = np.where(gap_s > SILENCE_S, (force * gap_s**3 / 12.0) ** 2, 0.0)
    total = walk * pings.time_s + np.concatenate([[0.0], np.cumsum(lost)])
    variance = np.interp(time_s, pings.time_s, total - total[0])
    return np.asarray(np.minimum.outer(variance, variance))


def integral(time_s: Array, rate: Array) -> Array:
    """Return the integral (n, ...) of a rate by trapezoids."""
    step = 0.5 * np.diff(time_s).reshape((-1,) + (1,) * (rate.ndim - 1))
    total = np.cumsum(step * (rate[1:] + rate[:-1]), axis=0)
    return np.concatenate([np.zeros_like(total[:1]), total])


def _prolonged(grid: Array) -> Array:
    """Return a quantity (G,) of an even grid with a point far before and after, as it went on."""
    before, after = grid[PROLONGED] - grid[0], grid[-1] - grid[-1 - PROLONGED]
    far = FARTHEST_S / (PROLONGED * STEP_S)
    return np.concatenate([[grid[0] - far * before], grid, [grid[-1] + far * after]])


@dataclass(frozen=True, eq=False)
class Track:
    """The way by pings and gyros, in level axes that do not turn; at the ends as it went on."""

    time_s: Array
    """(G,)"""
    way: Array
    """(G,) complex, m"""
    drift: Array
    """(G,) complex: what an error of heading or scale that grows adds, m"""
    up: Array
    """(G,) m"""
    along_b: Array
    """(G,) complex, forward and to the right as the body goes, m"""

    @classmethod
    def of(cls, logs: Logs, of: Hypothesis) -> Track:
        """Return the way of a hypothesis."""
        inertial, pings = logs.inertial(of), logs.pings(of)
        t, gained = inertial.time_s, inertial.gained_i
        # Between pings the accelerometers say how the velocity changes.
        off = pings.in_i(inertial) - inertial.at(gained, pings.time_s)
        v_i = gained + np.stack([np.interp(t, pings.time_s, axis) for axis in off.T], axis=-1)
        first, second = inertial.level_i
        level = np.sum(v_i * first, axis=1) + 1j * np.sum(v_i * second, axis=1)
        along = (t - 0.5 * (t[0] + t[-1])) / (t[-1] - t[0])
        up = np.sum(v_i * inertial.up_i, axis=1)
        forward, right = (np.sum(v_i * inertial.R_ib[:, :, k], axis=1) for k in (0, 1))
        rates = (level, along * level, up, forward + 1j * right)
        return cls(*(_prolonged(x) for x in (t, *(integral(t, rate) for rate in rates))))

    def at(self, quantity: Array, time_s: Array) -> Array:
        """Return a quantity (G,) at any times (n,)."""
        return np.interp(time_s, self.time_s, quantity)

    def covers(self, time_s: Array) -> Mask:
        """Return which times (n,) lie within the inertial data."""
        return is_inside(time_s, float(self.time_s[1]), float(self.time_s[-2]))


def arm_of(logs: Logs, of: Hypothesis, lever_arm_b: Array, time_s: Array) -> tuple[Array, Array]:
    """Return a lever arm in the level axes, complex (n,), and its part upwards (n,), m."""
    inertial = logs.inertial(of)
    level, up = (np.interp(time_s, inertial.time_s, x) for x in inertial.arm(lever_arm_b))
    return level, up
