"""The preintegrated process in NumPy: prediction of state and covariance, many runs at once.

Over an interval ``dt`` the specific force acts as in an inertial frame that coincides with the
navigation frame at the begin; gravity is constant in the navigation frame; at the end the turn of
the Earth is taken out again, with ``E = Exp(-omega dt)``::

    R' = E R dR
    p' = E (p + dt (v + omega x p) + dt^2 J2 g + R dp)
    v' = E (v + omega x p + dt J1 g + R dv) - omega x p'

``J1 = int_0^1 Exp(s omega dt) ds`` and ``J2 = int_0^1 (1 - s) Exp(s omega dt) ds``.

References
----------
.. [1] M. Brossard, A. Barrau, P. Chauchat, S. Bonnabel, "Associating Uncertainty to Extended Poses
   for on Lie Group IMU Preintegration With Rotating Earth", IEEE Transactions on Robotics, 2022.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from factors import so3
from ssm_graph.base.earth import LocalFrame
from ssm_graph.base.frozen import Array
from ssm_graph.engine.error_state import POSITION, ROTATION, STATE_DIM, VELOCITY
from ssm_graph.engine.states import NavigationStates
from ssm_graph.imu.arrays import Intervals
from ssm_graph.imu.preintegration import gravity_gradient, gtsam_gravity

BIASES = slice(9, 15)


class Prediction(NamedTuple):
    """States of B runs at the end of an interval."""

    states: NavigationStates
    transition: Array
    """(B, 15, 15) of the error state."""
    process_cov: Array
    """(B, 15, 15)"""


class Process:
    """Predicts B runs from keyframe to keyframe."""

    def __init__(self, intervals: Sequence[Intervals], frame: LocalFrame) -> None:
        columns = zip(*intervals, strict=True)
        self._intervals = Intervals(*(np.stack(column, axis=1) for column in columns))
        self._frame = frame
        self._gravity_gradient = gravity_gradient(frame)
        turn = self._intervals.dt[..., None] * frame.omega_ie_n
        self._Omega = so3.skew(frame.omega_ie_n)
        self._E = so3.exp(-turn)
        self._J1 = so3.left_jacobian(turn)
        self._J2 = _second_left_jacobian(turn)

    def predict(self, k: int, states: NavigationStates) -> Prediction:
        """Predict from keyframe ``k`` to the next."""
        m = Intervals(*(column[k] for column in self._intervals))
        E, Omega, dt = self._E[k], self._Omega, m.dt[:, None]
        g_n = gtsam_gravity(self._frame, states.p_n + 0.5 * dt * states.v_n)
        d_bias = (m.delta_D_bias @ states.bias[..., None])[..., 0]
        delta_R, delta_p, delta_v = _corrected(m, d_bias)
        inertial_v = states.v_n + _times(Omega, states.p_n)
        shift, gain = _times(states.R_nb, delta_p), _times(states.R_nb, delta_v)
        p_n = states.p_n + dt * inertial_v + dt**2 * _times(self._J2[k], g_n) + shift
        v_n = inertial_v + dt * _times(self._J1[k], g_n) + gain
        p_n = _times(E, p_n)
        moved = NavigationStates(
            R_nb=E @ states.R_nb @ delta_R,
            p_n=p_n,
            v_n=_times(E, v_n) - _times(Omega, p_n),
            bias=states.bias,
        )
        F = self._transition(k, m, states, moved, delta_p, delta_v, d_bias)
        process_cov = m.covariance.copy()
        process_cov[:, VELOCITY, :] = moved.R_nb @ process_cov[:, VELOCITY, :]
        process_cov[:, :, VELOCITY] = process_cov[:, :, VELOCITY] @ _T(moved.R_nb)
        # Gravity of the middle follows the end itself: d_j = F d_i + G_i d_i + G_j d_j + noise.
        at_end = self._gravity_along(k, dt[..., None], moved, moved.R_nb)
        change = np.asarray(np.linalg.inv(np.eye(STATE_DIM) - at_end), dtype=np.float64)
        F = change @ (F + self._gravity_along(k, dt[..., None], moved, states.R_nb))
        return Prediction(moved, F, change @ process_cov @ _T(change))

    def _gravity_along(self, k: int, dt: Array, moved: NavigationStates, R_nb: Array) -> Array:
        """Return what the error at an end of attitude ``R_nb`` does by the change of gravity there.

        Gravity is that of the middle; (B, 15, 15), on the error state at the end.
        """
        E = self._E[k]
        gravity_D = 0.5 * self._gravity_gradient @ R_nb
        p_D = dt**2 * (E @ self._J2[k] @ gravity_D)
        along = np.zeros((len(R_nb), STATE_DIM, STATE_DIM))
        along[:, POSITION, POSITION] = _T(moved.R_nb) @ p_D
        along[:, VELOCITY, POSITION] = dt * (E @ self._J1[k] @ gravity_D) - self._Omega @ p_D
        return along

    def _transition(
        self,
        k: int,
        m: Intervals,
        states: NavigationStates,
        moved: NavigationStates,
        delta_p: Array,
        delta_v: Array,
        d_bias: Array,
    ) -> Array:
        E, Omega, dt = self._E[k], self._Omega, m.dt[:, None, None]
        R_nb, R_bn = states.R_nb, _T(moved.R_nb)
        delta_R = _T(R_nb) @ _T(E) @ moved.R_nb
        F = np.zeros((len(R_nb), STATE_DIM, STATE_DIM))
        # Position and velocity first along the navigation axes.
        p_D, v_D = np.zeros((2, len(R_nb), 3, STATE_DIM))
        p_D[..., ROTATION] = -E @ R_nb @ so3.skew(delta_p)
        p_D[..., POSITION] = E @ (np.eye(3) + dt * Omega) @ R_nb
        p_D[..., VELOCITY] = dt * E
        v_D[..., ROTATION] = -E @ R_nb @ so3.skew(delta_v)
        v_D[..., POSITION] = E @ Omega @ R_nb
        v_D[..., VELOCITY] = E
        local_D_bias = _right_jacobian(d_bias) @ m.delta_D_bias
        p_D[..., BIASES] = moved.R_nb @ local_D_bias[:, 3:6]
        v_D[..., BIASES] = moved.R_nb @ local_D_bias[:, 6:9]
        F[:, ROTATION, ROTATION] = _T(delta_R)
        F[:, ROTATION, BIASES] = local_D_bias[:, :3]
        F[:, POSITION] = R_bn @ p_D
        F[:, VELOCITY] = v_D - Omega @ p_D
        F[:, BIASES, BIASES] = np.eye(6)
        return F


def _corrected(m: Intervals, d_bias: Array) -> tuple[Array, Array, Array]:
    """Return the increments moved by ``Exp(d_bias)`` on the right, d_bias (B, 9)."""
    phi = d_bias[:, :3]
    shift, gain = (so3.left_jacobian_times(phi, d_bias[:, s]) for s in (POSITION, VELOCITY))
    return (
        m.delta_R @ so3.exp(phi),
        m.delta_p + _times(m.delta_R, shift),
        m.delta_v + _times(m.delta_R, gain),
    )


def _right_jacobian(xi: Array) -> Array:
    """Return the right Jacobian (B, 9, 9) of the extended pose at ``xi`` (B, 9), small."""
    adjoint = np.zeros((len(xi), 9, 9))
    rotation = so3.skew(xi[:, :3])
    for i, part in enumerate((rotation, so3.skew(xi[:, 3:6]), so3.skew(xi[:, 6:9]))):
        block = slice(3 * i, 3 * i + 3)
        adjoint[:, block, block] = rotation
        if i:
            adjoint[:, block, :3] = part
    return so3.right_jacobian_series(adjoint, angle=float(np.abs(xi[:, :3]).sum(axis=1).max()))


def _second_left_jacobian(turn: Array) -> Array:
    """Return ``int_0^1 (1 - s) Exp(s turn) ds`` (..., 3, 3) of small turns, by its series."""
    S = so3.skew(turn)
    return np.asarray(np.eye(3) / 2.0 + S / 6.0 + S @ S / 24.0 + S @ S @ S / 120.0)


def _times(matrix: Array, vector: Array) -> Array:
    return np.asarray((matrix @ vector[..., None])[..., 0])


def _T(matrix: Array) -> Array:
    return np.swapaxes(matrix, -1, -2)
