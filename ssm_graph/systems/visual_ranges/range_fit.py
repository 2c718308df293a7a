"""Scale, anchors and biases from ranges along a path: damped least squares, a weight each.

With the camera's place ``p`` (map units, from the middle of the path), the lever arm ``l`` in map
axes (m), scale ``s``, anchor ``a`` (m, from the same middle), bias ``b`` and clock ``c`` (s)::

    e = |s (p + c v + D z) + l + c l' - a| + b + B y - range

``D z`` is what the path may have drifted by and ``B y`` how a bias may have walked: both are random
walks, as few of their Karhunen-Loeve modes as matter, with coefficients of unit variance. They are
estimated and thrown away, so that what remains has an honest covariance. So is what a lever arm is
off by that is not known exactly: ``A w`` beside ``l``, in the camera's axes.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import numpy as np

from ssm_graph.base.frozen import Array, ReadOnlyArrays
from ssm_graph.systems.visual_ranges.range_terms import CLOSEST_M, Places
from ssm_graph.systems.visual_ranges.ranges import Indices
from ssm_graph.systems.visual_ranges.weights import RangeKernel, sight_kernel

BIAS_M: Final = 0.15
"""Prior standard deviation of an anchor's bias."""
CLOCK_S: Final = 0.020
"""Prior standard deviation of the ranges' clock."""
BIAS_WALK_M: Final = 0.02
"""Random walk of a bias, m after one second: antennas that turn."""
DRIFT: Final = 0.002
"""Random walk of a visual path, its standard deviation at the end as a share of its length."""
N_MODES: Final = 6
"""Of a random walk; they hold 97 % of its variance."""
LOG_SCALE: Final = 3.0
ANCHOR_M: Final = 1e3
"""Prior standard deviations that only keep finite what is not observable."""
ROUNDS: Final = 60
SETTLED: Final = 1e-7
"""Relative change of the cost at which a search ends."""
POLISHES: Final = 20
"""Turns of share and solution, at most; they end when the scale moves by 0.01 sigma."""
STEP_DEVIANCE: Final = 0.5
"""By which a reweighting may raise the deviance, which is not quite what it lowers."""
SPACING_M: Final = 0.02
"""Standard deviation of the distance between two anchors whose places are known."""


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Problem(ReadOnlyArrays):
    """Ranges, and what is assumed beside them.

    Unknowns are log s, clock, for each anchor its place and bias, then the modes.
    """

    places: Places
    n_anchors: int
    middle: Array
    """(3,) of the path, map units; what `Places` holds is from there"""
    drift: Array
    """(M, D) map units for each coefficient, the same for three axes"""
    walk: Array
    """(M, W) m for each coefficient of each anchor's bias"""
    kernel: RangeKernel
    spacing: tuple[tuple[int, int, float], ...] = ()
    """Pairs of anchors and the distance between them, m"""
    scale_prior: tuple[float, float] = (0.0, LOG_SCALE)
    """Mean and standard deviation of log s, from what else knows it"""

    @property
    def n_core(self) -> int:
        """Unknowns that are asked for."""
        return 2 + 4 * self.n_anchors

    @property
    def n_unknowns(self) -> int:
        """With the modes."""
        drift, walk = self.drift.shape[1], self.walk.shape[1]
        arm = 0 if self.places.arm is None else 3
        return int(self.n_core + 3 * drift + self.n_anchors * walk + arm)

    def prior_information(self) -> Array:
        """Return its diagonal (P,)."""
        anchor = np.array([ANCHOR_M, ANCHOR_M, ANCHOR_M, BIAS_M])
        sigma = np.concatenate([[self.scale_prior[1], CLOCK_S], np.tile(anchor, self.n_anchors)])
        return np.concatenate([sigma**-2, np.ones(self.n_unknowns - self.n_core)])

    def off_prior(self, unknowns: Array) -> Array:
        """Return unknowns (..., P) less their prior's mean."""
        off = unknowns.copy()
        off[..., 0] -= self.scale_prior[0]
        return off


def problem_of(
    places: Places,
    n_anchors: int,
    kernel: RangeKernel,
    *,
    drift: float = DRIFT,
    bias_walk_m: float = BIAS_WALK_M,
    spacing: tuple[tuple[int, int, float], ...] = (),
    scale_prior: tuple[float, float] | None = None,
) -> Problem:
    """Return the problem of ranges in order of time, with modes of drift and walk as asked for."""
    middle = places.camera.mean(axis=0) if len(places.camera) else np.zeros(3)
    step = np.linalg.norm(np.diff(places.camera, axis=0), axis=1)
    gone = np.concatenate([[0.0], np.cumsum(step)])[: len(places.camera)]
    length = float(gone[-1]) if len(gone) else 0.0
    time = places.time_s - places.time_s[0] if len(places.time_s) else places.time_s
    lasts = float(time[-1]) if len(time) else 0.0
    none = np.zeros((len(places.camera), 0))
    return Problem(
        places._replace(camera=places.camera - middle),
        n_anchors,
        middle,
        drift * length * _modes(gone / max(length, 1e-12)) if drift > 0.0 else none,
        bias_walk_m * np.sqrt(lasts) * _modes(time / max(lasts, 1e-12)) if bias_walk_m else none,
        kernel,
        spacing,
        scale_prior or (0.0, LOG_SCALE),
    )


