"""First values and weights for the smoother: one robust pass forwards in time.

Robust weights must not start from a contaminated least-squares solution, which hides the culprit.
Here every beam meets the inertial prediction first, which no fault of a beam can have touched, and
the weights of one ping settle before the next.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from factors.similarity import Kernel
from ssm_graph.base.errors import SolverError
from ssm_graph.base.frozen import Array, ShortRepr
from ssm_graph.base.progress import told
from ssm_graph.base.stepwise import Steps, finished
from ssm_graph.engine.error_state import POSITION, ROTATION, STATE_DIM, VELOCITY
from ssm_graph.engine.extras import Extras
from ssm_graph.engine.states import NavigationStates, States
from ssm_graph.graph.aids.aid import RowStates
from ssm_graph.graph.beacon_start import find_beacons
from ssm_graph.graph.beam_rows import BeamRows, linearize_beams
from ssm_graph.graph.feature_start import find_features
from ssm_graph.graph.first_weights import met_weights, settle_weights, updated_trust
from ssm_graph.graph.forward_pass import AidsOfKeyframe, ForwardAids, ForwardExtras
from ssm_graph.graph.inertial_rows import InertialRows
from ssm_graph.graph.measurements import Measurements
from ssm_graph.imu.preintegration import gravity_gradient, gtsam_gravity
from ssm_graph.mission.imu_variables import GYRO_SCALE
from ssm_graph.mission.problem import Problem, start_of

LOCKED_OUT_PINGS = 3
"""After so many pings in a row without one good beam the prediction is doubted instead."""
ANCHOR_SIGMA = 1.0
"""m/s; after a silence that leaves the beams this uncertain they set the velocity anew."""
UNSURE_SCALE = 0.1
"""Prior sigma of the gyros' scale from which on a turn may go anywhere."""
BEGINS = (0.0, -0.5, 0.5, -1.0, 1.0)
"""Prior sigmas of it that passes begin at then."""
AID_ROUNDS = 5
"""How often the aids of a keyframe are linearised anew."""
AID_REACH = 0.1
"""Sigmas of an aid; where a round moves what is predicted by less, the next one is spared."""
MOST_TURN = 1e6
"""rad; a correction beyond any meaning, at which the arithmetic would overflow soon."""
_NONE = np.zeros(0)
GRAVITY_REACH = 20.0
"""m, how far gravity is carried linearly before it is evaluated anew."""


@dataclass(frozen=True, slots=True, eq=False)
class FirstValues(ShortRepr):
    """Where the smoother starts."""

    states: States
    weights: Array
    """(M,) one for each beam row"""
    n_doubts: int
    """How often the prediction was doubted."""
    aid_weights: Array
    """One for each measurement of the weighted aids"""


def first_values(problem: Problem, *, kernel: Kernel) -> FirstValues:
    """Run once through the mission, predicting and updating keyframe by keyframe."""
    return finished(first_values_steps(problem, kernel=kernel))


def first_values_steps(problem: Problem, *, kernel: Kernel) -> Steps[FirstValues]:
    """Make :func:`first_values` in steps.

    Where the scale of the gyros is hardly known, the first turn bends everything. So passes are
    made from scales half a prior sigma apart, each with half of it, and the one that leaves the
    beams the most weight is taken.
    """
    passes, ran_away = [], None
    for begin in _begins(problem.extras):
        try:
            passes.append((yield from _ForwardPass(problem, kernel, begin).run_steps()))
        except np.linalg.LinAlgError as error:
            ran_away = error
    if not passes:
        raise SolverError(f"the first pass ran away ({ran_away}): {_HINT}") from ran_away
    first = max(passes, key=lambda own: float(own.weights.sum()))
    if not (np.all(np.isfinite(first.states.p_n)) and np.all(np.isfinite(first.states.v_n))):
        raise SolverError(f"the first pass became non-finite: {_HINT}")
    return first


def _begins(extras: Extras) -> tuple[float | None, ...]:
    """Return the prior sigmas of the gyros' scale that passes begin at; None for one as it is."""
    if GYRO_SCALE in extras:
        own = extras.columns(GYRO_SCALE).start - STATE_DIM
        if extras.sigma[own] > UNSURE_SCALE:
            return BEGINS
    return (None,)


_HINT = "check units, axes and noise of [imu], and the initial state with its sigmas"


class _Rows(NamedTuple):
    """Measurements of one keyframe, linearised."""

    H: Array
    """(m, 15)"""
    innovation: Array
    """(m,) measured minus predicted"""
    variance: Array
    """(m,)"""


