"""A log of odometry and observed landmarks as every estimator here takes it, and an answer."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from factors.bearing_range import half_turn
from ssm_graph.base.errors import ConfigError, DataError
from ssm_graph.base.frozen import Array, ReadOnlyArrays
from ssm_graph.systems.landmark_slam.models import (
    Increments,
    Motion,
    between,
    composed,
    increments_of,
    turned,
)

UNKNOWN = -1
"""Landmark of an observation that nobody has named."""


@dataclass(frozen=True, slots=True, eq=False)
class SlamProblem(ReadOnlyArrays):
    """K poses in a row, M observations of L landmarks."""

    time_s: Array
    """(K,) increasing"""
    motion: Motion
    control: Array
    """(K - 1, c) from each pose to the next."""
    keyframe: NDArray[np.intp]
    """(M,) pose that saw it, ascending."""
    landmark: NDArray[np.intp]
    """(M,) 0 to L - 1; `UNKNOWN` where association has to find it."""
    measured: Array
    """(M, 2) range [m] and bearing [rad]; NaN where only the other was measured."""
    names: tuple[str, ...]
    """(L,) of the landmarks."""
    start: Array
    """(3,) pose of the first keyframe, m, m, rad: the frame of the map."""
    start_sigma: Array
    """(3,)"""
    drift_sigma: Array = field(default_factory=lambda: np.zeros(0))
    """(3,) of what `Odometry` may be wrong by all along: share of the distance, share of the turn,
    rad/s of turn. No rows: nothing."""
    observation_scale: Array | None = None
    """(M, 2) by which the sigmas of each observation are multiplied; None: by 1."""
    drift_slopes: Array | None = None
    """(K - 1, 3, 3) by which increments follow the drift; None: what they are themselves."""

    def __post_init__(self) -> None:
        n = len(self.time_s)
        for name, size in (("control", n - 1), ("landmark", len(self.keyframe))):
            if len(getattr(self, name)) != size:
                raise DataError(
                    f"SlamProblem.{name}: expected {size} rows, got {len(getattr(self, name))}"
                )
        if np.any(np.diff(self.keyframe) < 0):
            raise DataError("SlamProblem.keyframe: expected ascending poses; sort the observations")
        ReadOnlyArrays.__post_init__(self)

    @property
    def first_of(self) -> NDArray[np.intp]:
        """(K + 1,) where the observations of each keyframe begin, and M."""
        return np.searchsorted(self.keyframe, np.arange(len(self.time_s) + 1))

    @property
    def scales(self) -> Array:
        """(M, 2) by which the sigmas of each observation are multiplied."""
        if self.observation_scale is None:
            return np.ones((len(self.keyframe), 2))
        return self.observation_scale

    def steps(self, drift: Array | None = None) -> Array:
        """Return the increments (K - 1, 3) of odometry, put right by a drift (3,) or by none."""
        q = len(self.motion.labels)
        step = self.motion.increment(self.control, np.zeros((len(self.control), q)))
        if drift is not None and len(drift):
            step = step + (self.slopes @ drift[:, None])[..., 0]
        return step

    @property
    def slopes(self) -> Array:
        """(K - 1, 3, 3) by which increments follow the drift."""
        if self.drift_slopes is not None:
            return self.drift_slopes
        step = self.steps()
        slopes = np.zeros((len(step), 3, 3))
        slopes[:, :2, 0] = step[:, :2]
        slopes[:, 2, 1] = step[:, 2]
        slopes[:, 2, 2] = np.diff(self.time_s)
        return slopes

    def with_drift_as_noise(self, noise: SlamNoise) -> SlamProblem:
        """Return the same for who has no drift: what it may be is noise of each step."""
        if not len(self.drift_sigma):
            return self
        slopes = self.slopes * self.drift_sigma
        more = np.square(slopes).sum(axis=2) / np.square(noise.control)
        scales = np.sqrt(np.square(self.control[:, 3:]) + more)
        control = np.hstack([self.control[:, :3], scales])
        return replace(self, control=control, drift_sigma=np.zeros(0), drift_slopes=None)

    def dead_reckoned(self) -> Array:
        """Return poses (K, 3) by odometry alone."""
        poses = np.empty((len(self.time_s), 3))
        poses[0] = self.start
        for k, step in enumerate(self.steps()):
            poses[k + 1] = composed(poses[k], step)
        return poses

    def condensed(self, noise: SlamNoise) -> tuple[SlamProblem, SlamNoise, NDArray[np.intp]]:
        """Return the log with those poses alone that saw something, the first and the last.

        Also its noise, and which poses these are. Increments between are put together as they would
        be eliminated: the same to second order of their noise.
        """
        kept = np.unique(np.concatenate([[0], self.keyframe, [len(self.time_s) - 1]]))
        if len(kept) == len(self.time_s):
            return self, noise, kept
        poses, k = self.dead_reckoned(), np.arange(len(self.control))
        left = np.searchsorted(kept, k, side="right") - 1
        begin, end = poses[kept[left]], poses[kept[left + 1]]
        # What a step misses goes to the axes of the first pose; its turn turns what comes after.
        onto = turned(poses[:-1, 2] - begin[:, 2])
        c, s = np.cos(begin[:, 2]), np.sin(begin[:, 2])
        rest = end[:, :2] - poses[1:, :2]
        onto[:, 0, 2] = s * rest[:, 0] - c * rest[:, 1]
        onto[:, 1, 2] = c * rest[:, 0] + s * rest[:, 1]
        root = onto @ (self.motion.basis(self.control) * noise.control)
        cov = np.add.reduceat(root @ root.mT, kept[:-1]) + 1e-18 * np.eye(3)
        steps = between(poses[kept[:-1]], poses[kept[1:]])
        steps[:, 2] = np.add.reduceat(self.steps()[:, 2], kept[:-1])
        short = replace(
            self,
            time_s=self.time_s[kept],
            motion=Increments(),
            control=increments_of(steps, cov),
            keyframe=np.searchsorted(kept, self.keyframe),
            drift_slopes=np.add.reduceat(onto @ self.slopes, kept[:-1]),
        )
        return short, SlamNoise(np.ones(3), noise.observation), kept

    def expanded(self, pose: Array, kept: NDArray[np.intp]) -> Array:
        """Return all poses (K, 3) from those of the condensed log.

        What odometry misses by from one to the next is spread evenly over the poses between.
        """
        if len(kept) == len(self.time_s):
            return pose
        by_odometry, k = self.dead_reckoned(), np.arange(len(self.time_s))
        left = np.clip(np.searchsorted(kept, k, side="right") - 1, 0, len(kept) - 2)
        begin, end = kept[left], kept[left + 1]
        found = composed(pose[left], between(by_odometry[begin], by_odometry))
        missed = pose[left + 1] - composed(
            pose[left], between(by_odometry[begin], by_odometry[end])
        )
        missed[:, 2] = half_turn(missed[:, 2])
        found += ((k - begin) / (end - begin))[:, None] * missed
        found[:, 2] = half_turn(found[:, 2])
        return np.asarray(found)

    def associated(self, landmark: NDArray[np.intp], names: tuple[str, ...]) -> SlamProblem:
        """Return the same with other landmarks seen; observations of none (-1) are left out."""
        kept = landmark >= 0
        return replace(
            self,
            landmark=landmark[kept],
            keyframe=self.keyframe[kept],
            measured=self.measured[kept],
            names=names,
            observation_scale=None
            if self.observation_scale is None
            else self.observation_scale[kept],
        )


@dataclass(frozen=True, slots=True, eq=False)
class SlamNoise(ReadOnlyArrays):
    """Standard deviations."""

    control: Array
    """(q,) of the components of the motion's noise, in its units."""
    observation: Array
    """(2,) range [m] and bearing [rad]"""

    def __post_init__(self) -> None:
        for name in ("control", "observation"):
            value = np.array(getattr(self, name), dtype=np.float64)
            if not np.all(np.isfinite(value) & (value > 0.0)):
                raise ConfigError(
                    f"{name}: expected sigmas above 0, got {value.tolist()}; state what the "
                    "instrument is worth, or let it be estimated from a guess"
                )
            object.__setattr__(self, name, value)
        ReadOnlyArrays.__post_init__(self)


class SlamStatus(Enum):
    """Why an estimator stopped."""

    CONVERGED = "updates below 1e-2 of their sigmas, weights settled"
    MAX_ITERATIONS = "iteration limit reached: look at the start, or at odometry that jumps"
    DONE = "the whole log was filtered"
    AMBIGUOUS = "landmarks without names may have been taken for one another: see the notes"


@dataclass(frozen=True, slots=True, eq=False)
class SlamEstimate(ReadOnlyArrays):
    """Path and map with sigmas, and the weight of every observation."""

    pose: Array
    """(K, 3) m, m, rad"""
    pose_cov: Array
    """(K, 3, 3)"""
    landmarks: Array
    """(L, 2) m; NaN of one that was never placed"""
    landmark_cov: Array
    """(L, 2, 2)"""
    weights: Array
    """(M,)"""
    noise: SlamNoise
    """That was used."""
    status: SlamStatus
    n_iterations: int
    drift: Array
    """(3,) of the odometry, or no rows: see `SlamProblem.drift_sigma`."""
    notes: tuple[str, ...] = ()