def _modes(share: Array) -> Array:
    """Return modes (M, N_MODES) of a Wiener process of unit variance at its end."""
    order = (np.arange(N_MODES) + 0.5) * np.pi
    return np.asarray(np.sqrt(2.0) * np.sin(share[:, None] * order) / order)


def residuals(problem: Problem, unknowns: Array) -> tuple[Array, Array]:
    """Return errors (S, M), m, and their Jacobian (S, M, P) at sets of unknowns (S, P)."""
    at, n_sets = problem.places, len(unknowns)
    n, n_anchors, core = len(at.range_m), problem.n_anchors, problem.n_core
    s = np.exp(unknowns[:, 0])[:, None, None]
    clock = unknowns[:, 1, None, None]
    own = unknowns[:, 2:core].reshape(n_sets, n_anchors, 4)[:, at.anchor]
    n_drift, n_walk = problem.drift.shape[1], problem.walk.shape[1]
    z = unknowns[:, core : core + 3 * n_drift].reshape(n_sets, n_drift, 3)
    first_walk, end = core + 3 * n_drift, core + 3 * n_drift + n_anchors * n_walk
    y = unknowns[:, first_walk:end].reshape(n_sets, n_anchors, n_walk)[:, at.anchor]
    camera = at.camera + clock * at.velocity + problem.drift @ z
    line = s * camera + at.lever + clock * at.lever_rate - own[..., :3]
    if at.arm is not None:
        line = line + np.einsum("mij,sj->smi", at.arm, unknowns[:, end:])
    distance = np.linalg.norm(line, axis=2)
    u = line / np.maximum(distance, CLOSEST_M)[..., None]
    walked = np.einsum("mw,smw->sm", problem.walk, y)
    error = distance + own[..., 3] + walked - at.range_m
    J = np.zeros((n_sets, n, problem.n_unknowns))
    J[:, :, 0] = s[..., 0] * np.einsum("smi,smi->sm", u, camera)
    J[:, :, 1] = np.einsum("smi,smi->sm", u, s * at.velocity + at.lever_rate)
    along = (2 + 4 * at.anchor)[:, None] + np.arange(4)
    J[:, np.arange(n)[:, None], along] = np.concatenate([-u, np.ones((n_sets, n, 1))], axis=2)
    drift = s[..., None] * problem.drift[:, :, None] * u[:, :, None, :]
    J[:, :, core : core + 3 * n_drift] = drift.reshape(n_sets, n, 3 * n_drift)
    if n_walk:
        first = first_walk + n_walk * at.anchor
        J[:, np.arange(n)[:, None], first[:, None] + np.arange(n_walk)] = problem.walk
    if at.arm is not None:
        J[:, :, end:] = np.einsum("smi,mij->smj", u, at.arm)
    return error, J


class Fit(NamedTuple):
    """Where a search ended."""

    unknowns: Array
    """(S, P)"""
    cost: Array
    """(S,) deviance of the ranges and the priors: minus twice a log likelihood"""


def search(problem: Problem, starts: Array, *, held: Indices | None = None) -> Fit:
    """Return where damped robust searches from (S, P) end; all go side by side.

    ``held`` are columns that keep their value.
    """
    information = problem.prior_information()
    at = starts.copy()
    error, J = residuals(problem, at)
    cost = _cost(problem, at, error)
    damping = np.full(len(at), 1e-2)
    eye = np.eye(problem.n_unknowns)
    for _ in range(ROUNDS):
        normal, gradient = _normal(problem, at, error, J, variance=0.0)
        normal[:, np.arange(len(information)), np.arange(len(information))] += information
        gradient += information * problem.off_prior(at)
        if held is not None:
            normal[:, held, :] = normal[:, :, held] = 0.0
            normal[:, held, held] = 1.0
            gradient[:, held] = 0.0
        scaled = normal * (1.0 + damping[:, None, None] * eye)
        step = -np.linalg.solve(scaled, gradient[..., None])[..., 0]
        step[:, 0] = np.clip(step[:, 0], -0.5, 0.5)
        tried = at + step
        new_error, new_J = residuals(problem, tried)
        new_cost = _cost(problem, tried, new_error)
        better = new_cost <= cost
        gain = np.where(better, cost - new_cost, 0.0)
        at = np.where(better[:, None], tried, at)
        error = np.where(better[:, None], new_error, error)
        J = np.where(better[:, None, None], new_J, J)
        cost = np.where(better, new_cost, cost)
        settled = (better & (gain < SETTLED * (1.0 + cost))) | (damping > 1e8)
        damping = np.clip(np.where(better, damping / 10.0, damping * 10.0), 1e-12, 1e9)
        if settled.all():
            break
    return Fit(at, cost)