class _ForwardPass:
    """A filter on the same inertial factors as the graph, in covariance form."""

    def __init__(self, problem: Problem, kernel: Kernel, scale: float | None = None) -> None:
        """Begin at so many prior sigmas of the gyros' scale, known to half of one; None for 0."""
        self.problem = problem
        self.kernel = kernel
        start = start_of(problem)
        self.R_nb, self.p_n, self.v_n, self.bias = start[:4]
        self.extras = ForwardExtras(problem) if problem.extras else None
        self.P = self.extras.begin(start.covariance) if self.extras else start.covariance
        if self.extras and scale is not None:
            self.P = self.extras.begin_scale(self.P, scale)
        self.inertial = InertialRows(problem.frame, problem.extras)
        self.aids = Measurements.of_problem(problem)
        self.met = ForwardAids(self.aids)
        self.weights = np.ones(len(problem.beams.speed))
        self.trust = np.ones(problem.beams.n_beams)
        self.before: RowStates | None = None
        """The state at the keyframe before"""
        self.without_beam = 0
        self.n_doubts = 0
        self.gravity_at = np.full(3, np.inf)
        self.gravity, self.gravity_D_p = np.zeros(3), np.zeros((3, 3))
        self._g_n = gtsam_gravity(problem.frame, self.p_n)

    def run_steps(self) -> Steps[FirstValues]:
        problem = self.problem
        first_row = np.searchsorted(problem.beams.keyframe, np.arange(problem.n_keyframes + 1))
        history: list[tuple[Array, ...]] = []
        for k in told(range(problem.n_keyframes), problem.n_keyframes):
            if k > 0:
                self.before = self._here
                self._predict(k - 1)
            self._update_aids(k)
            self._update_dvl(slice(*first_row[k : k + 2]))
            walks = (self.extras.walks,) if self.extras else ()
            history.append((self.R_nb, self.p_n, self.v_n, self.bias, *walks))
            yield 0.6
        columns = [np.array(column) for column in zip(*history, strict=True)]
        states = States.of(*columns[:4])
        yield 0.02 * problem.n_keyframes
        if self.extras:
            states = states._replace(walks=columns[4], constants=self.extras.constants)
        states, met = find_beacons(states, self.aids, problem.extras, self.met.weights)
        states, met = find_features(states, self.aids, problem.extras, met)
        return FirstValues(states, self.weights, self.n_doubts, met)

    def _predict(self, k: int) -> None:
        interval = self.problem.chain.intervals.take(np.s_[k : k + 1])
        self._g_n = self._gravity(self.p_n + 0.5 * interval.span_s * self.v_n)
        here = States.of(*(column[None] for column in self._state))
        if self.extras:
            here = here._replace(walks=self.extras.walks[None], constants=self.extras.constants)
        ahead = self.inertial.predict(interval, here, g_n=self._g_n[None])
        self.P = ahead.covariance(self.P)
        if self.extras:
            self.extras.keep(ahead.states.walks[0], self.extras.constants)
        self.R_nb, self.p_n, self.v_n = (column[0] for column in ahead.states[:3])

    def _gravity(self, p_n: Array) -> Array:
        """Return gravity, linear about its last exact evaluation: good to 1e-10 m/s^2."""
        moved = p_n - self.gravity_at
        if not np.dot(moved, moved) < GRAVITY_REACH**2:
            self.gravity_at, moved = p_n, np.zeros(3)
            frame = self.problem.frame
            self.gravity, self.gravity_D_p = gtsam_gravity(frame, p_n), gravity_gradient(frame, p_n)
        return np.asarray(self.gravity + self.gravity_D_p @ moved)

    def _update_aids(self, k: int) -> None:
        """Correct by the weighted aids of one keyframe, together, linearised where they lead to.

        An uncertain position bends the distances to it by more than their sigmas. Fixes or depths
        that have contradicted the prediction several times in a row are believed instead.
        """
        if not self.met.has(k):
            return
        self.met.lead(k, self.before, self._here)
        met, innovation, weights = self._weigh_aids(k)
        believed = self.met.locked_out(met, innovation, weights)
        if np.any(believed):
            offset = self.met.common_offset(met, believed)
            if offset is None:
                weights = np.where(believed, 1.0, weights)
                self.met.weights[met.numbers] = weights
            else:
                A = np.linalg.pinv(met.H[believed[met.measurement], POSITION])
                self.P[POSITION, POSITION] += offset**2 * (A @ A.T)
                met, innovation, weights = self._weigh_aids(k)
        S = met.H @ self.P @ met.H.T + np.diag(1.0 / weights[met.measurement])
        self._correct(met.H, innovation, S)

    def _weigh_aids(self, k: int) -> tuple[AidsOfKeyframe, Array, Array]:
        """Return the aids of a keyframe, their innovation (R,), and their weights (m,)."""
        step = np.zeros(len(self.P))
        for _ in range(AID_ROUNDS):
            met = self.met.at(k, self._moved(step))
            innovation = met.innovation + met.H @ step
            predicted = met.H @ self.P @ met.H.T
            weights = self.met.weigh(met, innovation, predicted, self.kernel)
            S = predicted + np.diag(1.0 / weights[met.measurement])
            last, step = step, self.P @ met.H.T @ np.linalg.solve(S, innovation)
            if np.abs(met.H @ (step - last)).max() < AID_REACH:
                break
        return met, innovation, weights

    def _update_dvl(self, rows: slice) -> None:
        """Correct by the beams of one ping, together."""
        if rows.start == rows.stop:
            return
        H, innovation, variance = self._beam_rows(rows)
        S = H @ self.P @ H.T
        S.flat[:: len(S) + 1] += variance
        self._correct(H, innovation, S)

    def _beam_rows(self, rows: slice) -> _Rows:
        """Return the beams of one ping with the variances that their weights give them."""
        error, H = self._linearized(rows)
        innovation = -error
        variance = self.problem.beams.sigma[rows] ** 2
        predicted = H @ self.P @ H.T
        if predicted.diagonal().max() > ANCHOR_SIGMA**2:
            predicted = self._forget_velocity(H, innovation, predicted)
        beam = self.problem.beams.beam[rows]
        trust = self.trust[beam]
        weights = met_weights(innovation, predicted, variance, self.kernel, trust=trust)
        self.without_beam = self.without_beam + 1 if np.all(weights < 0.01) else 0
        if self.without_beam >= LOCKED_OUT_PINGS:
            self.n_doubts += 1
            self.without_beam = 0
            forget = self._forget_current if self._is_water(rows) else self._forget_velocity
            predicted = forget(H, innovation, predicted)
            weights = settle_weights(innovation, predicted, variance, self.kernel)
        self.trust = updated_trust(self.trust, beam, weights)
        self.weights[rows] = weights
        return _Rows(H, innovation, variance / weights)

    @property
    def _state(self) -> tuple[Array, Array, Array, Array]:
        return self.R_nb, self.p_n, self.v_n, self.bias

    @property
    def _here(self) -> RowStates:
        extra = (self.extras.walks, self.extras.constants) if self.extras else (_NONE, _NONE)
        return RowStates(*self._state, *extra, self.problem.extras, self._g_n)

    def _linearized(self, rows: slice) -> BeamRows:
        if self.extras:
            return self.extras.beam_rows(rows, self._state, self._g_n)
        return linearize_beams(
            self.problem.beams,
            rows=rows,
            R_nb=self.R_nb,
            v_n=self.v_n,
            bias=self.bias,
            omega_ie_n=self.problem.frame.omega_ie_n,
        )

    def _forget_velocity(self, H: Array, innovation: Array, predicted: Array) -> Array:
        """Let the beams alone set the velocity; return the predicted covariance of the beams.

        A prediction this poor is not linear any more: a filter that corrected the attitude by it
        would ruin the attitude.
        """
        self.P[VELOCITY, :] = 0.0
        self.P[:, VELOCITY] = 0.0
        variance = max(np.max(innovation**2), np.max(np.diag(predicted)))
        self.P[VELOCITY, VELOCITY] = variance * np.eye(3)
        return np.asarray(H @ self.P @ H.T)

    def _is_water(self, rows: slice) -> bool:
        return bool(self.problem.beams.is_water[rows].all())

    def _forget_current(self, H: Array, innovation: Array, predicted: Array) -> Array:
        """Let the beams off the water set the current: it has changed, not the velocity."""
        variance = max(np.max(innovation**2), np.max(np.diag(predicted)))
        assert self.extras is not None
        self.extras.forget_current(self.P, variance)
        return np.asarray(H @ self.P @ H.T)

    def _correct(self, H: Array, innovation: Array, innovation_cov: Array) -> None:
        PHt = self.P @ H.T
        gain = np.linalg.solve(innovation_cov, PHt.T).T
        moved = self._moved(gain @ innovation)
        P = self.P - gain @ PHt.T
        self.P = 0.5 * (P + P.T)
        self.R_nb, self.p_n, self.v_n, self.bias = moved[:4]
        if self.extras:
            self.extras.keep(moved.walks, moved.constants)

    def _moved(self, step: Array) -> RowStates:
        """Return the state after a step (E,) of the error state and what is behind it."""
        turn = float(np.abs(step[ROTATION]).max())
        if not turn < MOST_TURN:
            raise np.linalg.LinAlgError(f"an attitude corrected by {turn:.3g} rad")
        here = NavigationStates(*(column[None] for column in self._state))
        R_nb, p_n, v_n, bias = (column[0] for column in here.moved(step[None, :STATE_DIM]))
        walks, constants = self.extras.moved(step[STATE_DIM:]) if self.extras else (_NONE, _NONE)
        return RowStates(R_nb, p_n, v_n, bias, walks, constants, self.problem.extras, self._g_n)
