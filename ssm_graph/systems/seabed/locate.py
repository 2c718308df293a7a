"""Where a dive began, and what can be said of it: particles, hypotheses, verdict."""

from __future__ import annotations

import time
from dataclasses import dataclass
from enum import Enum
from typing import Final

import numpy as np

from ssm_graph.base.frozen import Array, FrozenArrays, shaped
from ssm_graph.filters.rules.hypotheses import CARRIED, Hypothesis, apart_from_each_other
from ssm_graph.filters.rules.particles import Particles, moments
from ssm_graph.sensors.seabed import MapErrors, SeabedGrid
from ssm_graph.systems.seabed.locator import (
    RATE,
    YAW,
    Locator,
    LocatorSettings,
    first_particles,
)
from ssm_graph.systems.seabed.search import SAME_M, Fit, search
from ssm_graph.systems.seabed.track import Track, way_from

_SPACING_M: Final = 2.0
"""Pings closer to each other are passed over: the next one sees the same."""
_N_SNAPSHOTS: Final = 8
_N_OWN: Final = 12
"""Places of the particles that are tried beside those of the search."""


class Verdict(Enum):
    """What can be said of the place; the text is shown to the user."""

    CONVERGED = "the place is known"
    AMBIGUOUS = "a few places explain the ranges"
    UNRESOLVED = "the seabed says too little of the place"
    FAILED = "no place on the map explains the ranges"

    @property
    def is_known(self) -> bool:
        """Whether the place may be used."""
        return self is Verdict.CONVERGED


@dataclass(frozen=True, slots=True, kw_only=True)
class VerdictSettings:
    """When a place is held to be known."""

    resolved_m: float = 15.0
    """Sigma of the place along its least known direction; more is not resolved."""
    few: int = 5
    """So many places at most are rivals; more, and the seabed says too little."""
    misfit: float = 1.5
    """Loss of log likelihood of a range beyond which nothing explains the ranges."""
    least_on_map: float = 0.5
    """Share of the ranges that have to end on the map."""


@dataclass(frozen=True, slots=True, eq=False)
class ParticleTrack(FrozenArrays):
    """Mean and covariance of the particles along the dive."""

    time_s: Array = shaped("N")
    x_y: Array = shaped("N", 2)
    """(N, 2) of the vehicle, m"""
    cov: Array = shaped("N", 2, 2)
    """(N, 2, 2) m^2"""
    n_particles: Array = shaped("N")


@dataclass(frozen=True, slots=True)
class Located:
    """Where a dive began on the map."""

    verdict: Verdict
    reason: str
    hypotheses: tuple[Hypothesis, ...]
    """Best first; their poses are x, y at the first ping, turn and drift of the heading."""
    cov: Array
    """(4, 4) of the best one's pose"""
    bias_m: float
    """The seabed is higher than the map by so much there"""
    track: ParticleTrack
    snapshots: tuple[tuple[float, Array], ...]
    """Particles (n, 2), m, at a few times, s"""
    way: Array
    """(N, 2) the vehicle's way from the best place, m"""
    middle: Array
    radius_m: float
    cpu_s: float

    @property
    def start(self) -> Array:
        """(2,) place at the first ping, m."""
        return np.array(self.hypotheses[0].pose[:2])


def locate(
    grid: SeabedGrid,
    errors: MapErrors,
    track: Track,
    *,
    middle: Array,
    radius_m: float,
    seed: int = 0,
    settings: LocatorSettings | None = None,
    judged: VerdictSettings | None = None,
) -> Located:
    """Find where on a map a dive began.

    Parameters
    ----------
    grid, errors : the map, and what it may be off by.
    track : of the dive, without the map.
    middle, radius_m : of the circle in which the first ping was, (2,) m and m.
    seed : of the particles.
    """
    begin_s = time.process_time()
    track = _spaced(track)
    slope = _typical_slope(grid, middle, radius_m + float(track.way_m.sum()))
    settings = settings or LocatorSettings()
    rng = np.random.default_rng(seed)
    particles, grain_m = first_particles(middle, radius_m, track.doubt, errors, settings, rng)
    locator = Locator(grid, errors, track.doubt, particles, grain_m, slope, rng, settings)
    followed, snapshots = _follow(locator, track)
    own = _begins(locator.particles, track)
    found, fit = search(grid, errors, track, middle=middle, radius_m=radius_m, slope=slope, own=own)
    judged = judged or VerdictSettings()
    verdict, reason = _judge(grid, errors, track, found, fit, followed, judged, middle, radius_m)
    return Located(
        verdict=verdict,
        reason=reason,
        hypotheses=tuple(found),
        cov=np.linalg.inv(fit.information[0])[:4, :4],
        bias_m=float(fit.bias[0]),
        track=followed,
        snapshots=snapshots,
        way=way_from(track, np.array(found[0].pose)[None])[0],
        middle=middle,
        radius_m=radius_m,
        cpu_s=time.process_time() - begin_s,
    )


def _spaced(track: Track) -> Track:
    """Return the pings that are some way apart, the first and the last among them."""
    cell = np.floor(np.cumsum(track.way_m) / _SPACING_M)
    kept = np.flatnonzero(np.diff(cell, prepend=-1.0) > 0)
    return track.part(np.union1d(kept, [0, len(track.time_s) - 1]))


