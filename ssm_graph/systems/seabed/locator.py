"""The particle filter over a map of the seabed: from a start in doubt to a place."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

import numpy as np

from factors.similarity import LogKernel
from ssm_graph.base.frozen import Array
from ssm_graph.base.units import DEGREE
from ssm_graph.filters.rules.particles import Particles, drawn_anew
from ssm_graph.sensors.seabed import MapErrors, SeabedGrid
from ssm_graph.systems.seabed.track import Counted, Doubt, Track, counted

X, Y, YAW, RATE, UP, UP_VAR = range(6)
"""Columns of a particle: m, m, rad and rad/s by which the dead reckoning's heading is too small and
its error grows, mean (m) and variance of what the map is too low by, given all that."""
CELL: Final = np.array([4.0, 4.0, 2.0 * DEGREE])
"""Of the cells that tell how many particles are needed."""
KERNEL: Final = LogKernel()
"""Of the similarity weight of each range."""
OFF_MAP: Final = 9.0
"""Squared sigmas that a range costs whose beam ends where the map has nothing."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LocatorSettings:
    """Everything that can be chosen about the filter; tuned on seeds below 100 only."""

    most: int = 8000
    """Particles in the beginning; their grid is made wider where they would be more."""
    least: int = 600
    finest_m: float = 6.0
    """Of the grid of the first particles."""
    annealing_m: float = 60.0
    """Way over which the grain of the first particles, as an error of heights, falls to 1/e."""
    roughening: tuple[float, float] = (0.4, 0.1 * DEGREE)
    """Sigma of what is added when particles are drawn anew: m, rad; of the rate as much as turns
    by so much within a minute."""


@dataclass(slots=True)
class Locator:
    """The filter on its way: predict with the dead reckoning, update with ranges."""

    grid: SeabedGrid
    errors: MapErrors
    doubt: Doubt
    particles: Particles
    grain_m: float
    """Between neighbours of the first particles."""
    slope: float
    """Typical of the map: what a grain is worth in height."""
    rng: np.random.Generator
    settings: LocatorSettings = field(default_factory=LocatorSettings)
    driven_m: float = 0.0

    def predict(self, step: Array, dt: float) -> None:
        """Move all particles by a step (2,) of the dead reckoning, m, within ``dt`` s."""
        p, d = self.particles.states, self.doubt
        n = len(p)
        noise = self.rng.standard_normal((3, n))
        middle = p[:, YAW] + 0.5 * p[:, RATE] * dt
        p[:, YAW] += p[:, RATE] * dt + d.rate_walk * np.sqrt(dt) * noise[2]
        way = float(np.hypot(*step))
        sigma = np.hypot(d.walk * np.sqrt(dt), d.scale * way)
        east, north = turned(step, middle).T
        p[:, X] += east + sigma * noise[0]
        p[:, Y] += north + sigma * noise[1]
        spread = 2.0 * self.errors.bias_sigma_m**2 / self.errors.bias_correlation_s
        p[:, UP_VAR] += spread * dt
        self.driven_m += way

    def update(self, track: Track, row: int) -> None:
        """Weigh all particles by the ranges of one ping, and draw them anew where few count."""
        fade = float(np.exp(-self.driven_m / self.settings.annealing_m))
        grain = self.slope * self.grain_m * fade
        seen = counted(self.grid, self.errors, track, row)
        p, s = self.particles, self.settings
        found = self._log_likelihood(p.states, track, row, seen, grain)
        metres, turn = s.roughening
        self.particles = drawn_anew(
            Particles(p.states, p.log_weight + found),
            cell=CELL,
            roughening=(*(metres + 0.35 * self.grain_m * fade,) * 2, turn, turn / 60.0),
            least=s.least,
            rng=self.rng,
        )

    def _log_likelihood(
        self, states: Array, track: Track, row: int, seen: Counted, grain: float
    ) -> Array:
        """Return the log likelihood (n,) of a ping's ranges, and put what they say of the map.

        With ``t`` the squared error of a range in sigmas and ``f`` the kernel, each particle's
        bias is where ``sum share f(t) - (b - mean)^2 / (2 var)`` is largest, and integrated out.
        """
        ends = track.ends[row]
        heard = np.isfinite(ends[:, 2])
        off = turned(ends[heard, :2], states[:, YAW, None])
        x, y = states[:, X, None] + off[..., 0], states[:, Y, None] + off[..., 1]
        error = track.height[row] + ends[heard, 2] - self.grid.height_at(x, y)
        known = np.isfinite(error)
        error = np.where(known, error, 0.0)
        sigma_sq = np.square(seen.sigma[heard]) + grain**2
        share = np.where(known, seen.share[heard], 0.0)
        mean, variance = states[:, UP, None], states[:, UP_VAR, None]
        t = np.square(error - mean) / (sigma_sq + variance)
        for _ in range(2):
            told = KERNEL.weight(t) * share / sigma_sq
            information = 1.0 / variance + told.sum(axis=1, keepdims=True)
            bias = (mean / variance + (told * error).sum(axis=1, keepdims=True)) / information
            t = np.square(error - bias) / sigma_sq
        states[:, UP], states[:, UP_VAR] = bias[:, 0], 1.0 / information[:, 0]
        lost = np.where(known, 0.0, seen.share[heard] * KERNEL.similarity(np.array(OFF_MAP)))
        total = (share * KERNEL.similarity(t) + lost).sum(axis=1)
        total -= 0.5 * ((bias - mean) ** 2 / variance + np.log(variance * information))[:, 0]
        return np.asarray(total)


def turned(x_y: Array, yaw: Array) -> Array:
    """Return vectors (..., 2), east and north, turned clockwise by angles (...), rad."""
    c, s = np.cos(yaw), np.sin(yaw)
    east, north = x_y[..., 0], x_y[..., 1]
    return np.stack([c * east + s * north, c * north - s * east], axis=-1)


def first_particles(
    middle: Array,
    radius_m: float,
    doubt: Doubt,
    errors: MapErrors,
    settings: LocatorSettings,
    rng: np.random.Generator,
) -> tuple[Particles, float]:
    """Return particles on a grid over a circle about a point (2,), and the grid's width, m."""
    n_yaw = 1 if np.isfinite(doubt.yaw) else 36
    most = settings.most * (1 if n_yaw == 1 else 6)
    grain = max(settings.finest_m, radius_m * np.sqrt(np.pi * n_yaw / most))
    side = np.arange(-radius_m, radius_m + 0.5 * grain, grain)
    x, y = (part.ravel() for part in np.meshgrid(side, side))
    inside = np.hypot(x, y) <= radius_m + 0.5 * grain
    x_y = np.repeat(np.column_stack([x, y])[inside], n_yaw, axis=0)
    n = len(x_y)
    states = np.zeros((n, 6))
    states[:, :2] = middle + x_y + rng.uniform(-0.5 * grain, 0.5 * grain, (n, 2))
    if n_yaw == 1:
        states[:, YAW] = doubt.yaw * rng.standard_normal(n)
    else:
        turn = 2.0 * np.pi / n_yaw
        states[:, YAW] = np.tile(turn * np.arange(n_yaw), n // n_yaw)
        states[:, YAW] += rng.uniform(-0.5 * turn, 0.5 * turn, n)
    states[:, RATE] = doubt.rate * rng.standard_normal(n)
    states[:, UP_VAR] = max(errors.bias_sigma_m, 0.01) ** 2
    return Particles(states, np.zeros(n)), grain
