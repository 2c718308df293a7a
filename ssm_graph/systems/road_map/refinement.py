"""A window of poses against the map's lines, with a similarity weight for every point of a curve.

The factor graph is small and stiff: K poses, one scale of the speed and one bias of the yaw rate,
joined by the chassis, begun by a prior, and each curve's points tied to the lines nearest to them
(found anew in each round). It is solved as it stands, so that the covariance is that of the whole:
on a straight road it says along the road what the prior says and no more.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from factors.lane_line import curve_covariance, line_residual
from factors.similarity import Kernel, LogKernel, expected_mahalanobis_sq
from ssm_graph.base.errors import SolverError
from ssm_graph.base.frozen import Array, ReadOnlyArrays
from ssm_graph.base.units import DEGREE, wrapped
from ssm_graph.systems.road_map.maps.index import LineIndex
from ssm_graph.systems.road_map.maps.road_map import LineKind, Mark
from ssm_graph.systems.road_map.window import Window, in_plane

_FAR_M: Final = 1.5
"""A point farther from every line of its kind is of none of them."""
_SLANTED: Final = 0.1
"""Sine of the angle between a line and the way that its points go when the window is moved along
the road, below which it says nothing of the place along it: what small kinks would say is the map's
error, the same in every picture. The road is an arc over the window, so that the move is one of a
stiff piece: moves of each picture for itself would differ by the chassis, and so say what no line
says."""
_SAME_WAY: Final = 0.9
"""Cosine to the course beyond which a line runs along the road and not across it."""
_LEAST_ARC_M: Final = 30.0
"""A shorter stretch of lines has no bend that could be told from kinks."""
_HERE_M: Final = 20.0
"""Lines within it tell how the road runs at the last pose: over a whole window at 25 m/s, 200 m,
bends change, and an arc through all of them is up to 15 degrees off there."""
_BEND_M: Final = 0.3
"""By how much, along the road, what a bend says is off in all pictures alike: its line in the map,
and the cubic that is laid along it; measured on seeds below 100."""
_FREE_ROUNDS: Final = 6
"""Afterwards a point that once lay on no line counts no more, and one that once said nothing of the
place along the road says nothing of it: points at the ends of lines would else come and go for
ever, and the window with them. For the same reason steps are halved then."""
_CLOSE_M: Final = 2e-4
_CLOSE_RAD: Final = 1e-4


@dataclass(frozen=True, slots=True, kw_only=True)
class RefinementSettings:
    """Noise of the window; distances in m, angles in rad."""

    rounds: int = 12
    slope_sigma: float = 4e-3
    """Of a detected curve."""
    scatter_m: float = 0.02
    """Of a point of a curve."""
    map_sigma_m: float = 0.04
    """Of the map's line, and of a cubic laid along it: the same error for all pictures that see the
    place, so that a point's share of it grows by how many those are."""
    way_sigma: float = 0.01
    """Relative, of the way between two pictures; the common scale is a state beside it."""
    way_floor_m: float = 0.01
    turn_floor: float = 0.1 * DEGREE
    """Of the turn between two pictures a fifth of a second apart."""
    kernel: Kernel = LogKernel(5.0)
    wrong_mark: float = 0.05
    """Weight of a point on a line that is dashed where the curve is solid, or the reverse."""


@dataclass(frozen=True, slots=True, eq=False)
class Prior(ReadOnlyArrays):
    """What is known of the first pose, the speed's scale and the yaw rate's bias beforehand."""

    mean: Array
    """(5,) x, y [m], yaw [rad], scale beyond 1, bias [rad/s]"""
    information: Array
    """(5, 5)"""


