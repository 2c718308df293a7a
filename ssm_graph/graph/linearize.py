"""The graph of a problem, linearised at any states and beam weights and solved.

All measurements are rows over the error state and the walks of their keyframe, or of two successive
ones, and the constants, in bulk. They are eliminated as a chain with a border.
"""

from __future__ import annotations

import itertools
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ssm_graph.base.frozen import Array
from ssm_graph.base.stepwise import Steps, finished
from ssm_graph.engine.chain import Chain, ChainSolution
from ssm_graph.engine.error_state import STATE_DIM
from ssm_graph.engine.extras import with_extras
from ssm_graph.engine.marginal_prior import prior_at_start
from ssm_graph.engine.states import States
from ssm_graph.graph.aids.aid import RowStates
from ssm_graph.graph.beam_rows import BeamRows, CalibratedBeams
from ssm_graph.graph.freed import FAULTS, Freed
from ssm_graph.graph.inertial_rows import InertialRows
from ssm_graph.graph.measurements import Measurements, states_at
from ssm_graph.mission.calibration import needs_motion
from ssm_graph.mission.imu_variables import imu_errors
from ssm_graph.mission.problem import Problem, start_of

JUDGED_PASSES = 2
"""The first pass is at the states of the forward pass, the second at smoothed ones."""
ERRORS_REACH = 1e-2
"""How far errors of the inertial sensors, shares of what is read, may move before the increments
are made anew; the rest counts to first order along each, which loses half the square of the turn
that it makes of one interval."""


class Misfit(NamedTuple):
    """How far the inertial data miss an answer."""

    sum_sq: float
    """Sum of its squared whitened errors"""
    n_rows: int
    n_factors: int


