"""From keyframe to keyframe: inertial data and walks as whitened rows, for batch and window.

Gravity of an interval is that of the middle between its ends, and follows the states. Within a
hundred metres that is a constant. Over a kilometre gravity turns by 1.5e-4 rad, and Gauss-Newton
without that derivative walks away from the answer.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from factors.imu_errors import SIZE
from factors.inertial import Intervals, Predicted, predict, whitened_error, whitened_rows
from ssm_graph.base.earth import LocalFrame
from ssm_graph.base.frozen import Array
from ssm_graph.engine.chain import ChainSolution
from ssm_graph.engine.error_state import STATE_DIM
from ssm_graph.engine.extras import Extras
from ssm_graph.engine.states import States
from ssm_graph.imu.preintegration import (
    gravity_between,
    gravity_gradient,
    gtsam_gravity,
)
from ssm_graph.mission.imu_variables import columns_of_errors, imu_errors


class InertialRows:
    """Rows between successive keyframes that carry these variables beside their error state."""

    def __init__(self, frame: LocalFrame, extras: Extras) -> None:
        self._frame, self._extras, self._gradient = frame, extras, gravity_gradient(frame)
        self._own = columns_of_errors(extras)
        """(E,) columns of the errors of the inertial sensors behind one keyframe's state"""
        is_constant = self._own >= extras.state_dim
        self._between = np.where(is_constant, extras.state_dim, 0) + self._own
        """(E,) and those between two keyframes"""

    def rows(self, intervals: Intervals, states: States) -> Array:
        """Return the rows (I, n, 2 n + C + 1) of I intervals at their I + 1 states, ``b`` last.

        Columns are those of the keyframe before, of the one after, and of C constants.
        """
        begin = states.take(np.s_[:-1])
        errors, slope = self.sensor_errors(begin)
        pairs = whitened_rows(
            self._seen(intervals),
            begin,
            states.take(np.s_[1:]),
            g_n=gravity_between(self._frame, states.p_n),
            gradient=self._gradient,
            errors=errors,
        )
        pairs = _by_variables(pairs, slope, from_column=2 * STATE_DIM)
        return self._with_walks(pairs, intervals, states.walks)

    def errors(self, intervals: Intervals, states: States) -> Array:
        """Return the whitened errors (I, n) of inertial data, then of the walks."""
        begin = states.take(np.s_[:-1])
        inertial = whitened_error(
            self._seen(intervals),
            begin,
            states.take(np.s_[1:]),
            g_n=gravity_between(self._frame, states.p_n),
            errors=self.sensor_errors(begin)[0],
        )
        if self._extras.n_walks == 0:
            return inertial
        factor, sigma = self._extras.transitions(intervals.span_s)
        walked = (states.walks[1:] - factor * states.walks[:-1]) / sigma
        return np.concatenate([inertial, walked], axis=1)

    def predict(self, interval: Intervals, last: States, *, g_n: Array | None = None) -> Ahead:
        """Return states (B, ...) at the end of an interval from those at its begin (B, ...).

        ``g_n`` (B, 3) is gravity between them, m/s^2; that of the frame when left out.
        """
        interval, (errors, slope) = self._seen(interval), self.sensor_errors(last)
        if g_n is None:
            g_n = gtsam_gravity(self._frame, last.p_n + 0.5 * interval.span_s * last.v_n)
        moved = predict(interval, last, g_n=g_n, gradient=self._gradient, errors=errors)
        transition = _by_variables(moved.transition, slope, from_column=STATE_DIM)
        moved = moved._replace(transition=transition)
        walks = last.walks
        if self._extras.n_walks:
            walks = walks * self._extras.transitions(interval.span_s)[0]
        ahead = States(*moved.state, walks, last.constants)
        return Ahead(ahead, interval.as_noisy_as(errors), moved, self)

    def _seen(self, intervals: Intervals) -> Intervals:
        """Return intervals without columns of errors that are no variables here."""
        return intervals if len(self._own) else intervals.without_errors(intervals.errors)

    def sensor_errors(self, begin: States) -> tuple[Array | None, Array | None]:
        """Return errors of what is read (I, 27), or (27,) of all, and their slope; None if none."""
        if len(self._own) == 0:
            return None, None
        return imu_errors(self._extras, begin.walks, begin.constants)

    def _with_walks(self, pairs: Array, intervals: Intervals, walks: Array) -> Array:
        """Return inertial rows (I, 15, 31 + E) with columns and rows of the walks (I + 1, s)."""
        extras = self._extras
        if not extras:
            return pairs
        n = extras.state_dim
        wide = np.zeros((len(pairs), n, n + extras.width + 1))
        wide[:, :STATE_DIM, :STATE_DIM] = pairs[:, :, :STATE_DIM]
        wide[:, :STATE_DIM, n : n + STATE_DIM] = pairs[:, :, STATE_DIM : 2 * STATE_DIM]
        if pairs.shape[2] > 2 * STATE_DIM + 1:
            wide[:, :STATE_DIM, self._between] = pairs[:, :, 2 * STATE_DIM : -1]
        wide[:, :STATE_DIM, -1] = pairs[:, :, -1]
        factor, sigma = extras.transitions(intervals.span_s)
        own = np.arange(STATE_DIM, n)
        wide[:, own, own], wide[:, own, n + own] = -factor / sigma, 1.0 / sigma
        wide[:, own, -1] = (factor * walks[:-1] - walks[1:]) / sigma
        return wide


