"""Errors of inertial sensors are as far off as their sigmas say, and so is the track."""

from __future__ import annotations

import numpy as np
import pytest

from ssm_graph.base.frozen import Array
from ssm_graph.evaluation import evaluate
from ssm_graph.mission.estimate import Estimate, Status
from ssm_graph.mission.problem import build_problem
from ssm_graph.simulation import GnssSettings, Grade
from ssm_graph.smoothers.batch import SsmSmoother
from ssm_graph.smoothers.fixed_lag import solve_fixed_lag
from tests.helpers import assert_consistent
from tests.imu_errors_fixture import SIGMAS, Distorted, asking, distorted
from tests.window_fixture import SHORT

RUNS = 10
FIXES = GnssSettings(sigma_horizontal=0.1, sigma_vertical=0.2)


def made(grade: Grade, seed: int) -> Distorted:
    """Return two minutes with errors as large as the prior sigmas, and fixes at the surface."""
    return distorted(grade, seed, gnss=FIXES)


def squared(estimate: Estimate, truth: Array) -> float:
    """Return the squared length of the error of the 27 numbers in their sigmas."""
    calibration = estimate.calibration
    assert calibration is not None
    error = np.array([value.value for value in calibration.values]) - truth
    return float(error @ np.linalg.solve(calibration.covariance, error))


@pytest.mark.slow
@pytest.mark.parametrize("grade", [Grade.NAVIGATION, Grade.MEMS], ids=lambda grade: grade.name)
def test_all_errors_and_the_track_over_seeds(grade: Grade) -> None:
    """NEES of 27 numbers, and of the positions with one independent sample a run."""
    found, placed = [], []
    for seed in range(RUNS):
        off = made(grade, 50 + seed)
        estimate = SsmSmoother().solve(build_problem(asking(off.mission, SIGMAS[grade])))
        assert estimate.status is Status.CONVERGED, estimate.reason
        assert off.sim.mission.reference is not None
        found.append(squared(estimate, off.errors))
        metrics = evaluate(estimate.trajectory, off.sim.mission.reference)
        placed.append(3.0 * metrics.nees_position)
    assert_consistent(np.array(found), dof=27)
    assert_consistent(np.array(placed), dof=3)


@pytest.mark.slow
def test_errors_in_a_window_over_seeds() -> None:
    """With a lag of 8 s, at the end of the mission, at MEMS grade."""
    found = []
    for seed in range(RUNS):
        off = distorted(Grade.MEMS, 50 + seed, gnss=FIXES, duration_s=30.0)
        problem = build_problem(asking(off.mission, SIGMAS[Grade.MEMS]))
        found.append(squared(solve_fixed_lag(problem, SHORT).newest, off.errors))
    assert_consistent(np.array(found), dof=27)