def _cost(problem: Problem, at: Array, error: Array) -> Array:
    deviance = problem.kernel.deviance(error, problem.places.sigma_m).sum(axis=1)
    apart = _spacing(problem, at)[0]
    spaced = np.square(apart / SPACING_M).sum(axis=1)
    off = problem.off_prior(at)
    return np.asarray(deviance + spaced + (problem.prior_information() * off**2).sum(axis=1))


def _spacing(problem: Problem, at: Array) -> tuple[Array, Array]:
    """Return errors (S, C) of the distances between anchors, m, and their Jacobian (S, C, P)."""
    count = len(problem.spacing)
    error, J = np.zeros((len(at), count)), np.zeros((len(at), count, problem.n_unknowns))
    for row, (i, j, wanted) in enumerate(problem.spacing):
        first, second = 2 + 4 * i, 2 + 4 * j
        line = at[:, first : first + 3] - at[:, second : second + 3]
        distance = np.linalg.norm(line, axis=1)
        error[:, row] = distance - wanted
        u = line / np.maximum(distance, CLOSEST_M)[:, None]
        J[:, row, first : first + 3], J[:, row, second : second + 3] = u, -u
    return error, J


def _normal(
    problem: Problem, at: Array, error: Array, J: Array, *, variance: Array | float
) -> tuple[Array, Array]:
    """Return information (S, P, P) of the measurements and gradients (S, P), without priors."""
    sigma = problem.places.sigma_m
    weighted = problem.kernel.weight(error, variance, sigma) / sigma**2
    J_w = np.swapaxes(J * weighted[..., None], 1, 2)
    normal, gradient = J_w @ J, (J_w @ error[..., None])[..., 0]
    if problem.spacing:
        apart, J_apart = _spacing(problem, at)
        J_apart_t = np.swapaxes(J_apart, 1, 2) / SPACING_M**2
        normal = normal + J_apart_t @ J_apart
        gradient = gradient + (J_apart_t @ apart[..., None])[..., 0]
    return normal, gradient


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Solution(ReadOnlyArrays):
    """Scale, anchors, biases and clock, with what they rest on."""

    scale: float
    """Metres a map unit."""
    clock_s: float
    anchors: Array
    """(J, 3) m, map axes, from the map's origin"""
    biases: Array
    """(J,) m"""
    covariance: Array
    """(2 + 4 J, 2 + 4 J) of log s, clock, and for each anchor place and bias"""
    unknowns: Array
    """(P,) as the search has them, with the modes"""
    error: Array
    """(M,) of the ranges, m, with the modes"""
    variance: Array
    """(M,) ``H P H'``, m^2"""
    weight: Array
    """(M,)"""
    cost: float
    """Deviance of ranges and priors."""
    drift_square: float = 1.0
    """Mean square of the path's modes, what is open of them included: 1 as expected."""
    arm: Array | None = None
    """(3,) coefficients of the lever arm's error; None where it is exact"""
    understated: float = 1.0
    """By how much information alone understates the covariance, and a deviance overstates: ranges
    that are too long in bursts say the same, and a robust kernel has its price."""

    @property
    def sigma_log_scale(self) -> float:
        """Relative standard deviation of the scale."""
        return float(np.sqrt(self.covariance[0, 0]))

    def anchor_covariance(self, j: int) -> Array:
        """Return that of an anchor's place (3, 3), m^2."""
        own = slice(2 + 4 * j, 5 + 4 * j)
        return self.covariance[own, own]


