"""What gyros, accelerometers and DVL say of a mission's motion, each without the others' help.

Everything is in axes ``i`` that do not turn: those of the body at the begin of the inertial data,
carried on by the gyros. In them gravity is constant, up to the gyros' drift and the turn of the
Earth, and so is the direction of a course.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final

import numpy as np
from scipy.ndimage import uniform_filter1d
from scipy.spatial.transform import Rotation

from factors.so3 import cross
from ssm_graph.base.frozen import Array
from ssm_graph.mission.mission import Mission
from ssm_graph.mission.start.measured import PARITY_GATE
from ssm_graph.sensors.dvl import DvlLog
from ssm_graph.sensors.imu import ImuLog

STEP_S: Final = 0.05
"""Of the grid that inertial data are summed to."""
LEVEL_S: Final = 12.0
"""Means of the specific force over twice so long say where up is."""


def _product(quaternions: Array) -> Array:
    """Return the products (N, 4) of all rotations up to each, scalar last."""
    # As pairs of complex numbers, a + b j: (a + b j)(c + d j) = ac - b d* + (ad + b c*) j.
    x, y, z, w = quaternions.T
    a, b = w + 1j * x, y + 1j * z
    shift = 1
    while shift < len(a):
        c, d = a[shift:], b[shift:]
        a, b = (
            np.concatenate([a[:shift], a[:-shift] * c - b[:-shift] * d.conj()]),
            np.concatenate([b[:shift], a[:-shift] * d + b[:-shift] * c.conj()]),
        )
        shift *= 2
    return np.stack([a.imag, b.real, b.imag, a.real], axis=1)


@dataclass(frozen=True, eq=False)
class Inertial:
    """Attitude and velocity gained by the inertial data alone, on a grid of times."""

    time_s: Array
    """(N,) s"""
    R_ib: Array
    """(N, 3, 3) body to the axes that do not turn."""
    gained_i: Array
    """(N, 3) integral of the specific force, m/s."""
    gyro_b: Array
    """(N, 3) mean rate about each time, rad/s."""
    turn_b: Array
    """(N - 1, 3) turn from each time to the next, rad,"""
    gain_b: Array
    """(N - 1, 3) and integral of the specific force, m/s."""

    @classmethod
    def of(cls, imu: ImuLog) -> Inertial:
        """Sum the inertial data up."""
        edges = np.concatenate([[imu.start_s], imu.time_s])
        span = np.diff(edges)[:, None]
        step = max(STEP_S, float(np.median(span)))
        time_s = np.linspace(edges[0], edges[-1], int((edges[-1] - edges[0]) / step) + 2)
        turn_b, gain_b = (
            np.diff(_resampled(edges, np.cumsum(x * span, axis=0), time_s), axis=0)
            for x in (imu.gyro_b, imu.accel_b)
        )
        return cls._summed(time_s, turn_b, gain_b)

    def scaled(self, gyro_scale: Array) -> Inertial:
        """Return the same with gyros that are multiplied by ``gyro_scale`` (3,)."""
        return self._summed(self.time_s, self.turn_b * gyro_scale, self.gain_b)

    @classmethod
    def _summed(cls, time_s: Array, turn_b: Array, gain_b: Array) -> Inertial:
        turned = Rotation.from_rotvec(turn_b).as_quat()
        R_ib = Rotation.from_quat(_product(np.vstack([[0.0, 0.0, 0.0, 1.0], turned]))).as_matrix()
        gained = np.einsum("nij,nj->ni", 0.5 * (R_ib[:-1] + R_ib[1:]), gain_b)
        rate = turn_b / np.diff(time_s)[:, None]
        about = 0.5 * (np.vstack([rate[:1], rate]) + np.vstack([rate, rate[-1:]]))
        gained_i = np.concatenate([np.zeros((1, 3)), np.cumsum(gained, axis=0)])
        return cls(time_s, R_ib, gained_i, about, turn_b, gain_b)

    @cached_property
    def up_i(self) -> Array:
        """(N, 3) where up is: the mean specific force over some time."""
        size = max(1, round(LEVEL_S / (self.time_s[1] - self.time_s[0])))
        force = np.gradient(self.gained_i, self.time_s, axis=0)
        for _ in range(2):
            force = uniform_filter1d(force, size, axis=0, mode="nearest")
        return np.asarray(force / np.linalg.norm(force, axis=1, keepdims=True))

    @cached_property
    def level_i(self) -> tuple[Array, Array]:
        """(N, 3) two level axes that do not turn, the second a quarter turn anticlockwise."""
        first = self.R_ib[0, :, 0] - self.up_i * (self.up_i @ self.R_ib[0, :, 0])[:, None]
        first = first / np.linalg.norm(first, axis=1, keepdims=True)
        return first, cross(self.up_i, first)

    def arm(self, lever_arm_b: Array) -> tuple[Array, Array]:
        """Return a lever arm in the level axes, complex (N,), and its part upwards (N,), m."""
        key = tuple(lever_arm_b.tolist())
        if key not in self._arms:
            arm_i = self.R_ib @ lever_arm_b
            first, second, up = (
                np.einsum("ni,ni->n", arm_i, axis) for axis in (*self.level_i, self.up_i)
            )
            self._arms[key] = first + 1j * second, up
        return self._arms[key]

    @cached_property
    def _arms(self) -> dict[tuple[float, ...], tuple[Array, Array]]:
        return {}

    def at(self, quantity: Array, time_s: Array) -> Array:
        """Return a quantity (N, ...) of the grid at any times (M, ...), held at the ends."""
        place = (np.asarray(time_s) - self.time_s[0]) / (self.time_s[1] - self.time_s[0])
        low = np.clip(place.astype(int), 0, len(self.time_s) - 2)
        share = np.clip(place - low, 0.0, 1.0).reshape(low.shape + (1,) * (quantity.ndim - 1))
        first, second = quantity.take(low, axis=0), quantity.take(low + 1, axis=0)
        return np.asarray(first * (1.0 - share) + second * share)


def _resampled(edges: Array, total: Array, time_s: Array) -> Array:
    whole = np.concatenate([np.zeros((1, 3)), total])
    return np.stack([np.interp(time_s, edges, axis) for axis in whole.T], axis=-1)


@dataclass(frozen=True, eq=False)
class Velocities:
    """Velocity of the DVL over ground by the pings whose beams agree, body axes."""

    time_s: Array
    """(P,) s, when they were taken by their stamps"""
    v_b: Array
    """(P, 3) m/s"""
    sigma: Array
    """(3,) m/s, of forward, right and down, by the stated sigma of the beams"""
    lever_arm_b: Array
    """(3,) m"""

    @classmethod
    def of(cls, dvl: DvlLog) -> Velocities:
        """Solve pings of all beams, or of three where these are rare; off the ground alone."""
        dvl = dvl.of_ground()
        mount, valid = dvl.mount, np.isfinite(dvl.speed)
        has_all = valid.all(axis=1)
        sigma = float(np.median(dvl.sigma[valid])) if valid.any() else 1.0
        covariance = np.linalg.pinv(mount.beams_b.T @ mount.beams_b) * sigma**2
        spread = np.sqrt(np.diagonal(covariance))
        if mount.n_beams < 3 or not has_all.any():
            return cls(np.zeros(0), np.zeros((0, 3)), spread, mount.lever_arm_b)
        parity = mount.parity(dvl.speed[has_all], dvl.sigma[has_all])
        # Where no ping fits, units or beams are wrong, and this is not the place to say so.
        usual = float(np.median(parity)) / 0.675 if mount.n_beams > 3 else 1.0
        agrees = ~(parity >= PARITY_GATE * max(1.0, usual))
        speed = dvl.speed[has_all][agrees]
        v_b = speed @ np.linalg.pinv(mount.beams_b).T
        return cls(dvl.valid_s[has_all][agrees], v_b, spread, mount.lever_arm_b)

    def __len__(self) -> int:
        return len(self.time_s)

    def scaled(self, matrix: Array) -> Velocities:
        """Return the velocities turned or scaled by a matrix (3, 3)."""
        return replace(self, v_b=self.v_b @ matrix.T)

    def at_times(self, time_s: Array) -> Velocities:
        """Return the velocities as if taken at other times (P,)."""
        return replace(self, time_s=time_s)

    def in_i(self, inertial: Inertial) -> Array:
        """Return the velocity of the body origin (P, 3) in the axes that do not turn, m/s."""
        R_ib = inertial.at(inertial.R_ib, self.time_s)
        arm_b = cross(inertial.at(inertial.gyro_b, self.time_s), self.lever_arm_b)
        return np.asarray(np.einsum("nij,nj->ni", R_ib, self.v_b - arm_b))


def is_enough(mission: Mission) -> bool:
    """Return whether there is anything to compare: pings beside inertial data, if not far off."""
    imu, pings_s = mission.imu, mission.dvl.time_s
    if len(imu.time_s) < 3 or len(pings_s) == 0:
        return False
    begin_s, end_s = max(imu.start_s, pings_s[0]), min(imu.time_s[-1], pings_s[-1])
    return bool(imu.time_s[-1] - imu.start_s > 2.0 * LEVEL_S and end_s > begin_s)
