"""All places that a dive could have begun at, each with its evidence.

The particles may have lost the right place before they knew better. So the dive as a whole, stiff
but for a turn and a drift of its heading, is laid on the map from everywhere it could have begun,
coarsely, and the best places finely, beside those of the particles.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ssm_graph.base.frozen import Array
from ssm_graph.filters.rules.hypotheses import Hypothesis, apart_from_each_other, told
from ssm_graph.sensors.seabed import MapErrors, SeabedGrid
from ssm_graph.systems.seabed.locator import KERNEL, OFF_MAP, turned
from ssm_graph.systems.seabed.track import Track, counted

SAME_M: Final = 12.0
"""Places closer to each other at the begin and at the end are one."""
_KEPT: Final = 40
_COARSE_S: Final = 240.0
"""Of the dive that is laid on the map from everywhere: its heading has not drifted far yet."""
_COARSE_PINGS: Final = 16
_FINE_PINGS: Final = 80
_COARSE_M: Final = 10.0
_POINTS: Final = 2_000_000
"""Beam ends looked up at a time."""
_ROUNDS: Final = 12
_FIRST_M: Final = 15.0
"""A fit begins as if the map were blurred by so much, and halves it from round to round."""
_WIDEST: Final = 2.5
"""Sigmas of the heading's turn and drift that are tried."""


class Fit(NamedTuple):
    """Places after a fit, n of them."""

    at: Array
    """(n, 4) x, y at the first ping, m, turn and drift of the heading, rad and rad/s"""
    information: Array
    """(n, 5, 5) of them and of the map's bias"""
    log_evidence: Array
    misfit: Array
    bias: Array
    """(n,) m, what the map is too low by"""


