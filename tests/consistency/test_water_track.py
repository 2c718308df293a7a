"""The stated uncertainty of state and current against the truth, over many seeds."""

from __future__ import annotations

import numpy as np
import pytest

from factors.similarity import GaussianKernel
from ssm_graph.engine.error_state import STATE_DIM
from ssm_graph.mission.estimate import Status
from ssm_graph.mission.problem import build_problem
from ssm_graph.simulation import CurrentSettings, Grade, WaterTrack
from ssm_graph.smoothers.batch import SmootherConfig, SsmSmoother
from tests.helpers import (
    assert_consistent,
    covariances,
    estimated_states,
    state_errors,
    true_states,
)
from tests.water_fixture import current_errors, in_current

SEEDS = range(10)
CURRENT = CurrentSettings(sigma=0.4, vertical_sigma=0.03, correlation_s=1800.0)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("grade", "track"),
    [
        (Grade.NAVIGATION, WaterTrack()),
        (Grade.TACTICAL, WaterTrack(beams=(1, 2), every=5)),
    ],
    ids=["navigation, all beams", "tactical, two beams"],
)
def test_state_and_current_are_consistent(grade: Grade, track: WaterTrack) -> None:
    """NEES of all error states and of the current before, amid and after a bottom loss.

    Clean missions with a gaussian kernel, so that the covariance has to be exact, and a current
    that is drawn from what the mission states; every epoch's mean within its own chi-square
    interval.
    """
    states_nees, current_nees = [], []
    for seed in SEEDS:
        sim = in_current(grade=grade, seed=seed, current=CURRENT, water_track=track)
        problem = build_problem(sim.mission)
        estimate = SsmSmoother(SmootherConfig(kernel=GaussianKernel())).solve(problem)
        assert estimate.status is Status.CONVERGED, estimate.reason
        assert estimate.current is not None
        states = estimated_states(problem, estimate.trajectory)
        states = states._replace(walks=estimate.current.velocity_enu)
        P = covariances(problem, states, estimate.beams.weight)
        errors, drift = (
            state_errors(states, true_states(problem, sim)),
            current_errors(estimate, sim),
        )
        epochs = (0, problem.n_keyframes // 2, -1)
        states_nees.append([errors[k] @ np.linalg.solve(P[k], errors[k]) for k in epochs])
        within = estimate.current.covariance_enu
        current_nees.append([drift[k] @ np.linalg.solve(within[k], drift[k]) for k in epochs])
    for samples in np.array(states_nees).T:
        assert_consistent(samples, dof=STATE_DIM)
    for samples in np.array(current_nees).T:
        assert_consistent(samples, dof=3)
