"""The window of a fixed-lag smoother: its keyframes, its prior, and their iteration."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import gtsam
import numpy as np

from factors.similarity import Kernel, LogKernel, Similarity, expected_mahalanobis_sq
from ssm_graph.data import Array
from ssm_graph.errors import ConfigError, SolverError
from ssm_graph.graph.depth import rises
from ssm_graph.graph.linearize import BeamRows, GraphLinearizer
from ssm_graph.graph.marginal_prior import moved_chart, prior_at_start, prior_on_last
from ssm_graph.graph.solve import LinearSolution, marginal_covariances, solve_linear
from ssm_graph.graph.states import States, retract, states_from_arrays
from ssm_graph.imu.preintegration import gtsam_gravity
from ssm_graph.problem.error_state import STATE_DIM, Linearised
from ssm_graph.problem.problem import Problem, start_of
from ssm_graph.problem.timeline import MIN_SPACING_S
from ssm_graph.problem.window import rows_in, window_of
from ssm_graph.smoothers.mixing import Mixing

ROUNDING = 1e-7
"""Posterior sigmas: updates of a window of several keyframes come down to a few 1e-8 and stay."""


@dataclass(frozen=True, slots=True)
class FixedLagConfig:
    """Settings of the fixed-lag smoother."""

    lag_s: float = 30.0
    """Keyframes older than this are marginalised; zero makes it the filter."""
    kernel: Kernel = field(default_factory=LogKernel)
    similarity: Similarity = Similarity.EXPECTED
    max_iterations: int = 50
    tolerance: float = 1e-8
    """Largest update, in its own posterior sigmas, at which a keyframe's iteration ends; not below
    1e-7 while the window has several."""
    linearised: Linearised = Linearised.EACH_PASS

    def __post_init__(self) -> None:
        if not (np.isfinite(self.lag_s) and self.lag_s >= 0.0):
            raise ConfigError(f"lag_s: expected zero or more seconds, got {self.lag_s}")
        if self.max_iterations < 1:
            raise ConfigError(f"max_iterations: expected 1 or more, got {self.max_iterations}")
        if not 0.0 < self.tolerance < 1.0:
            raise ConfigError(f"tolerance: expected a number in (0, 1), got {self.tolerance}")
        if self.linearised is Linearised.ONCE and self.lag_s > 0.0:
            raise ConfigError(f"linearised once: expected with lag_s zero, got {self.lag_s}")


@dataclass(slots=True, eq=False)
class Track:
    """States, covariances and beams as they were at one moment of their keyframe's life."""

    R_nb: Array
    """(K, 3, 3)"""
    p_n: Array
    """(K, 3) m"""
    v_n: Array
    """(K, 3) m/s"""
    bias: Array
    """(K, 6) accelerometer m/s^2, gyro rad/s"""
    covariance: Array
    """(K, 15, 15)"""
    innovation: Array
    """(M,) m/s, measured minus predicted before the first update"""
    mahalanobis_sq: Array
    """(M,)"""
    weight: Array
    """(M,)"""

    @classmethod
    def empty(cls, n_keyframes: int, n_beams: int) -> Track:
        """Return a track to be filled."""
        shapes = ((3, 3), (3,), (3,), (6,), (STATE_DIM, STATE_DIM))
        R_nb, p_n, v_n, bias, covariance = (np.zeros((n_keyframes, *s)) for s in shapes)
        innovation, mahalanobis_sq = np.zeros((2, n_beams))
        weight = np.ones(n_beams)
        return cls(R_nb, p_n, v_n, bias, covariance, innovation, mahalanobis_sq, weight)


class _Settled(NamedTuple):
    """Outcome of a window's iteration."""

    states: States
    covariance: Array
    root: Array
    """(15, 15) square-root information of the newest keyframe, the others marginalised"""
    weights: Array
    mahalanobis_sq: Array
    n_passes: int


def _largest(step: Array, covariance: Array) -> float:
    """Return the largest component of a step (K, 15) in its posterior sigmas."""
    sigma = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    return float(np.max(np.abs(step) / sigma))