@dataclass(frozen=True, slots=True, eq=False)
class Refined(ReadOnlyArrays):
    """Poses of a window with what is known of them."""

    poses: Array
    """(K, 3) x, y [m], yaw [rad]"""
    scale: float
    bias: float
    """rad/s"""
    covs: Array
    """(K, 3, 3) of each pose in the axes of the plane."""
    weight: Array
    """(C, m) similarity weight of every curve point; 0 where no line is near."""
    feet: Array
    """(C, m, 2) m, where each point lies on the map."""
    has_settled: bool
    ahead: Array
    """(2,) of length 1, along the road at the last pose."""
    bend: float
    """1/m, of the road there, anticlockwise."""
    next_prior: Prior | None = None
    """Of the second pose, the first one being left behind."""

    @property
    def sigmas(self) -> tuple[float, float, float]:
        """Across and along the last pose [m], and its yaw [rad]."""
        across, along = sigmas_of(self.poses[-1], self.covs[-1])
        return self._on_bend(across, along), along, float(np.sqrt(self.covs[-1][2, 2]))

    def _on_bend(self, across_m: float, along_m: float) -> float:
        """Return the sigma across with what a place off along a bend is beside it, m.

        That is ``bend x^2 / 2`` with x off by ``along_m``: its mean square is 3/4 bend^2 along^4.
        """
        return float(np.hypot(across_m, np.sqrt(0.75) * self.bend * along_m**2))

    def beside(self, place: Array) -> Array:
        """Return the last pose (3,) moved along the road until it is beside a place (2+,)."""
        shift = float((place[:2] - self.poses[-1, :2]) @ self.ahead)
        aside = 0.5 * self.bend * shift**2
        moved = shift * self.ahead + aside * np.array([-self.ahead[1], self.ahead[0]])
        return np.asarray(self.poses[-1] + [*moved, self.bend * shift])

    def with_along(self, along_m: float) -> tuple[float, float, float]:
        """Return the same sigmas where the place along the road is known so well by other means."""
        across = np.array([-self.ahead[1], self.ahead[0]])
        variance = float(across @ self.covs[-1][:2, :2] @ across)
        cov = variance * np.outer(across, across) + along_m**2 * np.outer(self.ahead, self.ahead)
        across_m, along_m = sigmas_of(self.poses[-1], cov)
        return self._on_bend(across_m, along_m), along_m, self.sigmas[2]


def sigmas_of(pose: Array, cov: Array) -> tuple[float, float]:
    """Return the standard deviations across and along a pose (3,) from its covariance, m."""
    c, s = np.cos(pose[2]), np.sin(pose[2])
    along, across = np.array([c, s]), np.array([-s, c])
    return (
        float(np.sqrt(across @ cov[:2, :2] @ across)),
        float(np.sqrt(along @ cov[:2, :2] @ along)),
    )


