"""Depth and dead reckoning as terms of a bundle adjustment, and the scale that they alone give.

With scale ``s`` (metres a map unit), ``n`` the unit vector down in map axes, ``z_0`` the depth of
the map's origin, and key frames ``R, t`` world to camera, centre ``c = -R' t``::

    depth      e = s n.c + n.(R' l) + z_0 - depth
    vertical   e = R n - down                          down: in camera axes, by dead reckoning
    step, turn of two key frames that follow each other: :mod:`factors.metric_step`

Further variables are ``log s``, two of ``n`` (along the columns of a basis across it) and ``z_0``.
Each residual of one, two or three rows has one similarity weight of all its rows, with what the
posterior leaves open in it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from factors.metric_step import metric_step_residual
from factors.similarity import LogKernel
from factors.so3 import skew
from ssm_graph.base.frozen import Array, ReadOnlyArrays
from ssm_graph.systems.visual_ranges.vehicle import DeadReckoning, Depths, Vehicle, inside

Indices = NDArray[np.int64]

N_EXTRA: Final = 4
"""log s, two of the vertical, depth of the origin."""
KERNEL: Final = LogKernel(5.0)
LEAST_STEPS: Final = 8
"""And depths, before the scale is tried."""
FREE: Final = np.array([3.0, 3.0, 3.0, 1e4])
"""Prior standard deviations that only keep finite what nothing tells."""
ROUNDS: Final = 30


class MetricRows(NamedTuple):
    """Whitened rows of one key frame or two."""

    error: Array
    """(M,)"""
    first: Indices
    by_first: Array
    """(M, 6)"""
    second: Indices
    """(M,) -1 for none"""
    by_second: Array
    by_extra: Array
    """(M, 4)"""


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class VehicleTerms(ReadOnlyArrays):
    """What the vehicle says of some key frames."""

    depth_of: Indices
    """(D,) key frames with a depth"""
    depth_m: Array
    depth_lever: Array
    """(3,) camera axes, m"""
    depth_sigma_m: float
    vertical_of: Indices
    """(V,) key frames with a vertical"""
    down: Array
    """(V, 3) camera axes"""
    tilt_rad: float
    step_of: Indices
    """(S, 2) key frames"""
    step_m: Array
    """(S, 3) axes of the first"""
    turn: Array
    """(S, 3, 3) first camera to second"""
    step_sigma_m: Array
    """(S,)"""
    turn_sigma: Array
    """(S,)"""

    def __len__(self) -> int:
        """Return the number of rows."""
        return len(self.depth_of) + 3 * len(self.vertical_of) + 6 * len(self.step_of)

    @property
    def sizes(self) -> Indices:
        """Rows of each residual, in the order of `rows`."""
        counts = [len(self.depth_of), len(self.vertical_of), 2 * len(self.step_of)]
        return np.repeat([1, 3, 3], counts)

    def on(self, pose_of: Indices) -> VehicleTerms:
        """Return what bears on some key frames alone, counted anew; ``pose_of`` (K,), -1: not."""
        depth, vertical, step = (
            pose_of[self.depth_of],
            pose_of[self.vertical_of],
            pose_of[self.step_of],
        )
        d, v, b = depth >= 0, vertical >= 0, (step >= 0).all(axis=1)
        return replace(
            self,
            depth_of=depth[d], depth_m=self.depth_m[d],
            vertical_of=vertical[v], down=self.down[v],
            step_of=step[b], step_m=self.step_m[b], turn=self.turn[b],
            step_sigma_m=self.step_sigma_m[b], turn_sigma=self.turn_sigma[b],
        )  # fmt: skip

    def rows(self, R_cw: Array, t_cw: Array, state: MetricState) -> MetricRows:
        """Return whitened rows: depths, verticals, then steps and turns."""
        parts = [
            self._depths(R_cw, t_cw, state),
            self._verticals(R_cw, state),
            *self._steps(R_cw, t_cw, state),
        ]
        return MetricRows(*(np.concatenate(column) for column in zip(*parts, strict=True)))

    def _depths(self, R_cw: Array, t_cw: Array, state: MetricState) -> MetricRows:
        R, t = R_cw[self.depth_of], t_cw[self.depth_of]
        down_c = R @ state.down
        s, white = np.exp(state.log_scale), 1.0 / self.depth_sigma_m
        along = -np.einsum("ni,ni->n", down_c, t)  # n.c
        error = s * along + down_c @ self.depth_lever + state.depth_m - self.depth_m
        by_pose = np.concatenate([-s * down_c, np.cross(down_c, self.depth_lever)], axis=1)
        place = s * -np.einsum("nji,nj->ni", R, t) + self.depth_lever @ R
        by_extra = np.column_stack([s * along, place @ state.across, np.ones(len(t))])
        none = np.full(len(t), -1)
        return MetricRows(
            error * white, self.depth_of, by_pose * white, none, 0.0 * by_pose, by_extra * white
        )

    def _verticals(self, R_cw: Array, state: MetricState) -> MetricRows:
        R, n = R_cw[self.vertical_of], len(self.vertical_of)
        down_c, white = R @ state.down, 1.0 / self.tilt_rad
        by_pose = np.concatenate([np.zeros((n, 3, 3)), -skew(down_c)], axis=2)
        by_extra = np.zeros((n, 3, N_EXTRA))
        by_extra[:, :, 1:3] = R @ state.across
        frame = np.repeat(self.vertical_of, 3)
        by_pose = by_pose.reshape(-1, 6) * white
        return MetricRows(
            (down_c - self.down).ravel() * white, frame, by_pose, np.full(3 * n, -1),
            0.0 * by_pose, by_extra.reshape(-1, N_EXTRA) * white,
        )  # fmt: skip

    def _steps(self, R_cw: Array, t_cw: Array, state: MetricState) -> tuple[MetricRows, MetricRows]:
        i, j = self.step_of.T
        found = metric_step_residual(
            (R_cw[i], t_cw[i]), (R_cw[j], t_cw[j]), float(np.exp(state.log_scale)),
            step_m=self.step_m, turn=self.turn,
        )  # fmt: skip
        by_extra = np.zeros((3 * len(i), N_EXTRA))
        by_extra[:, 0] = found.step_D_log_scale.ravel()

        def whitened(
            error: Array, first: Array, second: Array, sigma: Array, e: Array
        ) -> MetricRows:
            white = np.repeat(1.0 / sigma, 3)
            column = white[:, None]
            return MetricRows(
                error.ravel() * white, np.repeat(i, 3), first.reshape(-1, 6) * column,
                np.repeat(j, 3), second.reshape(-1, 6) * column, e * column,
            )  # fmt: skip

        return (
            whitened(
                found.step, found.step_D_first, found.step_D_second, self.step_sigma_m, by_extra
            ),
            whitened(
                found.turn, found.turn_D_first, found.turn_D_second, self.turn_sigma, 0.0 * by_extra
            ),
        )

    def weights(self, error: Array, variance: Array) -> Array:
        """Return similarity weights (M,) of rows, one of each residual, with its own dimension."""
        sizes = self.sizes
        if not len(sizes):
            return np.zeros(0)
        first = np.concatenate([[0], np.cumsum(sizes)[:-1]])
        t = np.add.reduceat(error**2 + variance, first)
        return np.repeat(KERNEL.weight(t, dim=sizes.astype(np.float64)), sizes)


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class MetricState(ReadOnlyArrays):
    """Scale, vertical and depth of the origin."""

    log_scale: float
    down: Array
    """(3,) unit vector, map axes"""
    depth_m: float
    covariance: Array
    """(4, 4)"""

    @property
    def across(self) -> Array:
        """(3, 2) unit vectors across `down`."""
        return np.linalg.svd(self.down[None])[2][1:].T

    def moved(self, extra: Array) -> MetricState:
        """Return it changed by (4,) of the further variables."""
        down = self.down + self.across @ extra[1:3]
        return replace(
            self,
            log_scale=self.log_scale + float(extra[0]),
            down=down / np.linalg.norm(down),
            depth_m=self.depth_m + float(extra[3]),
        )


def hung(vehicle: Vehicle, time_s: Array) -> VehicleTerms:
    """Return what a vehicle says of key frames at times (K,), which rise."""
    depth = vehicle.depths
    if depth is None:
        depth = Depths(np.zeros(0), np.zeros(0))
        at, share = np.zeros(0, dtype=np.int64), np.zeros(0)
    else:
        at, share = inside(depth.time_s, time_s)
    d = np.flatnonzero(np.isfinite(share))
    read = depth.depth_m
    depth_m = (1.0 - share[d]) * read[at[d]] + share[d] * read[at[d] + 1]
    known, position, R_nc = _reckoned(vehicle.dead_reckoning, time_s)
    reckoning = vehicle.dead_reckoning
    pair = np.flatnonzero(np.diff(known) == 1)
    i, j = known[pair], known[pair + 1]
    root = np.sqrt(time_s[j] - time_s[i])
    return VehicleTerms(
        depth_of=d.astype(np.int64),
        depth_m=depth_m,
        depth_lever=np.array(depth.lever_arm_m),
        depth_sigma_m=depth.sigma_m,
        vertical_of=known,
        down=R_nc[:, 2, :],
        tilt_rad=1.0 if reckoning is None else reckoning.tilt_rad,
        step_of=np.column_stack([i, j]),
        step_m=np.einsum("nji,nj->ni", R_nc[pair], position[pair + 1] - position[pair]),
        turn=np.swapaxes(R_nc[pair + 1], 1, 2) @ R_nc[pair],
        step_sigma_m=root * (1.0 if reckoning is None else reckoning.step_m),
        turn_sigma=root * (1.0 if reckoning is None else reckoning.turn_rad),
    )


def _reckoned(reckoning: DeadReckoning | None, time_s: Array) -> tuple[Indices, Array, Array]:
    """Return which key frames have dead reckoning, their places and rotations to its axes."""
    if reckoning is None:
        return np.zeros(0, dtype=np.int64), np.zeros((0, 3)), np.zeros((0, 3, 3))
    at, share = inside(reckoning.time_s, time_s)
    known = np.flatnonzero(np.isfinite(share))
    at, share = at[known], np.clip(share[known], 0.0, 1.0)[:, None]
    position = (1.0 - share) * reckoning.position_m[at] + share * reckoning.position_m[at + 1]
    if not len(known):
        return known.astype(np.int64), position, np.zeros((0, 3, 3))
    when = np.clip(time_s[known], reckoning.time_s[0], reckoning.time_s[-1])
    turned = Slerp(reckoning.time_s, Rotation.from_quat(reckoning.quaternion))(when)
    return known.astype(np.int64), position, turned.as_matrix()


def metric_state(terms: VehicleTerms, R_cw: Array, t_cw: Array) -> MetricState | None:
    """Return scale, vertical and depth from what the vehicle says of a path; None: too little.

    From steps the scale is the ratio of both ways; from depths alone the gradient of depth over the
    map is ``s n``: so it is if the path is in all directions. Then all together, weighted, poses
    held. The covariance is widened by what residuals repeat, as a map that drifts makes them.
    """
    n_steps, n_depths = len(terms.step_of), len(terms.depth_of)
    centre = -np.einsum("kji,kj->ki", R_cw, t_cw)
    if n_steps >= LEAST_STEPS:
        i, j = terms.step_of.T
        way = np.einsum("nij,nj->ni", R_cw[i], centre[j] - centre[i])
        square = float((way * way).sum())
        ratio = float((way * terms.step_m).sum()) / square if square > 0.0 else 0.0
        seen = np.einsum("nji,nj->ni", R_cw[terms.vertical_of], terms.down)
        down = np.median(seen, axis=0)
    elif n_depths >= 2 * LEAST_STEPS:
        rows = np.column_stack([centre[terms.depth_of], np.ones(n_depths)])
        gradient = np.linalg.lstsq(rows, terms.depth_m, rcond=1e-6)[0][:3]
        ratio, down = float(np.linalg.norm(gradient)), gradient
    else:
        return None
    if not (ratio > 0.0 and np.linalg.norm(down) > 0.0):
        return None
    down = down / np.linalg.norm(down)
    level = 0.0
    if n_depths:
        level = float(np.median(terms.depth_m - ratio * centre[terms.depth_of] @ down))
    return _settled(terms, R_cw, t_cw, MetricState(float(np.log(ratio)), down, level, np.eye(4)))


def _settled(terms: VehicleTerms, R_cw: Array, t_cw: Array, state: MetricState) -> MetricState:
    prior, variance = np.diag(FREE**-2.0), np.zeros(len(terms))
    for _ in range(ROUNDS):
        rows = terms.rows(R_cw, t_cw, state)
        J, weight = rows.by_extra, terms.weights(rows.error, variance)
        covariance = np.linalg.inv((J * weight[:, None]).T @ J + prior)
        variance = np.einsum("ma,ab,mb->m", J, covariance, J)
        step = -covariance @ (J.T @ (weight * rows.error))
        step[:3] = np.clip(step[:3], -0.5, 0.5)
        state = state.moved(step)
        # As a map drifts, neighbouring key frames pull the same way: batches tell by how much.
        pull = J[:, 0] * weight * rows.error * np.sqrt(covariance[0, 0])
        if float(np.max(np.abs(step) / np.sqrt(covariance.diagonal()))) < 1e-3:
            break
    repeats = _repeats(pull, rows.first)
    return replace(state, covariance=np.asarray(covariance * repeats, dtype=np.float64))


def _repeats(pull: Array, frame: Indices) -> float:
    """Return the variance of the sum of all pulls, by eight batches, over that expected."""
    if not len(pull) or frame.max() < 32:
        return 1.0
    batch = np.bincount(frame * 8 // (int(frame.max()) + 1), pull, minlength=8)
    return max(float(batch @ batch), 1.0)
