"""The window with calibrations, drifts and current, without lag, against a filter of its own."""

from __future__ import annotations

import numpy as np
import pytest

from factors.similarity import LogKernel, Similarity
from ssm_graph.filters.rules.ssm import SsmUpdate
from ssm_graph.mission.calibration import windowed
from ssm_graph.mission.problem import Problem, build_problem
from ssm_graph.simulation import Grade, Loss, OutlierKind, Outliers
from ssm_graph.smoothers.fixed_lag import FixedLagConfig, run_fixed_lag
from tests.augmented_filter import deviation_of, filter_augmented
from tests.water_fixture import in_current
from tests.window_fixture import asked, off

OUTLIERS = Outliers(OutlierKind.SPARSE, rate=0.2)


def miscalibrated(grade: Grade, duration_s: float) -> Problem:
    """Return a run with 19 extra states: scales, mounting, depth, antenna, clock, both drifts."""
    sim = off(grade=grade, duration_s=duration_s, seed=1, outliers=OUTLIERS, dropout_rate=0.1)
    problem = build_problem(asked(sim.mission))
    assert windowed(problem.extras).width == 15 + 19
    assert sim.is_outlier.any()
    return problem


def assert_the_same(problem: Problem, similarity: Similarity = Similarity.EXPECTED) -> None:
    """Compare states, covariances, weights and numbers of passes at every keyframe.

    Both stop at steps of 1e-8 sigma: up to 1.4e-8 sigma, 3e-10 of a covariance and 1e-9 of a weight
    were measured in five minutes.
    """
    kernel = LogKernel()
    window = run_fixed_lag(problem, FixedLagConfig(0.0, kernel, similarity))
    other = filter_augmented(problem, SsmUpdate(kernel, similarity=similarity))
    newest = window.newest
    sigma = np.sqrt(np.diagonal(newest.covariance, axis1=1, axis2=2))
    unit = sigma[:, :, None] * sigma[:, None, :]
    assert np.max(np.abs(deviation_of(newest.states, other.states)) / sigma) < 1e-7
    assert np.max(np.abs(other.covariance - newest.covariance) / unit) < 1e-8
    assert np.max(np.abs(other.weight - newest.weight)) < 1e-8
    np.testing.assert_array_equal(other.n_iterations, window.n_iterations)


def test_with_calibration_it_is_the_augmented_filter_for_twenty_seconds() -> None:
    """The quick version of the next one."""
    assert_the_same(miscalibrated(Grade.TACTICAL, 20.0))


@pytest.mark.slow
@pytest.mark.parametrize("similarity", Similarity, ids=lambda s: s.name)
@pytest.mark.parametrize(
    "grade", [Grade.NAVIGATION, Grade.TACTICAL, Grade.INDUSTRIAL], ids=lambda grade: grade.name
)
def test_with_calibration_it_is_the_augmented_filter(grade: Grade, similarity: Similarity) -> None:
    """A minute a grade."""
    assert_the_same(miscalibrated(grade, 60.0), similarity)


@pytest.mark.slow
def test_with_calibration_it_stays_the_augmented_filter() -> None:
    """Five minutes at navigation grade."""
    assert_the_same(miscalibrated(Grade.NAVIGATION, 300.0))


@pytest.mark.slow
def test_in_a_current_it_is_the_augmented_filter() -> None:
    """Pings off the water for a minute of two, a current of two walks and its vertical part."""
    sim = in_current(duration_s=120.0, losses=(Loss(40.0, 100.0),), outliers=OUTLIERS)
    problem = build_problem(sim.mission)
    assert problem.beams.is_water.any()
    assert windowed(problem.extras).width == 15 + 3
    assert_the_same(problem)
