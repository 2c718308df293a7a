"""Innovations: before the update in filters, at the final states in smoothers."""

from __future__ import annotations

from functools import cache

import numpy as np

from factors.similarity import GaussianKernel
from ssm_graph.base.frozen import Array
from ssm_graph.engine.error_state import Linearised
from ssm_graph.filters.navigation.named import filter_geodetic, filter_problems
from ssm_graph.mission.problem import Problem, build_problem
from ssm_graph.simulation import Grade, OutlierKind, Outliers, SimulatedMission
from ssm_graph.smoothers.batch import SmootherConfig, SsmSmoother
from ssm_graph.smoothers.fixed_lag import FixedLagConfig, solve_fixed_lag
from tests.helpers import simulated


@cache
def survey() -> tuple[SimulatedMission, Problem]:
    """Return 40 s with outliers of 0.5 to 3 m/s."""
    sim = simulated(
        duration_s=40.0, grade=Grade.TACTICAL, seed=5, outliers=Outliers(OutlierKind.SPARSE, 0.2)
    )
    return sim, build_problem(sim.mission)


def of_filter(name: str, *, smoothed: bool = False) -> Array:
    """Return the innovations of a filter, m/s."""
    (estimate,) = filter_problems([survey()[1]], name, smoothed=smoothed)
    return estimate.beams.innovation


def test_a_filter_is_told_before_it_updates() -> None:
    """Two rules that differ in all but the prediction have the same innovations at the first ping.

    Then each predicts from what it made of it.
    """
    problem = survey()[1]
    first = problem.beams.keyframe == problem.beams.keyframe[0]
    ekf, ssm = of_filter("ekf"), of_filter("ssm-log")
    np.testing.assert_array_equal(ekf[first], ssm[first])
    assert np.abs(ekf - ssm)[~first].max() > 1e-3


def test_outliers_show_in_full() -> None:
    """A filter that believes them has small residuals, and large innovations all the same."""
    sim, problem = survey()
    offset = sim.beam_offset[problem.beams.keyframe - 1, problem.beams.beam]
    bad = np.abs(offset) > 0.5
    np.testing.assert_allclose(of_filter("ssm-log")[bad], offset[bad], atol=0.1)


def test_three_ways_to_the_same_innovations() -> None:
    """NumPy, the graph and the geodetic filter predict the same beam speeds."""
    sim, problem = survey()
    expected = of_filter("ssm-log")
    config = FixedLagConfig(0.0, linearised=Linearised.ONCE)
    graph = solve_fixed_lag(problem, config).newest.beams.innovation
    (geodetic,) = filter_geodetic([problem], [sim.mission.imu])
    np.testing.assert_allclose(graph, expected, atol=1e-6)
    np.testing.assert_allclose(geodetic.beams.innovation, expected, atol=2e-5)


def test_a_smoother_looks_at_its_final_states() -> None:
    """The delayed states of a lag as long as the mission, and a pass backwards, as the batch."""
    problem = survey()[1]
    lagged = solve_fixed_lag(problem, FixedLagConfig(100.0))
    batch = SsmSmoother().solve(problem).beams.innovation
    np.testing.assert_allclose(lagged.delayed.beams.innovation, batch, atol=1e-5)
    assert np.abs(lagged.newest.beams.innovation - batch).max() > 1e-3


def test_a_pass_backwards_makes_a_smoother() -> None:
    """On clean data its innovations are nearly those of the batch, the filter's are not."""
    clean = build_problem(simulated(duration_s=40.0, seed=5).mission)
    batch = SsmSmoother(SmootherConfig(GaussianKernel())).solve(clean).beams.innovation
    (filtered,) = filter_problems([clean], "ekf")
    (backwards,) = filter_problems([clean], "ekf", smoothed=True)
    assert np.abs(filtered.beams.innovation - batch).max() > 1e-2
    np.testing.assert_allclose(backwards.beams.innovation, batch, atol=1e-3)
