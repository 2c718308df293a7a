"""States side by side, of many runs or of many keyframes, and their moves on the manifold."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from factors import so3
from ssm_graph.base.frozen import Array
from ssm_graph.engine.error_state import (
    NO_EXTRA,
    POSITION,
    ROTATION,
    STATE_DIM,
    VELOCITY,
    InitialMoments,
)

_EYE = np.eye(3)


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
        jacobians = so3.Jacobians.of(step[:, ROTATION])
        J = jacobians.left()
        turn = _EYE + jacobians.skew @ J
        return self._at(step, turn=turn, shift_b=(J @ step[:, POSITION, None])[..., 0])

    def swung(self, step: Array) -> NavigationStates:
        """Return the states moved by local errors (B, 15), velocity and position turned along.

        To first order that is :meth:`moved`. Where all are turned by much, what the inertial data
        say from one to the next, and velocities in body axes, stay as the errors to first order
        have them: the errors in navigation axes are those of the group of extended poses, in which
        they propagate linearly [1]_.

        References
        ----------
        .. [1] A. Barrau, S. Bonnabel, "The Invariant Extended Kalman Filter as a Stable Observer",
           IEEE Transactions on Automatic Control 62, 2017.
        """
        phi_n = (self.R_nb @ step[:, ROTATION, None])[..., 0]
        shift_n = (self.R_nb @ step[:, POSITION, None])[..., 0]
        turn, J = so3.exp(phi_n), so3.left_jacobian(phi_n)

        def turned(value: Array, by: Array) -> Array:
            own = by - np.cross(phi_n, value)
            return np.asarray((turn @ value[..., None] + J @ own[..., None])[..., 0])

        return NavigationStates(
            R_nb=turn @ self.R_nb,
            p_n=turned(self.p_n, shift_n),
            v_n=turned(self.v_n, step[:, VELOCITY]),
            bias=self.bias + step[:, 9:],
        )

    def displaced(self, xi: Array) -> NavigationStates:
        """Return the states at deviations (B, 15): the inverse of :meth:`deviation_of`."""
        return self._at(xi, turn=so3.exp(xi[:, ROTATION]), shift_b=xi[:, POSITION])

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

    def _at(self, step: Array, *, turn: Array, shift_b: Array) -> NavigationStates:
        return NavigationStates(
            R_nb=self.R_nb @ turn,
            p_n=self.p_n + (self.R_nb @ shift_b[..., None])[..., 0],
            v_n=self.v_n + step[:, VELOCITY],
            bias=self.bias + step[:, 9:],
        )


class States(NamedTuple):
    """States of K keyframes of one run, with the variables beside them."""

    R_nb: Array
    """(K, 3, 3)"""
    p_n: Array
    """(K, 3) m"""
    v_n: Array
    """(K, 3) m/s"""
    bias: Array
    """(K, 6) accelerometer m/s^2, gyro rad/s"""
    walks: Array
    """(K, s) variables that have a value at every keyframe, zero where they are as stated"""
    constants: Array = NO_EXTRA
    """(C,) those that hold for all of them"""

    @classmethod
    def of(
        cls,
        R_nb: Array,
        p_n: Array,
        v_n: Array,
        bias: Array,
        walks: Array | None = None,
        constants: Array = NO_EXTRA,
    ) -> States:
        """Return states, without the variables that are left out."""
        walks = np.zeros((len(p_n), 0)) if walks is None else walks
        return cls(R_nb, p_n, v_n, bias, walks, constants)

    @classmethod
    def at_start(cls, moments: InitialMoments) -> States:
        """Return the mean (1, ...) of a keyframe that carries its other variables in its state."""
        mean = (moments.R_nb, moments.p_n, moments.v_n, moments.bias, moments.extra)
        return cls(*(column[None] for column in mean))

    @property
    def navigation(self) -> NavigationStates:
        """The states without the other variables."""
        return NavigationStates(*self[:4])

    def moments(self, covariance: Array) -> InitialMoments:
        """Return the first of these keyframes as mean with its covariance (15 + s, 15 + s)."""
        R_nb, p_n, v_n, bias, walks = (column[0] for column in self[:5])
        return InitialMoments(R_nb, p_n, v_n, bias, covariance, walks)

    def moved(
        self, step: Array, constants_step: Array | None = None, *, swings: bool = False
    ) -> States:
        """Return the states moved by local errors (K, 15 + s), the pose as GTSAM retracts it.

        ``constants_step`` is (C,); the constants stay as they are when it is left out. With
        ``swings`` velocity and position are turned along, see :meth:`NavigationStates.swung`.
        """
        move = self.navigation.swung if swings else self.navigation.moved
        own = move(step[:, :STATE_DIM])
        constants = self.constants if constants_step is None else self.constants + constants_step
        return States(*own, walks=self.walks + step[:, STATE_DIM:], constants=constants)

    def take(self, keyframes: NDArray[np.intp] | slice) -> States:
        """Return the states of some keyframes."""
        return States(
            self.R_nb[keyframes],
            self.p_n[keyframes],
            self.v_n[keyframes],
            self.bias[keyframes],
            self.walks[keyframes],
            self.constants,
        )

    def followed_by(self, *others: States) -> States:
        """Return these states, then the others, which have the same constants."""
        parts = zip(*(part[:5] for part in (self, *others)), strict=True)
        R_nb, p_n, v_n, bias, walks = (np.concatenate(columns) for columns in parts)
        return States(R_nb, p_n, v_n, bias, walks, self.constants)


def local_D_deviation(xi: Array) -> Array:
    """Return how the local pose error at ``x.displaced(xi)`` follows that of ``xi``, (B, 6, 6).

    Velocity and biases follow as they are.
    """
    jacobian = np.zeros((len(xi), 6, 6))
    jacobian[:, :3, :3] = so3.left_jacobian(-xi[:, ROTATION])
    jacobian[:, 3:, 3:] = so3.exp(-xi[:, ROTATION])
    return jacobian
