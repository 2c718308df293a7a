"""The method to the letter of the patent application, with what its text leaves open as settings.

A grid of 50 m in cells of 3.5 m about the fix; each boundary against the map's boundary of the same
side; w <- w (1 - d) with normalised d; the worst 30 % are moved near the best 30 %; convergence by
the variance of the weights and one cluster of k-means; the mean is laid on the own lane's lines by
Levenberg and Marquardt. docs/road-map.md says which step is in the text and which is not.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Final

import numpy as np

from factors.lane_line import line_residual
from ssm_graph.base.frozen import Array
from ssm_graph.base.units import DEGREE
from ssm_graph.filters.rules.particles import moments
from ssm_graph.systems.road_map.drive import Curves, Drive, curve_groups, dead_reckoned
from ssm_graph.systems.road_map.maps.index import LineIndex
from ssm_graph.systems.road_map.maps.road_map import LineKind
from ssm_graph.systems.road_map.window import in_plane

YAW: Final = 2


class Normalisation(Enum):
    """How distances become d in [0, 1]; the text says "normalised" and no more."""

    MAX = "by the largest"
    MIN_MAX = "from the least to the largest"
    SUM = "by the sum"


@dataclass(frozen=True, slots=True, kw_only=True)
class PatentSettings:
    """Numbers of the text, and (assumed) those that it leaves open."""

    side_m: float = 50.0
    cell_m: float = 3.5
    normalisation: Normalisation = Normalisation.MAX
    n_points: int = 16
    """Assumed, of each curve."""
    every: int = 5
    """Assumed: updates from one resampling to the next."""
    share: float = 0.3
    """Of the particles that are moved, and of those near which they are put."""
    near_m: float = 0.5
    """Assumed."""
    near_yaw: float = 0.5 * DEGREE
    """Assumed."""
    yaw_sigma: float = 3.0 * DEGREE
    """Assumed: the text gives all particles the course of the receiver."""
    cap_m: float = 12.0
    """Assumed: a curve without a line on its side costs so much."""
    one_cluster_m: float = 2.5
    """Assumed: two means nearer to each other are one cluster."""
    weight_variance: float = 0.0
    """Assumed: variance of the weights, times n^2, that has to be exceeded; the text gives none."""


@dataclass(frozen=True, slots=True, eq=False)
class PatentAnswer:
    """What the method says at the end of a drive."""

    pose: Array
    """(3,) mean of the particles: x, y [m], yaw [rad]."""
    refined: Array
    """(3,) laid on the own lane's lines; the mean where none is in view."""
    converged_s: float
    """When it first said that it had converged; NaN for never."""
    converged: Array
    """(3,) the pose then; NaN for never."""


def locate_by_patent(
    drive: Drive,
    indices: Mapping[LineKind, LineIndex],
    settings: PatentSettings | None = None,
    seed: int = 0,
) -> PatentAnswer:
    """Follow a drive by the method of the patent application."""
    s = settings or PatentSettings()
    rng = np.random.default_rng([seed, 3])
    states = _grid(drive, s, rng)
    weight = np.full(len(states), 1.0 / len(states))
    groups = curve_groups(drive.curves)
    times = np.array([when for when, _ in groups])
    start = np.concatenate([[min(drive.chassis.time_s[0], times[0])], times])
    track = dead_reckoned(np.zeros(3), start, drive.chassis)
    converged_s, converged, spread_before, last = np.nan, np.full(3, np.nan), np.inf, 0
    for k, (when, rows) in enumerate(groups):
        _move(states, track[k], track[k + 1], rng)
        boundary = indices.get(LineKind.BOUNDARY)
        if boundary is not None:
            distance = _distances(states, drive.curves, rows, boundary, s)
            if distance is not None:
                weight = weight * (1.0 - _normalised(distance, s.normalisation))
                weight = weight / weight.sum()
        if np.isnan(converged_s) and _has_converged(states, weight, s, rng):
            converged_s, converged = when, moments(states, weight, YAW)[0]
        spread = float(np.var(states[:, :2], axis=0).sum())
        if k - last + 1 >= s.every or spread > spread_before:
            states, weight, last = *_redrawn(states, weight, s, rng), k + 1
        spread_before = spread
    pose, _ = moments(states, weight, YAW)
    refined = _on_own_lines(pose, drive.curves, groups[-1][1], indices, s)
    began_s = float(drive.chassis.time_s[0])
    return PatentAnswer(pose, refined, converged_s - began_s, converged)


def _grid(drive: Drive, s: PatentSettings, rng: np.random.Generator) -> Array:
    n = int(np.ceil(s.side_m / s.cell_m))
    centres = (np.arange(n) - 0.5 * (n - 1)) * s.cell_m
    gx, gy = np.meshgrid(*(drive.gnss.x_y[0][:, None] + centres), indexing="ij")
    yaw = 0.0 if drive.gnss.yaw is None else float(drive.gnss.yaw[0])
    noise = s.yaw_sigma * rng.standard_normal(n * n)
    return np.column_stack([gx.ravel(), gy.ravel(), yaw + noise])


