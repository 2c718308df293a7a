"""How well a mission's logs agree, two instruments at a time, under a hypothesis about one of them.

Each part is a regression whose residuals are white if the logs agree:

``velocity``
    Pings against accelerometers and gyros. In axes that do not turn ``R v - int R f dt`` is a
    straight line, by gravity, and a parabola, by a gyro bias, in every window of half a minute.
``fixes``
    Position fixes against the track of pings and gyros, as complex numbers: an origin, a heading
    and a scale near one, and their drift.
``depth``
    Depths against the vertical of the pings: an origin and a tilt of the mounting.
``compass``
    Readings against the turn of the gyros: an offset, a drift and the deviation.

What the noise adds up to, white noise of a reading and the walk of what is integrated, whitens the
residuals; their loss is that of a Student distribution, so that a bad reading says no more than
that it is bad.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Final, Protocol

import numpy as np

from ssm_graph.base.earth import LocalFrame
from ssm_graph.base.frozen import Array
from ssm_graph.base.times import Indices, is_inside
from ssm_graph.mission.suspects.hypothesis import NOTHING, Hypothesis
from ssm_graph.mission.suspects.motion import Velocities
from ssm_graph.mission.suspects.regression import (
    NEUTRAL,
    TINY,
    robust_residual,
    twice_walk_covariance,
    walk_covariance,
    whitened,
    whitener,
)
from ssm_graph.mission.suspects.track import (
    GRAVITY,
    Logs,
    arm_of,
    integral,
    track_covariance,
)
from ssm_graph.sensors.compass import HeadingLog

WINDOW_S: Final = 30.0
FEWEST: Final = 12
"""Readings of a window or a part."""
MOST_WINDOWS: Final = 60
MOST_READINGS: Final = 400
"""Of a part; of more, every n-th counts."""
LARGEST_SCALE: Final = 0.07
"""The DVL's speeds may be off by so much of what the fixes say before it is a question of units."""
WALK: Final = 0.01
"""Of the speed, 1/sqrt(s): what a track of pings walks beside the noise of the beams."""


class Part(Protocol):
    """One comparison of instruments."""

    @property
    def name(self) -> str:
        """What people call it."""

    @property
    def group(self) -> Indices:
        """(n,) the block, from 0, that each residual belongs to; blocks err independently."""

    @property
    def begin_s(self) -> Array:
        """(g,) when the blocks begin, s."""

    def depends_on(self, of: Hypothesis) -> tuple[object, ...]:
        """Return what of a hypothesis the residuals depend on."""

    def residual(self, logs: Logs, of: Hypothesis) -> Array:
        """Return the whitened residuals (n,)."""


@dataclass(frozen=True)
class _Window:
    rows: slice
    axes: Array
    """(3, 3) the axes that do not turn to two level ones and up"""
    whiten: tuple[Array, ...]
    """(n, n) whitens errors of each of these, less what a parabola takes up"""

    @classmethod
    def of(cls, rows: slice, logs: Logs) -> _Window:
        pings, noise, inertial = logs.velocities, logs.mission.imu.noise, logs.inertial(NOTHING)
        time_s, sigma = pings.time_s[rows], pings.sigma
        up = inertial.at(inertial.up_i, time_s.mean()[None])[0]
        first = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
        first /= np.linalg.norm(first)
        axes = np.stack([first, np.cross(up, first), up])
        v = pings.in_i(inertial)[rows] @ axes.T
        biases = np.einsum(
            "ai,nij->anj", axes, _of_biases(time_s, pings.in_i(inertial)[rows], logs)
        )
        speed_sq = float(np.mean(np.sum(v**2, axis=1)))
        walk, tilt = walk_covariance(time_s), twice_walk_covariance(time_s)
        white = np.eye(len(time_s))
        level = sigma[0] * sigma[1] * white + (GRAVITY * noise.gyro_density) ** 2 * tilt
        level += (noise.accel_density**2 + speed_sq * noise.gyro_density**2) * walk
        vertical = sigma[2] ** 2 * white + noise.accel_density**2 * walk
        covariances = (C + D @ D.T for C, D in zip((level, level, vertical), biases, strict=True))
        whiten = tuple(_without_parabola(time_s, c) for c in covariances)
        return cls(rows, axes, whiten)


