"""The graph of a problem, linearised at any states and beam weights and solved.

The inertial factors are GTSAM's. Beams, depth and GNSS are rows over the error state, the walks of
their keyframe and the constants, in bulk. They are eliminated as a chain with a border: GTSAM's own
Jacobian factor takes three keys from Python, and its elimination of the chain alone takes longer.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ssm_graph.base.frozen import Array
from ssm_graph.engine.bordered import BorderedSolution, ChainRows, solve_bordered
from ssm_graph.engine.error_state import STATE_DIM
from ssm_graph.engine.marginal_prior import prior_at_start
from ssm_graph.graph.aids.aid import RowStates
from ssm_graph.graph.beam_rows import BeamRows, CalibratedBeams
from ssm_graph.graph.inertial_rows import inertial_graph, inertial_rows
from ssm_graph.graph.measurements import Measurements, states_at
from ssm_graph.graph.states import States, retract
from ssm_graph.imu.preintegration import gravity_gradient
from ssm_graph.mission.calibration import needs_motion
from ssm_graph.mission.problem import Problem, start_of

JUDGED_PASSES = 2
"""The first pass is at the states of the forward pass, the second at smoothed ones."""


class Misfit(NamedTuple):
    """How far one kind of measurement misses an answer."""

    sum_sq: float
    """Sum of its squared whitened errors"""
    n_rows: int
    n_factors: int


class Step(NamedTuple):
    """A step of keyframes, walks and constants."""

    solution: BorderedSolution

    @property
    def delta(self) -> tuple[Array, Array]:
        """Steps of keyframes and walks (K, 15 + s), and of the constants (C,)."""
        return self.solution.step, self.solution.constants_step

    @property
    def covariance(self) -> Array:
        """Of the error state of every keyframe, (K, 15, 15)."""
        return self.solution.covariance(STATE_DIM)

    @property
    def neighbour_covariance(self) -> Array:
        """Between every keyframe and the next, (K - 1, 15, 15)."""
        return self.solution.neighbour_covariance(STATE_DIM)

    @property
    def sigma(self) -> Array:
        """Of all components of the step, (K (15 + s) + C,)."""
        own = np.diagonal(self.solution.constants_cov)
        return np.asarray(np.sqrt(np.concatenate([self.solution.variances().ravel(), own])))

    @property
    def extras_covariance(self) -> Array:
        """Of the walks at the last keyframe and of the constants, (E, E)."""
        return self.solution.end_covariance(STATE_DIM)

    @property
    def walks_covariance(self) -> Array:
        """Of the walks of every keyframe, (K, s, s)."""
        n_states = self.solution.step.shape[1]
        return self.solution.covariance_of(slice(STATE_DIM, n_states))

    def variance(self, keyframe: NDArray[np.intp], rows: Array) -> Array:
        """Return ``H P H'`` (M,) of rows (M, 15 + s + C)."""
        return self.solution.variance(keyframe, rows)


