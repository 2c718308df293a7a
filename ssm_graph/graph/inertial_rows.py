"""The inertial factors of GTSAM as rows, and what they lack: gravity that changes with position.

Gravity of an interval is that of the middle between its ends, and follows the states; GTSAM's
factor takes it for constant. Within a hundred metres that is the same. Over a kilometre gravity
turns by 1.5e-4 rad, and Gauss-Newton without that derivative walks away from the answer.
"""

from __future__ import annotations

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, V, X

from ssm_graph.data import Array
from ssm_graph.imu.preintegration import gravity_gradient
from ssm_graph.problem.error_state import POSITION, STATE_DIM, VELOCITY
from ssm_graph.problem.problem import Problem

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
    rows: Array, gradient: Array, *, R_begin: Array, R_end: Array, span_s: Array | float
) -> None:
    """Let whitened inertial rows know that gravity changes along with both positions, in place.

    More gravity by ``g`` is a velocity at the end that differs by ``g t`` and a position that
    differs by ``g t^2 / 2``.

    Parameters
    ----------
    rows : (..., 15, 31) begin, end and right-hand side, see :data:`PAIR_COLUMNS`.
    gradient : (3, 3) of :func:`gravity_gradient`.
    R_begin, R_end : (..., 3, 3) attitudes at both ends, body to ``n``.
    span_s : (...) from begin to end.
    """
    t = np.asarray(span_s)[..., None, None]
    end = rows[..., STATE_DIM : 2 * STATE_DIM]
    D_position_n = end[..., POSITION] @ np.swapaxes(R_end, -1, -2)
    D_gravity = -(end[..., VELOCITY] * t + D_position_n * (0.5 * t**2))
    D_middle = 0.5 * D_gravity @ gradient
    rows[..., POSITION] += D_middle @ R_begin
    end[..., POSITION] += D_middle @ R_end


class InertialRows:
    """Whitened rows of the inertial factors of a problem."""

    def __init__(self, problem: Problem, graph: gtsam.NonlinearFactorGraph) -> None:
        self._graph = graph
        self._span_s = np.diff(problem.keyframe_s)
        self._gradient = gravity_gradient(problem.frame)

    def at(self, values: gtsam.Values, R_nb: Array) -> Array:
        """Return the rows (K - 1, 15, 31), each of begin, end and ``b``.

        ``R_nb`` (K, 3, 3) are the attitudes in ``values``.
        """
        linear = self._graph.linearize(values)
        rows = np.empty((len(self._span_s), STATE_DIM, 2 * STATE_DIM + 1))
        for k in range(len(rows)):
            rows[k] = linear.at(k).augmentedJacobian()
        rows = rows[:, :, PAIR_COLUMNS]
        add_gravity_gradient(
            rows, self._gradient, R_begin=R_nb[:-1], R_end=R_nb[1:], span_s=self._span_s
        )
        return rows


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
