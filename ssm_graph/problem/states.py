"""States side by side, of many runs or of many keyframes, and their moves on the manifold."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from factors import so3
from ssm_graph.data import Array
from ssm_graph.problem.error_state import POSITION, ROTATION, VELOCITY


class NavigationStates(NamedTuple):
    """States of B runs at one time, or of B keyframes of one run."""

    R_nb: Array
    """(B, 3, 3)"""
    p_n: Array
    """(B, 3) m"""
    v_n: Array
    """(B, 3) m/s"""
    bias: Array
    """(B, 6) accelerometer m/s^2, gyro rad/s"""

    def moved(self, step: Array) -> NavigationStates:
        """Return the states moved by local errors (B, 15), the pose as GTSAM retracts it."""
        phi, rho = step[:, ROTATION], step[:, POSITION]
        return self._at(step, shift_b=so3.left_jacobian_times(phi, rho))

    def displaced(self, xi: Array) -> NavigationStates:
        """Return the states at deviations (B, 15): the inverse of :meth:`deviation_of`."""
        return self._at(xi, shift_b=xi[:, POSITION])

    def deviation_of(self, other: NavigationStates) -> Array:
        """Return how far other states are (B, 15), position along the body axes of these."""
        R_bn = np.swapaxes(self.R_nb, 1, 2)
        phi = so3.log(R_bn @ other.R_nb)
        rho = (R_bn @ (other.p_n - self.p_n)[..., None])[..., 0]
        return np.concatenate([phi, rho, other.v_n - self.v_n, other.bias - self.bias], axis=1)

    def take(self, runs: NDArray[np.intp] | NDArray[np.bool_] | slice) -> NavigationStates:
        """Return the states of some runs."""
        return NavigationStates(*(column[runs] for column in self))

    def followed_by(self, other: NavigationStates) -> NavigationStates:
        """Return these states, then the others."""
        return NavigationStates(*(np.concatenate(pair) for pair in zip(self, other, strict=True)))

    def _at(self, step: Array, *, shift_b: Array) -> NavigationStates:
        return NavigationStates(
            R_nb=self.R_nb @ so3.exp(step[:, ROTATION]),
            p_n=self.p_n + (self.R_nb @ shift_b[..., None])[..., 0],
            v_n=self.v_n + step[:, VELOCITY],
            bias=self.bias + step[:, 9:],
        )


def local_D_deviation(xi: Array) -> Array:
    """Return how the local pose error at ``x.displaced(xi)`` follows that of ``xi``, (B, 6, 6).

    Velocity and biases follow as they are.
    """
    jacobian = np.zeros((len(xi), 6, 6))
    jacobian[:, :3, :3] = so3.left_jacobian(-xi[:, ROTATION])
    jacobian[:, 3:, 3:] = so3.exp(-xi[:, ROTATION])
    return jacobian
