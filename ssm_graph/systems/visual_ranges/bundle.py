"""Bundle adjustment: poses, points, and scale, anchors and biases of ranges, with weights.

Levenberg-Marquardt on the reduced system. Every reprojection has a similarity weight (log kernel,
two dimensions) of ``t = (e^2 + J P J^T) / sigma^2``, renewed at every step; the posterior part
``J P J^T`` is computed at the steps that :class:`Effort` names, since it takes the inverse. Further
terms, those of ranges, join by :class:`FurtherTerms`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from factors import so3
from ssm_graph.systems.visual_ranges import bundle_rows
from ssm_graph.systems.visual_ranges.bundle_rows import Reduced, Views
from ssm_graph.systems.visual_ranges.geometry import DOF, orthonormal

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
Mask = NDArray[np.bool_]


class FurtherRows(NamedTuple):
    """Whitened scalar rows, each of one pose or two and of the further variables."""

    error: Array
    """(M,)"""
    pose: Indices
    """(M,) pose each hangs on"""
    by_pose: Array
    """(M, 6)"""
    by_extra: Array
    """(M, E)"""
    second: Indices | None = None
    """(M,) other pose that each hangs on, -1 for none; None: no row has one"""
    by_second: Array | None = None
    """(M, 6)"""


class FurtherTerms(Protocol):
    """Terms of poses and of variables of their own (scale, anchors, biases, clock)."""

    @property
    def n_extra(self) -> int:
        """Number of variables E."""

    @property
    def prior(self) -> Array:
        """Information (E, E) of the variables' prior."""

    def rows(self, R_cw: Array, t_cw: Array, extra: Array) -> FurtherRows:
        """Return whitened rows at poses (K, ...) and a change (E,) of the variables from now."""

    def prior_error(self, extra: Array) -> Array:
        """Return (E,) by how much the changed variables are off their prior's mean."""

    def weights(self, error: Array, variance: Array) -> Array:
        """Return similarity weights (M,) of whitened errors and their predictions' variance."""


@dataclass(frozen=True)
class Problem:
    """What to adjust."""

    R_cw: Array
    """(K, 3, 3)"""
    t_cw: Array
    """(K, 3)"""
    free: Mask
    """(K,) poses that may move"""
    points: Array
    """(P, 3), each with at least one view"""
    views: Views
    further: FurtherTerms | None = None
    variance: Array | None = None
    """(n,) of the reprojections' predictions, as known from before."""


@dataclass(frozen=True)
class Effort:
    """How long to try."""

    steps: int = 6
    settled: float = 1e-6
    """Relative change of the cost that ends it."""
    posterior_from: int | None = 3
    """Step from which the posterior variance is in the weights; None: nowhere, and no
    covariance."""
    dof: float = DOF
    """Of the reprojections' weights; infinite: least squares."""
    hold_scale: bool = False
    """Hold the distance of the two outermost poses: the gauge, when only one pose is held."""


@dataclass(frozen=True)
class Adjusted:
    """What came out."""

    R_cw: Array
    t_cw: Array
    points: Array
    extra: Array
    """(E,) change of the further variables"""
    square: Array
    """(n,) squared whitened reprojection errors"""
    weight: Array
    """(n,) weights of the reprojections"""
    variance: Array
    """(n,) of their predictions, in sigmas; zero without posterior"""
    further_weight: Array
    """(M,)"""
    covariance: Array
    """(K, 6, 6) of each pose; zero where held; NaN without posterior"""
    extra_covariance: Array
    """(E, E)"""
    cost: float
    """half the weighted sum of squares"""


class _State(NamedTuple):
    R_cw: Array
    t_cw: Array
    points: Array
    extra: Array


def adjust(problem: Problem, effort: Effort = Effort()) -> Adjusted:
    """Return the adjusted problem."""
    return _Adjustment(problem, effort).run()


