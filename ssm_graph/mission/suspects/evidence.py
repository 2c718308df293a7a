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

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular

from ssm_graph.base.earth import LocalFrame
from ssm_graph.base.frozen import Array
from ssm_graph.base.times import Indices, is_inside
from ssm_graph.mission.mission import Mission
from ssm_graph.mission.suspects.motion import STEP_S, Inertial, Velocities
from ssm_graph.sensors.compass import HeadingLog
from ssm_graph.sensors.imu import ImuNoise

DOF: Final = 4.0
"""Of the Student distribution that residuals are judged by."""
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
GRAVITY: Final = 9.81
"""m/s^2"""
SLOPE: Final = 0.002
"""rad, to which the level axes are known."""
PROLONGED: Final = 60
"""Steps of the grid at either end that say how the vehicle came and went on."""
FARTHEST_S: Final = 60.0
TINY: Final = 1e-12
MEDIAN_SQUARE: Final = 0.455
"""Of a standard Gaussian."""
NEUTRAL: Final = 0.926
"""A residual whose loss is that of a standard Gaussian one in the mean."""
Mask = NDArray[np.bool_]
SILENCE_S: Final = 3.0
"""Longer gaps between pings are bridged by the accelerometers alone."""


@dataclass(frozen=True)
class Delay:
    """How late the stamps of an instrument are; what differs from a switch on was set there."""

    before_s: float = 0.0
    after_s: float = 0.0
    switch_s: float = -np.inf

    def at(self, time_s: Array) -> Array:
        """Return the delay at stamps (n,)."""
        return np.where(time_s < self.switch_s, self.before_s, self.after_s)

    def later(self, by_s: float) -> Delay:
        """Return a delay that is longer throughout."""
        return Delay(self.before_s + by_s, self.after_s + by_s, self.switch_s)


ON_TIME: Final = Delay()


@dataclass(frozen=True)
class Hypothesis:
    """What is wrong with the logs; by default nothing."""

    gyro: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """Readings about x, y, z are to be multiplied by these."""
    velocity: tuple[float, ...] = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
    """(9,) matrix, row by row, that leads the velocities of the DVL to the true ones, body axes."""
    dvl: Delay = ON_TIME
    gnss: Delay = ON_TIME
    depth: Delay = ON_TIME
    compass: Delay = ON_TIME
    depth_scale: float = 1.0
    """Depths are to be multiplied by this."""
    is_swapped: bool = False
    """Whether longitudes and latitudes of the fixes have changed places."""
    jump_s: float = -np.inf
    """Before this, fixes are off by a constant."""


NOTHING: Final = Hypothesis()


class Part(Protocol):
    """One comparison of instruments."""

    name: str
    group: Indices
    """(n,) the block, from 0, that each residual belongs to; blocks err independently."""
    begin_s: Array
    """(g,) when the blocks begin"""

    def depends_on(self, of: Hypothesis) -> tuple[object, ...]:
        """Return what of a hypothesis the residuals depend on."""

    def residual(self, logs: Logs, of: Hypothesis) -> Array:
        """Return the whitened residuals (n,)."""


class Logs:
    """A mission as its parts need it, with the inertial data summed up once for each scale."""

    def __init__(self, mission: Mission) -> None:
        """Take the logs of a mission."""
        self.mission = mission
        self.velocities = Velocities.of(mission.dvl)
        self._inertial: dict[tuple[float, float, float], Inertial] = {}
        self._tracks: dict[tuple[object, ...], _Track] = {}

    def inertial(self, of: Hypothesis) -> Inertial:
        """Return the inertial data with the gyros of a hypothesis."""
        if of.gyro not in self._inertial:
            self._inertial[of.gyro] = Inertial.of(self.mission.imu, np.array(of.gyro))
        return self._inertial[of.gyro]

    def pings(self, of: Hypothesis) -> Velocities:
        """Return the velocities of a hypothesis."""
        stamps = self.velocities.time_s
        scaled = self.velocities.scaled(np.reshape(of.velocity, (3, 3)))
        return scaled.at_times(stamps - of.dvl.at(stamps))

    def track(self, of: Hypothesis) -> _Track:
        """Return the track of a hypothesis."""
        key = (of.gyro, of.velocity, of.dvl)
        if key not in self._tracks:
            self._tracks[key] = _Track.of(self, of)
        return self._tracks[key]

    @cached_property
    def parts(self) -> list[Part]:
        """What there is to compare."""
        made = (kind.of(self) for kind in (VelocityPart, FixPart, DepthPart, CompassPart))
        return [part for part in made if part is not None]


