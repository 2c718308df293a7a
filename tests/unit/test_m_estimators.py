"""Classical M-estimators: laws, GTSAM's own losses, limits, the constants, and their names."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import gtsam
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import chi2, norm

import ssm_graph
from factors.kernels import (
    KERNELS,
    WIDTH_OF_99_PERCENT,
    CauchyKernel,
    DcsKernel,
    GemanMcClureKernel,
    GeneralKernel,
    HuberKernel,
    MEstimator,
    TruncatedKernel,
    fitted_shape,
    log_partition,
    parse_kernel,
)
from factors.similarity import WEIGHT_FLOOR, GaussianKernel, Kernel, LogKernel, Similarity
from ssm_graph.base.errors import ConfigError
from ssm_graph.cli.options import kernel_from
from ssm_graph.cli.smooth import CHOICES
from ssm_graph.smoothers import batch
from ssm_graph.smoothers.batch import SmootherConfig
from tests.helpers import STEADY

loss_of = gtsam.noiseModel.mEstimator

MAKERS = (HuberKernel, CauchyKernel, DcsKernel, GemanMcClureKernel, TruncatedKernel)
parameters = st.floats(0.3, 50.0)
surrogates = st.builds(TruncatedKernel, parameters, st.floats(1e-3, 1e3))
shaped = st.builds(GeneralKernel, st.floats(-10.0, 2.0) | st.sampled_from([0.0, 1.0]), parameters)
estimators = st.one_of(surrogates, shaped, *(parameters.map(make) for make in MAKERS))
lengths = st.floats(0.0, 1e3)
with_parameter = pytest.mark.parametrize("make", MAKERS)


@STEADY
@given(kernel=estimators, t=st.lists(lengths, min_size=2))
def test_weights_lie_between_the_floor_and_one_and_never_rise(
    kernel: MEstimator, t: list[float]
) -> None:
    """A residual of zero counts in full, every larger one at most as much."""
    weight = kernel.weight(np.sort([0.0, *t]))
    assert weight[0] == 1.0
    assert weight.min() >= WEIGHT_FLOOR
    assert np.all(np.diff(weight) <= 1e-12)


@STEADY
@given(kernel=estimators, t=lengths)
def test_weight_is_minus_twice_the_slope_of_the_similarity(kernel: MEstimator, t: float) -> None:
    """The loss between two lengths lies between what the weights at both would make of it."""
    step = 1e-3
    rise = float(kernel.similarity(np.array(t)) - kernel.similarity(np.array(t + step)))
    last, first = kernel.weight(np.array([t + step, t]))
    rounding = 1e-12 * (1.0 + abs(float(kernel.similarity(np.array(t)))))
    assert 0.5 * step * (last - 2.0 * WEIGHT_FLOOR) - rounding <= rise
    assert rise <= 0.5 * step * first + rounding


@STEADY
@given(kernel=estimators, a=lengths, b=lengths)
def test_similarity_is_convex_and_zero_at_zero(kernel: MEstimator, a: float, b: float) -> None:
    """So the posterior variance may be put into ``t``: Jensen's inequality holds."""
    assert float(kernel.similarity(np.array(0.0))) == 0.0
    ends = kernel.similarity(np.array([a, b]))
    middle = float(kernel.similarity(np.array(0.5 * (a + b))))
    assert middle <= float(ends.mean()) + 1e-12 * (1.0 + float(np.abs(ends).max()))