class GraphLinearizer:
    """Linearises and solves the whole graph of a problem at any states and beam weights."""

    def __init__(self, problem: Problem) -> None:
        self.problem = problem
        self.inertial = inertial_graph(problem)
        self._gradient, self._span_s = gravity_gradient(problem.frame), np.diff(problem.keyframe_s)
        self.prior = prior_at_start(start_of(problem))
        self.aids, self.weighted = Measurements.in_full(problem), Measurements.weighted(problem)
        self._beams = CalibratedBeams(problem.beams, problem.extras, problem.frame)
        self._n_judged = 0
        factor, sigma = problem.extras.transitions(self._span_s)
        self._walk_factor, self._walk_sigma = factor, sigma

    def follow(self, states: States) -> bool:
        """Let gravity and the aids follow the states; to be called before the others.

        In the first passes, how much motion there is to calibrate by is judged anew: only smoothed
        states tell acceleration from a bias. Then the beams are to be linearised anew.
        """
        self.problem.chain.set_gravity(states.p_n)
        self.aids.follow(states)
        self.weighted.follow(states)
        if self._n_judged == JUDGED_PASSES or not needs_motion(self.problem.extras):
            return False
        self._n_judged += 1
        self._beams.judge(self._at_beams(states), states.bias)
        return True

    def beam_rows(self, states: States) -> BeamRows:
        """Linearise all beams at ``states``."""
        prepared = self._beams.prepare(states.walks, states.constants, states.bias)
        return self._beams.rows(self._at_beams(states), prepared)

    def solve(
        self,
        states: States,
        beam_rows: BeamRows,
        weights: Array,
        aid_weights: Array | None = None,
    ) -> Step:
        """Return the step at ``states``, with their beam rows and weights (M,).

        ``aid_weights`` are those of the weighted aids' measurements; all one when left out.
        """
        extras = self.problem.extras
        own, first = self._own_rows(states, beam_rows, weights, aid_weights)
        sigma = extras.sigma
        start = np.zeros((extras.state_dim, extras.width + 1))
        prior = self.prior.rows(states)
        start[:STATE_DIM, :STATE_DIM], start[:STATE_DIM, -1] = prior[:, :-1], prior[:, -1]
        walk, constant = np.arange(STATE_DIM, extras.state_dim), slice(extras.n_walks, None)
        start[walk, walk] = 1.0 / sigma[: extras.n_walks]
        start[STATE_DIM:, -1] = -states.walks[0] / sigma[: extras.n_walks]
        border = np.diag(1.0 / sigma[constant])
        rows = ChainRows(
            start=start,
            between=self._between(states),
            own=own,
            first=first,
            border=np.column_stack([border, -states.constants / sigma[constant]]),
        )
        return Step(solve_bordered(rows))

    def inertial_rows(self, states: States) -> Array:
        """Return the whitened rows (K - 1, 15, 31) of the inertial data at ``states``."""
        return inertial_rows(self.inertial, states, self._gradient, span_s=self._span_s)

    def retract(
        self, states: States, delta: tuple[Array, Array], *, scale: float = 1.0
    ) -> tuple[States, Array]:
        """Return the states moved by ``scale * delta``, and that step, flat."""
        step, constants_step = scale * delta[0], scale * delta[1]
        moved = retract(states, step, constants_step)
        return moved, np.concatenate([step.ravel(), constants_step])

    def cost(
        self,
        states: States,
        beam_rows: BeamRows,
        weights: Array,
        aid_weights: Array | None = None,
    ) -> float:
        """Return half the weighted sum of squares that :meth:`solve` makes least."""
        self.problem.chain.set_gravity(states.p_n)
        extras = self.problem.extras
        squares = np.sum(weights * (beam_rows.error / self.problem.beams.sigma) ** 2)
        squares += np.sum(self.prior.whitened(states) ** 2)
        squares += np.sum(self.aids.rows(states).error ** 2)
        squares += np.sum(self.weighted.rows(states, aid_weights).error ** 2)
        at_start = np.concatenate([states.walks[0], states.constants])
        squares += np.sum((at_start / extras.sigma) ** 2) + np.sum(self._walked(states) ** 2)
        return float(self.inertial.error(states.values) + 0.5 * squares)

    def misfits(self, states: States) -> dict[str, Misfit]:
        """Return the misfit of the aids and the inertial data, by name, where there are any."""
        n = self.inertial.size()
        found = {"inertial": Misfit(2.0 * self.inertial.error(states.values), n * STATE_DIM, n)}
        for aid in self.aids.all:
            error = aid.whitened(self.aids.at_keyframes(aid, states)).error
            found[aid.name] = Misfit(float(np.sum(error**2)), error.size, len(error))
        return {name: misfit for name, misfit in found.items() if misfit.n_factors}

    def _at_beams(self, states: States) -> RowStates:
        g_n = self.problem.frame.g_n_at(states.p_n)
        return states_at(states, self.problem.beams.keyframe, self.problem.extras, g_n=g_n)

    def _walked(self, states: States) -> Array:
        """Return the whitened errors (K - 1, s) of the walks."""
        went = states.walks[1:] - self._walk_factor * states.walks[:-1]
        return np.asarray(went / self._walk_sigma)

    def _between(self, states: States) -> Array:
        """Return the rows (K - 1, n, 2 n + C + 1) from each keyframe to the next."""
        extras = self.problem.extras
        n, n_intervals = extras.state_dim, self.problem.n_keyframes - 1
        begin, end, b = np.split(self.inertial_rows(states), [STATE_DIM, 2 * STATE_DIM], axis=2)
        between = np.zeros((n_intervals, n, n + extras.width + 1))
        between[:, :STATE_DIM, :STATE_DIM] = begin
        between[:, :STATE_DIM, n : n + STATE_DIM] = end
        between[:, :STATE_DIM, -1] = b[..., 0]
        for i in range(extras.n_walks):
            sigma, row = self._walk_sigma[:, i], STATE_DIM + i
            between[:, row, row] = -self._walk_factor[:, i] / sigma
            between[:, row, n + row] = 1.0 / sigma
            between[:, row, -1] = -self._walked(states)[:, i]
        return between

    def _own_rows(
        self,
        states: States,
        beam_rows: BeamRows,
        weights: Array,
        aid_weights: Array | None,
    ) -> tuple[Array, NDArray[np.intp]]:
        """Return all rows of one keyframe each (M, width + 1) in order, and where each begins."""
        beams = self.problem.beams
        scale = np.sqrt(weights) / beams.sigma
        whitened = np.column_stack([beam_rows.jacobian, -beam_rows.error]) * scale[:, None]
        keyframes, blocks = [beams.keyframe], [whitened]
        aid_rows = self.aids.rows(states), self.weighted.rows(states, aid_weights)
        for keyframe, error, jacobian in aid_rows:
            keyframes.append(keyframe)
            blocks.append(np.column_stack([jacobian, -error]))
        keyframe = np.concatenate(keyframes)
        order = np.argsort(keyframe, kind="stable")
        first = np.searchsorted(keyframe[order], np.arange(self.problem.n_keyframes + 1))
        return np.concatenate(blocks)[order], first
