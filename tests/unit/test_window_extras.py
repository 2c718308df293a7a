"""Drifts and calibrations in the window of a fixed-lag smoother."""

from __future__ import annotations

import numpy as np

from ssm_graph.mission.problem import build_problem
from ssm_graph.smoothers.batch import SsmSmoother
from ssm_graph.smoothers.fixed_lag import FixedLagConfig, solve_fixed_lag
from tests.window_fixture import asked, found, off


def test_a_window_of_the_whole_mission_is_the_batch() -> None:
    """Track, calibration and sigmas, to a fiftieth of a sigma."""
    problem = build_problem(asked(off(duration_s=40.0).mission))
    batch = SsmSmoother().solve(problem)
    config = FixedLagConfig(
        1e3, max_iterations=20, tolerance=1e-4, relinearise_sigmas=1e-3, reweigh=1e-3
    )
    whole = solve_fixed_lag(problem, config).delayed
    assert [v.label for v in found(whole).values] == [v.label for v in found(batch).values]
    for own, other in zip(found(whole).values, found(batch).values, strict=True):
        assert abs(own.value - other.value) < 0.02 * other.sigma, own.label
        assert abs(own.sigma - other.sigma) < 0.02 * other.sigma, own.label
    off_enu = whole.trajectory.velocity_enu - batch.trajectory.velocity_enu
    assert np.all(np.abs(off_enu) < 0.02 * batch.trajectory.velocity_sigma_enu)
    np.testing.assert_allclose(
        np.diagonal(whole.trajectory.position_cov_enu, axis1=1, axis2=2),
        np.diagonal(batch.trajectory.position_cov_enu, axis1=1, axis2=2),
        rtol=0.02,
    )
    np.testing.assert_allclose(whole.beams.weight, batch.beams.weight, atol=0.02)
