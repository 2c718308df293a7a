"""Preintegrated inertial data between two states: prediction, error and Jacobians, in bulk.

Over an interval ``t`` the specific force acts as in an inertial frame that coincides with the
navigation frame at the begin; gravity is constant in the navigation frame; at the end the turn of
the Earth is taken out again, with ``E = Exp(-omega t)``::

    R' = E R dR
    p' = E (p + t (v + omega x p) + t^2 J2 g + R dp)
    v' = E (v + omega x p + t J1 g + R dv) - omega x p'

``J1 = int_0^1 Exp(s omega t) ds`` and ``J2 = int_0^1 (1 - s) Exp(s omega t) ds``. The error of two
states is ``Log(X_j^-1 X')`` of the extended pose ``X = (R, p, v)`` [1]_ and ``b_i - b_j``: that of
GTSAM's ``GalileanCombinedImuFactor``, whose gravity is a parameter where here it is an argument.

References
----------
.. [1] M. Brossard, A. Barrau, P. Chauchat, S. Bonnabel, "Associating Uncertainty to Extended Poses
   for on Lie Group IMU Preintegration With Rotating Earth", IEEE Transactions on Robotics, 2022.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Protocol, Self

import numpy as np
from numpy.typing import NDArray

from factors import so3
from factors.imu_errors import by_noise_scale, noise_scale
from factors.so3 import Array

_ROTATION, _POSITION, _VELOCITY = slice(0, 3), slice(3, 6), slice(6, 9)
_BIAS = slice(9, 15)
_AT_ONCE = 128
"""So many intervals stay in the processor's cache, from the first product to the last."""
_EYE = np.eye(3)
_EYE.setflags(write=False)


class MovingState(Protocol):
    """States at one end of I intervals, whoever holds them."""

    @property
    def R_nb(self) -> Array:
        """(I, 3, 3)."""

    @property
    def p_n(self) -> Array:
        """(I, 3) m."""

    @property
    def v_n(self) -> Array:
        """(I, 3) m/s."""

    @property
    def bias(self) -> Array:
        """(I, 6) accelerometer m/s^2, gyro rad/s."""


class InertialState(NamedTuple):
    """States at one end of I intervals."""

    R_nb: Array
    """(I, 3, 3)"""
    p_n: Array
    """(I, 3) m"""
    v_n: Array
    """(I, 3) m/s"""
    bias: Array
    """(I, 6) accelerometer m/s^2, gyro rad/s"""