def _typical_slope(grid: SeabedGrid, middle: Array, half_m: float) -> float:
    """Return the root of the mean squared slope of the map within a square, at least 0.02."""
    side = np.linspace(-half_m, half_m, 60)
    x, y = np.meshgrid(middle[0] + side, middle[1] + side)
    slope = grid.surface_at(x, y).slope
    square = np.square(slope).sum(axis=-1)
    known = np.isfinite(square)
    return max(float(np.sqrt(square[known].mean())) if known.any() else 0.0, 0.02)


def _follow(
    locator: Locator, track: Track
) -> tuple[ParticleTrack, tuple[tuple[float, Array], ...]]:
    """Run the filter along a track."""
    n = len(track.time_s)
    shown = set(np.unique(np.linspace(0, n - 1, _N_SNAPSHOTS).astype(int)).tolist())
    snapshots, means, covs, counts = [], [], [], []
    for row in range(n):
        if row > 0:
            step = track.x_y[row] - track.x_y[row - 1]
            locator.predict(step, float(track.time_s[row] - track.time_s[row - 1]))
        locator.update(track, row)
        p = locator.particles
        mean, cov = moments(p.states[:, :3], p.weight, YAW)
        means.append(mean[:2])
        covs.append(cov[:2, :2])
        counts.append(len(p.states))
        if row in shown:
            drawn = locator.rng.choice(len(p.states), min(len(p.states), 1500), p=p.weight)
            snapshots.append((float(track.time_s[row]), p.states[drawn, :2].copy()))
    followed = ParticleTrack(track.time_s, np.array(means), np.array(covs), np.array(counts, float))
    return followed, tuple(snapshots)


def _begins(particles: Particles, track: Track) -> Array:
    """Return the places (n, 4) at the first ping of the best particles, apart from each other."""
    p = particles.states
    rows = apart_from_each_other(
        particles.log_weight,
        lambda best, others: np.hypot(*(p[others, :2] - p[best, :2]).T) < SAME_M,
        _N_OWN,
    )
    span_s = float(track.time_s[-1] - track.time_s[0])
    at = np.zeros((len(rows), 4))
    at[:, 3] = p[rows, RATE]
    at[:, 2] = p[rows, YAW] - at[:, 3] * span_s
    at[:, :2] = p[rows, :2] - way_from(track, at)[:, -1]
    return at


def _judge(
    grid: SeabedGrid,
    errors: MapErrors,
    track: Track,
    found: list[Hypothesis],
    fit: Fit,
    followed: ParticleTrack,
    judged: VerdictSettings,
    middle: Array,
    radius_m: float,
) -> tuple[Verdict, str]:
    """Return the verdict and why it is so."""
    cov = np.linalg.inv(fit.information[0])
    sigma = float(np.sqrt(np.linalg.eigvalsh(cov[:2, :2])[-1]))
    shares = np.array([h.share for h in found])
    likely = int(np.searchsorted(np.cumsum(shares), 1.0 - CARRIED)) + 1
    told = f"sigma {sigma:.1f} m, {100.0 * shares[0]:.0f} % of the evidence"
    ways = way_from(track, np.array([h.pose for h in found[:likely]]))
    if len(found) > 1:
        rival = np.array(found[1].pose) - np.array(found[0].pose)
        share = f"{100.0 * shares[1]:.1f} %" if shares[1] >= 1e-3 else "below 0.1 %"
        told += f"; rival {rival[0]:+.0f} m east, {rival[1]:+.0f} m north with {share}"
    x, y = ways[0].T
    on_map = float(np.isfinite(grid.height_at(x, y)).mean())
    if on_map < judged.least_on_map:
        return Verdict.FAILED, (
            f"{100.0 * (1.0 - on_map):.0f} % of the way lies off the map; is it the right one, and "
            "the start where it is said to be?"
        )
    if found[0].misfit > judged.misfit:
        return Verdict.FAILED, (
            f"the best place explains the ranges with a loss of {found[0].misfit:.1f} each, "
            f"expected below {judged.misfit:.1f}: a start more than {radius_m:.0f} m from where it "
            "is said to be, an old map, a datum that is not stated, or a sigma that is too small"
        )
    if sigma > judged.resolved_m or likely > judged.few:
        relief = grid.relief(middle, radius_m)
        is_flat = relief < 2.0 * np.hypot(errors.sigma_m, errors.smooth_sigma_m)
        return Verdict.UNRESOLVED, (
            f"{'flat: unresolved' if is_flat else 'unresolved'}: relief {relief:.2f} m about the "
            f"start, {likely} places share the evidence, {told}"
        )
    if likely > 1:
        return Verdict.AMBIGUOUS, f"{likely} places share the evidence: {told}"
    mean, spread = followed.x_y[-1], followed.cov[-1] + np.diag([SAME_M, SAME_M]) ** 2
    off = mean - ways[0, -1]
    if off @ np.linalg.solve(spread, off) > 3.0**2:
        return Verdict.AMBIGUOUS, (
            f"the particles ended {off[0]:+.0f} m east and {off[1]:+.0f} m north of the best "
            f"place: {told}"
        )
    return Verdict.CONVERGED, told
