"""A graph of poses and landmarks in the plane: what GTSAM's solvers here take.

Relations of poses that follow one another are odometry; others are closures: a place that was met
again. Closures and observations have similarity weights.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import gtsam
import numpy as np
from numpy.typing import NDArray

from factors.bearing_range import bearing_range_residual, half_turn, range_bearing_slopes
from ssm_graph.base.errors import DataError
from ssm_graph.base.frozen import Array, ReadOnlyArrays
from ssm_graph.systems.landmark_slam.models import (
    Increments,
    between,
    increments_of,
    turned,
)
from ssm_graph.systems.landmark_slam.problem import SlamNoise, SlamProblem
from ssm_graph.systems.landmark_slam.smoother import RIGID

START_SIGMA: Final = 1e-3
"""m, m, rad of the first pose where a file fixes none: the frame of the map."""


@dataclass(frozen=True, slots=True, eq=False)
class SlamGraph(ReadOnlyArrays):
    """K poses, L landmarks, E relations of two poses, M observations of a landmark."""

    time_s: Array
    """(K,) increasing; the number of each pose where nothing tells its time."""
    pairs: NDArray[np.intp]
    """(E, 2) an earlier pose and a later one."""
    step: Array
    """(E, 3) increment from the first to the second [m, m, rad], in the axes of the first."""
    step_cov: Array
    """(E, 3, 3) of it"""
    seen: NDArray[np.intp]
    """(M, 2) pose and landmark, poses ascending"""
    measured: Array
    """(M, 2) range [m] and bearing [rad]; NaN where only the other was measured."""
    sigma: Array
    """(M, 2) of these"""
    names: tuple[str, ...]
    """(L,) of the landmarks."""
    start: Array
    """(3,) of the first pose"""
    start_sigma: Array
    """(3,)"""
    truth: Array
    """(K, 3) where the file has one, else no rows."""

    def __post_init__(self) -> None:
        follows = np.flatnonzero(self.pairs[:, 1] - self.pairs[:, 0] == 1)
        has = np.zeros(len(self.time_s), dtype=bool)
        has[self.pairs[follows, 1]] = True
        if not has[1:].all():
            lost = 1 + int(np.argmin(has[1:]))
            raise DataError(
                f"SlamGraph.pairs: no odometry from pose {lost - 1} to pose {lost}; expected each "
                "pose tied to the one before it; number the poses in the order of the drive"
            )
        ReadOnlyArrays.__post_init__(self)

    @property
    def typical_sigma(self) -> Array:
        """(2,) of ranges [m] and bearings [rad]: medians; 1 where there is none."""
        return np.median(self.sigma, axis=0) if len(self.sigma) else np.ones(2)

    @property
    def is_closure(self) -> NDArray[np.bool_]:
        """(E,) pairs that do not follow one another, and all but the first of those that do."""
        follows = np.flatnonzero(self.pairs[:, 1] - self.pairs[:, 0] == 1)
        _, kept = np.unique(self.pairs[follows, 1], return_index=True)
        closes = np.ones(len(self.pairs), dtype=bool)
        closes[follows[kept]] = False
        return closes


def graph_of_problem(problem: SlamProblem, noise: SlamNoise) -> SlamGraph:
    """Return a log as a graph; what its odometry may be wrong by all along is noise of each step."""
    moving = problem.with_drift_as_noise(noise)
    root = moving.motion.basis(moving.control) * noise.control
    k = np.arange(len(moving.control))
    return SlamGraph(
        problem.time_s,
        np.column_stack([k, k + 1]),
        moving.steps(),
        root @ root.mT + RIGID**2 * np.eye(3),
        np.column_stack([problem.keyframe, problem.landmark]),
        problem.measured,
        noise.observation * problem.scales,
        problem.names,
        problem.start,
        problem.start_sigma,
        np.zeros((0, 3)),
    )


def problem_of_graph(graph: SlamGraph) -> tuple[SlamProblem, SlamNoise]:
    """Return a graph but for its closures as a log: each step's and each observation's own noise."""
    odometry = np.flatnonzero(~graph.is_closure)
    order = odometry[np.argsort(graph.pairs[odometry, 1])]
    unit = graph.typical_sigma
    problem = SlamProblem(
        graph.time_s,
        Increments(),
        increments_of(graph.step[order], graph.step_cov[order]),
        graph.seen[:, 0],
        graph.seen[:, 1],
        graph.measured,
        graph.names,
        graph.start,
        graph.start_sigma,
        observation_scale=graph.sigma / unit,
    )
    return problem, SlamNoise(np.ones(3), unit)


def pose_key(k: int) -> int:
    """Return GTSAM's key of a pose."""
    return int(gtsam.symbol("x", k))