class GraphLinearizer:
    """Linearises and solves the whole graph of a problem at any states and beam weights."""

    def __init__(self, problem: Problem, freed: Freed | None = None) -> None:
        """Take a problem, and what sensors are off by: with the last of its constants for it."""
        self.problem, self.freed = problem, freed
        self.intervals = problem.chain.intervals
        """Of the inertial data, about errors of the sensors near the states"""
        self._chain = problem.chain
        self._inertial = InertialRows(problem.frame, problem.extras)
        self.prior = prior_at_start(with_extras(start_of(problem), problem.extras.walks))
        self.weighted = Measurements.of_problem(problem, freed)
        self._beams = CalibratedBeams(problem.beams, problem.extras, problem.frame)
        self._n_judged = 0

    def follow(self, states: States) -> bool:
        """Let the aids follow the states; to be called before the others.

        In the first passes, how much motion there is to calibrate by is judged anew: only smoothed
        states tell acceleration from a bias. Then the beams are to be linearised anew.
        """
        self.weighted.follow(states)
        if self._n_judged == JUDGED_PASSES or not needs_motion(self.problem.extras):
            return False
        self._n_judged += 1
        self._beams.judge(self._at_beams(states), states.bias)
        return True

    def integrate_steps(self, states: States) -> Steps[None]:
        """Preintegrate anew where errors of the inertial sensors have moved too far."""
        source = self._chain.source
        if source is None:
            return
        errors, _ = imu_errors(self.problem.extras, states.walks[0], states.constants)
        if np.abs(errors - source.errors).max() > ERRORS_REACH:
            self._chain = yield from self._chain.about_steps(errors)
            self.intervals = self._chain.intervals

    def beam_rows(self, states: States) -> BeamRows:
        """Linearise all beams at ``states``."""
        prepared = self._beams.prepare(states.walks, states.constants, states.bias)
        if self.freed is None:
            return self._beams.rows(self._at_beams(states), prepared)
        off_by, instrument = self._off_by(states), prepared.instrument
        held_b = self.freed.held(instrument.beam_b, off_by)
        prepared = prepared._replace(instrument=instrument._replace(beam_b=held_b))
        rows = self._beams.rows(self._at_beams(states), prepared)
        own = self.freed.on_beams(self.problem, states, instrument.beam_b, off_by)
        rows.jacobian[:, self.problem.extras.columns(FAULTS)] = own
        return rows._replace(error=rows.error + self.freed.beams @ off_by)

    def solve(
        self, states: States, beam_rows: BeamRows, weights: Array, aid_weights: Array | None = None
    ) -> ChainSolution:
        """Return the step at ``states``, with their beam rows and weights (M,).

        ``aid_weights`` are those of the aids' measurements; all one when left out.
        """
        return finished(self.solve_steps(states, beam_rows, weights, aid_weights))

    def solve_steps(
        self, states: States, beam_rows: BeamRows, weights: Array, aid_weights: Array | None = None
    ) -> Steps[ChainSolution]:
        """Make :meth:`solve` in steps."""
        keyframe, own = self._own_rows(states, beam_rows, weights, aid_weights)
        yield 0.005 * self.problem.n_keyframes
        between = self.inertial_rows(states)
        yield 0.02 * self.problem.n_keyframes
        return (yield from self.solve_rows_steps(states, keyframe, own, between))

    def solve_rows_steps(
        self, states: States, keyframe: NDArray[np.intp], own: Array, between: Array
    ) -> Steps[ChainSolution]:
        """Solve rows (R, width + 1) of one keyframe each, in their order, and those between."""
        extras, prior = self.problem.extras, self.prior.rows(states)
        n, constants = extras.state_dim, np.zeros((extras.state_dim, extras.n_constants))
        chain = Chain(n, extras.n_constants)
        first = np.searchsorted(keyframe, np.arange(self.problem.n_keyframes + 1)).tolist()
        yield from chain.eliminate_steps(
            np.hstack([prior[:, :n], constants, prior[:, n:]]),
            [own[begin:end] for begin, end in itertools.pairwise(first)],
            between,
            begin=0,
        )
        sigma = extras.sigma[extras.n_walks :]
        border = np.column_stack([np.diag(1.0 / sigma), -states.constants / sigma])
        return (yield from chain.solve_steps(border))

    @property
    def has_freed_beam(self) -> NDArray[np.bool_]:
        """Which of the beam speeds (M,) something was freed on."""
        if self.freed is None:
            return np.zeros(len(self.problem.beams.speed), np.bool_)
        return self.freed.has_beam

    def inertial_rows(self, states: States) -> Array:
        """Return the rows of inertial data and walks, see :class:`InertialRows`."""
        rows = self._inertial.rows(self.intervals, states)
        if self.freed is not None:
            own, extras = self.freed.between, self.problem.extras
            columns = extras.columns(FAULTS)
            rows[:, :STATE_DIM, extras.state_dim :][..., columns] = own
            rows[:, :STATE_DIM, -1] -= own @ self._off_by(states)
        return rows

    def inertial_errors(self, states: States) -> Array:
        """Return the whitened errors (K - 1, n) of inertial data, then of the walks."""
        errors = self._inertial.errors(self.intervals, states)
        if self.freed is not None:
            errors[:, :STATE_DIM] += self.freed.between @ self._off_by(states)
        return errors

    def cost(
        self, states: States, beam_rows: BeamRows, weights: Array, aid_weights: Array | None = None
    ) -> float:
        """Return half the weighted sum of squares that :meth:`solve` makes least."""
        squares = np.sum(weights * (beam_rows.error / self.problem.beams.sigma) ** 2)
        squares += np.sum(self.prior.whitened(states) ** 2)
        squares += np.sum(self.weighted.rows(states, aid_weights).error ** 2)
        constants_sigma = self.problem.extras.sigma[self.problem.extras.n_walks :]
        squares += np.sum((states.constants / constants_sigma) ** 2)
        squares += np.sum(self.inertial_errors(states) ** 2)
        return float(0.5 * squares)

    def inertial_misfit(self, states: States) -> Misfit:
        """Return how far the inertial data miss these states."""
        errors = self.inertial_errors(states)[:, :STATE_DIM]
        return Misfit(float(np.sum(errors**2)), errors.size, len(errors))

    def _off_by(self, states: States) -> Array:
        """Return what sensors are off by (F,)."""
        assert self.freed is not None
        return states.constants[len(states.constants) - len(self.freed.sigma) :]

    def _at_beams(self, states: States) -> RowStates:
        g_n = self.problem.frame.g_n_at(states.p_n)
        return states_at(states, self.problem.beams.keyframe, self.problem.extras, g_n=g_n)

    def _own_rows(
        self, states: States, beam_rows: BeamRows, weights: Array, aid_weights: Array | None
    ) -> tuple[NDArray[np.intp], Array]:
        """Return the rows (R, width + 1) of one keyframe alone, in the order of these."""
        beams = self.problem.beams
        scale = np.sqrt(weights) / beams.sigma
        whitened = np.column_stack([beam_rows.jacobian, -beam_rows.error]) * scale[:, None]
        keyframes, blocks = [beams.keyframe], [whitened]
        keyframe, error, jacobian = self.weighted.rows(states, aid_weights)
        keyframes.append(keyframe)
        blocks.append(np.column_stack([jacobian, -error]))
        keyframe = np.concatenate(keyframes)
        order = np.argsort(keyframe, kind="stable")
        return keyframe[order], np.concatenate(blocks)[order]
