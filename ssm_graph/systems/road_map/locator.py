"""The annealed particle filter: from a fix to a lane."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from ssm_graph.base.errors import DataError
from ssm_graph.base.frozen import Array
from ssm_graph.base.units import DEGREE, wrapped
from ssm_graph.filters.rules.particles import Particles, drawn_anew, systematic
from ssm_graph.systems.road_map.drive import Curves
from ssm_graph.systems.road_map.maps.index import LineIndex, in_blocks
from ssm_graph.systems.road_map.maps.road_map import LineKind

X, Y, YAW, SCALE, BIAS = range(5)
"""Columns of a particle: m, m, rad, share of the speed beyond 1, rad/s."""
CELL: Final = np.array([1.0, 1.0, 4.0 * DEGREE])
"""Of the cells that tell how many particles are needed."""


@dataclass(frozen=True, slots=True)
class KindSettings:
    """How the curves of one kind are compared with the map."""

    sigma_m: float
    """Of the distance between a curve's point and its line, at the end ..."""
    annealed_m: float
    """... and what is added to it in the beginning."""
    cap_sq: float
    """A squared distance in sigmas counts no more than this."""
    information: float = 2.0
    """So many independent points a curve is worth: its errors are common to its points."""


OLD_SHARE: Final = 0.005
"""Of the weight that stays with the particles as they were, when others are put elsewhere."""
LEAST_SHARE: Final = 0.05
"""Of the particles that are put at a place, however small its share of the evidence; their weights
make up for it."""
INDEPENDENT_M: Final = 15.0
"""Pictures closer to each other than this see the same errors of the map, and count less."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LocatorSettings:
    """Everything that can be chosen about the filter; tuned on routes 0 to 99 only."""

    boundary: KindSettings = KindSettings(0.5, 2.0, 6.0)
    line: KindSettings = KindSettings(0.3, 1.2, 6.0)
    annealing: float = 8.0
    """Pictures over which the widths fall by a factor e."""
    n_points: int = 8
    """Of each curve."""
    cell_m: float = 2.0
    """Of the grid of the first particles."""
    most: int = 1000
    """Particles in the beginning; the grid is made wider where they would be more."""
    least: int = 300
    yaw_sigma: float = 4.0 * DEGREE
    """Of the first course, where the receiver gives one."""
    off_road_m: float = 25.0
    """First particles farther from every boundary and lane line are left out."""
    way_sigma: float = 0.01
    """Relative, of a step."""
    way_floor_m: float = 0.01
    turn_sigma: float = 0.1 * DEGREE
    """rad in a tenth of a second."""
    scale_sigma: float = 0.01
    bias_sigma: float = 0.05 * DEGREE
    """rad/s"""
    memory_s: float = 30.0
    """Over which scale and bias stay what they are; without new draws of them they would be those
    of the few particles that the first pictures left."""
    roughening: tuple[float, float, float] = (0.15, 0.15, 0.3 * DEGREE)
    """Sigma of what is added when particles are drawn anew: m, m, rad."""
    corridor_weight: float = 0.15
    """Log weight that each point of a boundary costs that lies within the corridor seen free."""
    wrong_mark: float = 0.7
    """Log weight that a lane line costs that is dashed where the map's is solid, or the reverse."""


@dataclass(slots=True)
class Locator:
    """The filter on its way: predict with the chassis, update with pictures."""

    indices: Mapping[LineKind, LineIndex]
    particles: Particles
    rng: np.random.Generator
    settings: LocatorSettings = field(default_factory=LocatorSettings)
    n_pictures: int = 0
    driven_m: float = 0.0
    _pictured_m: float = -INDEPENDENT_M

    def predict(self, way_m: float, turn: float, dt: float) -> None:
        """Move all particles by a step of the chassis: m, rad, s."""
        p, s = self.particles.states, self.settings
        n = len(p)
        noise = self.rng.standard_normal((4, n))
        kept = float(np.exp(-dt / s.memory_s))
        new = np.sqrt(1.0 - kept**2)
        p[:, SCALE] = kept * p[:, SCALE] + new * s.scale_sigma * noise[2]
        p[:, BIAS] = kept * p[:, BIAS] + new * s.bias_sigma * noise[3]
        way = way_m * (1.0 + p[:, SCALE]) + noise[0] * (s.way_sigma * abs(way_m) + s.way_floor_m)
        turned = turn - p[:, BIAS] * dt + noise[1] * s.turn_sigma * np.sqrt(dt / 0.1)
        middle = p[:, YAW] + 0.5 * turned
        p[:, X] += way * np.cos(middle)
        p[:, Y] += way * np.sin(middle)
        p[:, YAW] += turned
        self.driven_m += abs(way_m)

    def update(self, curves: Curves, rows: slice) -> None:
        """Weigh all particles by the curves of one picture, and draw them anew where few count."""
        new = min(1.0, (self.driven_m - self._pictured_m) / INDEPENDENT_M)
        self._pictured_m = self.driven_m
        found = log_likelihood(
            self.particles.states, curves, rows, self.indices, self.settings, self.n_pictures
        )
        p, s = self.particles, self.settings
        self.n_pictures += 1
        self.particles = drawn_anew(
            Particles(p.states, p.log_weight + new * found),
            cell=CELL,
            roughening=s.roughening,
            least=s.least,
            rng=self.rng,
        )

    def put(self, particles: Particles) -> None:
        """Go on with other particles."""
        self.particles = particles