def _move(states: Array, before: Array, after: Array, rng: np.random.Generator) -> None:
    """Move all particles (n, 3) by the chassis: unicycle, 1 % + 1 cm and 0.1 deg of noise."""
    n = len(states)
    way = float(np.hypot(*(after[:2] - before[:2])))
    noise = rng.standard_normal((2, n))
    turn = after[2] - before[2] + 0.1 * DEGREE * noise[0]
    length = way * (1.0 + 0.01 * noise[1]) + 0.01 * rng.standard_normal(n)
    middle = states[:, 2] + 0.5 * turn
    states[:, 0] += length * np.cos(middle)
    states[:, 1] += length * np.sin(middle)
    states[:, 2] += turn


def _distances(
    states: Array, curves: Curves, rows: slice, index: LineIndex, s: PatentSettings
) -> Array | None:
    """Return the mean distance (n,) of the boundaries' points to the boundary of the same side."""
    mine = np.arange(rows.start, rows.stop)
    mine = mine[curves.kind[mine] == LineKind.BOUNDARY]
    if len(mine) == 0:
        return None
    points = curves.points(mine, s.n_points)
    x, y = in_plane(states[:, None, None, :3], points)
    foot = index.foot(np.stack([x, y], axis=-1))
    dx, dy = np.moveaxis(foot.x_y - states[:, None, None, :2], -1, 0)
    yaw = states[:, None, None, 2]
    has_left_foot = np.cos(yaw) * dy - np.sin(yaw) * dx > 0.0
    is_left = (curves.side[mine] > 0.0)[None, :, None]
    cost = np.where(has_left_foot == is_left, np.minimum(foot.distance, s.cap_m), s.cap_m)
    return np.asarray(cost.mean(axis=(1, 2)))


def _normalised(distance: Array, how: Normalisation) -> Array:
    low, high = float(distance.min()), float(distance.max())
    if high <= 0.0 or (how is Normalisation.MIN_MAX and high <= low):
        return np.zeros_like(distance)
    if how is Normalisation.MAX:
        # The worst one would weigh nothing for ever: a hair is left, so that the sum stays above 0.
        return np.minimum(distance / high, 1.0 - 1e-9)
    if how is Normalisation.MIN_MAX:
        return np.minimum((distance - low) / (high - low), 1.0 - 1e-9)
    return np.asarray(distance / distance.sum())


def _redrawn(
    states: Array, weight: Array, s: PatentSettings, rng: np.random.Generator
) -> tuple[Array, Array]:
    """Put the worst share of the particles near the best share, drawn by their weights."""
    n = len(states)
    order = np.argsort(weight)
    k = round(s.share * n)
    worst, best = order[:k], order[-k:]
    p = weight[best] / weight[best].sum()
    drawn = states[rng.choice(best, k, p=p)]
    noise = rng.standard_normal((k, 3)) * [s.near_m, s.near_m, s.near_yaw]
    moved = states.copy()
    moved[worst] = drawn + noise
    return moved, np.full(n, 1.0 / n)


def _has_converged(
    states: Array, weight: Array, s: PatentSettings, rng: np.random.Generator
) -> bool:
    """Return whether the weights vary enough and k-means (k = 2) finds one cluster."""
    if float(np.var(weight)) * len(weight) ** 2 < s.weight_variance:
        return False
    points = states[weight >= np.median(weight), :2]
    centres = points[rng.choice(len(points), 2, replace=False)]
    for _ in range(10):
        nearer = np.square(points[:, None] - centres).sum(axis=2).argmin(axis=1)
        if nearer.min() == nearer.max():
            return True
        centres = np.stack([points[nearer == k].mean(axis=0) for k in (0, 1)])
    return float(np.hypot(*(centres[0] - centres[1]))) < s.one_cluster_m


def _on_own_lines(
    pose: Array,
    curves: Curves,
    rows: slice,
    indices: Mapping[LineKind, LineIndex],
    s: PatentSettings,
) -> Array:
    """Lay a pose (3,) on the lane lines in view: Levenberg-Marquardt on the points' distances."""
    index = indices.get(LineKind.LANE_LINE)
    mine = np.arange(rows.start, rows.stop)
    mine = mine[curves.kind[mine] == LineKind.LANE_LINE]
    if index is None or len(mine) == 0:
        return pose
    points = curves.points(mine, s.n_points).reshape(-1, 2)
    at, damping = pose[:3].copy(), 1e-3
    error, block = _line_rows(at, points, index)
    for _ in range(30):
        hessian = block.T @ block
        step = np.linalg.solve(
            hessian + damping * np.diag(np.diag(hessian) + 1e-6), block.T @ error
        )
        trial = at - step
        new_error, new_block = _line_rows(trial, points, index)
        if new_error @ new_error < error @ error:
            at, error, block, damping = trial, new_error, new_block, damping / 3.0
        else:
            damping *= 5.0
        if np.abs(step).max() < 1e-6:
            break
    return at


def _line_rows(at: Array, points: Array, index: LineIndex) -> tuple[Array, Array]:
    x_y = np.stack(in_plane(at, points), axis=-1)
    foot = index.foot(x_y)
    normal = index.normal[foot.segment]
    found = line_residual(at[:2], at[2], point_b=points, foot=foot.x_y, normal=normal)
    block = np.concatenate([normal, found.error_D_pose[..., 2:]], axis=-1)
    near = foot.distance < 2.0
    return np.where(near, found.error, 0.0), block * near[:, None]