def _by_variables(rows: Array, slope: Array | None, *, from_column: int) -> Array:
    """Return rows (I, r, c) with columns of the variables in the place of those of 27 errors."""
    if slope is None or rows.shape[2] == from_column:
        return rows
    end = from_column + SIZE
    parts = rows[:, :, :from_column], rows[:, :, from_column:end] @ slope, rows[:, :, end:]
    return np.concatenate(parts, axis=2)


class Ahead(NamedTuple):
    """A keyframe as the inertial data alone know it from the one before."""

    states: States
    """(B, ...)"""
    interval: Intervals
    moved: Predicted
    between: InertialRows

    def rows(self, last: States) -> Array:
        """Return the rows (1, n, 2 n + C + 1) from the keyframe before, linearised at both."""
        walks = np.concatenate([last.walks, self.states.walks])
        return self.between._with_walks(self.moved.rows(self.interval), self.interval, walks)

    def covariance(self, before: Array) -> Array:
        """Return covariances (..., n + C, n + C) here from those at the keyframe before.

        Of one state, or of B states those (B, n + C, n + C) of each.
        """
        F, Q = self.moved.transition, self.moved.noise(self.interval)
        if len(F) == 1:
            F, Q = F[0], Q[0]
        if before.shape[-1] == STATE_DIM:
            return np.asarray(F @ before @ F.mT + Q)
        carried = before.copy()
        seen = self._seen
        carried[..., :STATE_DIM, :] = F @ before[..., seen, :]
        carried[..., :STATE_DIM] = carried[..., seen] @ F.mT
        carried[..., :STATE_DIM, :STATE_DIM] += Q
        if self.between._extras.n_walks == 0:
            return carried
        (factor,), (sigma,) = self.between._extras.transitions(self.interval.span_s)
        own = np.arange(STATE_DIM, STATE_DIM + len(factor))
        carried[..., own, :] *= factor[:, None]
        carried[..., own] *= factor
        carried[..., own, own] += sigma**2
        return carried

    def deviation(self, before: Array) -> Array:
        """Return the deviations (..., n) from these states of what was off by ``before`` there."""
        own, (factor,) = STATE_DIM, self.between._extras.transitions(self.interval.span_s)[0]
        moved = before[..., self._seen] @ self.moved.transition[0].T
        return np.concatenate([moved, before[..., own:] * factor], axis=-1)

    @property
    def _seen(self) -> slice | NDArray[np.intp]:
        """Columns of the state that the inertial data depend on."""
        if self.moved.transition.shape[2] == STATE_DIM:
            return np.s_[:STATE_DIM]
        return np.concatenate([np.arange(STATE_DIM), self.between._own])


class InertialFit(NamedTuple):
    """Squared whitened errors of the inertial data, and what they are if noise is as stated."""

    chi_sq: Array
    """(K - 1,) of each interval"""
    dof: Array
    """(K - 1,)"""


def inertial_fit(rows: Array, solution: ChainSolution) -> InertialFit:
    """Return how well inertial rows (K - 1, n, ...) fit the answer that ``solution`` led to.

    Of the whitened errors most is taken up by the states: hardly anything else sees a keyframe's
    biases. With ``A_i d_i + A_j d_j = b + noise`` and the posterior covariance ``P`` of both
    keyframes the expected square is ``15 - tr(A P A')``: the degrees of freedom of the interval's
    chi-square.
    """
    n = rows.shape[1]
    A_i, A_j = rows[:, :STATE_DIM, :STATE_DIM], rows[:, :STATE_DIM, n : n + STATE_DIM]
    b, P = rows[:, :STATE_DIM, -1], solution.covariance(STATE_DIM)
    taken_up = (A_i @ P[:-1]) * A_i + (A_j @ P[1:]) * A_j
    taken_up += 2.0 * (A_i @ solution.neighbour_covariance(STATE_DIM)) * A_j
    dof = b.shape[1] - np.sum(taken_up, axis=(1, 2))
    A_c, crossed = rows[:, :STATE_DIM, 2 * n : -1], solution.sensitivity[:, :STATE_DIM]
    if A_c.any():
        through = 2.0 * (A_i @ crossed[:-1] + A_j @ crossed[1:]) + A_c
        dof -= np.sum((through @ solution.constants_cov) * A_c, axis=(1, 2))
    return InertialFit(np.sum(b**2, axis=1), dof)