class _Adjustment:
    """One run of Levenberg-Marquardt with weights."""

    def __init__(self, problem: Problem, effort: Effort) -> None:
        self.problem, self.effort = problem, effort
        self.column = np.where(problem.free, np.cumsum(problem.free) - 1, -1)
        self.n_poses = 6 * int(problem.free.sum())
        self.n_extra = problem.further.n_extra if problem.further else 0
        n = len(problem.views.point)
        self.variance = np.zeros(n) if problem.variance is None else problem.variance
        self.further_variance: Array | None = None
        self.covariance: Array | None = None
        self.gauge = self._gauge() if effort.hold_scale else None

    def run(self) -> Adjusted:
        """Return the adjusted problem."""
        problem, effort = self.problem, self.effort
        state = _State(problem.R_cw, problem.t_cw, problem.points, np.zeros(self.n_extra))
        damping = 1e-5
        error = bundle_rows.errors(*state[:3], problem.views)
        for step in range(effort.steps):
            if effort.posterior_from is not None and step == effort.posterior_from:
                self._take_posterior(state)
            weight, further_weight = self._weights(state, error)
            cost = self._cost(state, error, weight, further_weight)
            accepted = False
            for _ in range(5):
                moved = self._step(state, weight, further_weight, damping)
                new_error = bundle_rows.errors(*moved[:3], problem.views)
                new_cost = self._cost(moved, new_error, weight, further_weight)
                if new_cost <= cost * (1.0 + 1e-12):
                    accepted = True
                    break
                damping *= 10.0
            if not accepted:
                break
            state, error, damping = moved, new_error, max(damping * 0.2, 1e-9)
            late = effort.posterior_from is None or step >= effort.posterior_from
            if late and cost - new_cost < effort.settled * cost:
                break
        return self._answer(state, error)

    def _weights(self, state: _State, error: Array) -> tuple[Array, Array]:
        square = (error * error).sum(axis=1) + 2.0 * self.variance
        dof = self.effort.dof
        weight = np.ones(len(square)) if np.isinf(dof) else (dof + 2.0) / (dof + square)
        further = self.problem.further
        if further is None:
            return weight, np.zeros(0)
        rows = further.rows(state.R_cw, state.t_cw, state.extra)
        variance = self.further_variance
        return weight, further.weights(
            rows.error, np.zeros(len(rows.error)) if variance is None else variance
        )

    def _cost(self, state: _State, error: Array, weight: Array, further_weight: Array) -> float:
        cost = float(weight @ (error * error).sum(axis=1))
        further = self.problem.further
        if further is not None:
            rows = further.rows(state.R_cw, state.t_cw, state.extra)
            prior = further.prior_error(state.extra)
            cost += float(further_weight @ rows.error**2) + float(prior @ further.prior @ prior)
        if self.gauge is not None:
            cost += self._gauge_error(state) ** 2
        return 0.5 * cost

    def _system(
        self, state: _State, weight: Array, further_weight: Array, damping: float
    ) -> tuple[Reduced, Array, Array]:
        """Return the reduced system, and matrix and slope with the further variables."""
        problem = self.problem
        reduced = bundle_rows.reduced(*state[:3], problem.views, weight, self.column, damping)
        n = self.n_poses + self.n_extra
        matrix, slope = np.zeros((n, n)), np.zeros(n)
        matrix[: self.n_poses, : self.n_poses] = reduced.matrix
        slope[: self.n_poses] = reduced.slope
        if problem.further is not None:
            self._add_further(problem.further, state, further_weight, matrix, slope)
        if self.gauge is not None:
            self._add_gauge(state, matrix, slope)
        matrix[np.diag_indices(n)] += 1e-9
        return reduced, matrix, slope

    def _step(self, state: _State, weight: Array, further_weight: Array, damping: float) -> _State:
        reduced, matrix, slope = self._system(state, weight, further_weight, damping)
        try:
            step = -linalg.cho_solve(linalg.cho_factor(matrix, check_finite=False), slope)
        except linalg.LinAlgError:
            return state
        poses = step[: self.n_poses]
        points = state.points + bundle_rows.point_steps(
            reduced, self.problem.views, self.column, poses
        )
        xi = poses.reshape(-1, 6)
        R, t, free = state.R_cw.copy(), state.t_cw.copy(), self.problem.free
        turn = so3.exp(xi[:, 3:])
        R[free] = orthonormal(turn @ R[free])
        t[free] = np.einsum("kij,kj->ki", turn, t[free]) + xi[:, :3]
        return _State(R, t, points, state.extra + step[self.n_poses :])

    def _add_further(
        self, further: FurtherTerms, state: _State, weight: Array, matrix: Array, slope: Array
    ) -> None:
        rows = further.rows(state.R_cw, state.t_cw, state.extra)
        P, E = self.n_poses, self.n_extra
        system = np.zeros((P // 6, P // 6, 6, 6))
        across, pull = np.zeros((P // 6, 6, E)), np.zeros((P // 6, 6))
        ends = [(self.column[rows.pose], rows.by_pose)]
        if rows.second is not None and rows.by_second is not None:
            column = np.where(rows.second >= 0, self.column[rows.second], -1)
            ends.append((column, rows.by_second))
        for block, by_pose in ends:
            on = block >= 0
            weighted = by_pose[on] * weight[on, None]
            np.add.at(pull, block[on], weighted * rows.error[on, None])
            np.add.at(across, block[on], weighted[:, :, None] * rows.by_extra[on, None, :])
            for other, by_other in ends:
                both = on & (other >= 0)
                products = (by_pose[both] * weight[both, None])[:, :, None] * by_other[both, None]
                np.add.at(system, (block[both], other[both]), products)
        matrix[:P, :P] += system.transpose(0, 2, 1, 3).reshape(P, P)
        slope[:P] += pull.reshape(-1)
        if not E:
            return
        flat = across.reshape(P, E)
        matrix[:P, P:] += flat
        matrix[P:, :P] += flat.T
        matrix[P:, P:] += (rows.by_extra * weight[:, None]).T @ rows.by_extra + further.prior
        slope[P:] += (rows.by_extra * weight[:, None]).T @ rows.error
        slope[P:] += further.prior @ further.prior_error(state.extra)

    def _gauge(self) -> tuple[int, int, float]:
        """Return two poses far apart, and their distance."""
        centre = -np.einsum("kji,kj->ki", self.problem.R_cw, self.problem.t_cw)
        a = int(np.flatnonzero(~self.problem.free)[0]) if (~self.problem.free).any() else 0
        away = np.linalg.norm(centre - centre[a], axis=1)
        b = int(np.argmax(np.where(self.problem.free, away, -1.0)))
        return a, b, max(float(away[b]), 1e-9)

    def _gauge_error(self, state: _State) -> float:
        assert self.gauge is not None
        a, b, length = self.gauge
        base = state.R_cw[a].T @ state.t_cw[a] - state.R_cw[b].T @ state.t_cw[b]
        return float((np.linalg.norm(base) / length - 1.0) * _GAUGE)

    def _add_gauge(self, state: _State, matrix: Array, slope: Array) -> None:
        assert self.gauge is not None
        a, b, length = self.gauge
        base = state.R_cw[a].T @ state.t_cw[a] - state.R_cw[b].T @ state.t_cw[b]
        along = base / np.linalg.norm(base) / length * _GAUGE
        error = self._gauge_error(state)
        # c = -R^T t, so dc = -R^T rho under the left perturbation: rotation drops out.
        for pose, sign in ((b, -1.0), (a, 1.0)):
            k = self.column[pose]
            if k >= 0:
                J = sign * state.R_cw[pose] @ along
                at = slice(6 * k, 6 * k + 3)
                matrix[at, at] += np.outer(J, J)
                slope[at] += J * error

    def _take_posterior(self, state: _State) -> None:
        """Compute the covariance and from it the variance of every prediction."""
        error = bundle_rows.errors(*state[:3], self.problem.views)
        weight, further_weight = self._weights(state, error)
        reduced, matrix, _ = self._system(state, weight, further_weight, 0.0)
        factor = linalg.cho_factor(matrix, lower=True, check_finite=False)
        covariance = linalg.cho_solve(factor, np.eye(len(matrix)), check_finite=False)
        self.covariance = covariance
        P = np.ascontiguousarray(covariance[: self.n_poses, : self.n_poses])
        self.variance = bundle_rows.variances(
            *state[:3], self.problem.views, reduced, self.column, P
        )
        further = self.problem.further
        if further is not None:
            self.further_variance = self._variance_of(further, state, covariance)

    def _variance_of(self, further: FurtherTerms, state: _State, covariance: Array) -> Array:
        rows = further.rows(state.R_cw, state.t_cw, state.extra)
        ends = [(rows.pose, rows.by_pose)]
        if rows.second is not None and rows.by_second is not None:
            ends.append((rows.second, rows.by_second))
        columns, parts = [], []
        if self.n_poses:
            for pose, by_pose in ends:
                block = np.where(pose >= 0, self.column[pose], -1)
                columns.append(np.maximum(block, 0)[:, None] * 6 + np.arange(6))
                parts.append(by_pose * (block >= 0)[:, None])
        extra = self.n_poses + np.arange(self.n_extra)
        columns.append(np.broadcast_to(extra, (len(rows.error), self.n_extra)))
        column, J = np.concatenate(columns, axis=1), np.concatenate([*parts, rows.by_extra], axis=1)
        shared = covariance[column[:, :, None], column[:, None, :]]
        return np.asarray(np.einsum("ma,mab,mb->m", J, shared, J))

    def _answer(self, state: _State, error: Array) -> Adjusted:
        if self.effort.posterior_from is not None:
            self._take_posterior(state)
        weight, further_weight = self._weights(state, error)
        K = len(state.R_cw)
        covariance = np.full((K, 6, 6), np.nan)
        extra_covariance = np.full((self.n_extra, self.n_extra), np.nan)
        if self.covariance is not None:
            covariance[:] = 0.0
            full = self.covariance[: self.n_poses, : self.n_poses].reshape(
                self.n_poses // 6, 6, -1, 6
            )
            which = np.arange(self.n_poses // 6)
            covariance[self.problem.free] = full[which, :, which, :]
            extra_covariance = self.covariance[self.n_poses :, self.n_poses :]
        return Adjusted(
            *state[:3],
            extra=state.extra,
            square=(error * error).sum(axis=1),
            weight=weight,
            variance=self.variance,
            further_weight=further_weight,
            covariance=covariance,
            extra_covariance=extra_covariance,
            cost=self._cost(state, error, weight, further_weight),
        )


_GAUGE = 1e4
"""One over the sigma by which the gauge's distance is held, relative."""


def sorted_views(pose: Indices, point: Indices, xy: Array, scale: Array, n_points: int) -> Views:
    """Return observations sorted by point; every point has to have one."""
    order = np.argsort(point, kind="stable")
    first = np.searchsorted(point[order], np.arange(n_points + 1))
    return Views(first, point[order], pose[order], xy[order], scale[order])
