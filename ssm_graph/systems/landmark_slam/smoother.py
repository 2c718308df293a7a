"""The whole log at once: every pose, every landmark, a similarity weight for every observation.

The chain of poses is eliminated in time with the landmarks as its border (`engine.chain`), by QR.
Its marginals are exact, so that the weight of an observation is judged by what it is expected to
miss, residual and posterior variance, and noise is learnt from the same numbers.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import numpy as np

from factors.bearing_range import bearing_range_residual, half_turn
from factors.similarity import GaussianKernel, Kernel, LogKernel
from ssm_graph.base.errors import SolverError
from ssm_graph.base.frozen import Array
from ssm_graph.engine.chain import Chain, ChainSolution
from ssm_graph.engine.reweighting import MOST_TAILS, NEAR_SIGMAS, Lengths
from ssm_graph.systems.landmark_slam.models import between, turned
from ssm_graph.systems.landmark_slam.problem import (
    SlamEstimate,
    SlamNoise,
    SlamProblem,
    SlamStatus,
)
from ssm_graph.systems.landmark_slam.weights import tail_of, weights_of

RIGID: Final = 1e-4
"""m and rad: noise of an increment in directions that the motion's noise does not reach."""
FAR_M: Final = 1e4
"""Sigma of a landmark's place before it was seen; a range alone, or a bearing, leaves it wide."""
SETTLED: Final = 1e-2
"""Sigmas by which the last update moves anything at most."""
SETTLED_WEIGHT: Final = 1e-2
ROUGH: Final = 5.0
"""Times these, where the whole log follows."""
HALVINGS: Final = 12


@dataclass(frozen=True, slots=True)
class SmootherSettings:
    """How the log is solved."""

    kernel: Kernel = LogKernel(5.0)
    """Weighs the observations."""
    finds_tail: bool = True
    """Whether the logarithm's kernel gets the tail that the observations ask for, see `tail_of`; of
    sigmas that are wider than single errors they tell nothing."""
    odometry_kernel: Kernel = GaussianKernel()
    """Weighs the increments of odometry, each as a whole."""
    max_iterations: int = 50


class Values(NamedTuple):
    """Where a solution stands."""

    pose: Array
    """(K, 3)"""
    landmarks: Array
    """(L, 2)"""
    drift: Array = np.zeros(0)
    """(3,) of the odometry, or no rows"""


class Rows(NamedTuple):
    """Whitened by the sigmas, not by the weights."""

    between: Array
    """(K - 1, 3, 6) by the poses of both ends"""
    between_error: Array
    """(K - 1, 3)"""
    between_drift: Array
    """(K - 1, 3, c) by the drift of the odometry"""
    own: Array
    """(M, 2, 5) by pose and landmark; zero where nothing was measured"""
    own_error: Array
    """(M, 2)"""
    n_rows: Array
    """(M,) of 1 or 2 components measured"""


class Marginals(NamedTuple):
    """What a solution knows: of the whitened rows, squares that are expected of them."""

    own: Array
    """(M, 2) residual^2 + H P H'"""
    between: Array
    """(K - 1, 3, 3) residual residual' + H P H'"""
    pose_cov: Array
    """(K, 3, 3)"""


def linearised(problem: SlamProblem, noise: SlamNoise, values: Values) -> Rows:
    """Return the rows of all factors at some values."""
    pose = values.pose
    basis = problem.motion.basis(problem.control) * noise.control
    cov = basis @ basis.mT + RIGID**2 * np.eye(3)
    white = np.linalg.inv(np.linalg.cholesky(cov))
    step = problem.steps(values.drift)
    moved = between(pose[:-1], pose[1:])
    error = moved - step
    error[:, 2] = half_turn(error[:, 2])
    back = turned(pose[:-1, 2]).mT
    to_first = -back.copy()
    to_first[:, 0, 2], to_first[:, 1, 2] = moved[:, 1], -moved[:, 0]
    own = bearing_range_residual(
        pose[problem.keyframe], values.landmarks[problem.landmark], measured=problem.measured
    )
    is_there = np.isfinite(own.error)
    scale = is_there / (noise.observation * problem.scales)
    slopes = np.concatenate([own.error_D_pose, own.error_D_landmark], axis=2) * scale[..., None]
    return Rows(
        white @ np.concatenate([to_first, back], axis=2),
        (white @ error[..., None])[..., 0],
        -white @ problem.slopes[..., : len(values.drift)],
        slopes,
        np.where(is_there, own.error, 0.0) * scale,
        is_there.sum(axis=1).astype(np.float64),
    )