class _Lines:
    """Curve points tied to the map at a set of poses: errors, normals, weights."""

    def __init__(
        self, window: Window, indices: Mapping[LineKind, LineIndex], settings: RefinementSettings
    ) -> None:
        self.window, self.indices, self.settings = window, indices, settings
        s = settings
        self.of: NDArray[np.int64] = window.picture.astype(int)
        self.counted: NDArray[np.bool_] = np.ones(window.points.shape[:2], dtype=bool)
        self.crosses = self.counted
        self.scatter_m = float(np.hypot(s.scatter_m, s.map_sigma_m * np.sqrt(window.overlap)))

    def tie(self, poses: Array, *, is_late: bool = False) -> None:
        """Find the lines nearest to all points; late, none that was left out comes back."""
        shape = self.window.points.shape
        at = poses[self.of][:, None]
        x_y = np.stack(in_plane(at, self.window.points), axis=-1)
        self.feet, self.normals = np.zeros(shape), np.zeros(shape)
        self.normals[..., 1] = 1.0
        self.trust = np.zeros(shape[:2])
        for kind, index in self.indices.items():
            mine = self.window.kind == kind
            if not mine.any():
                continue
            foot = index.foot(x_y[mine])
            self.normals[mine] = index.normal[foot.segment]
            trust = (foot.distance < _FAR_M).astype(float)
            off = np.abs(np.sum(self.normals[mine] * (x_y[mine] - foot.x_y), axis=-1))
            trust[foot.distance > off + 0.05] = 0.0  # beyond the end of a line
            if kind is LineKind.LANE_LINE:
                seen, there = self.window.mark[mine][:, None], index.mark[foot.segment]
                wrong = (seen != Mark.UNKNOWN) & (there != Mark.UNKNOWN) & (seen != there)
                trust = np.where(wrong, trust * self.settings.wrong_mark, trust)
            self.trust[mine] = trust
            self.feet[mine] = np.where(trust[..., None] > 0.0, foot.x_y, x_y[mine])
        if is_late:
            self.trust = np.where(self.counted, self.trust, 0.0)
        self.ahead, self.bend = self.road(poses)
        slant = np.abs(np.sum(self.normals * self._moved_along(self.feet, poses[-1, :2]), axis=-1))
        crosses = slant > _SLANTED
        self.crosses = crosses & self.crosses if is_late else crosses
        self.counted = self.trust > 0.0

    def road(self, poses: Array, reach_m: float = np.inf) -> tuple[Array, float]:
        """Return the road's direction (2,) at the last pose and its bend, 1/m, anticlockwise.

        A straight line is laid through the directions of the lines over the way, or of those within
        a reach of the last pose; without lines the road runs along the course.
        """
        way = np.hypot(*np.diff(poses[:, :2], axis=0).T)
        s = np.concatenate([[0.0], np.cumsum(way)]) - way.sum()
        turn = wrapped(poses[:, 2] - poses[-1, 2])
        c, sn = np.cos(poses[self.of, 2])[:, None], np.sin(poses[self.of, 2])[:, None]
        forward = self.normals[..., 1] * c - self.normals[..., 0] * sn
        left = -self.normals[..., 0] * c - self.normals[..., 1] * sn
        use = (self.trust > 0.0) & (np.abs(forward) > _SAME_WAY)
        angle = (np.arctan(left / np.where(use, forward, 1.0)) + turn[self.of][:, None])[use]
        at = (s[self.of][:, None] + self.window.points[..., 0])[use]
        angle, at = angle[np.abs(at) < reach_m], at[np.abs(at) < reach_m]
        bend, beside = 0.0, 0.0
        if len(at):
            middle, mean = at.mean(), angle.mean()
            if np.ptp(at) > _LEAST_ARC_M:
                bend = float((at - middle) @ (angle - mean) / np.square(at - middle).sum())
            beside = float(mean - bend * middle)
        if abs(beside) > np.arccos(_SAME_WAY):  # no line runs so here: they are of a junction
            bend, beside = 0.0, 0.0
        yaw = poses[-1, 2] + beside
        return np.array([np.cos(yaw), np.sin(yaw)]), bend

    def _moved_along(self, x_y: Array, last: Array) -> Array:
        """Return how points (..., 2) go when all is moved along the road by 1 m."""
        off = x_y - last
        return self.ahead + self.bend * np.stack([-off[..., 1], off[..., 0]], axis=-1)

    def rows(self, poses: Array, covs: Array | None) -> tuple[Array, Array, Array, Array]:
        """Return whitened errors (C, m), blocks (C, m, 3) in plane axes, and weights (C, m).

        Last come the blocks without what is left out of the first ones: how the errors change.
        """
        w, s = self.window, self.settings
        pose = poses[self.of]
        found = line_residual(
            pose[:, None, :2],
            pose[:, None, 2],
            point_b=w.points,
            foot=self.feet,
            normal=self.normals,
        )
        last = poses[-1, :2]
        slant = np.sum(self.normals * self._moved_along(self.feet, last), axis=-1)
        own = self._moved_along(pose[:, :2], last)
        own /= np.maximum(np.square(own).sum(axis=-1, keepdims=True), 0.1)
        slant = np.where(self.crosses, 0.0, slant)
        said = self.normals - slant[..., None] * own[:, None]
        block = np.concatenate([said, found.error_D_pose[..., 2:]], axis=-1)
        whole = np.concatenate([self.normals, found.error_D_pose[..., 2:]], axis=-1)
        is_on = (self.trust > 0.0)[..., None]  # a point on no line says nothing
        block, whole = block * is_on, whole * is_on
        x = w.points[..., 0]
        variance = w.sigma_m[:, None] ** 2 + (s.slope_sigma * x) ** 2 + self.scatter_m**2
        spread = np.zeros(x.shape)
        if covs is not None:
            spread = np.einsum("cmi,cij,cmj->cm", block, covs[self.of], block)
        t = expected_mahalanobis_sq(found.error, spread, sigma=np.sqrt(variance))
        weight = s.kernel.weight(t) * self.trust
        cov = curve_covariance(
            x,
            np.maximum(weight, 1e-6),
            offset=w.sigma_m,
            slope=s.slope_sigma,
            scatter=self.scatter_m,
        )
        root = np.linalg.cholesky(cov)
        error = np.where(self.trust > 0.0, found.error, 0.0)
        both = np.linalg.solve(root, np.concatenate([error[..., None], block, whole], axis=-1))
        return both[..., 0], both[..., 1:4], weight, both[..., 4:]


