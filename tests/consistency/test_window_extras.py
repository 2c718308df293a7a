"""Calibrations and drifts of a fixed-lag smoother: as far off as their sigmas say."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ssm_graph.base.frozen import Array
from ssm_graph.mission.calibration import DVL_MOUNTING, DVL_SCALE
from ssm_graph.mission.estimate import Estimate
from ssm_graph.mission.problem import build_problem
from ssm_graph.simulation import SimulatedMission
from ssm_graph.smoothers.fixed_lag import solve_fixed_lag
from tests.calibration_cases import MOUNTING, SCALE
from tests.helpers import assert_consistent
from tests.window_fixture import SHORT, asked, found, off

RUNS = 10


def nees(error: Array, covariance: Array) -> float:
    """Return the squared length of an error in its sigmas."""
    return float(error @ np.linalg.solve(covariance, error))


def calibration_nees(estimate: Estimate) -> float:
    """Return that of scale and mounting, four numbers."""
    calibration = found(estimate)
    own = [i for i, v in enumerate(calibration.values) if v.variable in (DVL_SCALE, DVL_MOUNTING)]
    values = np.array([calibration.values[i].value for i in own])
    return nees(values - [SCALE, *MOUNTING], calibration.covariance[np.ix_(own, own)])


def position_nees(estimate: Estimate, sim: SimulatedMission) -> float:
    """Return that of the last position, east and north."""
    track, frame = estimate.trajectory, sim.mission.frame
    truth = sim.truth_at(track.time_s)
    p, p_true = (frame.p_n_from_geodetic(x.lat, x.lon, x.height) for x in (track, truth))
    return nees((p - p_true)[-1, :2], track.position_cov_enu[-1, :2, :2])


@pytest.mark.slow
@pytest.mark.parametrize("lag_s", [0.0, 8.0])
def test_calibration_and_track_are_as_far_off_as_their_sigmas(lag_s: float) -> None:
    """Scale and mounting at the end, and the position as it is known at once, over seeds."""
    calibrated, placed = [], []
    for seed in range(RUNS):
        sim = off(seed=seed)
        config = replace(SHORT, lag_s=lag_s)
        estimate = solve_fixed_lag(build_problem(asked(sim.mission)), config).newest
        calibrated.append(calibration_nees(estimate))
        placed.append(position_nees(estimate, sim))
    assert_consistent(np.array(calibrated), dof=4)
    assert_consistent(np.array(placed), dof=2)