def eliminated(
    problem: SlamProblem, rows: Rows, weights: Array, step_weights: Array, values: Values
) -> ChainSolution:
    """Return the solution of the weighted linear problem."""
    n_drift, places = len(values.drift), 2 * len(values.landmarks)
    size = places + n_drift
    chain = Chain(3, size)
    own = np.zeros((*rows.own.shape[:2], 3 + size + 1))
    at = 3 + 2 * problem.landmark[:, None] + np.arange(2)
    m, two = np.arange(len(own))[:, None, None], np.arange(2)[:, None]
    root = np.sqrt(weights)[:, None, None]
    own[..., :3] = root * rows.own[..., :3]
    own[m, two, at[:, None]] = root * rows.own[..., 3:]
    own[..., -1] = -root[..., 0] * rows.own_error
    first = 2 * problem.first_of
    flat = own.reshape(-1, own.shape[2])
    of_each = [flat[a:b] for a, b in itertools.pairwise(first.tolist())]
    wide = np.zeros((len(rows.between), 3, 6 + size + 1))
    root = np.sqrt(step_weights)[:, None, None]
    wide[..., :6] = root * rows.between
    wide[..., 6 + places : -1] = root * rows.between_drift
    wide[..., -1] = -root[..., 0] * rows.between_error
    prior = np.zeros((3, 3 + size + 1))
    prior[:, :3] = np.diag(1.0 / problem.start_sigma)
    off = problem.start - values.pose[0]
    off[2] = half_turn(off[2])
    prior[:, -1] = off / problem.start_sigma
    chain.eliminate(prior, of_each, wide, begin=0)
    border = np.zeros((size, size + 1))
    border[:places, :places] = np.eye(places) / FAR_M
    border[places:, places:size] = np.diag(1.0 / problem.drift_sigma)
    border[places:, -1] = -values.drift / problem.drift_sigma
    return chain.solve(border)


def marginals(problem: SlamProblem, rows: Rows, solution: ChainSolution) -> Marginals:
    """Return expected squares of all whitened rows."""
    k, at = problem.keyframe, 2 * problem.landmark[:, None] + np.arange(2)
    P = solution.constants_cov
    # One product of matrices: of each pose by itself it takes three times as long.
    through = (solution.sensitivity.reshape(-1, len(P)) @ P).reshape(solution.sensitivity.shape)
    pose_cov = solution.conditional + through @ solution.sensitivity.mT
    cross = through[k[:, None, None], np.arange(3)[:, None], at[:, None]]
    pose, place = rows.own[..., :3], rows.own[..., 3:]
    inner = np.einsum("mri,mij,mrj->mr", pose, pose_cov[k], pose, optimize=True)
    inner += 2.0 * np.einsum("mri,mij,mrj->mr", pose, cross, place, optimize=True)
    own_cov = P[at[:, :, None], at[:, None]]
    inner += np.einsum("mri,mij,mrj->mr", place, own_cov, place, optimize=True)
    c = rows.between_drift.shape[2]
    both = np.empty((len(rows.between), 6 + c, 6 + c))
    both[:, :3, :3], both[:, 3:6, 3:6] = pose_cov[:-1], pose_cov[1:]
    both[:, :3, 3:6] = through[:-1] @ solution.sensitivity[1:].mT
    both[:, :3, 3:6] -= solution.gain[:-1] @ solution.conditional[1:]
    both[:, 3:6, :3] = both[:, :3, 3:6].mT
    own_drift = slice(P.shape[0] - c, None)
    both[:, :3, 6:], both[:, 3:6, 6:] = through[:-1, :, own_drift], through[1:, :, own_drift]
    both[:, 6:, :6], both[:, 6:, 6:] = both[:, :6, 6:].mT, P[own_drift, own_drift]
    slopes = np.concatenate([rows.between, rows.between_drift], axis=2)
    spread = slopes @ both @ slopes.mT
    e = rows.between_error
    squares = e[:, :, None] * e[:, None, :]
    return Marginals(rows.own_error**2 + inner, squares + spread, pose_cov)