@pytest.mark.parametrize(
    ("make", "theirs"),
    [
        (HuberKernel, loss_of.Huber),
        (CauchyKernel, loss_of.Cauchy),
        (DcsKernel, loss_of.DCS),
        (GemanMcClureKernel, loss_of.GemanMcClure),
        (TruncatedKernel, loss_of.TruncatedLeastSquares),
    ],
)
@pytest.mark.parametrize("parameter", [0.4, 1.0, 1.345, 2.3849, 7.0])
def test_losses_and_weights_are_those_of_gtsam(
    make: Callable[[float], Kernel],
    theirs: Any,
    parameter: float,
) -> None:
    """On a grid of residuals of either side of every threshold."""
    residual = np.linspace(0.0, 30.0, 401)
    oracle = theirs(parameter)
    weight = [max(oracle.weight(r), WEIGHT_FLOOR) for r in residual]
    loss = [oracle.loss(r) for r in residual]
    kernel = make(parameter)
    np.testing.assert_allclose(kernel.weight(residual**2), weight, rtol=1e-9)
    np.testing.assert_allclose(-kernel.similarity(residual**2), loss, rtol=1e-9, atol=1e-12)


@with_parameter
@STEADY
@given(t=lengths)
def test_an_infinite_scale_is_least_squares(make: Callable[[float], Kernel], t: float) -> None:
    """Without outliers to speak of every estimator disappears."""
    assert make(1e9).weight(t) == pytest.approx(1.0, abs=1e-5)
    plain = float(GaussianKernel().similarity(np.array(t)))
    assert float(make(1e9).similarity(np.array(t))) == pytest.approx(plain, rel=1e-5, abs=1e-9)


@with_parameter
def test_rejected_measurements_keep_the_floor(make: Callable[[float], Kernel]) -> None:
    """An information of zero would leave keyframes undetermined."""
    np.testing.assert_array_equal(make(1.0).weight(np.array([1e20, np.inf])), WEIGHT_FLOOR)


def test_cauchy_is_the_log_kernel_of_another_norm() -> None:
    """Their weights are in a fixed proportion."""
    t = np.linspace(0.0, 50.0, 11)
    ratio = LogKernel(dof=4.0).weight(t) / CauchyKernel(width=2.0).weight(t)
    np.testing.assert_allclose(ratio, 5.0 / 4.0, rtol=1e-12)


def test_weights_by_hand() -> None:
    """Ten sigmas, four squared sigmas, and the middle of the truncated kernel's band."""
    assert float(HuberKernel(2.0).weight(100.0)) == pytest.approx(0.2)
    assert float(CauchyKernel(2.0).weight(4.0)) == pytest.approx(0.5)
    assert float(DcsKernel(1.0).weight(4.0)) == pytest.approx((2.0 / 5.0) ** 2)
    assert float(GemanMcClureKernel(2.0).weight(4.0)) == pytest.approx(0.25)
    half_way = TruncatedKernel(width=2.0, mu=1.0)
    np.testing.assert_allclose(half_way.weight([2.0, 4.0, 8.1]), [1.0, math.sqrt(2.0) - 1.0, 1e-8])
    assert float(half_way.similarity(np.array(9.0))) == -2.0


def efficiency(kernel: Kernel) -> float:
    """Return the asymptotic efficiency of a location on Gaussian noise, (E psi')^2 / E psi^2."""
    r = np.linspace(-10.0, 10.0, 40001)
    psi = r * kernel.weight(r**2)
    density = norm.pdf(r) * (r[1] - r[0])
    return float(np.sum(r * psi * density) ** 2 / np.sum(psi**2 * density))


@pytest.mark.parametrize(
    ("kernel", "expected"),
    [
        (GaussianKernel(), 1.0),
        (HuberKernel(), 0.95),
        (CauchyKernel(), 0.95),
        (DcsKernel(), 0.64),
        (DcsKernel(3.60), 0.95),
        (GemanMcClureKernel(), 0.44),
        (GemanMcClureKernel(3.79), 0.95),
        (TruncatedKernel(), 0.92),
    ],
    ids=str,
)
def test_stated_efficiencies(kernel: Kernel, expected: float) -> None:
    """The constants of the literature, and what the documentation says of the others."""
    assert efficiency(kernel) == pytest.approx(expected, abs=5e-3)


