"""The particle filter's law: drawing, number, angles."""

from __future__ import annotations

import numpy as np
import pytest

from ssm_graph.filters.rules.particles import (
    effective_number,
    kld_number,
    moments,
    normalised,
    systematic,
)


def test_weights_do_not_depend_on_a_constant() -> None:
    """Logarithms far below what a float can hold as a weight."""
    log_weight = np.array([-1e5, -1e5 + np.log(3.0), -np.inf])
    np.testing.assert_allclose(normalised(log_weight), [0.25, 0.75, 0.0])


def test_effective_number() -> None:
    """Equal weights count in full, one weight counts once."""
    assert effective_number(np.full(8, 0.125)) == pytest.approx(8.0)
    assert effective_number(np.array([1.0, 0.0])) == pytest.approx(1.0)


def test_systematic_draws_each_within_one_of_its_share() -> None:
    """Whatever the random number; more would be multinomial, not systematic."""
    rng = np.random.default_rng(0)
    weight = rng.dirichlet(np.full(30, 0.3))
    for _ in range(50):
        counts = np.bincount(systematic(weight, 100, rng), minlength=30)
        assert np.all(np.abs(counts - 100 * weight) < 1.0)


def test_kld_number() -> None:
    """Fox 2003: by the chi-square quantile that it approximates; one cell needs one particle."""
    from scipy.stats import chi2

    assert kld_number(1) == 1
    for cells in (10, 100, 1000):
        exact = chi2.ppf(0.99, cells - 1) / (2 * 0.05)
        assert kld_number(cells) == pytest.approx(exact, rel=0.01)


def test_moments_across_half_a_turn() -> None:
    """Courses about +-pi have their mean there, not at zero, and the spread they have."""
    rng = np.random.default_rng(1)
    yaw = np.pi + 0.1 * rng.standard_normal(400)
    states = np.column_stack(
        [*0.3 * rng.standard_normal((2, 400)), (yaw + np.pi) % (2 * np.pi) - np.pi]
    )
    weight = np.full(400, 1 / 400)
    mean, cov = moments(states, weight, 2)
    assert abs(abs(mean[2]) - np.pi) < 0.02
    assert np.sqrt(cov[2, 2]) == pytest.approx(0.1, rel=0.15)
