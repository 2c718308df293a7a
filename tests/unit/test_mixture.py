"""Sound measurements among gross ones: the weight is the chance of being sound."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from factors.mixture import MixtureKernel, likeliest_mixture
from factors.similarity import Array, LogKernel
from factors.tails import tail_evidence, tails_of


def contaminated(share: float, *, dim: int, n: int = 4000) -> tuple[Array, NDArray[np.bool_]]:
    """Return squared lengths (n,), this share of them from anywhere, and which those are."""
    rng = np.random.default_rng(5)
    gross = rng.random(n) < share
    errors = rng.standard_normal((n, dim))
    errors[gross] = rng.uniform(-50.0, 50.0, (int(gross.sum()), dim))
    return np.sum(errors**2, axis=1), gross


def test_the_weight_is_the_slope_of_the_similarity() -> None:
    """Minus twice, by differences; it never rises, and ends where nothing is sound."""
    kernel, t = MixtureKernel(14.0), np.linspace(0.0, 60.0, 301)
    slope = (kernel.similarity(t + 1e-4) - kernel.similarity(t - 1e-4)) / 2e-4
    assert kernel.raw_weight(t) == pytest.approx(-2.0 * slope, abs=1e-7)
    assert np.all(np.diff(kernel.raw_weight(t)) < 0.0)
    assert kernel.weight(14.0) == pytest.approx(0.5)
    assert kernel.weight(1e9) == pytest.approx(1e-8)


@pytest.mark.parametrize("dim", [1, 2, 3])
@pytest.mark.parametrize("share", [0.02, 0.3])
def test_gross_measurements_are_told_from_sound_ones(share: float, dim: int) -> None:
    """Nearly all weights are right, and no tail makes the measurements as likely."""
    t, gross = contaminated(share, dim=dim)
    ones = np.ones(len(t))
    found = likeliest_mixture(t, ones, dim=dim)
    assert found is not None
    weight = found.kernel.weight(t, dim=dim)
    far = gross & (t > 40.0)
    assert weight[far].max() < 1e-2
    assert np.mean(weight[~gross] > 0.5) > 0.98
    tails = tails_of(LogKernel(5.0))
    assert found.evidence > tail_evidence(tails, t, ones, dim=dim).max() + 100.0


def test_evidence_is_that_of_the_density() -> None:
    """Of sound measurements alone it is the normal density's, but for a gross one supposed."""
    t = np.sum(np.random.default_rng(6).standard_normal((5000, 2)) ** 2, axis=1)
    found = likeliest_mixture(t, np.ones(len(t)), dim=2)
    assert found is not None
    normal = -0.5 * t.sum() - len(t) * np.log(2.0)
    assert found.evidence == pytest.approx(normal, abs=30.0)


def test_more_gross_than_may_be_is_none() -> None:
    """Then sigmas are wrong, and nothing is told."""
    t, _ = contaminated(0.6, dim=2)
    assert likeliest_mixture(t, np.ones(len(t)), dim=2) is None
