"""The stated uncertainty against the truth, over many seeds and all grades."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from factors.similarity import ExpKernel, GaussianKernel, Kernel, LogKernel, SqrtKernel
from ssm_graph.engine.error_state import STATE_DIM
from ssm_graph.mission.estimate import Estimate, Status
from ssm_graph.mission.problem import Problem, build_problem
from ssm_graph.simulation import Fault, Grade, Loss, OutlierKind, Outliers, SimulatedMission
from ssm_graph.smoothers.batch import Similarity, SmootherConfig, SsmSmoother
from tests.helpers import (
    assert_consistent,
    covariances,
    estimated_states,
    simulated,
    state_errors,
    true_states,
)

SEEDS = range(10)
DURATION_S = {
    Grade.NAVIGATION: 300.0,
    Grade.TACTICAL: 300.0,
    Grade.INDUSTRIAL: 300.0,
    # Longer, the position bends with the heading and its error is no ellipsoid any more.
    Grade.MEMS: 180.0,
}
each_grade = pytest.mark.parametrize("grade", Grade, ids=lambda grade: grade.name)


def solved(sim: SimulatedMission, kernel: Kernel) -> tuple[Problem, Estimate]:
    """Return problem and estimate of a simulated mission."""
    problem = build_problem(sim.mission)
    return problem, SsmSmoother(SmootherConfig(kernel=kernel)).solve(problem)


@pytest.mark.slow
@each_grade
def test_whole_state_is_consistent(grade: Grade) -> None:
    """NEES of all 15 error states at the first, middle and last keyframe of clean missions.

    The kernel is gaussian, so the covariance has to be exact; random initial errors from the
    stated sigmas; every epoch's mean over the seeds within its own chi-square interval. So are the
    squared errors of velocity and angles at the end, each component in the sigma that is told.
    """
    nees, squares = [], []
    for seed in SEEDS:
        sim = simulated(duration_s=DURATION_S[grade], grade=grade, seed=seed)
        problem, estimate = solved(sim, GaussianKernel())
        assert estimate.status is Status.CONVERGED, estimate.reason
        states = estimated_states(problem, estimate.trajectory)
        P = covariances(problem, states, estimate.beams.weight)
        errors = state_errors(states, true_states(problem, sim))
        epochs = (0, problem.n_keyframes // 2, -1)
        nees.append([errors[k] @ np.linalg.solve(P[k], errors[k]) for k in epochs])
        trajectory, truth = estimate.trajectory, sim.truth_at(problem.keyframe_s[-1:])
        velocity = trajectory.velocity_enu[-1] - truth.velocity_enu[0]
        angles = trajectory.roll_pitch_heading[-1] - truth.roll_pitch_heading[0]
        angles = (angles + np.pi) % (2.0 * np.pi) - np.pi
        squares.append(
            np.r_[
                (velocity / trajectory.velocity_sigma_enu[-1]) ** 2,
                (angles / trajectory.attitude_sigma[-1]) ** 2,
            ]
        )
    for samples in np.array(nees).T:
        assert_consistent(samples, dof=STATE_DIM)
    for component in np.array(squares).T:
        assert_consistent(component, dof=1)


@pytest.mark.slow
@pytest.mark.parametrize("kernel", [LogKernel(), SqrtKernel(), ExpKernel()], ids=str)
def test_robust_kernels_stay_consistent_with_outliers(kernel: Kernel) -> None:
    """10 % outliers at tactical grade: position NEES of the last epoch as if there were none.

    Robust weights cost a tenth of variance on clean data, so the upper end of the interval for
    1.15 times the degrees of freedom is the limit.
    """
    nees = []
    for seed in SEEDS:
        sim = simulated(
            duration_s=300.0,
            grade=Grade.TACTICAL,
            seed=200 + seed,
            outliers=Outliers(OutlierKind.SPARSE, rate=0.1),
        )
        problem, estimate = solved(sim, kernel)
        assert estimate.status is Status.CONVERGED, estimate.reason
        errors = state_errors(
            estimated_states(problem, estimate.trajectory), true_states(problem, sim)
        )
        R_ln = np.swapaxes(problem.frame.R_nl_at(true_states(problem, sim).p_n[-1]), 0, 1)
        error_enu = R_ln @ true_states(problem, sim).R_nb[-1] @ errors[-1, 3:6]
        P = estimate.trajectory.position_cov_enu[-1]
        nees.append(error_enu @ np.linalg.solve(P, error_enu))
    assert_consistent(np.array(nees) / 1.15, dof=3)


LOST: dict[str, tuple[int, ...]] = {
    "four beams": (),
    "three beams": (3,),
    "two beams": (2, 3),
    "one beam": (1, 2, 3),
    "no beam": (0, 1, 2, 3),
}


def losses_of(beams: tuple[int, ...], start_s: float, end_s: float) -> tuple[Loss, ...]:
    """Return the loss of some beams, or none."""
    return (Loss(start_s, end_s, beams=beams),) if beams else ()


@pytest.mark.slow
def test_fewer_beams_know_less() -> None:
    """150 s with ever fewer beams: the horizontal sigma at the end grows with each one lost.

    The remaining beams of each case are among those of the case before, so this is a law.
    """
    sigmas = []
    for beams in LOST.values():
        losses = losses_of(beams, 20.0, 170.0)
        sim = simulated(duration_s=180.0, grade=Grade.TACTICAL, losses=losses, seed=9)
        _, estimate = solved(sim, GaussianKernel())
        sigmas.append(np.sqrt(np.trace(estimate.trajectory.position_cov_enu[-1, :2, :2])))
    assert np.all(np.diff(sigmas) > 0.0)
    assert sigmas[-1] > 3.0 * sigmas[0]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["two beams", "one beam", "no beam"])
def test_truth_stays_within_three_sigma_with_few_beams(name: str) -> None:
    """3 min with few or no beams at tactical grade: at least 99 % of axes and epochs."""
    beams, inside = LOST[name], []
    for seed in SEEDS:
        losses = losses_of(beams, 60.0, 240.0)
        sim = simulated(duration_s=300.0, grade=Grade.TACTICAL, losses=losses, seed=300 + seed)
        problem, estimate = solved(sim, LogKernel())
        assert estimate.status is Status.CONVERGED, estimate.reason
        truth = true_states(problem, sim)
        errors = state_errors(estimated_states(problem, estimate.trajectory), truth)
        R_lb = np.swapaxes(problem.frame.R_nl_at(truth.p_n), 1, 2) @ truth.R_nb
        error_enu = np.einsum("kij,kj->ki", R_lb, errors[:, 3:6])
        P = estimate.trajectory.position_cov_enu
        inside.append(np.abs(error_enu) < 3.0 * np.sqrt(np.diagonal(P, axis1=1, axis2=2)))
    assert np.mean(inside) >= 0.99


@pytest.mark.slow
@each_grade
@pytest.mark.parametrize("similarity", Similarity, ids=lambda s: s.name)
@pytest.mark.parametrize("kernel", [LogKernel(), SqrtKernel(), ExpKernel()], ids=str)
def test_robust_kernels_converge_over_minutes(
    kernel: Kernel, similarity: Similarity, grade: Grade
) -> None:
    """160 s with sparse outliers in two beams at once, and with a programmed fault of 40 s."""
    fault = Fault(beams=(1,), start_s=80.0, end_s=120.0, offset_m_per_s=1.0)
    cases: list[dict[str, Any]] = [
        {"outliers": Outliers(OutlierKind.TWO_BEAMS, rate=0.1)},
        {"faults": (fault,)},
    ]
    for seed, changes in enumerate(cases):
        sim = simulated(duration_s=160.0, grade=grade, seed=400 + seed, **changes)
        config = SmootherConfig(kernel=kernel, similarity=similarity)
        estimate = SsmSmoother(config).solve(build_problem(sim.mission))
        assert estimate.status is Status.CONVERGED, estimate.reason
        bad = sim.is_outlier[np.isfinite(sim.mission.dvl.speed)]
        assert np.mean(estimate.beams.weight[bad] < 0.05) >= 0.99
