"""Errors of the chassis and the delay of the receiver, from a drive alone: no map is needed.

Over a minute the bias of a yaw rate and the scale of a speed bend and stretch the way that the
fixes tell, and a delay of the fixes shifts it along the speed. All are found together with the
beginning's pose by least squares with a weight for every fix.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np

from factors.similarity import Kernel, LogKernel, expected_mahalanobis_sq
from ssm_graph.base.errors import DataError
from ssm_graph.base.frozen import Array, ReadOnlyArrays
from ssm_graph.base.units import DEGREE
from ssm_graph.systems.road_map.drive import Chassis, Drive, GnssFixes, dead_reckoned

LEAST_FIXES: Final = 8
PRIOR: Final = np.array([np.inf, np.inf, np.inf, 0.05, 1.0 * DEGREE, 0.5])
"""Sigma of x, y, yaw (nothing is known), scale, bias [rad/s], delay [s] beforehand."""
_STEP: Final = np.array([1e-3, 1e-3, 1e-6, 1e-6, 1e-7, 1e-4])


_LEAST_NOISE_M: Final = 0.5
"""From fix to fix, of any receiver."""
TOLD: Final = 10.0 * DEGREE
"""A course is told by fixes once its sigma is below this."""


class FirstCourse(NamedTuple):
    """A course over ground to begin with."""

    fix: int
    """Number of the fix by which it is known, from 0."""
    yaw: float | None
    """rad, at that fix; None where neither the receiver nor the way tells it"""
    sigma: float
    """rad; 0 where the receiver gives it"""


def first_course(drive: Drive) -> FirstCourse:
    """Return the first course of a drive: the receiver's, or that which its way tells.

    Fixes are off by much, but alike: as the vehicle goes, their way turns onto the dead-reckoned
    one, by the rotation that is best for all of them.
    """
    gnss = drive.gnss
    if gnss.yaw is not None and np.isfinite(gnss.yaw[0]):
        return FirstCourse(0, float(gnss.yaw[0]), 0.0)
    t = drive.chassis.time_s
    inside = np.flatnonzero((gnss.time_s >= t[0]) & (gnss.time_s <= t[-1]))
    if len(inside) < 2:
        return FirstCourse(0, None, np.inf)
    way = dead_reckoned(np.zeros(3), gnss.time_s[inside], drive.chassis)
    noise = noise_of(drive)
    for n in range(2, len(inside) + 1):
        a = way[:n, :2] - way[:n, :2].mean(axis=0)
        b = gnss.x_y[inside[:n]] - gnss.x_y[inside[:n]].mean(axis=0)
        sigma = noise / max(float(np.sqrt(np.square(a).sum())), 1e-9)
        if sigma < TOLD:
            return FirstCourse(int(inside[n - 1]), float(way[n - 1, 2]) + turn_between(a, b), sigma)
    return FirstCourse(0, None, np.inf)


def noise_of(drive: Drive) -> float:
    """Return the sigma of fixes from one to the next, without what they are off by in common, m."""
    of_bias = drive.gnss_bias_m**2 / 3.0
    return float(np.sqrt(max(float(drive.gnss.sigma_m[0]) ** 2 - of_bias, _LEAST_NOISE_M**2)))


def turn_between(a: Array, b: Array) -> float:
    """Return by which angle points (N, 2) about their mean are to be turned onto others, rad."""
    return float(np.arctan2(np.sum(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]), np.sum(a * b)))


@dataclass(frozen=True, slots=True, eq=False)
class MotionErrors(ReadOnlyArrays):
    """What a drive says of its own instruments."""

    start: Array
    """(3,) pose at the first chassis row that is used: x, y [m], yaw [rad]."""
    scale: float
    """By which the speed is multiplied, less 1."""
    bias: float
    """rad/s, taken off the yaw rate."""
    delay_s: float
    """How much too late the fixes are stamped."""
    sigma: Array
    """(6,) of x, y, yaw, scale, bias and delay."""
    weight: Array
    """(N,) of every fix."""


def motion_errors(
    chassis: Chassis,
    gnss: GnssFixes,
    *,
    first_s: float | None = None,
    last_s: float | None = None,
    kernel: Kernel | None = None,
    rounds: int = 30,
) -> MotionErrors:
    """Return scale, bias and delay that make dead reckoning and fixes one.

    Parameters
    ----------
    first_s, last_s : the fixes that are used; by default all.
    kernel : of the similarity weights of the fixes.

    Raises :class:`DataError` for too few fixes.
    """
    k = kernel or LogKernel()
    began = max(float(chassis.time_s[0]), -np.inf if first_s is None else first_s)
    ended = min(float(chassis.time_s[-1]), np.inf if last_s is None else last_s)
    use = (gnss.time_s > began + 1.0) & (gnss.time_s < ended - 0.5)
    if use.sum() < LEAST_FIXES:
        raise DataError(
            f"gnss: expected {LEAST_FIXES} or more fixes within {began:.1f} and {ended:.1f} s, got "
            f"{int(use.sum())}; give a longer drive"
        )
    time_s, x_y, sigma = gnss.time_s[use], gnss.x_y[use], gnss.sigma_m[use]
    at = _first_guess(chassis, began, time_s, x_y)
    information = np.where(np.isfinite(PRIOR), 1.0 / np.square(PRIOR), 0.0)
    weight, cov = np.ones(len(time_s)), np.zeros((6, 6))
    for _ in range(rounds):
        error = _errors(at, chassis, began, time_s, x_y) / sigma[:, None]
        block = _jacobian(at, chassis, began, time_s, x_y) / sigma[:, None, None]
        spread = np.einsum("nij,jk,nik->n", block, cov, block)
        t = expected_mahalanobis_sq(np.hypot(*error.T), spread, sigma=1.0)
        weight = k.weight(t, dim=2)
        hessian = np.einsum("n,nij,nik->jk", weight, block, block) + np.diag(information)
        slope = np.einsum("n,nij,ni->j", weight, block, error) + information * at
        cov = np.linalg.inv(hessian)
        step = -cov @ slope
        at = at + step
        if np.all(np.abs(step) < 1e-3 * np.sqrt(np.diag(cov))):
            break
    return MotionErrors(
        at[:3], float(at[3]), float(at[4]), float(at[5]), np.sqrt(np.diag(cov)), weight
    )


def _first_guess(chassis: Chassis, began: float, time_s: Array, x_y: Array) -> Array:
    """Return the six numbers with the way turned onto the fixes as a whole."""
    track = dead_reckoned(np.zeros(3), np.concatenate([[began], time_s]), chassis)[1:, :2]
    a, b = track - track.mean(axis=0), x_y - x_y.mean(axis=0)
    yaw = turn_between(a, b)
    c, s = np.cos(yaw), np.sin(yaw)
    x, y = x_y.mean(axis=0) - np.array([[c, -s], [s, c]]) @ track.mean(axis=0)
    return np.array([x, y, yaw, 0.0, 0.0, 0.0])


def _errors(at: Array, chassis: Chassis, began: float, time_s: Array, x_y: Array) -> Array:
    """Return predicted minus measured (N, 2), m: the vehicle was there a delay before the stamp."""
    when = np.concatenate([[began], time_s - at[5]])
    track = dead_reckoned(at[:3], when, chassis, scale=1.0 + at[3], bias=at[4])
    return np.asarray(track[1:, :2] - x_y)


def _jacobian(at: Array, chassis: Chassis, began: float, time_s: Array, x_y: Array) -> Array:
    """Return the derivatives (N, 2, 6) by central differences: six integrations of the way."""
    columns = []
    for axis, step in zip(np.eye(6), _STEP, strict=True):
        high = _errors(at + step * axis, chassis, began, time_s, x_y)
        low = _errors(at - step * axis, chassis, began, time_s, x_y)
        columns.append((high - low) / (2.0 * step))
    return np.stack(columns, axis=-1)
