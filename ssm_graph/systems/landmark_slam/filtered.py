"""A log through a filter, pose by pose: an answer of its own, and where a smoother begins."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ssm_graph.base.frozen import Array
from ssm_graph.systems.landmark_slam.drifting_filter import DriftingFilter
from ssm_graph.systems.landmark_slam.filters import SlamFilter
from ssm_graph.systems.landmark_slam.methods import FILTERS
from ssm_graph.systems.landmark_slam.problem import (
    SlamEstimate,
    SlamNoise,
    SlamProblem,
    SlamStatus,
)
from ssm_graph.systems.landmark_slam.range_starts import placed
from ssm_graph.systems.landmark_slam.smoother import Values


def first_values(problem: SlamProblem, noise: SlamNoise) -> Values:
    """Return where a smoother begins: by a filter with weights.

    Without a drift of the odometry it goes through the poses that saw something.
    """
    short, its_noise, kept = problem, noise, np.arange(len(problem.time_s))
    if not len(problem.drift_sigma):
        short, its_noise, kept = problem.condensed(noise)
    answer = filtered(short, its_noise, "ekf-weighted")
    places = placed(short, its_noise.observation, answer.pose, answer.landmarks)
    return Values(problem.expanded(answer.pose, kept), np.nan_to_num(places), answer.drift)


def filter_along(
    problem: SlamProblem, noise: SlamNoise, method: str, *, capacity: int
) -> tuple[SlamFilter, Callable[[int], None]]:
    """Return a filter at the first pose of a log, and what moves it to pose k from the one before.

    The drift of the odometry is a state of those that follow it, noise for others.
    """
    how, begin = FILTERS[method], problem
    more = {}
    if how.follows_drift:
        more["drift_sigma"] = problem.drift_sigma
    else:
        begin = problem.with_drift_as_noise(noise)
    slam = how.begin(
        problem.motion,
        noise.control,
        noise.observation,
        problem.start[None],
        capacity=capacity,
        start_cov=np.diag(problem.start_sigma**2),
        **more,
    )
    slopes = problem.slopes

    def move(k: int) -> None:
        control = begin.control[k - 1][None]
        if isinstance(slam, DriftingFilter):
            slam.predict(control, slopes[k - 1][None])
        else:
            slam.predict(control)

    return slam, move


def filtered(problem: SlamProblem, noise: SlamNoise, method: str) -> SlamEstimate:
    """Return what a filter says at every pose, with its map at the end."""
    slam, move = filter_along(problem, noise, method, capacity=len(problem.names))
    K, L = len(problem.time_s), len(problem.names)
    pose, cov = np.empty((K, 3)), np.empty((K, 3, 3))
    weights = np.ones(len(problem.keyframe))
    first = problem.first_of.tolist()
    is_whole = np.all(np.isfinite(problem.measured), axis=1).tolist()
    for k in range(K):
        if k > 0:
            move(k)
        rows = [i for i in range(first[k], first[k + 1]) if is_whole[i]]
        if rows:
            names = problem.landmark[rows].tolist()
            told = slam.update(names, problem.measured[rows][None], problem.scales[rows])
            weights[np.array(rows)[told.known]] = told.weights[0]
        pose[k], cov[k] = slam.pose[0], slam.pose_cov[0]
    places, covs = np.full((L, 2), np.nan), np.full((L, 2, 2), np.nan)
    for name in np.unique(problem.landmark[np.array(is_whole, dtype=bool)]).tolist():
        place, place_cov = slam.landmark(name)
        places[name], covs[name] = place[0], place_cov[0]
    end = SlamNoise(*(_sigmas(x[0]) for x in (slam.noise.control, slam.noise.observation)))
    drift = slam.drift[0] if isinstance(slam, DriftingFilter) else np.zeros(0)
    return SlamEstimate(pose, cov, places, covs, weights, end, SlamStatus.DONE, 1, drift)


def _sigmas(cov: Array) -> Array:
    return np.asarray(np.sqrt(np.diagonal(cov)))
