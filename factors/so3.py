"""Small vector and rotation algebra that NumPy and SciPy have only in a slower form."""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_NEXT, _AFTER = np.array([1, 2, 0]), np.array([2, 0, 1])
_EYE = np.eye(3)
SMALL_SQUARE: Final = 1e-2
"""rad^2; up to it series are used, where closed forms lose digits."""


def cross(a: Array, b: Array) -> Array:
    """Return ``a x b`` for vectors (..., 3) that broadcast: a seventh of ``numpy.cross``'s time.

    ``numpy.cross`` takes 16 us for one pair, most of it for the generality of its axes; the
    filters call this for every ping.
    """
    forwards = a.take(_NEXT, axis=-1) * b.take(_AFTER, axis=-1)
    return np.asarray(forwards - a.take(_AFTER, axis=-1) * b.take(_NEXT, axis=-1))


def times(matrix: Array, vector: Array) -> Array:
    """Return ``matrix @ vector`` for matrices (..., n, m) and vectors (..., m) that broadcast."""
    if matrix.ndim == 2:
        return np.asarray(vector @ matrix.T)  # one product of two matrices, not one for each vector
    return np.asarray((matrix @ vector[..., None])[..., 0])


_SKEW = np.zeros((3, 9))
for _axis, (_plus, _minus) in enumerate(((7, 5), (2, 6), (3, 1))):
    _SKEW[_axis, _plus], _SKEW[_axis, _minus] = 1.0, -1.0


def skew(a: Array) -> Array:
    """Return ``[a x]`` (..., 3, 3)."""
    return np.asarray((a @ _SKEW).reshape(*a.shape, 3))


def exp(phi: Array) -> Array:
    """Return the rotation matrix (..., 3, 3) of a rotation vector (..., 3), rad."""
    first, second, _ = coefficients(phi)
    return _polynomial(phi, first, second)


def left_jacobian(phi: Array) -> Array:
    """Return ``int_0^1 Exp(s phi) ds`` (..., 3, 3)."""
    _, second, third = coefficients(phi)
    return _polynomial(phi, second, third)


def left_jacobian_times(phi: Array, vector: Array) -> Array:
    """Return :func:`left_jacobian` times vectors (..., 3)."""
    _, second, third = coefficients(phi)
    once = cross(phi, vector)
    return np.asarray(vector + second * once + third * cross(phi, once))


def left_jacobian_solve(phi: Array, vector: Array) -> Array:
    """Return the inverse of :func:`left_jacobian` times vectors (..., 3), angles below 2 pi."""
    square = (phi * phi).sum(axis=-1, keepdims=True)
    factor = 1.0 / 12.0 + square / 720.0 + square**2 / 30240.0 + square**3 / 1209600.0
    if square.max(initial=0.0) > SMALL_SQUARE:
        first, second, _ = coefficients(phi)
        large = square > SMALL_SQUARE
        closed = (1.0 - 0.5 * first / second) / np.where(large, square, 1.0)
        factor = np.where(large, closed, factor)
    once = cross(phi, vector)
    return np.asarray(vector - 0.5 * once + factor * cross(phi, once))


_UNSKEW = np.zeros((9, 4))
for _axis, (_plus, _minus) in enumerate(((7, 5), (2, 6), (3, 1))):
    _UNSKEW[_plus, _axis], _UNSKEW[_minus, _axis] = 0.5, -0.5
    _UNSKEW[4 * _axis, 3] = 0.5


def log(R: Array) -> Array:
    """Return the rotation vector (..., 3) of a rotation matrix, rad; angles well below pi."""
    parts = R.reshape(*R.shape[:-2], 9) @ _UNSKEW
    sine_axis, cosine = parts[..., :3], parts[..., 3:] - 0.5
    sine = np.sqrt((sine_axis * sine_axis).sum(axis=-1, keepdims=True))
    angle = np.arctan2(sine, cosine)
    scale = np.divide(angle, sine, out=np.ones_like(sine), where=sine > 0.0)
    return np.asarray(scale * sine_axis)


def _polynomial(phi: Array, linear: Array, quadratic: Array) -> Array:
    """Return ``I + linear [phi x] + quadratic [phi x]^2`` (..., 3, 3)."""
    S = skew(phi)
    return np.asarray(np.eye(3) + linear[..., None] * S + quadratic[..., None] * (S @ S))


