"""Truncated Taylor series in time: exact derivatives of closed-form motion.

A :class:`Series` carries a function of time as its normalised Taylor coefficients at every epoch,
so that velocities, accelerations and rates follow from positions and angles to rounding, without a
difference quotient. Coefficient ``k`` is the ``k``-th derivative over ``k!``. Operations on series
of different order give the lower order.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class Series:
    """A function of time, known at ``N`` epochs with its first derivatives."""

    __slots__ = ("coefficients",)

    def __init__(self, coefficients: Sequence[Array]) -> None:
        self.coefficients = tuple(coefficients)

    @property
    def order(self) -> int:
        """Highest derivative that is known."""
        return len(self.coefficients) - 1

    @property
    def value(self) -> Array:
        """The function itself."""
        return self.coefficients[0]

    @property
    def rate(self) -> Array:
        """First derivative, 1/s."""
        return self.coefficients[1]

    @property
    def acceleration(self) -> Array:
        """Second derivative, 1/s^2."""
        return 2.0 * self.coefficients[2]

    def derivative(self) -> Series:
        """Return the derivative as a series of one order less."""
        return Series([k * c for k, c in enumerate(self.coefficients)][1:])

    def cut(self, order: int) -> Series:
        """Return the series without the derivatives above ``order``."""
        return Series(self.coefficients[: order + 1])

    def __neg__(self) -> Series:
        return Series([-c for c in self.coefficients])

    def __add__(self, other: Series | float) -> Series:
        if isinstance(other, Series):
            pairs = zip(self.coefficients, other.coefficients, strict=False)
            return Series([a + b for a, b in pairs])
        return Series([self.coefficients[0] + other, *self.coefficients[1:]])

    def __sub__(self, other: Series | float) -> Series:
        return self + (-other)

    def __mul__(self, other: Series | float) -> Series:
        if not isinstance(other, Series):
            return Series([c * other for c in self.coefficients])
        a, b = self.coefficients, other.coefficients
        return Series([_dot(a, b, k) for k in range(min(len(a), len(b)))])

    def __truediv__(self, other: Series | float) -> Series:
        if not isinstance(other, Series):
            return self * (1.0 / other)
        quotient: list[Array] = []
        inverse = 1.0 / other.coefficients[0]
        for k in range(min(self.order, other.order) + 1):
            rest = self.coefficients[k]
            for i in range(k):
                rest = rest - quotient[i] * other.coefficients[k - i]
            quotient.append(rest * inverse)
        return Series(quotient)

    def __rtruediv__(self, other: float) -> Series:
        zeros = (np.array(0.0) for _ in range(self.order))
        return Series([np.array(other), *zeros]) / self

    __radd__ = __add__
    __rmul__ = __mul__

    def __rsub__(self, other: float) -> Series:
        return -self + other


def _dot(a: Sequence[Array], b: Sequence[Array], k: int) -> Array:
    """Return coefficient ``k`` of the product."""
    total = a[0] * b[k]
    for i in range(1, k + 1):
        total = total + a[i] * b[k - i]
    return total


def time_series(time_s: Array, *, order: int) -> Series:
    """Return time itself as a series of ``order`` at least 1."""
    return Series([time_s, np.array(1.0), *(np.array(0.0) for _ in range(order - 1))])


def constant(value: float, like: Series) -> Series:
    """Return a constant with the epochs and the order of ``like``."""
    zeros = np.zeros(np.broadcast_shapes(*(np.shape(c) for c in like.coefficients)))
    return Series([zeros + value, *(zeros for _ in range(like.order))])


def antiderivative(value: Array, derivative: Series) -> Series:
    """Return the series that has this value and this derivative."""
    return Series([value, *(c / (k + 1) for k, c in enumerate(derivative.coefficients))])


def sin_cos(x: Series) -> tuple[Series, Series]:
    """Return sine and cosine."""
    sine, cosine = [np.sin(x.value)], [np.cos(x.value)]
    weighted = x.derivative().coefficients
    for k in range(1, x.order + 1):
        sine.append(_dot(weighted, cosine, k - 1) / k)
        cosine.append(-_dot(weighted, sine, k - 1) / k)
    return Series(sine), Series(cosine)


def sqrt(x: Series) -> Series:
    """Return the square root of a positive series."""
    root = [np.sqrt(x.value)]
    half_inverse = 0.5 / root[0]
    for k in range(1, x.order + 1):
        rest = x.coefficients[k]
        for i in range(1, k):
            rest = rest - root[i] * root[k - i]
        root.append(rest * half_inverse)
    return Series(root)


def log(x: Series) -> Series:
    """Return the natural logarithm of a positive series."""
    return antiderivative(np.log(x.value), x.derivative() / x)


def atan2(y: Series, x: Series) -> Series:
    """Return the angle of ``(x, y)``, which must not vanish."""
    rate = (x * y.derivative() - y * x.derivative()) / (x * x + y * y)
    return antiderivative(np.arctan2(y.value, x.value), rate)


def tanh(x: Series) -> Series:
    """Return the hyperbolic tangent, from ``y' = (1 - y^2) x'``."""
    result = [np.tanh(x.value)]
    weighted = x.derivative().coefficients
    for k in range(1, x.order + 1):
        slope = [-_dot(result, result, i) for i in range(k)]
        slope[0] = slope[0] + 1.0
        result.append(_dot(weighted, slope, k - 1) / k)
    return Series(result)
