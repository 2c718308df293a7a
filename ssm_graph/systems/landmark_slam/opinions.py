"""Landmarks for a log that names none: several first opinions, each mended, and the best of them.

A filter that goes along cannot take back what it paired wrongly, and a little more or less trust in
the observations leads it elsewhere. So it goes along several times. Each time the log is smoothed
and its scans are paired anew along the path; the opinion is taken that bends the odometry least and
explains most, with the fewest landmarks. Where the others put the path tells whether it is sure.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ssm_graph.base.frozen import Array
from ssm_graph.systems.landmark_slam.association import Associated, AssociationSettings, associate
from ssm_graph.systems.landmark_slam.problem import SlamNoise, SlamProblem
from ssm_graph.systems.landmark_slam.reassociation import Reassociated, reassociate
from ssm_graph.systems.landmark_slam.smoother import (
    Rows,
    SmootherSettings,
    Values,
    linearised,
    smooth_landmarks,
)

TRUSTS: Final = ((1.0, 1.0), (1.5, 1.0), (1.0, 1.5))
"""By which the sigmas of ranges and bearings are multiplied while a first opinion is formed."""
SIGMA_OF_MEDIAN: Final = 1.4826
"""A Gaussian's standard deviation over its median absolute value."""


class Opinion(NamedTuple):
    """A log with landmarks, and where it stands."""

    problem: SlamProblem
    values: Values
    landmark: NDArray[np.intp]
    """(M,) of the log that came, `problem.UNKNOWN` of observations left out"""
    cost: float
    """Of what observations and odometry are missed by, and of the landmarks that it takes."""
    elsewhere_m: Array
    """(K,) by which the paths of the other opinions are off this one's, at most"""


def best_opinion(
    problem: SlamProblem, noise: SlamNoise, how: AssociationSettings, settings: SmootherSettings
) -> Opinion:
    """Return the opinion of least cost on a log; names it has are not looked at."""
    found = []
    for trust in TRUSTS:
        wider = SlamNoise(noise.control, noise.observation * trust)
        first = associate(problem, wider, how)
        if len(first.places):
            found.append(_mended(problem, noise, first, settings))
    if not found:  # nothing was seen three times: what the filter says is all there is
        values, nothing = Values(first.pose, first.places), np.zeros(len(first.pose))
        return Opinion(first.problem, values, first.landmark, np.inf, nothing)
    best = min(found, key=lambda one: one.cost)
    off = np.array([one.values.pose - best.values.pose for one in found])[..., :2]
    return best._replace(elsewhere_m=np.linalg.norm(off, axis=2).max(axis=0))


def _mended(
    problem: SlamProblem, noise: SlamNoise, first: Associated, settings: SmootherSettings
) -> Opinion:
    begin = Values(first.pose, first.places)
    estimate = smooth_landmarks(first.problem, noise, begin, settings)
    values = Values(estimate.pose, estimate.landmarks, estimate.drift)
    rows = linearised(first.problem, noise, values)
    sigma = noise.observation * problem.scales * _more(rows)
    again = reassociate(problem, sigma, estimate.pose, estimate.landmarks)
    names = tuple(str(i) for i in range(len(again.places)))
    named = problem.associated(again.landmark, names)
    drift = estimate.drift / problem.drift_sigma if len(estimate.drift) else np.zeros(0)
    cost = _cost(again) + float(np.sum(rows.between_error**2) + drift @ drift)
    values, nothing = values._replace(landmarks=again.places), np.zeros(len(values.pose))
    return Opinion(named, values, again.landmark, cost, nothing)


def _more(rows: Rows) -> Array:
    """Return by what (2,) the sigmas are too small, by medians of what is missed; 1 at least."""
    return np.maximum(SIGMA_OF_MEDIAN * np.median(np.abs(rows.own_error), axis=0), 1.0)


def _cost(found: Reassociated) -> float:
    """Return twice the negative logarithm of the likelihood, with the price of the landmarks.

    Errors have heavy tails (Student's with two degrees of freedom, two rows: ``4 log(1 + t / 2)``);
    each landmark is two numbers, of ``log M`` each (the criterion of Schwarz).
    """
    missed = 4.0 * np.log1p(0.5 * found.squares)
    return float(missed.sum() + 2.0 * len(found.places) * np.log(max(len(missed), 2)))
