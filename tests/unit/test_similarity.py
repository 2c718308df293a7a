"""Similarity kernels: laws for all parameters, then limits, then the numbers of the tables."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from factors.similarity import (
    WEIGHT_FLOOR,
    ExpKernel,
    GaussianKernel,
    Kernel,
    LogKernel,
    SqrtKernel,
    expected_mahalanobis_sq,
)
from tests.helpers import STEADY

parameters = st.floats(0.5, 1e4)
kernels = st.one_of(
    st.just(GaussianKernel()),
    parameters.map(LogKernel),
    parameters.map(SqrtKernel),
    parameters.map(ExpKernel),
)
robust_kernels = st.one_of(
    *(st.floats(0.5, 100.0).map(make) for make in (LogKernel, SqrtKernel, ExpKernel))
)
dims = st.integers(1, 4)
lengths = st.floats(0.0, 1e3)
with_parameter = pytest.mark.parametrize("make", [LogKernel, SqrtKernel, ExpKernel])


@STEADY
@given(kernel=kernels, dim=dims)
def test_a_residual_of_expected_size_keeps_its_noise(kernel: Kernel, dim: int) -> None:
    """``weight(dim) = 1`` whatever the parameter."""
    assert kernel.weight(float(dim), dim=dim) == pytest.approx(1.0, rel=1e-12)


@STEADY
@given(kernel=robust_kernels, dim=dims, t=st.lists(lengths, min_size=2, unique=True))
def test_larger_residuals_weigh_less(kernel: Kernel, dim: int, t: list[float]) -> None:
    """Weights are positive, never rise, and fall where they are not at the floor."""
    weight = kernel.weight(np.sort(t), dim=dim)
    assert np.all(weight >= WEIGHT_FLOOR)
    assert np.all(np.diff(weight) <= 0.0)
    apart = (np.diff(np.sort(t)) > 1e-6) & (weight[:-1] > WEIGHT_FLOOR)
    assert np.all(np.diff(weight)[apart] < 0.0)


@STEADY
@given(kernel=kernels, dim=dims, t=st.floats(0.0, 300.0))
def test_weight_is_minus_twice_the_slope_of_the_similarity(
    kernel: Kernel, dim: int, t: float
) -> None:
    """Central differences of ``f``; near 0 from the inside."""
    step = 1e-3
    middle = max(t, step)
    above, below = (kernel.similarity(np.array(middle + s), dim=dim) for s in (step, -step))
    slope = float(above - below) / (2.0 * step)
    scale = max(abs(float(kernel.similarity(np.array(middle), dim=dim))), 1.0)
    # The rounding of f over the step, and the third derivative times step^2.
    assert float(kernel.weight(middle, dim=dim)) == pytest.approx(
        -2.0 * slope, rel=1e-5, abs=1e-15 * scale / step * 4.0 + 2.0 * WEIGHT_FLOOR
    )


@STEADY
@given(kernel=kernels, dim=dims, a=lengths, b=lengths)
def test_similarity_is_convex(kernel: Kernel, dim: int, a: float, b: float) -> None:
    """The bound of the method rests on Jensen's inequality, for which ``f`` must be convex."""
    ends = kernel.similarity(np.array([a, b]), dim=dim)
    middle = float(kernel.similarity(np.array(0.5 * (a + b)), dim=dim))
    assert middle <= float(ends.mean()) + 1e-12 * (1.0 + float(np.abs(ends).max()))


@with_parameter
@STEADY
@given(t=lengths, dim=dims)
def test_an_infinite_parameter_is_least_squares(
    make: Callable[[float], Kernel], t: float, dim: int
) -> None:
    """Without heavy tails every kernel disappears."""
    assert make(1e12).weight(t, dim=dim) == pytest.approx(1.0, abs=1e-8)