def refine(
    window: Window,
    first: Array,
    prior: Prior,
    indices: Mapping[LineKind, LineIndex],
    settings: RefinementSettings | None = None,
) -> Refined:
    """Return the poses of a window from first guesses (K, 3), with honest covariance.

    Raises :class:`SolverError` where they run away.
    """
    s = settings or RefinementSettings()
    lines = _Lines(window, indices, s)
    poses, extra = np.array(first), np.array(prior.mean[3:])
    covs, has_settled = None, False
    for number in range(s.rounds):
        is_late = number >= _FREE_ROUNDS
        lines.tie(poses, is_late=is_late)
        hessian, slope, weight, change = _system(window, lines, poses, extra, prior, s, covs)
        cov = np.linalg.inv(hessian)
        step = -(0.5 if is_late else 1.0) * np.linalg.solve(change, slope)
        moved = step[:-2].reshape(-1, 3)
        if not np.all(np.isfinite(step)) or np.abs(moved[:, :2]).max() > 100.0:
            raise SolverError(
                "refinement: the window ran away from the map; is it begun in the right lane?"
            )
        poses, extra = poses + moved, extra + step[-2:]
        covs = np.stack([cov[i : i + 3, i : i + 3] for i in range(0, 3 * len(poses), 3)])
        shift, turn = np.abs(moved[:, :2]).max(), np.abs(moved[:, 2]).max()
        if shift < _CLOSE_M + 0.03 * np.sqrt(covs[-1, :2, :2].trace()) and turn < _CLOSE_RAD:
            has_settled = True
            break
    back = np.linalg.inv(change)
    cov = back @ hessian @ back.T  # the errors change by more than what is held to be said
    covs = np.stack([cov[i : i + 3, i : i + 3] for i in range(0, 3 * len(poses), 3)])
    ahead, bend = lines.road(poses, _HERE_M)
    return Refined(
        poses,
        float(extra[0]),
        float(extra[1]),
        _with_bends(covs, ahead) if covs is not None else np.zeros((len(poses), 3, 3)),
        weight,
        lines.feet,
        has_settled,
        ahead,
        bend,
        _leave_first(window, lines, poses, extra, prior, s, covs),
    )


def _with_bends(covs: Array, ahead: Array) -> Array:
    """Return covariances (K, 3, 3) with what bends are off by along the road."""
    found = covs.copy()
    found[:, :2, :2] += _BEND_M**2 * np.outer(ahead, ahead)
    return found


def _system(
    window: Window,
    lines: _Lines,
    poses: Array,
    extra: Array,
    prior: Prior,
    s: RefinementSettings,
    covs: Array | None,
) -> tuple[Array, Array, Array, Array]:
    """Return the normal equations of all poses, scale and bias, and the weights of the points.

    Last comes how the slope changes with the poses.
    """
    n = len(poses)
    size = 3 * n + 2
    hessian, slope = np.zeros((size, size)), np.zeros(size)
    head = np.array([0, 1, 2, size - 2, size - 1])
    off = np.concatenate([poses[0], extra]) - prior.mean
    off[2] = wrapped(off[2])
    hessian[np.ix_(head, head)] += prior.information
    slope[head] += prior.information @ off
    moved, blocks = _motion(window, poses, extra, s)
    at = np.empty((n - 1, 8), dtype=int)
    at[:, :6], at[:, 6:] = 3 * np.arange(n - 1)[:, None] + np.arange(6), [size - 2, size - 1]
    steps = np.einsum("kia,kib->kab", blocks, blocks)
    np.add.at(hessian, (at[:, :, None], at[:, None]), steps)
    np.add.at(slope, at, np.einsum("kia,ki->ka", blocks, moved))
    change = hessian.copy()
    error, block, weight, whole = lines.rows(poses, covs)
    own, felt, pull = np.zeros((n, 3, 3)), np.zeros((n, 3, 3)), np.zeros((n, 3))
    np.add.at(own, lines.of, np.einsum("cmi,cmj->cij", block, block))
    np.add.at(felt, lines.of, np.einsum("cmi,cmj->cij", block, whole))
    np.add.at(pull, lines.of, np.einsum("cmi,cm->ci", block, error))
    at = 3 * np.arange(n)[:, None] + np.arange(3)
    hessian[at[:, :, None], at[:, None]] += own
    change[at[:, :, None], at[:, None]] += felt
    slope[: 3 * n] += pull.ravel()
    return hessian, slope, weight, change