@dataclass(frozen=True)
class VelocityPart:
    """Pings against accelerometers and gyros."""

    windows: tuple[_Window, ...]
    group: Indices
    begin_s: Array
    name: str = "accelerometers"

    @classmethod
    def of(cls, logs: Logs) -> VelocityPart | None:
        """Cut the pings into windows."""
        pings = logs.velocities
        if len(pings) < FEWEST:
            return None
        edges = np.arange(pings.time_s[0], pings.time_s[-1] + WINDOW_S, WINDOW_S)
        cuts = np.searchsorted(pings.time_s, edges)
        inertial_s = logs.inertial(NOTHING).time_s
        n_inertial = np.diff(np.searchsorted(inertial_s, edges))
        ranges = [
            (a, b)
            for (a, b), n in zip(pairwise(cuts.tolist()), n_inertial, strict=True)
            if min(b - a, n) >= FEWEST
        ]
        ranges = ranges[:: 1 + len(ranges) // MOST_WINDOWS]
        if not ranges:
            return None
        slices = [slice(a, b, 1 + (b - a) // MOST_READINGS) for a, b in ranges]
        windows = [_Window.of(rows, logs) for rows in slices]
        sizes = [3 * len(window.whiten[0]) for window in windows]
        begin_s = np.array([pings.time_s[window.rows.start] for window in windows])
        return cls(tuple(windows), np.repeat(np.arange(len(sizes)), sizes), begin_s)

    def _whitened(self, error_i: Array) -> Array:
        """Return errors (P, 3) in axes that do not turn, level and whitened (n,)."""
        found = []
        for window in self.windows:
            error = window.axes @ error_i[window.rows].T
            found += [W @ e for W, e in zip(window.whiten, error, strict=True)]
        return np.concatenate(found)

    def depends_on(self, of: Hypothesis) -> tuple[object, ...]:
        """Return what of a hypothesis the residuals depend on."""
        return (of.gyro, of.velocity, of.dvl)

    def residual(self, logs: Logs, of: Hypothesis) -> Array:
        """Return the whitened residuals (n,)."""
        inertial, pings = logs.inertial(of), logs.pings(of)
        error = pings.in_i(inertial) - inertial.at(inertial.gained_i, pings.time_s)
        return self._whitened(error)


def _of_biases(time_s: Array, v_i: Array, logs: Logs) -> Array:
    """Return what biases of one sigma, fixed to the body, add to an error (n, 3, 6), m/s."""
    inertial, noise = logs.inertial(NOTHING), logs.mission.imu.noise
    grid = slice(*np.searchsorted(inertial.time_s, [time_s[0] - 0.1, time_s[-1] + 0.1]))
    t = inertial.time_s[grid]
    turned = integral(t, inertial.R_ib[grid])
    force = np.gradient(inertial.gained_i[grid], t, axis=0)
    lost = integral(t, np.cross(turned, force[:, :, None], axis=1))
    at = np.clip(np.searchsorted(t, time_s), 0, len(t) - 1)
    of_gyro = np.cross(turned[at], v_i[:, :, None], axis=1) - lost[at]
    return np.concatenate(
        [noise.gyro_bias_sigma * of_gyro, noise.accel_bias_sigma * turned[at]], axis=2
    )


def _without_parabola(time_s: Array, covariance: Array) -> Array:
    W = whitener(covariance)
    s = (time_s - time_s.mean()) / WINDOW_S
    Q = np.linalg.qr(W @ np.stack([np.ones_like(s), s, s**2], axis=1))[0]
    return np.asarray(W - Q @ (Q.T @ W))


def _chosen(time_s: Array, logs: Logs) -> Indices:
    """Return which readings lie within the pings, thinned out."""
    pings = logs.velocities.time_s
    if len(pings) < FEWEST:
        return np.zeros(0, np.intp)
    inside = np.flatnonzero((time_s >= pings[0]) & (time_s <= pings[-1]))
    return inside[:: 1 + len(inside) // MOST_READINGS]


def _blocks(time_s: Array, components: int = 1) -> tuple[Indices, Array]:
    """Return the blocks of residuals in order of time, and when each begins."""
    block = np.arange(len(time_s)) // max(FEWEST, -(-len(time_s) // 24))
    begins = np.unique(block, return_index=True)[1]
    return np.tile(block, components), time_s[begins]


def _walk(pings: Velocities, axis: int, share: float) -> float:
    """Return what a track of pings walks along a body axis, m^2/s; ``share`` of its speed."""
    speed_sq = float(np.mean(np.sum(pings.v_b**2, axis=1)))
    spacing_s = float(np.median(np.diff(pings.time_s)))
    return float(pings.sigma[axis] ** 2 * spacing_s + share**2 * speed_sq)


@dataclass(frozen=True, eq=False)
class FixPart:
    """Position fixes against the track."""

    time_s: Array
    fix: Array
    """(n,) complex, m"""
    swapped: Array
    """(n,) the same with longitude and latitude in each other's place"""
    whiten: Array
    group: Indices
    begin_s: Array
    name: str = "fixes"

    @classmethod
    def of(cls, logs: Logs) -> FixPart | None:
        """Take the fixes during the pings."""
        gnss, frame = logs.mission.gnss, logs.mission.frame
        if gnss is None:
            return None
        time_s = gnss.valid_s
        used = _chosen(time_s, logs)
        if len(used) < FEWEST:
            return None
        fix = frame.p_n_from_geodetic(gnss.lat, gnss.lon, gnss.height)[used]
        swapped = _swapped(gnss.lat[used], gnss.lon[used])
        sigma = np.sqrt(np.mean(gnss.sigma_enu[used, :2] ** 2, axis=1))
        walk = _walk(logs.velocities, 0, WALK)
        drift = gnss.calibration.drift
        white = sigma * drift.white
        if drift.sigma:
            walk += 2.0 * drift.sigma**2 / drift.correlation_s
        covariance = np.diag(white**2)
        covariance += track_covariance(time_s[used], logs.velocities, logs.mission.imu.noise, walk)
        return cls(
            time_s[used],
            fix[:, 0] + 1j * fix[:, 1],
            swapped,
            whitener(covariance),
            *_blocks(time_s[used], 2),
        )

    def depends_on(self, of: Hypothesis) -> tuple[object, ...]:
        """Return what of a hypothesis the residuals depend on."""
        return (of.gyro, of.velocity, of.dvl, of.gnss, of.is_swapped, of.jump_s)

    def residual(self, logs: Logs, of: Hypothesis) -> Array:
        """Return the whitened residuals (2 n,), east and north."""
        at_s = self.time_s - of.gnss.at(self.time_s)
        track = logs.track(of)
        assert logs.mission.gnss is not None
        arm = arm_of(logs, of, logs.mission.gnss.lever_arm_b, at_s)[0]
        way = track.at(track.way, at_s) + arm
        fix = self.swapped if of.is_swapped else self.fix
        columns = [fix, way, np.ones_like(way), track.at(track.drift, at_s)]
        if of.jump_s > self.time_s[0]:
            columns.append((self.time_s < of.jump_s).astype(complex))
        made = whitened(self.whiten, np.stack(columns, axis=1))
        y, X = made[:, 0], made[:, 1:]
        known = track.covers(at_s)
        residual, c = robust_residual(y, X, known)
        size = max(abs(c[0]), TINY)
        if abs(size - 1.0) > LARGEST_SCALE:
            way = X[:, 0] * c[0] / size * np.clip(size, 1.0 - LARGEST_SCALE, 1.0 + LARGEST_SCALE)
            residual, _ = robust_residual(y - way, X[:, 1:], known)
        imaginary = np.where(known, residual.imag, NEUTRAL)
        return np.concatenate([residual.real, imaginary])


def _swapped(lat: Array, lon: Array) -> Array:
    """Return positions (n,), complex, m, with longitudes taken for latitudes."""
    lat, lon = lon, lat
    frame = LocalFrame(float(lat[0]), float(lon[0]), 0.0)
    p_n = frame.p_n_from_geodetic(lat, lon, np.zeros(len(lat)))
    return np.asarray(p_n[:, 0] + 1j * p_n[:, 1])


@dataclass(frozen=True, eq=False)
class DepthPart:
    """Depths against the vertical of the pings."""

    time_s: Array
    depth: Array
    whiten: Array
    group: Indices
    begin_s: Array
    name: str = "depth"

    @classmethod
    def of(cls, logs: Logs) -> DepthPart | None:
        """Take the depths during the pings."""
        log = logs.mission.depth
        if log is None:
            return None
        used = _chosen(log.time_s, logs)
        if len(used) < FEWEST:
            return None
        time_s, pings = log.time_s[used], logs.velocities
        walk = _walk(pings, 2, WALK / 3.0)
        covariance = np.diag(np.full(len(used), log.sigma**2))
        covariance += track_covariance(time_s, pings, logs.mission.imu.noise, walk)
        return cls(time_s, log.depth[used], whitener(covariance), *_blocks(time_s))

    def depends_on(self, of: Hypothesis) -> tuple[object, ...]:
        """Return what of a hypothesis the residuals depend on."""
        return (of.gyro, of.velocity, of.dvl, of.depth, of.depth_scale)

    def residual(self, logs: Logs, of: Hypothesis) -> Array:
        """Return the whitened residuals (n,)."""
        at_s, track = self.time_s - of.depth.at(self.time_s), logs.track(of)
        assert logs.mission.depth is not None
        up = track.at(track.up, at_s) + arm_of(logs, of, logs.mission.depth.lever_arm_b, at_s)[1]
        ways = [track.at(way, at_s) for way in (track.way, track.along_b)]
        X = np.stack(
            [np.ones_like(up), *(part for way in ways for part in (way.real, way.imag))], axis=1
        )
        y = self.whiten @ (self.depth + up / of.depth_scale)
        return robust_residual(y, self.whiten @ X, track.covers(at_s))[0]


@dataclass(frozen=True, eq=False)
class CompassPart:
    """Readings of a compass against the turn of the gyros."""

    time_s: Array
    heading: Array
    whiten: Array
    group: Indices
    begin_s: Array
    name: str = "compass"

    @classmethod
    def of(cls, logs: Logs) -> CompassPart | None:
        """Take the readings during the inertial data."""
        log = logs.mission.aids.get(HeadingLog)
        if log is None:
            return None
        imu = logs.mission.imu
        inside = np.flatnonzero((log.time_s >= imu.start_s) & (log.time_s <= imu.time_s[-1]))
        used = inside[:: 1 + len(inside) // MOST_READINGS]
        if len(used) < FEWEST:
            return None
        time_s, errors = log.time_s[used], log.errors
        walk = imu.noise.gyro_density**2 + 2.0 * errors.walk_sigma**2 / errors.correlation_s
        covariance = np.diag(np.full(len(used), log.sigma**2)) + walk * walk_covariance(time_s)
        heading = np.unwrap(log.heading)[used]
        return cls(time_s, heading, whitener(covariance), *_blocks(time_s))

    def depends_on(self, of: Hypothesis) -> tuple[object, ...]:
        """Return what of a hypothesis the residuals depend on."""
        return (of.gyro, of.compass)

    def residual(self, logs: Logs, of: Hypothesis) -> Array:
        """Return the whitened residuals (n,)."""
        at_s, inertial = self.time_s - of.compass.at(self.time_s), logs.inertial(of)
        forward = inertial.R_ib[:, :, 0]
        first, second = inertial.level_i
        turned = -np.unwrap(
            np.arctan2(np.sum(forward * second, axis=1), np.sum(forward * first, axis=1))
        )
        turned = np.interp(at_s, inertial.time_s, turned)
        s = (self.time_s - self.time_s.mean()) / np.ptp(self.time_s)
        h = self.heading
        X = np.stack(
            [np.ones_like(s), s, np.sin(h), np.cos(h), np.sin(2 * h), np.cos(2 * h)], axis=1
        )
        known = is_inside(at_s, float(inertial.time_s[0]), float(inertial.time_s[-1]))
        return robust_residual(self.whiten @ (h - turned), self.whiten @ X, known)[0]


def parts_of(logs: Logs) -> tuple[Part, ...]:
    """Return what there is to compare."""
    made: tuple[Part | None, ...] = (
        VelocityPart.of(logs),
        FixPart.of(logs),
        DepthPart.of(logs),
        CompassPart.of(logs),
    )
    return tuple(part for part in made if part is not None)