def log_likelihood(
    states: Array,
    curves: Curves,
    rows: slice,
    indices: Mapping[LineKind, LineIndex],
    settings: LocatorSettings,
    n_pictures: int,
) -> Array:
    """Return how well the curves of a picture lie on the map's lines from poses (n, 3+): (n,).

    For each curve, with D_j the distance of its point j to the nearest line of its kind::

        information * mean_j( -min((D_j / s)^2, cap) / 2 ),    s = sigma + annealed exp(-k / K)
    """
    s = settings
    fade = float(np.exp(-n_pictures / s.annealing))
    wider_m = {
        LineKind.BOUNDARY: s.boundary.annealed_m * fade,
        LineKind.LANE_LINE: s.line.annealed_m * fade,
    }
    points, kind = curves.points(rows, s.n_points), curves.kind[rows]
    total = likelihood_of_points(states, points, kind, curves.mark[rows], indices, s, wider_m)
    index = indices.get(LineKind.BOUNDARY)
    if index is not None and s.corridor_weight > 0.0:
        total -= (1.0 - fade) * s.corridor_weight * _in_corridor(states, curves, rows, index)
    return total


def likelihood_of_points(
    states: Array,
    points: Array,
    kind: Array,
    mark: Array,
    indices: Mapping[LineKind, LineIndex],
    settings: LocatorSettings,
    wider_m: Mapping[LineKind, float],
) -> Array:
    """Return how well points (C, m, 2) of curves lie on the map's lines from poses (n, 3+): (n,).

    The points are in the axes of each pose; ``kind`` and ``mark`` (C,) are the curves'.
    ``wider_m`` is what is added to the sigma of each kind.
    """
    n_points = points.shape[1]
    total = np.zeros(len(states))
    for block in in_blocks(len(states), points.shape[0] * n_points):
        for of_kind, index in indices.items():
            mine = kind == of_kind
            if not mine.any():
                continue
            how = settings.line if of_kind is LineKind.LANE_LINE else settings.boundary
            dx, dy, segment = index.off(*laid(states[block], points[mine]))
            sigma = how.sigma_m + wider_m[of_kind]
            cost = np.minimum((dx * dx + dy * dy) * sigma**-2, how.cap_sq)
            if of_kind is LineKind.LANE_LINE:
                seen = np.repeat(mark[mine], n_points)[:, None]
                wrong = index.is_painted_otherwise(seen, segment) & (cost < how.cap_sq)
                cost += 2.0 * settings.wrong_mark / how.information * wrong
            total[block] -= 0.5 * how.information / n_points * cost.sum(axis=0)
    return total


def laid(states: Array, points: Array) -> tuple[Array, Array]:
    """Return x and y (p, n), m, of points (..., 2), p in all, in the axes of poses (n, 3+).

    The poses come last: there are more of them than points, and what is long is fast.
    """
    px, py = points[..., 0].reshape(-1, 1), points[..., 1].reshape(-1, 1)
    c, s = np.cos(states[:, YAW]), np.sin(states[:, YAW])
    return c * px - s * py + states[:, X], s * px + c * py + states[:, Y]


def _in_corridor(states: Array, curves: Curves, rows: slice, index: LineIndex) -> Array:
    """Return how many points of the corridor seen free lie on a boundary: (n,), at most 10.

    The corridor is looked at along its middle, between the two boundaries seen.
    """
    kind, side, cubic = curves.kind[rows], curves.side[rows], curves.cubic[rows]
    is_boundary = kind == LineKind.BOUNDARY
    left, right = (np.flatnonzero(is_boundary & (side == s)) for s in (1.0, -1.0))
    if not (left.size and right.size):
        return np.zeros(len(states))
    reach = curves.reach[rows]
    high = min(reach[left[0], 1], reach[right[0], 1])
    low = max(reach[left[0], 0], reach[right[0], 0])
    if high - low < 4.0:
        return np.zeros(len(states))
    x = np.linspace(low, high, 6)
    powers = x[:, None] ** np.arange(4)
    yl, yr = powers @ cubic[left[0]], powers @ cubic[right[0]]
    y = yr + np.array([[0.3], [0.5], [0.7]]) * (yl - yr)
    free = np.minimum(yl - y, y - yr) - 1.0
    use = free > 0.3
    points, free = np.stack([np.broadcast_to(x, y.shape)[use], y[use]], axis=-1), free[use][:, None]
    total = np.zeros(len(states))
    for block in in_blocks(len(states), len(points)):
        dx, dy, _ = index.off(*laid(states[block], points))
        total[block] = (dx * dx + dy * dy < free * free).sum(axis=0)
    return np.minimum(total, 10.0)