class Pass(NamedTuple):
    """One round: where it stands, what was expected there, and what comes next."""

    values: Values
    rows: Rows
    solution: ChainSolution
    expected: Marginals
    weights: Array
    step_weights: Array
    update_sigmas: float
    weight_change: float

    @property
    def lengths(self) -> Lengths:
        """Of its observations."""
        square = self.expected.own.sum(axis=1)
        return Lengths(square, square - np.square(self.rows.own_error).sum(axis=1))


def one_pass(
    problem: SlamProblem,
    noise: SlamNoise,
    settings: SmootherSettings,
    values: Values,
    weights: Array,
    step_weights: Array,
) -> Pass:
    """Linearise, solve, move as far as the weighted cost falls, and weigh anew."""
    rows = linearised(problem, noise, values)
    solution = eliminated(problem, rows, weights, step_weights, values)
    cost = _cost(problem, rows, weights, step_weights, values)
    share = 1.0
    for _ in range(HALVINGS):
        moved = _moved(values, solution, share)
        after = linearised(problem, noise, moved)
        if _cost(problem, after, weights, step_weights, moved) <= cost * (1.0 + 1e-9) + 1e-9:
            break
        share *= 0.5
    expected = marginals(problem, after, solution)
    new = weights_of(settings.kernel, expected.own.sum(axis=1), rows.n_rows)
    t = np.einsum("kii->k", expected.between)
    new_step = weights_of(settings.odometry_kernel, t, np.full(len(t), 3))
    own_var = np.einsum("kii->ki", expected.pose_cov).ravel()
    sigma = np.sqrt(np.concatenate([own_var, np.diagonal(solution.constants_cov)]))
    steps = np.concatenate([solution.step.ravel(), solution.constants_step])
    change = float(np.max(np.abs(new - weights), initial=0.0))
    update = float(np.max(np.abs(steps) / sigma, initial=0.0))
    return Pass(moved, after, solution, expected, new, new_step, update, change)


def _moved(values: Values, solution: ChainSolution, share: float) -> Values:
    pose = values.pose + share * solution.step
    pose[:, 2] = half_turn(pose[:, 2])
    places = values.landmarks.size
    constants = share * solution.constants_step
    return Values(
        pose,
        values.landmarks + constants[:places].reshape(-1, 2),
        values.drift + constants[places:],
    )


def _cost(
    problem: SlamProblem, rows: Rows, weights: Array, step_weights: Array, values: Values
) -> float:
    off = values.pose[0] - problem.start
    off[2] = half_turn(off[2])
    squares = weights @ np.sum(rows.own_error**2, axis=1)
    squares += step_weights @ np.sum(rows.between_error**2, axis=1)
    prior = np.concatenate([off / problem.start_sigma, values.drift / problem.drift_sigma])
    return float(squares + prior @ prior)