def test_default_truncation_is_the_quantile_of_gtsam() -> None:
    """Its inlier cost threshold is half of ``chi2inv(0.99, 1)``."""
    assert pytest.approx(chi2.ppf(0.99, 1), rel=1e-12) == WIDTH_OF_99_PERCENT**2


@with_parameter
@pytest.mark.parametrize("value", [0.0, -1.0, math.nan, math.inf])
def test_bad_parameters_are_refused(make: Callable[[float], Kernel], value: float) -> None:
    """A scale is a finite number above zero; the message names it."""
    with pytest.raises(ValueError, match=r"^(width|phi): expected a number above zero, got"):
        make(value)


@pytest.mark.parametrize("mu", [0.0, -1.0, math.nan])
def test_a_graduation_is_above_zero(mu: float) -> None:
    """Infinite is allowed, and the default."""
    with pytest.raises(ValueError, match="mu: expected a number above zero"):
        TruncatedKernel(mu=mu)


def test_kernels_say_what_they_are() -> None:
    """The result files print them."""
    texts = [str(make(1.5)) for make in MAKERS] + [str(TruncatedKernel(2.0, mu=1e-3))]
    assert texts == [
        "huber(width=1.5)",
        "cauchy(width=1.5)",
        "dcs(phi=1.5)",
        "geman-mcclure(width=1.5)",
        "truncated(width=1.5)",
        "truncated(width=2, mu=0.001)",
    ]


def test_every_kernel_has_a_name() -> None:
    """Its name begins its text, and its default is that of the class."""
    for name, choice in KERNELS.items():
        kernel = parse_kernel(name)
        assert kernel == choice.make()
        assert str(kernel).split("(")[0] == name
        if choice.default is not None:
            assert parse_kernel(f"{name}:{choice.default!r}") == kernel
    assert parse_kernel("log:7") == LogKernel(dof=7.0)
    assert parse_kernel("dcs:2") == DcsKernel(phi=2.0)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("lgo", "there is no kernel 'lgo'; known: log, sqrt"),
        ("log:", "expected dof after the colon"),
        ("huber:-1", "width: expected a number above zero"),
        ("gaussian:3", "expected the name alone"),
    ],
)
def test_bad_names_are_refused(text: str, message: str) -> None:
    """With what was expected."""
    with pytest.raises(ValueError, match=message):
        parse_kernel(text)


def test_command_line_refuses_what_a_kernel_does_not_have() -> None:
    """And says which kernels do."""
    assert kernel_from(CHOICES, "huber", dof=None, width=2.0, phi=None) == HuberKernel(2.0)
    assert kernel_from(CHOICES, "dcs", phi=2.0) == DcsKernel(2.0)
    assert kernel_from(CHOICES, "gnc-tls", width=3.0) == TruncatedKernel(3.0)
    with pytest.raises(ConfigError, match=r"--dof: expected with --kernel log or sqrt, got huber"):
        kernel_from(CHOICES, "huber", dof=5.0)
    with pytest.raises(ConfigError, match=r"--phi: expected with --kernel dcs, got cauchy"):
        kernel_from(CHOICES, "cauchy", phi=5.0)
    with pytest.raises(ConfigError, match=r"--kernel huber: width: expected a number above zero"):
        kernel_from(CHOICES, "huber", width=0.0)


def test_each_family_is_judged_as_it_was_published() -> None:
    """The other way can be asked for."""
    assert SmootherConfig().judged_by is Similarity.EXPECTED
    assert SmootherConfig(kernel=HuberKernel()).judged_by is Similarity.PLAIN
    for similarity in Similarity:
        config = SmootherConfig(kernel=HuberKernel(), similarity=similarity)
        assert config.judged_by is similarity
    assert ssm_graph.Similarity is batch.Similarity is Similarity


T = np.array([0.0, 0.3, 2.0, 9.0, 1e3, 1e8])


