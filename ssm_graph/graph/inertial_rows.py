"""The inertial factors of GTSAM as rows, and what they lack: gravity that changes with position.

Gravity of an interval is that of the middle between its ends, and follows the states; GTSAM's
factor takes it for constant. Within a hundred metres that is the same. Over a kilometre gravity
turns by 1.5e-4 rad, and Gauss-Newton without that derivative walks away from the answer.
"""

from __future__ import annotations

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, V, X

from factors.so3 import skew
from ssm_graph.base.frozen import Array
from ssm_graph.base.stepwise import Steps
from ssm_graph.engine.error_state import POSITION, STATE_DIM, VELOCITY
from ssm_graph.graph.states import States
from ssm_graph.mission.problem import Problem

PAIR_COLUMNS = np.r_[0:9, 18:24, 9:18, 24:30, 30]
"""Columns of GTSAM's factor, x_i v_i x_j v_j b_i b_j and b, as two error states and b."""


def inertial_graph(problem: Problem) -> gtsam.NonlinearFactorGraph:
    """Return the inertial factors between successive keyframes."""
    graph = gtsam.NonlinearFactorGraph()
    for k, measured in enumerate(problem.chain.measurements):
        graph.add(
            gtsam.GalileanCombinedImuFactor(
                X(k), V(k), X(k + 1), V(k + 1), B(k), B(k + 1), measured
            )
        )
    return graph


def add_gravity_gradient(
    rows: Array,
    gradient: Array,
    *,
    omega_ie_n: Array,
    R_begin: Array,
    R_end: Array,
    span_s: Array | float,
) -> None:
    """Let whitened inertial rows know that gravity changes along with both positions, in place.

    With ``T = skew(omega t)`` more gravity by ``g`` is a velocity at the end that differs by
    ``t (I - T) g`` and a position that differs by ``t^2 (I/2 - T/3) g``, the turn of the Earth in
    a time ``t`` taken to first order. Without it a metre of position is 2e-10 m/s off after each
    second, always the same way: 2e-6 of the velocity's sigma after minutes at navigation grade.

    Parameters
    ----------
    rows : (..., 15, 31) begin, end and right-hand side, see :data:`PAIR_COLUMNS`.
    gradient : (3, 3) 1/s^2, of gravity; see :func:`ssm_graph.imu.preintegration.gravity_gradient`.
    omega_ie_n : (3,) rad/s, of the Earth.
    R_begin, R_end : (..., 3, 3) attitudes at both ends, body to ``n``.
    span_s : (...) from begin to end.
    """
    t = np.asarray(span_s)[..., None, None]
    end = rows[..., STATE_DIM : 2 * STATE_DIM]
    D_position_n = end[..., POSITION] @ np.swapaxes(R_end, -1, -2)
    T, eye = skew(omega_ie_n) * t, np.eye(3)
    D_gravity = -t * (end[..., VELOCITY] @ (eye - T) + D_position_n @ (t * (eye / 2.0 - T / 3.0)))
    D_middle = 0.5 * D_gravity @ gradient
    rows[..., POSITION] += D_middle @ R_begin
    end[..., POSITION] += D_middle @ R_end


def inertial_rows_steps(
    graph: gtsam.NonlinearFactorGraph,
    states: States,
    gradient: Array,
    *,
    omega_ie_n: Array,
    span_s: Array,
) -> Steps[Array]:
    """Return the whitened rows (K - 1, 15, 31) of a chain of inertial factors at ``states``."""
    linear = graph.linearize(states.values)
    yield 0.012 * len(span_s)
    rows = np.empty((len(span_s), STATE_DIM, 2 * STATE_DIM + 1))
    for k in range(len(rows)):
        rows[k] = linear.at(k).augmentedJacobian()
    yield 0.003 * len(rows)
    rows = rows[:, :, PAIR_COLUMNS]
    R_nb = states.R_nb
    add_gravity_gradient(
        rows,
        gradient,
        omega_ie_n=omega_ie_n,
        R_begin=R_nb[:-1],
        R_end=R_nb[1:],
        span_s=span_s,
    )
    return rows


def pair_rows(
    factor: gtsam.NonlinearFactor,
    values: gtsam.Values,
    gradient: Array,
    *,
    omega_ie_n: Array,
    R_begin: Array,
    R_end: Array,
    span_s: float,
) -> Array:
    """Return the whitened rows (15, 31) of one inertial factor; see :func:`inertial_rows_steps`."""
    pair = factor.linearize(values).augmentedJacobian()[:, PAIR_COLUMNS]
    add_gravity_gradient(
        pair, gradient, omega_ie_n=omega_ie_n, R_begin=R_begin, R_end=R_end, span_s=span_s
    )
    return np.asarray(pair)


def carried_covariance(pair: Array, covariance: Array) -> Array:
    """Return the covariance (15, 15) at the end of an inertial factor from that at its begin.

    Whitened, ``A_i d_i + A_j d_j`` is noise of unit variance, ``pair`` (15, 31) being
    ``[A_i, A_j, b]``. Extra variables behind the error state make the covariance larger; they are
    carried as they are.
    """
    A_i, A_j = pair[:, :STATE_DIM], pair[:, STATE_DIM : 2 * STATE_DIM]
    solved = np.linalg.solve(A_j, np.hstack([-A_i, np.eye(STATE_DIM)]))
    F, root_Q = solved[:, :STATE_DIM], solved[:, STATE_DIM:]
    if len(covariance) == STATE_DIM:
        return np.asarray(F @ covariance @ F.T + root_Q @ root_Q.T)
    carried = covariance.copy()
    carried[:STATE_DIM] = F @ covariance[:STATE_DIM]
    carried[:, :STATE_DIM] = carried[:, :STATE_DIM] @ F.T
    carried[:STATE_DIM, :STATE_DIM] += root_Q @ root_Q.T
    return carried