def smooth_landmarks(
    problem: SlamProblem,
    noise: SlamNoise,
    first: Values,
    settings: SmootherSettings | None = None,
    *,
    weights: Array | None = None,
) -> SlamEstimate:
    """Return the smoothed path and map.

    Parameters
    ----------
    problem : every observation has its landmark.
    noise : sigmas; `estimate_noise` finds them.
    first : values to begin at, of a filter for example.
    settings : kernel and limits.
    weights : (M,) of the first pass; ones if None.
    """
    how = settings or SmootherSettings()
    values = with_drift(problem, first)
    w = np.ones(len(problem.keyframe)) if weights is None else weights
    kernel = how.kernel
    short, its_noise, kept = problem.condensed(noise)
    if short is not problem:  # most of the way with fewer poses
        begin = values._replace(pose=values.pose[kept])
        near = _settled(short, its_noise, how, kernel, begin, w, limit=ROUGH)
        found, kernel = near.last, near.kernel
        values = found.values._replace(pose=problem.expanded(found.values.pose, kept))
        w = found.weights
    end = _settled(problem, noise, how, kernel, values, w)
    if not np.all(np.isfinite(end.last.values.pose)):
        raise SolverError("smooth_landmarks: no finite solution; look at sigmas and first values")
    return _estimate_of(problem, noise, how, end)


class _Settled(NamedTuple):
    last: Pass
    kernel: Kernel
    """In force at the end"""
    is_settled: bool
    n_passes: int


def _settled(
    problem: SlamProblem,
    noise: SlamNoise,
    how: SmootherSettings,
    kernel: Kernel,
    values: Values,
    w: Array,
    *,
    limit: float = 1.0,
) -> _Settled:
    """Return where passes lead that begin with a kernel and weights (M,)."""
    step_w, is_settled, count = np.ones(len(problem.control)), False, 0
    change, tails = np.zeros(len(w)), 0
    while not is_settled and count < how.max_iterations:
        found = one_pass(problem, noise, replace(how, kernel=kernel), values, w, step_w)
        values, step_w, count = found.values, found.step_weights, count + 1
        if how.finds_tail and tails < MOST_TAILS and found.update_sigmas < NEAR_SIGMAS:
            n_rows = found.rows.n_rows
            asked = tail_of(how.kernel, found.lengths, w, n_rows)
            if asked != kernel:
                kernel, tails, change = asked, tails + 1, np.zeros(len(w))
                w = weights_of(kernel, found.lengths.square, n_rows)
                continue
        before, change = change, found.weights - w
        w = found.weights if found.update_sigmas > 1.0 else _ahead(found.weights, before, change)
        is_settled = found.update_sigmas < limit * SETTLED
        is_settled &= found.weight_change < limit * SETTLED_WEIGHT
    return _Settled(found, kernel, is_settled, count)


def _ahead(weights: Array, before: Array, change: Array) -> Array:
    """Return where weights (M,) are bound for, if their changes go on to shrink by one ratio."""
    ratio = float(before @ change) / max(float(before @ before), 1e-300)
    if not 0.1 < ratio < 0.8:
        return weights
    told = weights + ratio / (1.0 - ratio) * change
    return np.clip(told, 0.5 * weights, np.maximum(weights, 1.5 * weights))


def with_drift(problem: SlamProblem, values: Values) -> Values:
    """Return values with a drift of the odometry where the problem has one."""
    return (
        values if len(values.drift) else values._replace(drift=np.zeros(len(problem.drift_sigma)))
    )


def _estimate_of(
    problem: SlamProblem, noise: SlamNoise, how: SmootherSettings, end: _Settled
) -> SlamEstimate:
    """Return where the passes ended as an answer."""
    found = end.last
    L = len(found.values.landmarks)
    P = found.solution.constants_cov[: 2 * L, : 2 * L].reshape(L, 2, L, 2)
    at, notes = np.arange(L), []
    seen = np.bincount(problem.landmark, minlength=L)
    once = [problem.names[i] for i in np.flatnonzero(seen == 1)]
    if once:
        notes.append(f"seen only once, placed by that alone: landmarks {', '.join(once[:5])}")
    if end.kernel != how.kernel:
        notes.append(
            f"observations weighed by {end.kernel}: it makes them likelier than {how.kernel}"
        )
    return SlamEstimate(
        found.values.pose,
        found.expected.pose_cov,
        found.values.landmarks,
        P[at, :, at],
        found.weights,
        noise,
        SlamStatus.CONVERGED if end.is_settled else SlamStatus.MAX_ITERATIONS,
        end.n_passes,
        found.values.drift,
        tuple(notes),
    )
