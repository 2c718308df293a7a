"""Sigmas of odometry and observations from the log itself: expectation maximisation, accelerated.

With the smoother's marginals every component has ``sigma^2 = mean of r^2 + H P H'`` over what is no
outlier. Which these are cannot be told with sigmas that are far off: first the sigmas of the
observations are made to fit the medians of their squares, with the weights of the kernel, which
half of them may spoil. Then what lies within the gate counts in full, the rest not, for a weight in
between would tell a small noise of odometry from the wrong spread. Rounds close in slowly where
little is known, so their extrapolation is taken (SQUAREM).

References
----------
.. [1] R. H. Shumway, D. S. Stoffer, "An Approach to Time Series Smoothing and Forecasting Using the
   EM Algorithm", Journal of Time Series Analysis 3, 1982.
.. [2] R. Varadhan, C. Roland, "Simple and Globally Convergent Methods for Accelerating the
   Convergence of Any EM Algorithm", Scandinavian Journal of Statistics 35, 2008.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import numpy as np

from factors.kernels import TruncatedKernel
from ssm_graph.base import chi2
from ssm_graph.base.frozen import Array
from ssm_graph.evaluation.statistics import Interval
from ssm_graph.systems.landmark_slam.problem import SlamEstimate, SlamNoise, SlamProblem
from ssm_graph.systems.landmark_slam.smoother import (
    RIGID,
    Pass,
    SmootherSettings,
    Values,
    one_pass,
    smooth_landmarks,
    with_drift,
)
from ssm_graph.systems.landmark_slam.weights import square_share

MOST_CHANGE: Final = 4.0
"""By which a variance changes in a round at most; more is not believed."""
SETTLED_LOG: Final = 4e-3
"""Change of the logarithm of a variance in a round at which it is settled."""


GATE: Final = 3.717
"""Sigmas: beyond lies one of a thousand observations of two rows."""
WEIGHTS_NEAR: Final = 0.2
"""Change of a weight in a pass below which medians are taken."""
MEDIAN_SETTLED: Final = 0.05
"""Logarithm of the factor on a sigma at which medians have told what they can."""


@dataclass(frozen=True, slots=True)
class NoiseSettings:
    """How noise is estimated."""

    rounds: int = 30
    """Solutions of the log at most."""
    median_rounds: int = 8
    """Of these, for the medians."""


class SigmaFound(NamedTuple):
    """What a log says of one sigma."""

    label: str
    stated: float
    found: Interval
    """Its interval is that of so many independent squares as have been weighed."""


class NoiseFound(NamedTuple):
    """The log solved with sigmas of its own."""

    estimate: SlamEstimate
    sigmas: tuple[SigmaFound, ...]
    rounds: int
    is_settled: bool


def estimate_noise(
    problem: SlamProblem,
    stated: SlamNoise,
    first: Values,
    settings: SmootherSettings | None = None,
    how: NoiseSettings | None = None,
) -> NoiseFound:
    """Return the smoothed log with sigmas from itself; ``stated`` is where they begin."""
    smoother, limits = settings or SmootherSettings(), how or NoiseSettings()
    gated = replace(smoother, kernel=TruncatedKernel(GATE))
    state = _Rounds(problem, stated, first)
    for _ in range(limits.median_rounds):
        found = state.go(smoother)
        if found.update_sigmas < 1.0 and found.weight_change < WEIGHTS_NEAR:
            ratio = np.sqrt(_median_ratio(found))
            state.noise = SlamNoise(state.noise.control, state.noise.observation * ratio)
            if float(np.max(np.abs(np.log(ratio)))) < MEDIAN_SETTLED:
                break
    past: list[Array] = []
    is_settled = False
    while not is_settled and state.count < limits.rounds:
        found = state.go(gated)
        if found.update_sigmas > 1.0:
            continue
        past.append(np.log(_variances(state.noise)))
        wanted = np.log(_variances(_maximised(problem, state.noise, found, gated)))
        wanted = past[-1] + np.clip(wanted - past[-1], -np.log(MOST_CHANGE), np.log(MOST_CHANGE))
        is_settled = bool(np.max(np.abs(wanted - past[-1])) < SETTLED_LOG)
        past.append(wanted)
        if len(past) == 4:  # two plain rounds: three iterates
            wanted = wanted if is_settled else _extrapolated(past[0], past[1], past[3])
            past = []
        state.noise = _noise_of(wanted, len(stated.control))
    told = _told(problem, stated, state.noise, found)
    estimate = smooth_landmarks(problem, state.noise, state.values, smoother, weights=state.weights)
    return NoiseFound(estimate, told, state.count, is_settled)


class _Rounds:
    """Where the rounds have got."""

    def __init__(self, problem: SlamProblem, noise: SlamNoise, values: Values) -> None:
        self._problem, self.noise = problem, noise
        self.values = with_drift(problem, values)
        self.weights = np.ones(len(problem.keyframe))
        self._step_weights = np.ones(len(problem.control))
        self.count = 0

    def go(self, settings: SmootherSettings) -> Pass:
        """Make a pass and take what it found."""
        found = one_pass(
            self._problem, self.noise, settings, self.values, self.weights, self._step_weights
        )
        self.values, self.weights, self._step_weights = (
            found.values,
            found.weights,
            found.step_weights,
        )
        self.count += 1
        return found


def _median_ratio(found: Pass) -> Array:
    """Return by what the variances of range and bearing have to be multiplied to fit medians."""
    is_there = np.abs(found.rows.own).sum(axis=2) > 0.0
    # Of a row whose fit has taken the share h of its variance, r^2 is (1 - h) chi-square and
    # H P H' is h: so far that is what the median of their sum should be.
    share = np.clip(found.expected.own - found.rows.own_error**2, 0.0, 1.0)
    expected = (1.0 - share) * chi2.ppf(0.5, 1) + share
    ratio = np.ones(2)
    for i in range(2):
        if is_there[:, i].any():
            told = np.median((found.expected.own / expected)[is_there[:, i], i])
            ratio[i] = np.clip(told, 1.0 / MOST_CHANGE**2, MOST_CHANGE**2)
    return ratio


def _variances(noise: SlamNoise) -> Array:
    return np.concatenate([noise.control, noise.observation]) ** 2


def _noise_of(log_variances: Array, n_control: int) -> SlamNoise:
    sigma = np.exp(0.5 * log_variances)
    return SlamNoise(sigma[:n_control], sigma[n_control:])


def _extrapolated(zero: Array, one: Array, two: Array) -> Array:
    """Return the SQUAREM step from three successive logarithms of variances."""
    r, v = one - zero, two - 2.0 * one + zero
    length = np.where(np.abs(v) > 1e-12, np.abs(r) / np.maximum(np.abs(v), 1e-12), 1.0)
    alpha = -np.clip(length, 1.0, 8.0)
    step = -2.0 * alpha * r + alpha**2 * v
    return np.asarray(zero + np.clip(step, -np.log(16.0), np.log(16.0)))


def _maximised(
    problem: SlamProblem, noise: SlamNoise, found: Pass, settings: SmootherSettings
) -> SlamNoise:
    """Return the sigmas that the expected squares ask for."""
    observation = noise.observation * np.sqrt(_observed_ratio(found, settings))
    control = noise.control * np.sqrt(_control_ratio(problem, noise, found, settings))
    return SlamNoise(control, observation)


def _observed_ratio(found: Pass, settings: SmootherSettings) -> Array:
    rows, ratio = found.rows, np.ones(2)
    is_there = np.abs(rows.own).sum(axis=2) > 0.0
    share = np.array([1.0, *(square_share(settings.kernel, dim) for dim in (1, 2))])
    weights = found.weights / share[rows.n_rows.astype(int)]
    for i in range(2):
        use = is_there[:, i]
        if use.any():
            total = found.weights[use].sum()
            ratio[i] = float(weights[use] @ found.expected.own[use, i] / max(total, 1e-300))
    return ratio


def _control_ratio(
    problem: SlamProblem, noise: SlamNoise, found: Pass, settings: SmootherSettings
) -> Array:
    basis = problem.motion.basis(problem.control) * noise.control
    cov = basis @ basis.mT + RIGID**2 * np.eye(3)
    root = np.linalg.cholesky(cov)
    # Expected noise of a step given its increment's error: the projection of least variance.
    onto = basis.mT @ np.linalg.inv(root).mT
    left = np.eye(basis.shape[2]) - onto @ onto.mT
    squares = np.einsum("kii->ki", onto @ found.expected.between @ onto.mT + left)
    weights = found.step_weights / square_share(settings.odometry_kernel, 3)
    moves = np.abs(basis).sum(axis=1) > 0.0
    total = np.where(moves, weights[:, None] * squares, 0.0).sum(axis=0)
    return np.asarray(total / np.maximum(moves.sum(axis=0), 1))


def _told(
    problem: SlamProblem, stated: SlamNoise, noise: SlamNoise, found: Pass
) -> tuple[SigmaFound, ...]:
    labels = (*problem.motion.labels, "range, m", "bearing, rad")
    n_seen = (np.abs(found.rows.own).sum(axis=2) > 0.0).sum(axis=0)
    counts = [*[len(problem.control)] * len(noise.control), *n_seen.tolist()]
    before = np.concatenate([stated.control, stated.observation])
    after = np.concatenate([noise.control, noise.observation])
    # Squares less what their own fit has taken: the share of a row that the rest determines.
    shares = _own_shares(problem, found)
    told = []
    for i, label in enumerate(labels):
        dof = max(counts[i] * shares[i], 1.0)
        low, high = np.sqrt(dof / chi2.ppf([0.975, 0.025], dof))
        told.append(
            SigmaFound(
                label,
                float(before[i]),
                Interval(float(after[i]), float(after[i] * low), float(after[i] * high)),
            )
        )
    return tuple(told)


def _own_shares(problem: SlamProblem, found: Pass) -> Array:
    """Return of every component the share of its expected squares that are residuals."""
    q = len(problem.motion.labels)
    own = found.rows.own_error**2
    observed = own.sum(axis=0) / np.maximum(found.expected.own.sum(axis=0), 1e-300)
    error = found.rows.between_error
    total = np.einsum("kii->k", found.expected.between).sum()
    moved = float(np.sum(error**2) / max(total, 1e-300))
    return np.concatenate([np.full(q, moved), observed])