def _motion(
    window: Window, poses: Array, extra: Array, s: RefinementSettings
) -> tuple[Array, Array]:
    """Return whitened errors (K-1, 3) of the steps between pictures, and their blocks (.., 3, 8).

    In the axes of the earlier picture, with the way d and turn a of the chassis over dt::

        R' (t2 - t1) - (1 + scale) d,    yaw2 - yaw1 - (a - bias dt)
    """
    m = window.motion
    dt = np.diff(window.time_s)
    c0, s0 = np.cos(m[:-1, 2]), np.sin(m[:-1, 2])
    d = np.diff(m, axis=0)
    way = np.column_stack([c0 * d[:, 0] + s0 * d[:, 1], c0 * d[:, 1] - s0 * d[:, 0]])
    c, sn = np.cos(poses[:-1, 2]), np.sin(poses[:-1, 2])
    g = np.diff(poses, axis=0)
    forward, left = c * g[:, 0] + sn * g[:, 1], c * g[:, 1] - sn * g[:, 0]
    error = np.column_stack(
        [
            forward - (1.0 + extra[0]) * way[:, 0],
            left - (1.0 + extra[0]) * way[:, 1],
            wrapped(g[:, 2] - d[:, 2] + extra[1] * dt),
        ]
    )
    block = np.zeros((len(dt), 3, 8))
    block[:, 0, 3], block[:, 0, 4], block[:, 0, 2] = c, sn, left
    block[:, 1, 3], block[:, 1, 4], block[:, 1, 2] = -sn, c, -forward
    block[:, :2, :2] = -block[:, :2, 3:5]
    block[:, 2, 2], block[:, 2, 5] = -1.0, 1.0
    block[:, :2, 6] = -way
    block[:, 2, 7] = dt
    length = np.hypot(*way.T)
    turn = s.turn_floor * np.sqrt(dt / 0.2)
    sigma_way = s.way_sigma * length + s.way_floor_m
    sigma = np.column_stack([sigma_way, 0.5 * length * turn + 0.5 * s.way_floor_m, turn])
    return error / sigma, block / sigma[..., None]


def _leave_first(
    window: Window,
    lines: _Lines,
    poses: Array,
    extra: Array,
    prior: Prior,
    s: RefinementSettings,
    covs: Array | None,
) -> Prior | None:
    """Return the prior of the second pose once the first one is eliminated, with all it saw."""
    if len(poses) < 2:
        return None
    error, block, _, _ = lines.rows(poses, covs)
    mine = lines.of == 0
    hessian, slope = np.zeros((8, 8)), np.zeros(8)
    hessian[:3, :3] = np.einsum("cmi,cmj->ij", block[mine], block[mine])
    slope[:3] = np.einsum("cmi,cm->i", block[mine], error[mine])
    head = np.array([0, 1, 2, 6, 7])
    off = np.concatenate([poses[0], extra]) - prior.mean
    off[2] = wrapped(off[2])
    hessian[np.ix_(head, head)] += prior.information
    slope[head] += prior.information @ off
    moved, blocks = _motion(window, poses, extra, s)
    hessian += blocks[0].T @ blocks[0]
    slope += blocks[0].T @ moved[0]
    gain = np.linalg.solve(hessian[:3, :3], hessian[:3, 3:]).T
    information = hessian[3:, 3:] - gain @ hessian[:3, 3:]
    rest = slope[3:] - gain @ slope[:3]
    mean = np.concatenate([poses[1], extra]) - np.linalg.solve(information, rest)
    return Prior(mean, 0.5 * (information + information.T))