def landmark_key(i: int) -> int:
    """Return GTSAM's key of a landmark."""
    return int(gtsam.symbol("l", i))


def pair_factor(graph: SlamGraph, e: int, weight: float = 1.0) -> gtsam.NonlinearFactor:
    """Return the factor of a relation of poses; GTSAM has its error in the axes of the end."""
    i, j = graph.pairs[e].tolist()
    back = turned(graph.step[e, 2]).T
    cov = back @ graph.step_cov[e] @ back.T / weight
    model = gtsam.noiseModel.Gaussian.Covariance(cov)
    return gtsam.BetweenFactorPose2(
        pose_key(i), pose_key(j), gtsam.Pose2(*graph.step[e].tolist()), model
    )


def seen_factor(graph: SlamGraph, m: int, weight: float = 1.0) -> gtsam.NonlinearFactor:
    """Return the factor of an observation, of range and bearing or of what there is of them."""
    k, i = graph.seen[m].tolist()
    r, b = graph.measured[m].tolist()
    range_sigma, bearing_sigma = (graph.sigma[m] / np.sqrt(weight)).tolist()
    keys = pose_key(k), landmark_key(i)
    sigmas = gtsam.noiseModel.Diagonal.Sigmas
    if np.isnan(b):
        return gtsam.RangeFactor2D(*keys, r, sigmas(np.array([range_sigma])))
    if np.isnan(r):
        return gtsam.BearingFactor2D(*keys, gtsam.Rot2(b), sigmas(np.array([bearing_sigma])))
    both = sigmas(np.array([bearing_sigma, range_sigma]))
    return gtsam.BearingRangeFactor2D(*keys, gtsam.Rot2(b), r, both)


def whitened_pairs(graph: SlamGraph, which: NDArray[np.intp], pose: Array) -> tuple[Array, Array]:
    """Return errors (n, 3) of relations, in sigmas, and their slopes (n, 3, 6) by both poses."""
    first, second = pose[graph.pairs[which, 0]], pose[graph.pairs[which, 1]]
    moved = between(first, second)
    error = moved - graph.step[which]
    error[:, 2] = half_turn(error[:, 2])
    back = turned(first[:, 2]).mT
    to_first = -back
    to_first[:, 0, 2], to_first[:, 1, 2] = moved[:, 1], -moved[:, 0]
    white = np.linalg.inv(np.linalg.cholesky(graph.step_cov[which]))
    return (white @ error[..., None])[..., 0], white @ np.concatenate(
        [to_first, turned(first[:, 2]).mT], axis=2
    )


def whitened_seen(
    graph: SlamGraph, which: NDArray[np.intp], pose: Array, landmarks: Array
) -> tuple[Array, Array]:
    """Return errors (n, 2) of observations, in sigmas, and slopes (n, 2, 5); zero of no part."""
    at, place = pose[graph.seen[which, 0]], landmarks[graph.seen[which, 1]]
    own = bearing_range_residual(at, place, measured=graph.measured[which])
    there = np.isfinite(own.error)
    scale = np.where(there, 1.0 / np.where(there, graph.sigma[which], 1.0), 0.0)
    slopes = np.concatenate(range_bearing_slopes(at, place), axis=2) * scale[..., None]
    return np.where(there, own.error, 0.0) * scale, slopes