@dataclass(frozen=True, slots=True)
class Stiff:
    """A stretch of a track as one piece, to be laid on the map."""

    grid: SeabedGrid
    errors: MapErrors
    track: Track
    share: Array
    """(K, B) how much each range counts; 0 where there is none"""
    sigma_sq: Array
    """(K, B) m^2"""

    @classmethod
    def of(cls, grid: SeabedGrid, errors: MapErrors, track: Track, n_pings: int) -> Stiff:
        """Return a track, thinned to so many pings."""
        n = len(track.time_s)
        part = track.rows(np.unique(np.linspace(0, n - 1, min(n, n_pings)).astype(int)))
        seen = [counted(grid, errors, part, row) for row in range(len(part.time_s))]
        heard = np.isfinite(part.ends[..., 2])
        share = np.where(heard, np.array([s.share for s in seen]), 0.0)
        return cls(
            grid, errors, part, share, np.where(heard, np.array([s.sigma for s in seen]), 1.0) ** 2
        )

    def ends_at(self, at: Array) -> tuple[Array, Array]:
        """Return where beams end (n, K, B, 2) from places (n, 4), and the vehicle (n, K, 2), m."""
        since = self.track.time_s - self.track.time_s[0]
        yaw = at[:, 2, None] + at[:, 3, None] * since
        middle = 0.5 * (yaw[:, 1:] + yaw[:, :-1])
        steps = turned(np.diff(self.track.x_y, axis=0), middle)
        way = np.concatenate([np.zeros((len(at), 1, 2)), np.cumsum(steps, axis=1)], axis=1)
        vehicle = at[:, None, :2] + way
        ends = np.nan_to_num(self.track.ends[..., :2])
        return vehicle[:, :, None] + turned(ends, yaw[:, :, None]), vehicle

    @property
    def heights(self) -> Array:
        """(K, B) at which beams end above the ellipsoid, m; 0 where there is none."""
        return np.nan_to_num(self.track.height[:, None] + self.track.ends[..., 2])

    def _bias(self, error: Array, weight: Array) -> Array:
        """Return what the map is too low by (n,), from errors and information (n, K, B)."""
        prior = 1.0 / max(self.errors.bias_sigma_m, 0.01) ** 2
        return (weight * error).sum(axis=(1, 2)) / (prior + weight.sum(axis=(1, 2)))

    def _robust_bias(self, error: Array, sigma_sq: Array, share: Array) -> tuple[Array, Array]:
        """Return the bias (n,) and similarity weights (n, K, B) that agree with each other."""
        bias = np.median(error, axis=(1, 2))
        limit = 2.0 * self.errors.bias_sigma_m
        bias = np.clip(bias, -limit, limit)
        weight = np.ones_like(error)
        for _ in range(3):
            weight = KERNEL.weight(np.square(error - bias[:, None, None]) / sigma_sq)
            bias = self._bias(error, weight * share / sigma_sq)
        return bias, weight

    def coarse(self, at: Array, wider_m: float) -> Array:
        """Return log likelihoods (n,) of places (n, 4), the map blurred by so much height."""
        found = np.empty(len(at))
        chunk = max(1, _POINTS // self.share.size)
        sigma_sq = self.sigma_sq + wider_m**2
        for begin in range(0, len(at), chunk):
            part = slice(begin, begin + chunk)
            ends, _ = self.ends_at(at[part])
            error = self.heights - self.grid.height_at(ends[..., 0], ends[..., 1])
            known = np.isfinite(error)
            error = np.where(known, error, 0.0)
            share = np.where(known, self.share, 0.0)
            bias = self._bias(error, share / sigma_sq)
            t = np.square(error - bias[:, None, None]) / sigma_sq
            t = np.where(known, t, OFF_MAP)
            prior = 0.5 * np.square(bias / max(self.errors.bias_sigma_m, 0.01))
            found[part] = (self.share * KERNEL.similarity(t)).sum(axis=(1, 2)) - prior
        return found

    def fitted(self, at: Array, *, first_m: float, slope: float) -> Fit:
        """Return places (n, 4) moved to where the stretch fits best nearby: damped Gauss-Newton."""
        at = at.copy()
        for number in range(_ROUNDS):
            wider = slope * first_m * 0.5**number
            information, gradient, _, _ = self._normal_equations(at, wider if wider > 0.02 else 0.0)
            scale = np.einsum("nii->ni", information)
            step = np.linalg.solve(
                information + 1e-3 * np.einsum("ni,ij->nij", scale, np.eye(5)), gradient[..., None]
            )[..., 0]
            reach = np.maximum(np.hypot(step[:, 0], step[:, 1]) / first_m, 1.0)
            at -= step[:, :4] / reach[:, None]
        information, _, log_likelihood, bias = self._normal_equations(at, 0.0)
        doubt, e = self.track.doubt, self.errors
        prior = np.square(at[:, 2] / doubt.yaw) + np.square(at[:, 3] / doubt.rate)
        prior = prior + np.square(bias / max(e.bias_sigma_m, 0.01))
        volume = -np.linalg.slogdet(information)[1]
        evidence = log_likelihood - 0.5 * prior + 0.5 * volume
        misfit = -log_likelihood / max(float(self.share.sum()), 1e-9)
        return Fit(at, information, evidence, misfit, bias)

    def _normal_equations(self, at: Array, wider_m: float) -> tuple[Array, Array, Array, Array]:
        """Return information (n, 5, 5), slope (n, 5), log likelihood and bias (n,) at places."""
        ends, vehicle = self.ends_at(at)
        surface = self.grid.surface_at(ends[..., 0], ends[..., 1])
        known = np.isfinite(surface.height)
        error = np.where(known, self.heights - surface.height, 0.0)
        grows = -np.where(known[..., None], surface.slope, 0.0)
        share = np.where(known, self.share, 0.0)
        sigma_sq = self.sigma_sq + wider_m**2
        bias, weight = self._robust_bias(error, sigma_sq, share)
        left = error - bias[:, None, None]
        rows = np.concatenate([grows, np.zeros((*error.shape, 2)), -np.ones((*error.shape, 1))], -1)
        arm = ends - vehicle[:, :1, None]
        rows[..., 2] = grows[..., 0] * arm[..., 1] - grows[..., 1] * arm[..., 0]
        rows[..., 3] = self._drift(grows, ends, vehicle)
        counts = weight * share / sigma_sq
        information = np.einsum("nkb,nkbi,nkbj->nij", counts, rows, rows)
        gradient = np.einsum("nkb,nkbi->ni", counts * left, rows)
        doubt = self.track.doubt
        own = [1e-8, 1e-8, doubt.yaw**-2, doubt.rate**-2, max(self.errors.bias_sigma_m, 0.01) ** -2]
        information += np.diag(own)
        gradient += np.column_stack([np.zeros((len(at), 2)), at[:, 2:], np.zeros(len(at))]) * own
        gradient[:, 4] += own[4] * bias
        t = np.where(known, np.square(left) / self.sigma_sq, OFF_MAP)
        likelihood = (self.share * KERNEL.similarity(t)).sum(axis=(1, 2))
        return information, gradient, likelihood, bias

    def _drift(self, grows: Array, ends: Array, vehicle: Array) -> Array:
        """Return the derivative (n, K, B) of errors with respect to the drift of the heading."""
        since = self.track.time_s - self.track.time_s[0]
        steps = np.diff(vehicle, axis=1)
        middle = 0.5 * (since[1:] + since[:-1])
        arms = np.zeros_like(vehicle)
        arms[:, 1:] = np.cumsum(steps * middle[:, None], axis=1)
        arm = arms[:, :, None] + since[:, None, None] * (ends - vehicle[:, :, None])
        return np.asarray(grows[..., 0] * arm[..., 1] - grows[..., 1] * arm[..., 0])


def search(
    grid: SeabedGrid,
    errors: MapErrors,
    track: Track,
    *,
    middle: Array,
    radius_m: float,
    slope: float,
    own: Array,
) -> tuple[list[Hypothesis], Fit]:
    """Return the places that a dive allows, best first, and their fits in the same order.

    Parameters
    ----------
    middle, radius_m : of the circle in which the dive began, (2,) m and m.
    slope : typical of the map, m/m.
    own : (n, 4) places that are tried as well, those of the particles.
    """
    whole = Stiff.of(grid, errors, track, _FINE_PINGS)
    since = track.time_s - track.time_s[0]
    first = Stiff.of(grid, errors, track.rows(since <= _COARSE_S), _COARSE_PINGS)
    at = _everywhere(first, middle, radius_m)
    value = first.coarse(at, slope * _COARSE_M)
    rows = apart_from_each_other(value, _same_begin(at), _KEPT)
    begun = first.fitted(at[rows], first_m=_FIRST_M, slope=slope).at
    fit = whole.fitted(np.concatenate([begun, own]), first_m=_FIRST_M, slope=slope)
    inside = np.hypot(*(fit.at[:, :2] - middle).T) <= radius_m + 5.0 * SAME_M
    evidence = np.where(inside, fit.log_evidence, -np.inf)
    if not inside.any():
        evidence = fit.log_evidence
    _, vehicle = whole.ends_at(fit.at)

    def is_same(best: int, others: NDArray[np.intp]) -> NDArray[np.bool_]:
        gap = np.hypot(*np.moveaxis(vehicle[others] - vehicle[best], -1, 0))
        return np.asarray((gap[:, 0] < SAME_M) & (gap[:, -1] < SAME_M))

    kept = [
        row for row in apart_from_each_other(evidence, is_same, _KEPT) if np.isfinite(evidence[row])
    ]
    every = told(fit.at, evidence, fit.misfit, kept)
    return [every[row] for row in kept], Fit(*(column[kept] for column in fit))


def _everywhere(stretch: Stiff, middle: Array, radius_m: float) -> Array:
    """Return places (n, 4) over a circle, with all turns and drifts that make a difference."""
    step = max(_COARSE_M, radius_m / 60.0)
    side = np.arange(-radius_m, radius_m + 0.5 * step, step)
    x, y = (part.ravel() for part in np.meshgrid(side, side))
    inside = np.hypot(x, y) <= radius_m + 0.5 * step
    track, doubt = stretch.track, stretch.track.doubt
    reach = max(float(np.hypot(*(track.x_y - track.x_y[0]).T).max()), 30.0)
    span_s = max(float(track.time_s[-1] - track.time_s[0]), 1.0)
    if np.isfinite(doubt.yaw):
        yaws = _trials(doubt.yaw, 2.0 * step / reach)
    else:
        n = int(np.clip(np.ceil(np.pi * reach / step), 24, 120))
        yaws = 2.0 * np.pi * np.arange(n) / n
    rates = _trials(doubt.rate, 4.0 * step / reach / span_s)
    parts = np.meshgrid(np.arange(inside.sum()), yaws, rates, indexing="ij")
    row = parts[0].ravel().astype(int)
    place = np.column_stack([x[inside], y[inside]])[row] + middle
    return np.column_stack([place, parts[1].ravel(), parts[2].ravel()])


def _trials(sigma: float, step: float) -> Array:
    """Return values about zero, so far apart, as far as they may be; at most 9 of them."""
    n = min(int(np.ceil(_WIDEST * sigma / step - 0.5)), 4)
    return np.zeros(1) if n <= 0 else np.linspace(-_WIDEST * sigma, _WIDEST * sigma, 2 * n + 1)


def _same_begin(at: Array):  # type: ignore[no-untyped-def]
    def is_same(best: int, rows: NDArray[np.intp]) -> NDArray[np.bool_]:
        gap = np.hypot(*(at[rows, :2] - at[best, :2]).T)
        return np.asarray(gap < 1.6 * _COARSE_M)

    return is_same
