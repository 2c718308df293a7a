"""A drive: what the vehicle recorded, as frozen values in SI units."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ssm_graph.base.errors import DataError
from ssm_graph.base.frozen import Array, FrozenArrays, optional_shaped, shaped

LONGEST_GAP_S: Final = 1.0
"""Of the chassis: over a longer one nothing is known of the motion."""


@dataclass(frozen=True, slots=True, eq=False)
class GnssFixes(FrozenArrays):
    """Fixes of a receiver in the plane of the map."""

    time_s: Array = shaped("N")
    x_y: Array = shaped("N", 2)
    """m"""
    sigma_m: Array = shaped("N")
    """Of each axis."""
    yaw: Array | None = optional_shaped("N")
    """rad, course over ground; NaN where there is none; None: never."""


@dataclass(frozen=True, slots=True, eq=False)
class Chassis(FrozenArrays):
    """Speed and yaw rate of the vehicle."""

    time_s: Array = shaped("N")
    speed: Array = shaped("N")
    """m/s, of the rear axle, forward."""
    yaw_rate: Array = shaped("N")
    """rad/s, anticlockwise."""


@dataclass(frozen=True, slots=True, eq=False)
class Curves(FrozenArrays):
    """Boundaries and lane lines as cubics in vehicle axes, y = c0 + c1 x + c2 x^2 + c3 x^3."""

    time_s: Array = shaped("N")
    """Several have the same time: those of one picture."""
    kind: Array = shaped("N")
    """`LineKind`"""
    side: Array = shaped("N")
    """1 for the left, -1 for the right."""
    cubic: Array = shaped("N", 4)
    """c0 [m], c1, c2 [1/m], c3 [1/m^2]"""
    reach: Array = shaped("N", 2)
    """m, least and largest x for which the cubic was fitted."""
    sigma_m: Array = shaped("N")
    """Standard deviation of the offset c0."""
    mark: Array = shaped("N")
    """`Mark` of a lane line."""

    def points(self, rows: NDArray[np.int64] | slice, n_points: int) -> Array:
        """Return points (rows, n_points, 2) evenly along x on some of the curves, m."""
        low, high = self.reach[rows].T
        x = low[:, None] + (high - low)[:, None] * np.linspace(0.0, 1.0, n_points)
        c0, c1, c2, c3 = (c[:, None] for c in self.cubic[rows].T)
        return np.stack([x, c0 + x * (c1 + x * (c2 + x * c3))], axis=-1)


@dataclass(frozen=True, slots=True, eq=False)
class Poses(FrozenArrays):
    """Where the vehicle was or is held to be."""

    time_s: Array = shaped("N")
    x_y: Array = shaped("N", 2)
    """m"""
    yaw: Array = shaped("N")
    """rad"""

    def at(self, time_s: Array) -> Array:
        """Return x, y and yaw (M, 3) at times (M,), straight between the poses."""
        yaw = np.interp(time_s, self.time_s, np.unwrap(self.yaw))
        x, y = (np.interp(time_s, self.time_s, values) for values in self.x_y.T)
        return np.column_stack([x, y, yaw])


@dataclass(frozen=True, slots=True, eq=False)
class Drive:
    """Logs of a drive, checked."""

    name: str
    gnss: GnssFixes
    chassis: Chassis
    curves: Curves
    truth: Poses | None = None
    gnss_bias_m: float = 0.0
    """Half the side of the square within which fixes are off for minutes; 0 where sigma is all."""

    def __post_init__(self) -> None:
        _check_times(f"{self.name} gnss", self.gnss.time_s)
        _check_times(f"{self.name} chassis", self.chassis.time_s)
        if len(self.gnss.time_s) == 0:
            raise DataError(f"{self.name} gnss: expected a fix to begin with, got none")
        if len(self.chassis.time_s) < 2:
            raise DataError(f"{self.name} chassis: expected two or more rows")
        gap = np.diff(self.chassis.time_s)
        if gap.max() > LONGEST_GAP_S:
            row = int(gap.argmax())
            raise DataError(
                f"{self.name} chassis: a gap of {gap[row]:.2f} s after "
                f"{self.chassis.time_s[row]:.3f} s; expected at most {LONGEST_GAP_S:g} s, the "
                "motion is not known over it; cut the drive there"
            )
        _check_curves(self.name, self.curves)


def _check_times(label: str, time_s: Array) -> None:
    if not np.all(np.isfinite(time_s)):
        raise DataError(f"{label}: expected finite times, got NaN or infinity")
    late = np.flatnonzero(np.diff(time_s) <= 0.0)
    if late.size:
        row = int(late[0])
        raise DataError(
            f"{label}: expected times that increase, got {time_s[row + 1]:.6f} s after "
            f"{time_s[row]:.6f} s (row {row + 2}); delete the row, or sort the table"
        )


def _check_curves(name: str, curves: Curves) -> None:
    label = f"{name} curves"
    if np.any(np.diff(curves.time_s) < 0.0):
        row = int(np.argmax(np.diff(curves.time_s) < 0.0))
        raise DataError(f"{label}: row {row + 2} is older than the one before; sort the table")
    checks = (
        (~np.isfinite(curves.cubic).all(axis=1), "its coefficients are not finite"),
        (~(curves.reach[:, 1] > curves.reach[:, 0]), "its range of x has no length"),
        (~np.isin(curves.side, (-1.0, 1.0)), "its side is neither 1 (left) nor -1 (right)"),
        (~(curves.sigma_m > 0.0), "its sigma is not above zero"),
        (~np.isin(curves.kind, (0.0, 1.0)), "its kind is neither 0 (boundary) nor 1 (lane line)"),
        (~np.isin(curves.mark, (0.0, 1.0, 2.0)), "its mark is none of 0, 1, 2"),
    )
    for is_bad, text in checks:
        if is_bad.any():
            row = int(np.argmax(is_bad))
            raise DataError(
                f"{label}: row {row + 1} at {curves.time_s[row]:.3f} s: {text}; delete it"
            )


def curve_groups(curves: Curves) -> list[tuple[float, slice]]:
    """Return the times of the pictures with the rows of each."""
    time_s = curves.time_s
    first = np.flatnonzero(np.diff(time_s, prepend=-np.inf) > 0.0)
    bounds = [*map(int, first), len(time_s)]
    return [(float(time_s[a]), slice(a, b)) for a, b in pairwise(bounds)]


def dead_reckoned(
    start: Array, time_s: Array, chassis: Chassis, *, scale: float = 1.0, bias: float = 0.0
) -> Array:
    """Return x, y and yaw (N, 3) at times (N,) from a pose (3,) at the first of them.

    Speed times ``scale`` and yaw rate minus ``bias`` (rad/s) are integrated by the trapezoidal rule
    on the chassis' own times; the yaw of the middle of each step turns it.
    """
    inside = (chassis.time_s > time_s[0]) & (chassis.time_s < time_s[-1])
    t = np.union1d(chassis.time_s[inside], time_s)
    speed = scale * np.interp(t, chassis.time_s, chassis.speed)
    rate = np.interp(t, chassis.time_s, chassis.yaw_rate) - bias
    dt = np.diff(t)
    yaw = start[2] + np.concatenate([[0.0], np.cumsum(0.5 * (rate[1:] + rate[:-1]) * dt)])
    way = 0.5 * (speed[1:] + speed[:-1]) * dt
    middle = 0.5 * (yaw[1:] + yaw[:-1])
    x = start[0] + np.concatenate([[0.0], np.cumsum(way * np.cos(middle))])
    y = start[1] + np.concatenate([[0.0], np.cumsum(way * np.sin(middle))])
    rows = np.searchsorted(t, time_s)
    return np.column_stack([x[rows], y[rows], yaw[rows]])
