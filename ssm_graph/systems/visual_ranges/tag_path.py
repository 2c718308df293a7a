"""A path from few marks and ranges alone: every sighting and every range with a weight of its own.

The chain of knots is eliminated in time with marks, anchors and biases as its border
(:mod:`ssm_graph.engine.chain`). Its marginals are exact, so that a weight is judged by residual and
posterior variance.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import numpy as np

from factors.similarity import Kernel, LogKernel
from ssm_graph.base.errors import SolverError
from ssm_graph.base.frozen import Array
from ssm_graph.engine.chain import Chain, ChainSolution
from ssm_graph.systems.visual_ranges.range_fit import BIAS_M, BIAS_WALK_M, CLOCK_S
from ssm_graph.systems.visual_ranges.tag_rows import (
    DIM,
    N_RIG,
    OwnRows,
    TagProblem,
    TagValues,
    motion_rows,
    range_rows,
    sighting_rows,
)
from ssm_graph.systems.visual_ranges.weights import SIGMA_OF_MEDIAN, RangeKernel, robust_rms

START_SIGMA: Final = np.repeat([1e-3, 1e-3, 2.0, 2.0], 3)
"""Of the first knot, rad, m, m/s and rad/s: where it is, is the map's origin."""
FAR_M: Final = 1e3
"""Sigma of marks and anchors before they are measured."""
BASE_SHARE: Final = 0.01
"""Of the baseline's logarithm: a millimetre of a decimetre."""
RIG_TURN: Final = np.deg2rad(0.2)
"""Of a stereo rig's axes against those of its calibration, each angle: some pixels."""
DENSITY: Final = (5.0, 1.0, BIAS_WALK_M**2)
"""Of accelerations at first, rad^2/s^3 and m^2/s^3: a rig in the hand, 3 rad/s^2 and 1 m/s^2 for
half a second at a time; and of biases, m^2/s."""
UNITS: Final = np.repeat([0.3, 0.5, 1.0, 1.0], 3)
"""Steps of a knot, rad, m, m/s and rad/s, within which rows are taken to be straight."""
UNIT_M: Final = 0.5
"""The same of marks and anchors."""
MOST_DAMPING: Final = 1e6
KERNEL: Final[Kernel] = LogKernel(5.0)
"""Of a sighting, four numbers together."""
SETTLED: Final = 0.02
"""Sigmas by which the last step moves anything at most."""


@dataclass(frozen=True)
class TagWeights:
    """What is renewed from pass to pass."""

    sighting: Array
    """(n,)"""
    range: Array
    """(M,)"""
    density: Array
    """(3,) as of :func:`.tag_rows.motion_rows`"""
    is_trusting: bool = False
    """Whether sightings keep their weights: while a path grows, what is far off is the path."""
    damping: float = 1e-2
    """Of a step, as information of a step of ``UNITS``."""


class TagPass(NamedTuple):
    """One round: where it stands, and what is known there."""

    values: TagValues
    weights: TagWeights
    solution: ChainSolution
    sightings: OwnRows
    ranges: OwnRows
    cost: float
    update_sigmas: float


class _Rows(NamedTuple):
    sightings: OwnRows
    ranges: OwnRows
    motion: Array
    motion_error: Array
    first_error: Array
    border_error: Array


def _linearised(problem: TagProblem, values: TagValues, density: Array) -> _Rows:
    motion, motion_error = motion_rows(problem.time_s, values, density)
    first = np.concatenate([np.zeros(6), values.velocity[0], values.rate[0], values.biases[0]])
    border = np.zeros(values.n_constants)
    border[-5:] = values.clock_s, *values.turn, values.log_base
    return _Rows(
        sighting_rows(problem, values), range_rows(problem, values), motion, motion_error,
        first / _first_sigma(values), border / _border_sigma(values),
    )  # fmt: skip


def _first_sigma(values: TagValues) -> Array:
    """Return standard deviations (n,) of the first knot's prior."""
    return np.concatenate([START_SIGMA, np.full(len(values.anchors), BIAS_M)])


def _border_sigma(values: TagValues) -> Array:
    """Return standard deviations (C,) of the constants' prior."""
    sigma = np.full(values.n_constants, FAR_M)
    sigma[-5:] = CLOCK_S, *np.repeat(RIG_TURN, 3), BASE_SHARE
    return sigma


def _roots(weights: TagWeights, n_ranges: int) -> tuple[Array, Array]:
    return np.repeat(np.sqrt(weights.sighting), 4), np.sqrt(weights.range[:n_ranges])


def _cost(rows: _Rows, weights: TagWeights) -> float:
    seen, heard = _roots(weights, len(rows.ranges.error))
    parts = (
        seen * rows.sightings.error, heard * rows.ranges.error, rows.motion_error.ravel(),
        rows.first_error, rows.border_error,
    )  # fmt: skip
    return float(sum(part @ part for part in parts))