def solution(
    problem: Problem, start: Array, *, rounds: int = ROUNDS, is_near: bool = False
) -> Solution:
    """Return the minimum near one set of unknowns (P,), weights with the posterior in them.

    First a damped search by the residuals alone, where the start is not near already, then at most
    ``rounds`` reweightings with ``H P H'`` of the posterior before; they end when no unknown moves
    by a thousandth of its sigma.
    """
    at = start[None] if is_near else search(problem, start[None]).unknowns
    information = np.diag(problem.prior_information())
    variance: Array = np.zeros((1, len(problem.places.range_m)))
    for _ in range(rounds):
        error, J = residuals(problem, at)
        normal, gradient = _normal(problem, at, error, J, variance=variance)
        covariance = np.linalg.inv(normal[0] + information)
        variance = ((J[0] @ covariance) * J[0]).sum(axis=1)[None]
        step = -covariance @ (gradient[0] + information @ problem.off_prior(at[0]))
        moved = _kept_step(problem, at, step)
        at = at + moved
        if float(np.max(np.abs(moved) / np.sqrt(covariance.diagonal()))) < 1e-3:
            break
    error, J = residuals(problem, at)
    weight = problem.kernel.weight(error, variance, problem.places.sigma_m)
    modes = slice(problem.n_core, problem.n_core + 3 * problem.drift.shape[1])
    square = at[0, modes] ** 2 + covariance.diagonal()[modes]
    understated = float(problem.kernel.inefficiency(error, problem.places.sigma_m))
    understated *= _repeated(problem, weight[0] * error[0])
    cost = float(_cost(problem, at, error)[0])
    each = (error[0], variance[0], weight[0])
    found = _outwards(problem, at[0], understated * covariance, each, cost)
    found = replace(found, understated=understated)
    if problem.places.arm is not None:
        found = replace(found, arm=at[0, -3:].copy())
    return replace(found, drift_square=float(square.mean())) if square.size else found


def _repeated(problem: Problem, pull: Array) -> float:
    """Return how many ranges in a row say the same: 1 plus twice the sum of autocorrelations.

    ``pull`` (M,) are weighted errors. The largest of all anchors; the sum ends at the first lag
    that is negative, or within two of its own sigmas of zero.
    """
    most = 1.0
    for j in range(problem.n_anchors):
        own = pull[problem.places.anchor == j]
        n, square = len(own), float(own @ own)
        total = 1.0
        for lag in range(1, n // 4):
            part = float(own[lag:] @ own[:-lag]) / square if square > 0.0 else 0.0
            if part < 2.0 / np.sqrt(n):
                break
            total += 2.0 * part
        most = max(most, total)
    return most


def _outwards(
    problem: Problem,
    unknowns: Array,
    covariance: Array,
    each: tuple[Array, Array, Array],
    cost: float,
) -> Solution:
    """Return a solution with anchors from the map's origin instead of the middle of the path."""
    core, n_anchors = problem.n_core, problem.n_anchors
    scale = float(np.exp(unknowns[0]))
    own = unknowns[2:core].reshape(n_anchors, 4)
    shift = np.eye(core)
    for j in range(n_anchors):
        shift[2 + 4 * j : 5 + 4 * j, 0] = scale * problem.middle
    return Solution(
        scale,
        float(unknowns[1]),
        own[:, :3] + scale * problem.middle,
        own[:, 3].copy(),
        shift @ covariance[:core, :core] @ shift.T,
        unknowns.copy(),
        *each,
        cost,
    )


def _kept_step(problem: Problem, at: Array, step: Array) -> Array:
    """Return a step (P,), or a part of it, that does not leave the minimum; zero if none.

    Along what is not observable a full step may go anywhere.
    """
    shares = np.array([1.0, 0.3, 0.1, 0.03])
    tried = np.vstack([at, at + shares[:, None] * step])
    cost = _cost(problem, tried, residuals(problem, tried)[0])
    for share, new in zip(shares, cost[1:], strict=True):
        if new < cost[0] + STEP_DEVIANCE:
            return np.asarray(share * step)
    return np.zeros_like(step)


def polished(problem: Problem, found: Solution) -> Solution:
    """Return a minimum by ranges in sight alone, as far as their errors tell: :class:`SightKernel`.

    Share and excess of those that are too long are found with it, in turns. Its cost, and what that
    overstates, stay those of the kernel it was found by, so that minima can be compared.
    """
    at, last = problem.places, found
    for _ in range(POLISHES):
        error = residuals(problem, last.unknowns[None])[0][0]
        kernel = sight_kernel(error, at.sigma_m, at.anchor)
        before = last
        last = solution(replace(problem, kernel=kernel), last.unknowns, is_near=True, rounds=5)
        if abs(np.log(last.scale / before.scale)) < 0.01 * last.sigma_log_scale:
            break
    return replace(last, cost=found.cost, understated=found.understated)


def unknowns_of(
    problem: Problem, scale: float, anchors: Array, biases: Array, clock_s: float = 0.0
) -> Array:
    """Return unknowns (P,) of a solution, modes at zero."""
    own = np.column_stack([anchors - scale * problem.middle, biases]).ravel()
    modes = np.zeros(problem.n_unknowns - problem.n_core)
    return np.concatenate([[np.log(scale), clock_s], own, modes])