def first_particles(
    x_y: Array,
    half_m: float,
    yaw: float | None,
    indices: Mapping[LineKind, LineIndex],
    settings: LocatorSettings,
    rng: np.random.Generator,
) -> Particles:
    """Return particles on a grid over the square about a fix, where lines are near.

    Without a course (None) they look everywhere. Raises :class:`DataError` where there are none.
    """
    cell = settings.cell_m
    nearest_m = min(float(index.tree.query(x_y)[0]) for index in indices.values())
    if nearest_m > half_m + settings.off_road_m:
        raise DataError(
            f"gnss: the first fix, ({x_y[0]:.1f}, {x_y[1]:.1f}), is {nearest_m:.0f} m from every "
            f"boundary and lane line of the map; expected one within {half_m:.0f} m, by which "
            f"fixes are off, and {settings.off_road_m:.0f} m: another map, or a larger bias_m in "
            "[gnss]"
        )
    while True:
        side = np.arange(-half_m, half_m + 0.5 * cell, cell)
        gx, gy = np.meshgrid(x_y[0] + side, x_y[1] + side, indexing="ij")
        x, y = gx.ravel(), gy.ravel()
        near = np.zeros(len(x), dtype=bool)
        for index in indices.values():
            d, _ = index.tree.query(np.column_stack([x, y]))
            near |= d < settings.off_road_m
        x, y = x[near], y[near]
        n_yaw = 1 if yaw is not None else 24
        if len(x) * n_yaw <= settings.most * (1 if yaw is not None else 12) or cell > half_m:
            break
        cell *= 1.1
    several = max(1, int(np.ceil(settings.least / max(1, len(x) * n_yaw))))  # a good receiver
    x, y = np.repeat(x, several), np.repeat(y, several)
    n = len(x) * n_yaw
    states = np.zeros((n, 5))
    states[:, X], states[:, Y] = np.repeat(x, n_yaw), np.repeat(y, n_yaw)
    states[:, :2] += rng.uniform(-0.5 * cell, 0.5 * cell, (n, 2))
    if yaw is not None:
        states[:, YAW] = yaw + settings.yaw_sigma * rng.standard_normal(n)
    else:
        states[:, YAW] = np.tile(2.0 * np.pi * np.arange(n_yaw) / n_yaw, len(x))
        states[:, YAW] += rng.uniform(-np.pi / n_yaw, np.pi / n_yaw, n)
    states[:, SCALE] = settings.scale_sigma * rng.standard_normal(n)
    states[:, BIAS] = settings.bias_sigma * rng.standard_normal(n)
    states[:, YAW] = wrapped(states[:, YAW])
    return Particles(states, np.zeros(n))


def spread_over(
    at: Array,
    share: Array,
    reach_m: float,
    old: Particles,
    settings: LocatorSettings,
    rng: np.random.Generator,
) -> Particles:
    """Return particles about places (n, 3) by their shares; some of the old ones stay.

    ``reach_m`` is the length along the course over which those of a place are laid.
    """
    n = settings.most
    kept = old.states[rng.choice(len(old.states), n // 5, p=old.weight)]
    share = share / share.sum()
    of_number = np.maximum(share, min(LEAST_SHARE, 0.5 / len(share)))
    of_number = of_number / of_number.sum()
    rows = systematic(of_number, n - len(kept), rng)
    drawn = old.states[rng.choice(len(old.states), len(rows), p=old.weight)].copy()
    drawn[:, :3] = at[rows]
    along = rng.uniform(-0.5 * reach_m, 0.5 * reach_m, len(rows))
    drawn[:, 0] += along * np.cos(drawn[:, 2]) + 0.2 * rng.standard_normal(len(rows))
    drawn[:, 1] += along * np.sin(drawn[:, 2]) + 0.2 * rng.standard_normal(len(rows))
    drawn[:, 2] += 0.5 * DEGREE * rng.standard_normal(len(rows))
    weight = (share / of_number)[rows]
    weight *= (1.0 - OLD_SHARE) / weight.sum()
    weight = np.concatenate([np.full(len(kept), OLD_SHARE / len(kept)), weight])
    return Particles(np.concatenate([kept, drawn]), np.log(np.maximum(weight, 1e-300)))
