"""The graph in single steps against the filters that were written without it.

The one in gains and covariances is the same estimator in other words, so that only rounding and
where the iteration stops are left. The geodetic one has its own mechanisation and error model, so
that the two are as good as equal, no more.
"""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from factors.similarity import Similarity
from ssm_graph.engine.error_state import Linearised
from ssm_graph.filters.geodetic.mechanisation import Feedback
from ssm_graph.mission.problem import Problem, build_problem
from ssm_graph.simulation import GnssSettings, Grade, Loss, OutlierKind, Outliers, SimulatedMission
from tests.helpers import simulated
from tests.single_step import GRADES, Difference, against_filter, against_geodetic, missions

each_grade = pytest.mark.parametrize("grade", GRADES, ids=lambda grade: grade.name)
each_similarity = pytest.mark.parametrize("similarity", Similarity, ids=lambda s: s.name)


@cache
def survey(grade: Grade, duration_s: float = 60.0) -> tuple[SimulatedMission, Problem]:
    """Return a run in waves: outliers, dropouts, a bottom loss, GNSS in the first third."""
    sim = simulated(
        duration_s=duration_s,
        grade=grade,
        seed=1,
        outliers=Outliers(OutlierKind.SPARSE, rate=0.2),
        dropout_rate=0.1,
        losses=(Loss(duration_s / 2.0, duration_s / 1.5),),
        gnss=GnssSettings(windows=((0.0, duration_s / 3.0),)),
    )
    problem = build_problem(sim.mission)
    assert sim.is_outlier.sum() >= 3
    assert len(problem.beams.speed) < 0.8 * sim.is_outlier.size
    return sim, problem


def assert_the_same(found: Difference) -> None:
    """Compare with the limits of two that stop at steps of 1e-8 sigma.

    Each keyframe leaves less than such a step between them, which the later ones forget: up to
    2e-8 sigma, 7e-10 of a covariance and 9e-10 of a weight were measured in a minute. A process
    that is not quite the same adds up instead, and shows in twenty.
    """
    assert found.state < 1e-7
    assert found.covariance < 1e-8
    assert found.weight < 5e-9
    assert found.n_iterations == 0


@each_similarity
def test_it_is_the_filter_for_twenty_seconds(similarity: Similarity) -> None:
    """The quick version of the next one."""
    _, problem = survey(Grade.TACTICAL, 20.0)
    assert_the_same(against_filter(problem, similarity))


@pytest.mark.slow
@each_similarity
@each_grade
def test_it_is_the_filter(grade: Grade, similarity: Similarity) -> None:
    """States, covariances, weights and numbers of passes, keyframe by keyframe.

    The filter is the one that linearises anew at each pass, and ``ssm-log`` is told apart.
    """
    _, problem = survey(grade)
    found = against_filter(problem, similarity)
    assert_the_same(found)
    assert found.once > 1e-2


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(len(GRADES)), ids=[grade.name for grade in GRADES])
def test_it_stays_the_filter(seed: int) -> None:
    """Five minutes of the missions of the benchmark, one a grade, within the limits of a minute."""
    sim = missions(len(GRADES), 300.0)[seed]
    assert sim.config.grade is GRADES[seed]
    assert_the_same(against_filter(build_problem(sim.mission), Similarity.EXPECTED))


@pytest.mark.slow
def test_it_stays_the_filter_for_twenty_minutes() -> None:
    """The benchmark's first mission, navigation grade, within what its page promises."""
    sim = missions(1, 1200.0)[0]
    assert sim.config.grade is Grade.NAVIGATION
    found = against_filter(build_problem(sim.mission), Similarity.EXPECTED)
    assert found.state < 1e-6
    assert found.covariance < 1e-6
    assert found.weight < 1e-8
    assert found.n_iterations == 0


GEODETIC_LIMITS = (0.05, 0.1)
"""Posterior sigmas of velocity and of horizontal position."""


@pytest.mark.slow
@each_grade
def test_it_is_the_geodetic_filter(grade: Grade) -> None:
    """Both linearised once, all errors fed back: 0.012 sigma of velocity at most, measured.

    What is left is second order: errors of attitude about body axes here, local axes there.
    """
    sim, problem = survey(grade)
    apart = against_geodetic(problem, sim, Linearised.ONCE, Feedback.COMPLETE)
    assert np.all(np.array(apart) < GEODETIC_LIMITS)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("linearised", "feedback"),
    [(Linearised.ONCE, Feedback.PAPER), (Linearised.EACH_PASS, Feedback.COMPLETE)],
    ids=["biases kept as errors", "Gauss-Newton"],
)
def test_another_geodetic_filter_is_told_apart(linearised: Linearised, feedback: Feedback) -> None:
    """With industrial sensors the limit on velocity is one that other choices do not meet."""
    sim, problem = survey(Grade.INDUSTRIAL)
    velocity, _ = against_geodetic(problem, sim, linearised, feedback)
    assert velocity > 2.0 * GEODETIC_LIMITS[0]