class Window:
    """The keyframes from ``first`` to ``last`` and the prior on the first."""

    def __init__(self, problem: Problem, config: FixedLagConfig) -> None:
        self._problem, self._config = problem, config
        self.track = Track.empty(problem.n_keyframes, len(problem.beams.speed))
        self._first, self._last = 0, -1
        self._rise = np.zeros(problem.n_keyframes)
        start = start_of(problem)
        self._put(slice(0, 1), *(column[None] for column in start[:4]))
        self._prior = self._posterior = prior_at_start(start)

    @property
    def _keyframes(self) -> range:
        return range(self._first, self._last + 1)

    def advance(self, k: int) -> None:
        """Predict keyframe ``k`` and marginalise what the lag leaves behind."""
        if k > 0:
            self._predict(k)
        self._last = k
        self._note_rise(k)
        oldest_s = self._problem.keyframe_s[k] - self._config.lag_s - MIN_SPACING_S
        first = int(np.searchsorted(self._problem.keyframe_s[: k + 1], oldest_s))
        if first > self._first:
            self._marginalise(first)

    def iterate(self) -> int:
        """Reweight and solve the window until it has settled; return the number of passes."""
        window = window_of(self._problem, self._keyframes)
        linearizer = self._linearizer(window)
        states = self._states()
        linearizer.follow_depth(states)
        rows = rows_in(self._problem.beams.keyframe, self._keyframes)
        settle = self._settle if self._config.linearised is Linearised.EACH_PASS else self._reweigh
        at = linearizer.beam_rows(states)
        is_new = window.beams.keyframe == window.n_keyframes - 1
        self.track.innovation[rows][is_new] = -at.error[is_new]
        settled = settle(linearizer, states, at, self.track.weight[rows])
        self._keep(settled, rows)
        has_measurement = (
            len(window.beams.speed) or linearizer.depth.size() + linearizer.gnss.size()
        )
        return settled.n_passes if has_measurement or window.n_keyframes > 1 else 0

    def _settle(
        self, linearizer: GraphLinearizer, states: States, beam_rows: BeamRows, weights: Array
    ) -> _Settled:
        """Solve and reweigh, everything linearised anew at each pass."""
        config, n_keyframes = self._config, linearizer.problem.n_keyframes
        tolerance = max(config.tolerance, ROUNDING) if n_keyframes > 1 else config.tolerance
        mixing = Mixing()
        for number in range(1, config.max_iterations + 1):
            if n_keyframes > 1:  # a single keyframe keeps what its prediction came with
                linearizer.follow(states)
            solution, covariance = self._solve(linearizer, states, beam_rows, weights)
            states, update = retract(states, solution.delta)
            beam_rows = linearizer.beam_rows(states)
            t = self._mahalanobis_sq(linearizer.problem, beam_rows, covariance)
            if _largest(update, covariance) < tolerance:
                break
            if number < config.max_iterations:
                settled = config.kernel.weight(t)
                # A single keyframe's weights are those of the filter, pass by pass.
                weights = mixing.next_weights(weights, settled) if n_keyframes > 1 else settled
        root = solution.R[-1]
        return _Settled(states, covariance, root, weights, t, number)

    def _reweigh(
        self, linearizer: GraphLinearizer, states: States, at: BeamRows, weights: Array
    ) -> _Settled:
        """Solve and reweigh a single keyframe, linearised at its prediction only."""
        config = self._config
        before = np.zeros((1, STATE_DIM))
        for number in range(1, config.max_iterations + 1):
            solution, covariance = self._solve(linearizer, states, at, weights)
            moved, step = retract(states, solution.delta)
            left = BeamRows(at.error + at.jacobian @ step[0], at.jacobian)
            t = self._mahalanobis_sq(linearizer.problem, left, covariance)
            if _largest(step - before, covariance) < config.tolerance:
                break
            before = step
            if number < config.max_iterations:
                weights = config.kernel.weight(t)
        J = moved_chart(step[0])
        covariance = J @ covariance @ J.T
        root = solution.R[-1] @ np.linalg.inv(J)
        return _Settled(moved, covariance, root, weights, t, number)

    def _solve(
        self, linearizer: GraphLinearizer, states: States, rows: BeamRows, weights: Array
    ) -> tuple[LinearSolution, Array]:
        problem = linearizer.problem
        linear = linearizer.linearize(states, rows, weights)
        solution = solve_linear(linear, linearizer.ordering, n_keyframes=problem.n_keyframes)
        covariance = marginal_covariances(solution)
        if not np.all(np.isfinite(covariance)):
            raise SolverError(
                f"the window ending at {problem.keyframe_s[-1]:.3f} s has no finite solution; "
                "check noise and time stamps of [imu] there"
            )
        return solution, covariance

    def _keep(self, settled: _Settled, rows: slice) -> None:
        track, at = self.track, slice(self._first, self._last + 1)
        self._posterior = prior_on_last(settled.states, settled.root, step=np.zeros(STATE_DIM))
        self._put(at, *settled.states[1:])
        track.covariance[at] = settled.covariance
        track.weight[rows], track.mahalanobis_sq[rows] = settled.weights, settled.mahalanobis_sq

    def copy_newest(self, newest: Track) -> None:
        """Keep the newest keyframe as it is now."""
        k = self._last
        rows = rows_in(self._problem.beams.keyframe, range(k, k + 1))
        for name in ("R_nb", "p_n", "v_n", "bias", "covariance"):
            getattr(newest, name)[k] = getattr(self.track, name)[k]
        for name in ("innovation", "mahalanobis_sq", "weight"):
            getattr(newest, name)[rows] = getattr(self.track, name)[rows]

    def _predict(self, k: int) -> None:
        track, chain = self.track, self._problem.chain
        i = k - 1
        span = self._problem.keyframe_s[k] - self._problem.keyframe_s[i]
        middle = track.p_n[i] + 0.5 * span * track.v_n[i]
        chain.params[i].n_gravity = gtsam_gravity(chain.frame, middle)
        state = gtsam.NavState(gtsam.Rot3(track.R_nb[i]), track.p_n[i], track.v_n[i])
        bias = track.bias[i]
        predicted = chain.measurements[i].predict(
            state, gtsam.imuBias.ConstantBias(bias[:3], bias[3:])
        )
        self._put(
            slice(k, k + 1),
            predicted.attitude().matrix()[None],
            predicted.position()[None],
            predicted.velocity()[None],
            bias[None],
        )

    def _marginalise(self, first: int) -> None:
        """Leave a prior on keyframe ``first``, made at the present states and weights."""
        problem, left = self._problem, range(self._first, first)
        if first == self._last:
            # Of a window that goes as a whole, the posterior of its end is all that counts.
            self._prior, self._first, left = self._posterior, first - 1, range(first, first)
        keyframes = range(self._first, first + 1)
        window = window_of(problem, keyframes, measured=left)
        linearizer = self._linearizer(window)
        states = self._states(keyframes)
        linearizer.follow_depth(states)
        weights = self.track.weight[rows_in(problem.beams.keyframe, left)]
        linear = linearizer.linearize(states, linearizer.beam_rows(states), weights)
        solution = solve_linear(linear, linearizer.ordering, n_keyframes=len(keyframes))
        self._prior = prior_on_last(states, solution.R[-1], step=solution.last_step())
        self._first = first

    def _linearizer(self, window: Problem) -> GraphLinearizer:
        return GraphLinearizer(window, prior=self._prior, first_rise=float(self._rise[self._first]))

    def _note_rise(self, k: int) -> None:
        """Keep how the depth sensor rose since its readings: it cannot be known later."""
        if k == 0 or self._problem.depths is None:
            return
        pair = range(k - 1, k + 1)
        window = window_of(self._problem, pair)
        assert window.depths is not None
        states = self._states(pair)
        self._rise[k] = rises(window.depths, states, window.frame, window.keyframe_s)[1]

    def _states(self, keyframes: range | None = None) -> States:
        keyframes = self._keyframes if keyframes is None else keyframes
        at, track = slice(keyframes.start, keyframes.stop), self.track
        return states_from_arrays(track.R_nb[at], track.p_n[at], track.v_n[at], track.bias[at])

    def _put(self, at: slice, R_nb: Array, p_n: Array, v_n: Array, bias: Array) -> None:
        track = self.track
        track.R_nb[at], track.p_n[at], track.v_n[at], track.bias[at] = R_nb, p_n, v_n, bias

    def _mahalanobis_sq(self, window: Problem, rows: BeamRows, covariance: Array) -> Array:
        H, beams = rows.jacobian, window.beams
        spread = np.zeros(len(H))
        if self._config.similarity is Similarity.EXPECTED:
            spread = np.einsum("mi,mij,mj->m", H, covariance[beams.keyframe], H, optimize=True)
        return expected_mahalanobis_sq(rows.error, spread, sigma=beams.sigma)