def whitener(covariance: Array) -> Array:
    """Return the matrix that whitens errors of a covariance (n, n)."""
    n = len(covariance)
    return np.asarray(solve_triangular(np.linalg.cholesky(covariance), np.eye(n), lower=True))


def track_covariance(time_s: Array, pings: Velocities, noise: ImuNoise, walk: float) -> Array:
    """Return the covariance (n, n) of a track that walks, most of all where pings are missing."""
    gap_s = np.diff(pings.time_s)
    force = noise.accel_bias_sigma + SLOPE * GRAVITY
    lost = np.where(gap_s > SILENCE_S, (force * gap_s**3 / 12.0) ** 2, 0.0)
    total = walk * pings.time_s + np.concatenate([[0.0], np.cumsum(lost)])
    variance = np.interp(time_s, pings.time_s, total - total[0])
    return np.minimum.outer(variance, variance)


def walk_covariance(time_s: Array) -> Array:
    """Return the covariance (n, n) of a random walk of unit density, from the first time on."""
    t = time_s - time_s[0]
    return np.minimum.outer(t, t)


def twice_walk_covariance(time_s: Array) -> Array:
    """Return the covariance (n, n) of the integral of a random walk of unit density."""
    t = time_s - time_s[0]
    low, high = np.minimum.outer(t, t), np.maximum.outer(t, t)
    return np.asarray(low**2 * (3.0 * high - low) / 6.0)


def robust_residual(y: Array, X: Array, known: Mask, *, rounds: int = 3) -> tuple[Array, Array]:
    """Return residuals (n,) and coefficients (c,) of a regression with a Student loss.

    Rows that are not ``known`` (n,), before or after all logs, say nothing for or against.
    """
    weight = known.astype(float)
    for _ in range(rounds):
        root = np.sqrt(weight)
        coefficients = np.linalg.lstsq(X * root[:, None], y * root, rcond=1e-10)[0]
        residual = y - X @ coefficients
        usual = np.median(np.abs(residual[known]) ** 2) if known.any() else 1.0
        scale_sq = max(float(usual) / MEDIAN_SQUARE, TINY)
        weight = known * (DOF + 1.0) / (DOF + np.abs(residual) ** 2 / scale_sq)
    return np.where(known, residual, NEUTRAL), coefficients