class Intervals(NamedTuple):
    """What the inertial sensors say of I intervals, relative to the attitude at their begin."""

    span_s: Array
    """(I,)"""
    delta_R: Array
    """(I, 3, 3) rotation of the body"""
    delta_pv: Array
    """(I, 2, 3) m and m/s, displacement and velocity change by specific force"""
    bias: Array
    """(I, 6) about which they are preintegrated"""
    delta_D_bias: Array
    """(I, 9, 6) rotation, position, velocity, all in body axes at the end, with respect to the
    biases: other ones by ``b`` move the increment by ``Exp(delta_D_bias b)``."""
    covariance: Array
    """(I, 15, 15) noise of rotation, position, velocity (body axes at the end) and biases"""
    root_information: Array
    """(I, 15, 15) upper triangular ``W`` with ``W' W`` the inverse of that"""
    along: Array
    """(I, 6, 6) position and velocity at the end, navigation axes, from those at the begin"""
    by_force: Array
    """(I, 6, 6) the same from ``R dp`` and ``R dv``"""
    by_gravity: Array
    """(I, 6, 3) the same from gravity"""
    errors: Array
    """(I, E) errors of the sensors, see :mod:`factors.imu_errors`, that are taken off already; E is
    27, or zero where none of them is a variable"""
    delta_D_errors: Array
    """(I, 9, E) how the increment follows them, as it does the biases"""

    @classmethod
    def of(
        cls,
        span_s: Array,
        delta_R: Array,
        delta_pv: Array,
        bias: Array,
        delta_D_bias: Array,
        covariance: Array,
        *,
        omega_ie_n: Array,
    ) -> Self:
        """Return intervals from what is measured, see there, and the turn of the Earth (3,).

        They do not follow errors of the sensors.
        """
        turn = span_s[:, None] * omega_ie_n
        Omega, t = so3.skew(omega_ie_n), span_s[:, None, None]
        E = so3.exp(-turn)
        S = so3.skew(turn)
        J2 = np.eye(3) / 2.0 + S / 6.0 + S @ S / 24.0 + S @ S @ S / 120.0  # the turn is small
        eye = np.eye(3)
        p_D_p, p_D_v = E @ (eye + t * Omega), t * E
        p_D_g = t**2 * (E @ J2)
        along = np.concatenate(
            [
                np.concatenate([p_D_p, p_D_v], axis=2),
                np.concatenate([E @ Omega - Omega @ p_D_p, E - Omega @ p_D_v], axis=2),
            ],
            axis=1,
        )
        by_force = np.zeros((len(t), 6, 6))
        by_force[:, :3, :3] = by_force[:, 3:, 3:] = E
        by_force[:, 3:, :3] = -Omega @ E
        v_D_g = t * (E @ so3.left_jacobian(turn)) - Omega @ p_D_g
        sigma = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
        correlation = covariance / (sigma[:, :, None] * sigma[:, None, :])
        root = np.linalg.cholesky(np.linalg.inv(correlation)).mT
        made = cls(
            span_s,
            delta_R,
            delta_pv,
            bias,
            delta_D_bias,
            covariance,
            root / sigma[:, None, :],
            along,
            by_force,
            np.concatenate([p_D_g, v_D_g], axis=1),
            np.zeros((len(span_s), 0)),
            np.zeros((len(span_s), 9, 0)),
        )
        for column in made:
            column.setflags(write=False)
        return made

    def take(self, which: slice | NDArray[np.intp]) -> Intervals:
        """Return some of them."""
        return Intervals(*(column[which] for column in self))

    def without_errors(self, errors: Array) -> Intervals:
        """Return the same with errors (27,) or (I, 27) taken off, as if they were known."""
        if self.errors.shape[1] == 0:
            return self
        moved = _corrected(self, self.bias, errors, derivative=False)
        return self.as_noisy_as(errors)._replace(
            delta_R=moved.R,
            delta_pv=moved.pv,
            errors=self.errors[:, :0],
            delta_D_errors=self.delta_D_errors[:, :, :0],
        )

    def as_noisy_as(self, errors: Array | None) -> Intervals:
        """Return the same with the noise that is left where errors (27,) or (I, 27) are taken off.

        White noise is that of readings: of ``(I - W) gyro`` it is ``I - W`` times as much. Were it
        not, a scale that makes the readings vanish would explain them best.
        """
        if errors is None or self.errors.shape[1] == 0:
            return self
        scale = noise_scale(errors)
        grown = scale @ self.covariance @ scale.mT
        root = self.root_information @ np.linalg.inv(scale)
        return self._replace(covariance=grown, root_information=root)

    @staticmethod
    def joined(parts: Sequence[Intervals]) -> Intervals:
        """Return the intervals of all parts, one after the other."""
        if len(parts) == 1:
            return parts[0]
        made = Intervals(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))
        for column in made:
            column.setflags(write=False)
        return made