def coefficients(phi: Array) -> tuple[Array, Array, Array]:
    """Return ``sin a/a``, ``(1 - cos a)/a^2`` and ``(a - sin a)/a^3`` of the angle, (..., 1)."""
    square = (phi * phi).sum(axis=-1, keepdims=True)
    first = 1.0 - square / 6.0 * (
        1.0 - square / 20.0 * (1.0 - square / 42.0 * (1.0 - square / 72.0))
    )
    second = 0.5 - square / 24.0 * (
        1.0 - square / 30.0 * (1.0 - square / 56.0 * (1.0 - square / 90.0))
    )
    third = 1.0 - square / 20.0 * (1.0 - square / 42.0 * (1.0 - square / 72.0))
    third = third / 6.0
    if square.max(initial=0.0) > SMALL_SQUARE:
        large = square > SMALL_SQUARE
        square = np.where(large, square, 1.0)
        angle = np.sqrt(square)
        sinc = np.sin(angle) / angle
        first = np.where(large, sinc, first)
        second = np.where(large, 2.0 * (np.sin(0.5 * angle) / angle) ** 2, second)
        third = np.where(large, (1.0 - sinc) / square, third)
    return first, second, third


# Powers of the square of the angle in: (1 - cos a)/a^2, (a - sin a)/a^3, and what, times the
# vector, is the gradient of each; and in (1 - a/2 cot a/2)/a^2.
_SERIES = np.array(
    [
        [1 / 2, 1 / 6, -1 / 12, -1 / 60, 1 / 12],
        [-1 / 24, -1 / 120, 1 / 180, 1 / 1260, 1 / 720],
        [1 / 720, 1 / 5040, -1 / 6720, -1 / 60480, 1 / 30240],
        [-1 / 40320, -1 / 362880, 1 / 453600, 1 / 4989600, 1 / 1209600],
        [1 / 3628800, 1 / 39916800, -1 / 47900160, -1 / 622702080, 1 / 47900160],
    ]
)
_POWERS = np.arange(5)


class Jacobians(NamedTuple):
    """Of rotation vectors (..., 3), all that derivatives of extended poses are made of."""

    phi: Array
    skew: Array
    """(..., 3, 3)"""
    coefficients: Array
    """(..., 5)"""

    @classmethod
    def of(cls, phi: Array) -> Jacobians:
        """Return them of rotation vectors, rad, angles below 2 pi."""
        square = (phi * phi).sum(axis=-1, keepdims=True)
        found = np.minimum(square, SMALL_SQUARE) ** _POWERS @ _SERIES
        if square.max(initial=0.0) > SMALL_SQUARE:
            large = square > SMALL_SQUARE
            square = np.where(large, square, 1.0)
            first, second, third = coefficients(phi)
            closed = np.concatenate(
                [
                    second,
                    third,
                    (first - 2.0 * second) / square,
                    (second - 3.0 * third) / square,
                    (1.0 - 0.5 * first / second) / square,
                ],
                axis=-1,
            )
            found = np.where(large, closed, found)
        return cls(phi, skew(phi), found)

    def left(self) -> Array:
        """Return :func:`left_jacobian` (..., 3, 3)."""
        S, k = self.skew, self.coefficients[..., None]
        return np.asarray(_EYE + k[..., :1, :] * S + k[..., 1:2, :] * (S @ S))

    def left_inverse(self) -> Array:
        """Return its inverse (..., 3, 3)."""
        S = self.skew
        return np.asarray(_EYE - 0.5 * S + self.coefficients[..., 4:, None] * (S @ S))

    def slope(self, vectors: Array) -> Array:
        """Return how ``left() a`` follows the rotation vector, (..., m, 3, 3) of m ``a``."""
        S, k = self.skew, self.coefficients[..., None, :]
        once = vectors @ S.mT  # phi x a
        along = k[..., 2:3] * once + k[..., 3:4] * (once @ S.mT)
        straight = skew(k[..., :1] * vectors + k[..., 1:2] * once)
        bent = k[..., 1:2, None] * (S[..., None, :, :] @ skew(vectors))
        return np.asarray(along[..., None] * self.phi[..., None, None, :] - straight - bent)