@pytest.mark.parametrize("width", [1.0, 2.7])
@pytest.mark.parametrize(
    ("alpha", "loss"),
    [
        (2.0, lambda x: 0.5 * x),
        (1.0, lambda x: np.sqrt(x + 1.0) - 1.0),
        (0.0, lambda x: np.log(0.5 * x + 1.0)),
        (-2.0, lambda x: 2.0 * x / (x + 4.0)),
        (-math.inf, lambda x: 1.0 - np.exp(-0.5 * x)),
        (-3.4, lambda x: 5.4 / -3.4 * ((x / 5.4 + 1.0) ** (-1.7) - 1.0)),
    ],
)
def test_general_loss_is_the_published_one(
    alpha: float, loss: Callable[[Any], Any], width: float
) -> None:
    """Barron's loss in its named shapes and in one between them, in squared widths."""
    kernel = GeneralKernel(alpha, width)
    expected = -(width**2) * loss(T / width**2)
    np.testing.assert_allclose(kernel.similarity(T), expected, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("limit", [2.0, 0.0, -math.inf])
def test_general_loss_passes_smoothly_through_its_limits(limit: float) -> None:
    """Just beside a shape with a formula of its own it is nearly that one."""
    near = -1e7 if math.isinf(limit) else limit - 1e-7
    own, beside = GeneralKernel(limit), GeneralKernel(near)
    t = T[:-2]
    np.testing.assert_allclose(beside.similarity(t), own.similarity(t), rtol=1e-5)
    np.testing.assert_allclose(beside.raw_weight(t), own.raw_weight(t), rtol=1e-4)


def test_general_loss_is_cauchys_and_geman_mcclures() -> None:
    """With the widths that its docstring says."""
    for general, known in (
        (GeneralKernel(0.0, 1.5), CauchyKernel(1.5 * math.sqrt(2.0))),
        (GeneralKernel(-2.0, 1.5), GemanMcClureKernel(3.0)),
    ):
        np.testing.assert_allclose(general.similarity(T), known.similarity(T), rtol=1e-12)
        np.testing.assert_allclose(general.weight(T), known.weight(T), rtol=1e-12)


def test_a_shape_above_two_is_refused() -> None:
    """It would count large residuals more than small ones."""
    with pytest.raises(ValueError, match=r"alpha: expected a number of 2 or less, got 2\.5"):
        GeneralKernel(2.5)


def test_the_partition_function_of_known_densities() -> None:
    """A Gaussian's to 10 sigmas, and Cauchy's with scale sqrt(2), in closed form."""
    assert log_partition(2.0) == pytest.approx(0.5 * math.log(2.0 * math.pi), abs=1e-9)
    cauchy = 2.0 * math.sqrt(2.0) * math.atan(10.0 / math.sqrt(2.0))
    assert log_partition(0.0) == pytest.approx(math.log(cauchy), abs=1e-6)


def test_the_shape_follows_the_tails() -> None:
    """Least squares for a Gaussian, near Cauchy's for Cauchy's, and lower the more is gross."""
    rng = np.random.default_rng(1)
    good = rng.normal(size=4000) ** 2
    assert fitted_shape(good) == 2.0
    assert fitted_shape(np.zeros(0)) == 2.0
    cauchy = rng.standard_t(1.0, size=40000) * math.sqrt(2.0)
    assert fitted_shape(cauchy[np.abs(cauchy) < 10.0] ** 2) == pytest.approx(0.0, abs=0.15)
    some, many = (np.append(good, np.full(n, 1e4)) for n in (400, 4000))
    assert fitted_shape(many) <= fitted_shape(some) < 0.0
    assert fitted_shape(9.0 * good, width=3.0) == 2.0


def test_a_wrong_use_of_shapes_is_refused() -> None:
    """Only the general kernel has one to adapt."""
    with pytest.raises(ConfigError, match="adapt_shape: expected with a GeneralKernel"):
        SmootherConfig(adapt_shape=True)
    assert SmootherConfig(GeneralKernel(), adapt_shape=True).weighting == "adaptive(width=1)"
