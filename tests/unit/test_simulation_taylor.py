"""Taylor series in time: every function against the derivatives it must have."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest

from ssm_graph.base.frozen import Array
from ssm_graph.simulation.taylor import (
    Series,
    antiderivative,
    atan2,
    constant,
    log,
    sin_cos,
    sqrt,
    tanh,
    time_series,
)

TIMES = np.array([-1.7, 0.0, 0.3, 2.9])


def wave(t: Series) -> Series:
    """Return a positive function with derivatives of every order."""
    return sin_cos(t * 1.3 + 0.2)[0] * 0.4 + t * t * 0.05 + 2.0


FUNCTIONS: dict[str, Callable[[Series], Series]] = {
    "product": lambda t: wave(t) * sin_cos(t)[0],
    "quotient": lambda t: sin_cos(t)[1] / wave(t),
    "reciprocal": lambda t: 2.0 / wave(t),
    "sqrt": lambda t: sqrt(wave(t)),
    "log": lambda t: log(wave(t)),
    "tanh": lambda t: tanh(wave(t) - 2.0),
    "atan2": lambda t: atan2(sin_cos(t)[0] * 2.0 + 0.1, wave(t)),
    "affine": lambda t: 1.0 - (-wave(t) + 3.0 * t) / 7.0,
}


@pytest.mark.parametrize("name", FUNCTIONS)
def test_coefficients_are_those_of_the_function(name: str) -> None:
    """A series to order 7 predicts the function a tenth of a second away."""
    step = 0.1
    coefficients = FUNCTIONS[name](time_series(TIMES, order=7)).coefficients
    predicted = sum(c * step**k for k, c in enumerate(coefficients))
    exact = FUNCTIONS[name](time_series(TIMES + step, order=1)).value
    np.testing.assert_allclose(predicted, exact, atol=2e-8)


@pytest.mark.parametrize("name", FUNCTIONS)
def test_first_and_second_derivative(name: str) -> None:
    """Rate and acceleration equal central differences of value and rate."""
    step = 1e-5

    def at(times: Array) -> Series:
        return FUNCTIONS[name](time_series(times, order=2))

    rate = (at(TIMES + step).value - at(TIMES - step).value) / (2.0 * step)
    acceleration = (at(TIMES + step).rate - at(TIMES - step).rate) / (2.0 * step)
    np.testing.assert_allclose(at(TIMES).rate, rate, atol=1e-9)
    np.testing.assert_allclose(at(TIMES).acceleration, acceleration, atol=1e-9)


def test_sine_and_cosine_stay_on_the_circle() -> None:
    """All derivatives of ``sin^2 + cos^2`` vanish."""
    sine, cosine = sin_cos(wave(time_series(TIMES, order=6)))
    ones, *zeros = (sine * sine + cosine * cosine).coefficients
    np.testing.assert_allclose(ones, 1.0, atol=1e-15)
    np.testing.assert_allclose(zeros, 0.0, atol=1e-14)


def test_roots_invert_squares() -> None:
    """The square root squares back, order by order."""
    x = wave(time_series(TIMES, order=5))
    for got, want in zip((sqrt(x) * sqrt(x)).coefficients, x.coefficients, strict=True):
        np.testing.assert_allclose(got, want, atol=1e-13)


def test_antiderivative_gains_an_order_and_cut_loses_it() -> None:
    """Derivative and antiderivative are inverse."""
    x = wave(time_series(TIMES, order=3))
    back = antiderivative(x.value, x.derivative())
    assert back.order == 3
    assert back.cut(1).order == 1
    for got, want in zip(back.coefficients, x.coefficients, strict=True):
        np.testing.assert_allclose(got, want, atol=1e-15)


def test_constants_do_not_move() -> None:
    """A constant has the epochs and the order of its model, and no derivatives."""
    series = constant(math.pi, time_series(TIMES, order=2))
    assert series.order == 2
    np.testing.assert_array_equal(series.value, np.full(4, math.pi))
    np.testing.assert_array_equal(series.rate, np.zeros(4))
    np.testing.assert_array_equal(series.acceleration, np.zeros(4))
