"""States side by side, of many runs or of many keyframes, and their moves on the manifold."""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from factors import so3
from ssm_graph.base.frozen import Array
from ssm_graph.engine.error_state import POSITION, ROTATION, STATE_DIM, VELOCITY, InitialMoments


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


class AugmentedStates(NamedTuple):
    """States of K keyframes of one run, each with its own values of the extra variables."""

    R_nb: Array
    """(K, 3, 3)"""
    p_n: Array
    """(K, 3) m"""
    v_n: Array
    """(K, 3) m/s"""
    bias: Array
    """(K, 6) accelerometer m/s^2, gyro rad/s"""
    extra: Array
    """(K, E) zero where they are as stated"""

    @classmethod
    def of(cls, moments: InitialMoments) -> AugmentedStates:
        """Return the mean (1, ...) of a keyframe."""
        mean = (moments.R_nb, moments.p_n, moments.v_n, moments.bias, moments.extra)
        return cls(*(column[None] for column in mean))

    @property
    def navigation(self) -> NavigationStates:
        """The states without the extra variables."""
        return NavigationStates(self.R_nb, self.p_n, self.v_n, self.bias)

    def moments(self, covariance: Array) -> InitialMoments:
        """Return the first of these keyframes as mean with its covariance (15 + E, 15 + E)."""
        R_nb, p_n, v_n, bias, extra = (column[0] for column in self)
        return InitialMoments(R_nb, p_n, v_n, bias, covariance, extra)

    def moved(self, step: Array) -> AugmentedStates:
        """Return the states moved by local errors (K, 15 + E), the pose as GTSAM retracts it."""
        own = self.navigation.moved(step[:, :STATE_DIM])
        return AugmentedStates(*own, self.extra + step[:, STATE_DIM:])

    def take(self, keyframes: NDArray[np.intp] | slice) -> AugmentedStates:
        """Return the states of some keyframes."""
        return AugmentedStates(*(column[keyframes] for column in self))

    def followed_by(self, other: AugmentedStates) -> AugmentedStates:
        """Return these states, then the others."""
        return AugmentedStates(*(np.concatenate(pair) for pair in zip(self, other, strict=True)))


def local_D_deviation(xi: Array) -> Array:
    """Return how the local pose error at ``x.displaced(xi)`` follows that of ``xi``, (B, 6, 6).

    Velocity and biases follow as they are.
    """
    jacobian = np.zeros((len(xi), 6, 6))
    jacobian[:, :3, :3] = so3.left_jacobian(-xi[:, ROTATION])
    jacobian[:, 3:, 3:] = so3.exp(-xi[:, ROTATION])
    return jacobian


class KeyframeStates(Protocol):
    """Arrays of K keyframes, whoever estimated them."""

    @property
    def R_nb(self) -> Array:
        """(K, 3, 3)."""

    @property
    def p_n(self) -> Array:
        """(K, 3) m."""

    @property
    def v_n(self) -> Array:
        """(K, 3) m/s."""

    @property
    def bias(self) -> Array:
        """(K, 6) accelerometer m/s^2, gyro rad/s."""