class Predicted(NamedTuple):
    """States at the end of I intervals as they follow from those at the begin."""

    state: InertialState
    transition: Array
    """(I, 15, 15 + E) of the error state: rotation and position in body axes, velocity in
    navigation axes, biases; then how it follows the errors of the sensors"""
    at_end: Array
    """(I, 2, 3, 3) position and velocity, navigation axes, by gravity's change along with the end
    alone, whose position is in body axes"""

    def noise(self, m: Intervals) -> Array:
        """Return the covariance (I, 15, 15) that the intervals add to that carried here."""
        R_nb = self.state.R_nb
        noise = np.tile(m.covariance, (len(R_nb) // len(m.covariance), 1, 1))
        noise[:, _VELOCITY] = R_nb @ noise[:, _VELOCITY]
        noise[:, :, _VELOCITY] = noise[:, :, _VELOCITY] @ R_nb.mT
        back = np.concatenate([R_nb.mT @ self.at_end[:, 0], self.at_end[:, 1]], axis=1)
        # What the noise moves moves gravity.
        half = np.zeros_like(noise)
        half[:, 3:9] = back @ noise[:, _POSITION]
        return noise + half + half.mT

    def rows(self, m: Intervals) -> Array:
        """Return :func:`whitened_rows` with these states at the end, where the error is zero."""
        R_bn, root = self.state.R_nb.mT, m.root_information
        rows = np.zeros((len(root), 15, self.transition.shape[2] + 16))
        end = rows[:, :, 15:30]
        np.negative(root, out=end)
        end[:, :, _VELOCITY] = end[:, :, _VELOCITY] @ R_bn
        by_position, by_velocity = root[:, :, _POSITION] @ R_bn, root[:, :, _VELOCITY] @ R_bn
        end[:, :, _POSITION] += by_position @ self.at_end[:, 0] + by_velocity @ self.at_end[:, 1]
        begin = end @ self.transition
        np.negative(begin[:, :, :15], out=rows[:, :, :15])
        np.negative(begin[:, :, 15:], out=rows[:, :, 30:-1])
        return rows


class _Increment(NamedTuple):
    """Increments for the biases at hand."""

    R: Array
    pv: Array
    D_bias: Array
    """(I, 3, 3, 6 + E) rotation, position, velocity, in body axes at the end, by biases and errors;
    none if not asked for"""


class _Slopes(NamedTuple):
    """How the predicted end follows the error state at the begin, and the errors of the sensors."""

    rotation: Array
    """(I, 3, 15 + E) in body axes at the end"""
    pv: Array
    """(I, 2, 3, 15 + E) position and velocity, navigation axes"""
    gravity: Array
    """(I, 2, 3, 3) the same with respect to half the change of gravity at the end, 1/s^2 taken"""


def predict(
    m: Intervals,
    begin: MovingState,
    *,
    g_n: Array,
    gradient: Array,
    errors: Array | None = None,
) -> Predicted:
    """Return states and transition at the end of intervals.

    Parameters
    ----------
    m : I intervals; or one, for I states at its begin.
    begin : the states at their begin.
    g_n : (I, 3) m/s^2, gravity without the centrifugal term.
    gradient : (3, 3) 1/s^2, how gravity changes with position. It is that of the middle between
        both ends, so the transition knows of half the change at either; the state itself takes
        ``g_n`` as it is.
    errors : (I, 27) or (27,) of the sensors, where ``m`` follows them; those that are taken off
        already when left out.
    """
    increment = _corrected(m, begin.bias, errors, derivative=True)
    end = _predicted(m, begin, increment, g_n)
    slopes = _slopes(m, begin, end, increment, gradient)
    R_bn, at_end = end.R_nb.mT, slopes.gravity
    transition = np.zeros((len(R_bn), 15, slopes.rotation.shape[2]))
    transition[:, _ROTATION] = slopes.rotation
    # Gravity of the middle changes along with the end, too: a millionth of its way, twice is exact.
    first = R_bn @ slopes.pv[:, 0]
    along = R_bn @ at_end[:, 0]
    position = first + along @ (first + along @ first)
    transition[:, _POSITION] = position
    transition[:, _VELOCITY] = slopes.pv[:, 1] + at_end[:, 1] @ position
    bias = range(9, 15)
    transition[:, bias, bias] = 1.0
    return Predicted(end, transition, at_end)


def whitened_error(
    m: Intervals,
    begin: MovingState,
    end: MovingState,
    *,
    g_n: Array,
    errors: Array | None = None,
) -> Array:
    """Return the whitened errors (I, 15) of states at both ends, parameters of :func:`predict`."""
    m = m.as_noisy_as(errors)
    predicted = _predicted(m, begin, _corrected(m, begin.bias, errors, derivative=False), g_n)
    R, pv = _between(end, predicted)
    phi = so3.log(R)
    error = np.empty((len(phi), 15))
    error[:, :3] = phi
    error[:, 3:9] = (pv @ so3.Jacobians.of(phi).left_inverse().mT).reshape(-1, 6)
    error[:, 9:] = begin.bias - end.bias
    return so3.times(m.root_information, error)


def whitened_rows(
    m: Intervals,
    begin: MovingState,
    end: MovingState,
    *,
    g_n: Array,
    gradient: Array,
    errors: Array | None = None,
) -> Array:
    """Return whitened rows ``A d = b`` (I, 15, 31 + E).

    Columns are the error states at begin and end, the errors of the sensors, and ``b``. Parameters
    as of :func:`predict`. An error state is rotation and position in body axes, velocity in
    navigation axes, biases.
    """
    off = m.errors if errors is None else np.broadcast_to(errors, m.errors.shape)
    rows = np.empty((len(g_n), 15, 31 + off.shape[1]))
    for i in range(0, len(g_n), _AT_ONCE):
        at = slice(i, i + _AT_ONCE)
        own = (InertialState(x.R_nb[at], x.p_n[at], x.v_n[at], x.bias[at]) for x in (begin, end))
        _fill_rows(rows[at], m.take(at), *own, g_n=g_n[at], gradient=gradient, errors=off[at])
    return rows


def _fill_rows(
    rows: Array,
    m: Intervals,
    begin: MovingState,
    end: MovingState,
    *,
    g_n: Array,
    gradient: Array,
    errors: Array,
) -> None:
    m = m.as_noisy_as(errors)
    increment = _corrected(m, begin.bias, errors, derivative=True)
    predicted = _predicted(m, begin, increment, g_n)
    slopes = _slopes(m, begin, end, increment, gradient)
    R, pv = _between(end, predicted)
    phi = so3.log(R)
    J = so3.Jacobians.of(phi)
    from_left = J.left_inverse()
    tangent = pv @ from_left.mT
    from_right = from_left @ R  # of the rotation vector by a local error of the prediction
    bent = from_left[:, None] @ J.slope(tangent)
    from_nav = (from_left @ end.R_nb.mT)[:, None]
    # Columns: error state at the begin 15, errors of the sensors, from ``n`` on rotation, position,
    # velocity at the end 9, b.
    n = slopes.rotation.shape[2]
    error = np.zeros((len(phi), 3, 3, n + 10))
    error[:, 0, :, :n] = from_right @ slopes.rotation
    error[:, 1:, :, :n] = from_nav @ slopes.pv - bent @ error[:, :1, :, :n]
    error[:, 0, :, n : n + 3] = -from_left
    error[:, 1:, :, n : n + 3] = bent @ from_left[:, None] + from_left[:, None] @ so3.skew(pv)
    error[:, 1:, :, n + 3 : n + 6] = from_nav @ slopes.gravity
    error[:, 1, :, n + 3 : n + 6] -= from_left
    error[:, 2, :, n + 6 : n + 9] = -from_nav[:, 0]
    if n > 15:
        error[..., 15:n] += by_noise_scale(errors, np.concatenate([phi[:, None], tangent], axis=1))
    error[:, 0, :, -1] = -phi
    error[:, 1:, :, -1] = -tangent
    root = m.root_information
    whitened = root[:, :, :9] @ error.reshape(-1, 9, n + 10)
    rows[:, :, :15] = whitened[:, :, :15]
    rows[:, :, _BIAS] += root[:, :, 9:]
    rows[:, :, 15:24] = whitened[:, :, n : n + 9]
    np.negative(root[:, :, 9:], out=rows[:, :, 24:30])
    rows[:, :, 30:-1] = whitened[:, :, 15:n]
    rows[:, :, -1] = whitened[:, :, -1]
    rows[:, :, -1] += so3.times(root[:, :, 9:], end.bias - begin.bias)


def _corrected(m: Intervals, bias: Array, errors: Array | None, *, derivative: bool) -> _Increment:
    """Return the increments for other biases and errors than those they are preintegrated about."""
    xi = so3.times(m.delta_D_bias, bias - m.bias)
    if errors is not None and m.errors.shape[1]:
        xi = xi + so3.times(m.delta_D_errors, errors - m.errors)
    xi = xi.reshape(-1, 3, 3)
    phi, shift = xi[:, 0], xi[:, 1:]
    jacobians = so3.Jacobians.of(phi)
    J = jacobians.left()
    turn = _EYE + jacobians.skew @ J
    pv = m.delta_pv + shift @ (m.delta_R @ J).mT
    R = m.delta_R @ turn
    if not derivative:
        return _Increment(R, pv, _EYE)
    by_bias = m.delta_D_bias.reshape(-1, 3, 3, 6)
    if m.errors.shape[1]:
        by_errors = m.delta_D_errors.reshape(-1, 3, 3, m.errors.shape[1])
        by_bias = np.concatenate([by_bias, by_errors], axis=3)
    D_bias = J.mT[:, None] @ by_bias
    D_bias[:, 1:] += (turn.mT[:, None] @ jacobians.slope(shift)) @ by_bias[:, :1]
    return _Increment(R, pv, D_bias)


def _predicted(
    m: Intervals, begin: MovingState, increment: _Increment, g_n: Array
) -> InertialState:
    R_nb = begin.R_nb
    force = (increment.pv @ R_nb.mT).reshape(-1, 6)
    at = np.concatenate([begin.p_n, begin.v_n], axis=1)
    end = so3.times(m.along, at) + so3.times(m.by_gravity, g_n) + so3.times(m.by_force, force)
    E = m.by_force[:, :3, :3]
    return InertialState(E @ R_nb @ increment.R, end[:, :3], end[:, 3:], begin.bias)


def _between(end: MovingState, predicted: InertialState) -> tuple[Array, Array]:
    """Return ``X_j^-1 X'``: rotation (I, 3, 3), position and velocity (I, 2, 3)."""
    apart = np.stack([predicted.p_n - end.p_n, predicted.v_n - end.v_n], axis=1)
    return end.R_nb.mT @ predicted.R_nb, apart @ end.R_nb


def _slopes(
    m: Intervals, begin: MovingState, end: MovingState, increment: _Increment, gradient: Array
) -> _Slopes:
    """Return how the predicted end follows the begin; gravity there is that of ``end``."""
    n, R_nb, R = len(begin.p_n), begin.R_nb, increment.R
    width = 9 + increment.D_bias.shape[3]
    inner = np.empty((n, 2, 3, width - 6))
    np.negative(so3.skew(increment.pv), out=inner[..., :3])
    np.matmul(R[:, None], increment.D_bias[:, 1:], out=inner[..., 3:])
    by_force = m.by_force @ (R_nb[:, None] @ inner).reshape(n, 6, width - 6)
    by_gravity = m.by_gravity @ (0.5 * gradient)
    pv = np.empty((n, 6, width))
    pv[:, :, _ROTATION] = by_force[:, :, :3]
    pv[:, :, _POSITION] = (m.along[:, :, :3] + by_gravity) @ R_nb
    pv[:, :, _VELOCITY] = m.along[:, :, 3:]
    pv[:, :, 9:] = by_force[:, :, 3:]
    rotation = np.zeros((n, 3, width))
    rotation[:, :, _ROTATION] = R.mT
    rotation[:, :, 9:] = increment.D_bias[:, 0]
    return _Slopes(
        rotation, pv.reshape(n, 2, 3, width), (by_gravity @ end.R_nb).reshape(n, 2, 3, 3)
    )