def _eliminated(rows: _Rows, weights: TagWeights, values: TagValues) -> ChainSolution:
    """Return the solution of the weighted, damped linear problem."""
    C, K, n = values.n_constants, len(values.place), values.dim
    damped = np.zeros((K, DIM, n + C + 1))
    damped[:, :, :DIM] = np.diag(np.sqrt(weights.damping) / UNITS)
    blocks, knots = [damped.reshape(K * DIM, -1)], [np.repeat(np.arange(K), DIM)]
    roots = _roots(weights, len(rows.ranges.error))
    for own, root in zip((rows.sightings, rows.ranges), roots, strict=True):
        on = np.flatnonzero(own.rows.any(axis=1))
        blocks.append(np.column_stack([own.rows[on], -own.error[on]]) * root[on, None])
        knots.append(own.knot[on])
    knot = np.concatenate(knots)
    order = np.argsort(knot, kind="stable")
    flat = np.concatenate(blocks)[order]
    first = np.searchsorted(knot[order], np.arange(K + 1))
    between = np.zeros((K - 1, n, 2 * n + C + 1))
    between[..., : 2 * n], between[..., -1] = rows.motion, -rows.motion_error
    prior = np.zeros((n, n + C + 1))
    prior[:, :n], prior[:, -1] = np.diag(1.0 / _first_sigma(values)), -rows.first_error
    chain = Chain(n, C)
    of_each = [flat[a:b] for a, b in itertools.pairwise(first.tolist())]
    chain.eliminate(prior, of_each, between, begin=0)
    border = np.zeros((C, C + 1))
    border[:, :C], border[:, -1] = np.diag(1.0 / _border_sigma(values)), -rows.border_error
    held = np.sqrt(weights.damping) / UNIT_M * np.eye(C - N_RIG, C + 1)
    return chain.solve(np.concatenate([border, held]))


def deviance(problem: TagProblem, values: TagValues, density: Array) -> float:
    """Return minus twice the log likelihood of all, with the kernels' tails, but for a constant."""
    rows = _linearised(problem, values, density)
    square = np.sum(rows.sightings.error.reshape(-1, 4) ** 2, axis=1)
    seen = KERNEL.similarity(np.zeros(1), dim=4) - KERNEL.similarity(square, dim=4)
    heard = RangeKernel().deviance(rows.ranges.error, np.ones_like(rows.ranges.error))
    rest = rows.motion_error.ravel(), rows.first_error, rows.border_error
    return float(2.0 * seen.sum() + heard.sum() + sum(part @ part for part in rest))


def one_pass(problem: TagProblem, values: TagValues, weights: TagWeights) -> TagPass:
    """Linearise, solve, move if the weighted cost falls, and weigh anew."""
    rows = _linearised(problem, values, weights.density)
    cost = _cost(rows, weights)
    while True:
        solution = _eliminated(rows, weights, values)
        moved = values.moved(solution.step, solution.constants_step)
        after = _linearised(problem, moved, weights.density)
        new_cost = _cost(after, weights)
        if new_cost <= cost * (1.0 + 1e-9) + 1e-9:
            break
        if weights.damping > MOST_DAMPING:
            moved, after, new_cost = values, rows, cost
            break
        weights = replace(weights, damping=10.0 * max(weights.damping, 1e-4))
    steps = np.concatenate([solution.step.ravel(), solution.constants_step])
    update = float(np.max(np.abs(steps) / solution.sigma))
    weights = replace(weights, damping=0.1 * min(weights.damping, 100.0))
    return TagPass(
        moved, _renewed(after, solution, weights), solution, after.sightings, after.ranges,
        new_cost, update,
    )  # fmt: skip


def _renewed(rows: _Rows, solution: ChainSolution, weights: TagWeights) -> TagWeights:
    """Return weights by residual and posterior variance."""
    own, sighting, heard = rows.sightings, weights.sighting, weights.range
    if not weights.is_trusting:
        square = own.error**2 + solution.variance(own.knot, own.rows)
        used = own.rows.any(axis=1).reshape(-1, 4).sum(axis=1)
        sighting = KERNEL.weight(square.reshape(-1, 4).sum(axis=1), dim=used)
    if len(rows.ranges.error):
        variance = solution.variance(rows.ranges.knot, rows.ranges.rows)
        heard = RangeKernel().weight(rows.ranges.error, variance, np.ones_like(rows.ranges.error))
    return replace(weights, sighting=sighting, range=heard)


def widened(problem: TagProblem, found: TagPass) -> TagProblem:
    """Return the problem with sigmas that are not below what residuals show, each anchor's own.

    Ranges that place no anchor have no residuals: their sigmas stay.
    """
    range_sigma = problem.range_sigma.copy()
    for j in range(len(found.values.anchors)):
        own = problem.anchor == j
        error = found.ranges.error[own] * range_sigma[own]
        range_sigma[own] = np.fmax(range_sigma[own], robust_rms(error))
    seen = np.abs(found.sightings.error[found.sightings.error != 0.0])
    wider = max(SIGMA_OF_MEDIAN * float(np.median(seen)), 1.0)
    return replace(problem, range_sigma=range_sigma, seen_sigma=wider * problem.seen_sigma)


def settle(
    problem: TagProblem,
    values: TagValues,
    weights: TagWeights,
    *,
    most: int,
    settled: float = SETTLED,
) -> TagPass:
    """Return the last of as many passes as it takes, ``most`` of them or until none moves much.

    Raises :class:`SolverError` where not even one can be made.
    """
    found = one_pass(problem, values, weights)
    for _ in range(most - 1):
        if found.update_sigmas < settled:
            break
        found = one_pass(problem, found.values, found.weights)
    if not np.isfinite(found.cost):
        raise SolverError("the path from marks and ranges is not finite: look at sigmas and times")
    return found
