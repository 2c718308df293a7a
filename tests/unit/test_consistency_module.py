"""What is common to all systems: consistency of sigmas, rates, circular means."""

from __future__ import annotations

import numpy as np
import pytest

from ssm_graph.base.errors import DataError
from ssm_graph.evaluation.consistency import (
    NORMAL_SHARES,
    circular_mean,
    consistency,
    rate_with_interval,
)


def test_true_sigmas_are_consistent_and_halved_ones_are_not() -> None:
    """Errors drawn from a covariance fit it, and not one of half the sigmas."""
    rng = np.random.default_rng(5)
    root = np.array([[2.0, 0.0, 0.0], [0.5, 1.0, 0.0], [-0.3, 0.2, 0.1]])
    errors = rng.normal(size=(4000, 3)) @ root.T
    covs = np.broadcast_to(root @ root.T, (4000, 3, 3))
    good = consistency(errors, covs)
    assert good.is_consistent
    # Four standard deviations of a share of 12000 draws.
    for share, expected in zip(good.shares, NORMAL_SHARES, strict=True):
        assert abs(share - expected) < 4.0 * np.sqrt(expected * (1 - expected) / 12000)
    told_less = consistency(errors, covs / 4.0)
    assert not told_less.is_consistent
    assert told_less.nees.value == pytest.approx(4.0 * good.nees.value)


def test_a_mean_over_the_seam_is_on_the_seam() -> None:
    """Angles on both sides of 180 degrees have their mean there, not at zero."""
    assert abs(circular_mean(np.radians([179.0, -179.0]))) == pytest.approx(np.pi)
    assert circular_mean([0.1, 0.3], [1.0, 3.0]) == pytest.approx(0.25, abs=1e-3)
    with pytest.raises(DataError, match="cancel"):
        circular_mean([0.0, np.pi])


def test_a_rate_has_its_exact_interval() -> None:
    """None of n: the upper end is where (1 - p)^n is 2.5 %."""
    none = rate_with_interval(np.zeros(58, dtype=bool))
    assert (none.value, none.low) == (0.0, 0.0)
    assert none.high == pytest.approx(1.0 - 0.025 ** (1 / 58))
    every = rate_with_interval(np.ones(58, dtype=bool))
    assert every.low == pytest.approx(1.0 - none.high)
    with pytest.raises(DataError, match="no trials"):
        rate_with_interval([])