@dataclass(frozen=True)
class _Window:
    rows: slice
    axes: Array
    """(3, 3) the axes that do not turn to two level ones and up"""
    whiten: tuple[Array, Array, Array]
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
        ranges = [(a, b) for a, b in zip(cuts[:-1], cuts[1:], strict=True) if b - a >= FEWEST]
        ranges = ranges[:: 1 + len(ranges) // MOST_WINDOWS]
        if not ranges:
            return None
        slices = [slice(a, b, 1 + (b - a) // MOST_READINGS) for a, b in ranges]
        windows = [_Window.of(rows, logs) for rows in slices]
        sizes = [3 * len(window.whiten[0]) for window in windows]
        begin_s = np.array([pings.time_s[window.rows.start] for window in windows])
        return cls(tuple(windows), np.repeat(np.arange(len(sizes)), sizes), begin_s)

    def _whitened(self, error_i: Array) -> Array:
        """Return errors (P, 3, ...) in axes that do not turn, level and whitened, (n, ...)."""
        found = []
        for window in self.windows:
            error = np.einsum("aj,nj...->an...", window.axes, error_i[window.rows])
            found += [np.tensordot(W, e, 1) for W, e in zip(window.whiten, error, strict=True)]
        return np.concatenate(found)

    def depends_on(self, of: Hypothesis) -> tuple[object, ...]:
        """Return what of a hypothesis the residuals depend on."""
        return (of.gyro, of.velocity, of.dvl)

    def residual(self, logs: Logs, of: Hypothesis) -> Array:
        """Return the whitened residuals (n,)."""
        inertial, pings = logs.inertial(of), logs.pings(of)
        error = pings.in_i(inertial) - inertial.at(inertial.gained_i, pings.time_s)
        return self._whitened(error)

    def columns(self, logs: Logs, of: Hypothesis) -> Array:
        """Return how the residuals (n, 9) follow the matrix of the velocities, row by row."""
        inertial, pings = logs.inertial(of), logs.pings(of)
        R_ib = inertial.at(inertial.R_ib, pings.time_s)
        columns = np.einsum("nij,nk->nijk", R_ib, pings.v_b).reshape(len(pings), 3, 9)
        return self._whitened(columns)


def _of_biases(time_s: Array, v_i: Array, logs: Logs) -> Array:
    """Return what biases of one sigma, fixed to the body, add to an error (n, 3, 6), m/s."""
    inertial, noise = logs.inertial(NOTHING), logs.mission.imu.noise
    grid = slice(*np.searchsorted(inertial.time_s, [time_s[0] - 0.1, time_s[-1] + 0.1]))
    t = inertial.time_s[grid]
    turned = _integral(t, inertial.R_ib[grid])
    force = np.gradient(inertial.gained_i[grid], t, axis=0)
    lost = _integral(t, np.cross(turned, force[:, :, None], axis=1))
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


def _integral(time_s: Array, rate: Array) -> Array:
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
class _Track:
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
    def of(cls, logs: Logs, of: Hypothesis) -> _Track:
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
        return cls(*(_prolonged(x) for x in (t, *(_integral(t, rate) for rate in rates))))

    def at(self, quantity: Array, time_s: Array) -> Array:
        return np.interp(time_s, self.time_s, quantity)

    def covers(self, time_s: Array) -> Mask:
        return is_inside(time_s, float(self.time_s[1]), float(self.time_s[-2]))


def _arm(logs: Logs, of: Hypothesis, lever_arm_b: Array, time_s: Array) -> tuple[Array, Array]:
    """Return a lever arm in the level axes, complex (n,), and its part upwards (n,), m."""
    inertial = logs.inertial(of)
    arm_i = inertial.at(inertial.R_ib, time_s) @ lever_arm_b
    first, second, up = (inertial.at(x, time_s) for x in (*inertial.level_i, inertial.up_i))
    level = np.sum(arm_i * first, axis=1) + 1j * np.sum(arm_i * second, axis=1)
    return level, np.sum(arm_i * up, axis=1)


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
        pings = logs.velocities
        speed_sq = float(np.mean(np.sum(pings.v_b**2, axis=1)))
        walk = pings.sigma[0] ** 2 * float(np.median(np.diff(pings.time_s))) + WALK**2 * speed_sq
        drift = gnss.calibration.drift
        white = sigma * (drift.white_share if drift.sigma else 1.0)
        if drift.sigma:
            walk += 2.0 * drift.sigma**2 / drift.correlation_s
        covariance = np.diag(white**2)
        covariance += track_covariance(time_s[used], pings, logs.mission.imu.noise, walk)
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
        arm = _arm(logs, of, logs.mission.gnss.lever_arm_b, at_s)[0]
        way = track.at(track.way, at_s) + arm
        y = self.whiten @ (self.swapped if of.is_swapped else self.fix)
        columns = [way, np.ones_like(way), track.at(track.drift, at_s)]
        if of.jump_s > self.time_s[0]:
            columns.append(self.time_s < of.jump_s)
        X = self.whiten @ np.stack(columns, axis=1)
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
        speed_sq = float(np.mean(np.sum(pings.v_b**2, axis=1)))
        walk = (
            pings.sigma[2] ** 2 * float(np.median(np.diff(pings.time_s)))
            + (WALK / 3.0) ** 2 * speed_sq
        )
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
        up = track.at(track.up, at_s) + _arm(logs, of, logs.mission.depth.lever_arm_b, at_s)[1]
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