@with_parameter
def test_rejected_measurements_keep_the_floor(make: Callable[[float], Kernel]) -> None:
    """An information of zero would leave keyframes undetermined."""
    weight = make(5.0).weight(np.array([1e18, 1e300, np.inf]))
    np.testing.assert_array_equal(weight, WEIGHT_FLOOR)


def test_weights_of_a_hundred_sigma_outlier() -> None:
    """Hand-computed values: log and exp let go, sqrt keeps pulling."""
    t = 1e4
    assert float(LogKernel(dof=5.0).weight(t)) == pytest.approx(6.0 / 10005.0, rel=1e-12)
    assert float(SqrtKernel(dof=5.0).weight(t)) == pytest.approx(
        math.sqrt(6.0 / 10005.0), rel=1e-12
    )
    assert float(ExpKernel(width=5.0).weight(t)) == WEIGHT_FLOOR
    assert float(ExpKernel(width=5.0).weight(26.0)) == pytest.approx(math.exp(-0.5), rel=1e-12)
    assert float(GaussianKernel().weight(t)) == 1.0


def test_weights_keep_the_shape_of_their_input() -> None:
    """Pings by beams in, pings by beams out."""
    t = np.linspace(0.0, 9.0, 12).reshape(3, 4)
    for kernel in (GaussianKernel(), LogKernel(), SqrtKernel(), ExpKernel()):
        assert kernel.weight(t).shape == (3, 4)
        assert np.asarray(kernel.similarity(t)).shape == (3, 4)


@with_parameter
@pytest.mark.parametrize("value", [0.0, -1.0, math.nan, math.inf])
def test_bad_parameters_are_refused(make: Callable[[float], Kernel], value: float) -> None:
    """A kernel parameter is a finite number above zero; the message names it."""
    with pytest.raises(ValueError, match=r"^(dof|width): expected a number above zero, got"):
        make(value)


def test_kernels_are_equal_by_value_and_say_what_they_are() -> None:
    """The smoother compares kernels, the result files print them."""
    log: Kernel = LogKernel(5.0)
    sqrt: Kernel = SqrtKernel(5.0)
    assert log == LogKernel(dof=5.0) != LogKernel(4.0)
    assert log != sqrt
    kernels_ = (GaussianKernel(), LogKernel(5.0), SqrtKernel(2.5), ExpKernel(4.0))
    texts = [str(kernel) for kernel in kernels_]
    assert texts == ["gaussian", "log(dof=5)", "sqrt(dof=2.5)", "exp(width=4)"]


@STEADY
@given(innovation=st.floats(-10.0, 10.0), spread=st.floats(0.0, 10.0), sigma=st.floats(1e-3, 10.0))
def test_expected_length_is_that_of_samples(innovation: float, spread: float, sigma: float) -> None:
    """Two points one spread either side have exactly the expected mean square."""
    ends = innovation + np.sqrt(spread) * np.array([-1.0, 1.0])
    t = expected_mahalanobis_sq(np.array(innovation), np.array(spread), sigma=sigma)
    assert float(t) == pytest.approx(float(np.mean((ends / sigma) ** 2)), rel=1e-9, abs=1e-12)


def test_posterior_variance_lowers_the_weight_and_its_absence_is_the_m_estimator() -> None:
    """A residual in doubt counts less than one that is known; arrays and sigmas broadcast."""
    innovation, sigma = np.array([[0.0, 0.01], [0.02, 0.0]]), np.array([0.005, 0.01])
    plain = expected_mahalanobis_sq(innovation, np.zeros((2, 2)), sigma=sigma)
    np.testing.assert_allclose(plain, [[0.0, 1.0], [16.0, 0.0]], rtol=1e-12)
    doubted = expected_mahalanobis_sq(innovation, np.full((2, 2), 1e-4), sigma=sigma)
    np.testing.assert_allclose(doubted - plain, [[4.0, 1.0], [4.0, 1.0]], rtol=1e-12)
    assert np.all(LogKernel().weight(doubted) < LogKernel().weight(plain))
