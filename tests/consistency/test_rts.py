"""The Rauch-Tung-Striebel pass against the batch smoother: two ways to the same least squares."""

from __future__ import annotations

from dataclasses import astuple

import numpy as np
import pytest

from factors.similarity import GaussianKernel
from ssm_graph.base.frozen import Array
from ssm_graph.filters.navigation.named import filter_problems
from ssm_graph.mission.estimate import Status, Trajectory
from ssm_graph.mission.problem import Problem, build_problem
from ssm_graph.sensors.imu import ImuNoise
from ssm_graph.simulation import DepthSettings, DvlSettings, GnssSettings, Grade, Loss
from ssm_graph.simulation.inertial import IMU_NOISE, START_SIGMAS, StartSigmas
from ssm_graph.smoothers.batch import SmootherConfig, SsmSmoother
from tests.helpers import covariances, estimated_states, simulated, state_errors

GRADES = (Grade.NAVIGATION, Grade.TACTICAL, Grade.INDUSTRIAL)
LOUD, QUIET = 1.0, 0.1


def survey(grade: Grade, noise: float) -> Problem:
    """Return a minute in waves, every noise ``noise`` times that of the grade.

    Depth is read at the keyframes: in between it is carried along the track as known so far, which
    is another one for the filter than for the smoother.
    """
    sim = simulated(
        duration_s=60.0,
        grade=grade,
        seed=2,
        imu_noise=ImuNoise(*(noise * density for density in astuple(IMU_NOISE[grade]))),
        start_sigmas=StartSigmas(*(noise * sigma for sigma in astuple(START_SIGMAS[grade]))),
        dvl=DvlSettings(noise=noise * 0.005),
        depth=DepthSettings(rate_hz=1.0, sigma=noise * 0.05),
        gnss=GnssSettings(
            sigma_horizontal=noise * 0.5, sigma_vertical=noise, windows=((0.0, 20.0),)
        ),
        dropout_rate=0.1,
        losses=(Loss(30.0, 40.0),),
    )
    return build_problem(sim.mission)


def sigmas(covariance: Array) -> Array:
    """Return the roots of the diagonals."""
    return np.sqrt(np.diagonal(covariance, axis1=-2, axis2=-1))


def covariance_difference(found: Trajectory, expected: Trajectory) -> float:
    """Return the largest difference of what the covariances say, relative."""
    sigma = sigmas(expected.position_cov_enu)
    unit = sigma[:, :, None] * sigma[:, None, :]
    return max(
        float(np.abs((found.position_cov_enu - expected.position_cov_enu) / unit).max()),
        float(np.abs(found.velocity_sigma_enu / expected.velocity_sigma_enu - 1.0).max()),
        float(np.abs(found.attitude_sigma / expected.attitude_sigma - 1.0).max()),
    )


@pytest.mark.parametrize("noise", [QUIET, pytest.param(LOUD, marks=pytest.mark.slow)])
@pytest.mark.parametrize("grade", GRADES, ids=lambda grade: grade.name)
def test_it_is_the_batch_smoother_to_first_order(grade: Grade, noise: float) -> None:
    """All 15 states at all keyframes, and the covariances: apart by a share that goes with noise.

    The filter linearises once, at its predictions; the smoother where it ends. That leaves terms
    of second order: in sigmas, and relative to the covariance, as large as the errors themselves.
    Measured for the three grades: 0.06, 0.13 and 0.44 sigma, 0.014, 0.024 and 0.067 of a
    covariance; of a tenth of the noise 0.008, 0.012 and 0.040, 0.001, 0.002 and 0.005.
    """
    problem = survey(grade, noise)
    (found,) = filter_problems([problem], "ekf", smoothed=True)
    # The default tolerance is 1e-3 sigma: far enough below, it is out of the comparison.
    expected = SsmSmoother(SmootherConfig(GaussianKernel(), tolerance=1e-5)).solve(problem)
    assert found.status is Status.CONVERGED, found.reason
    assert expected.status is Status.CONVERGED, expected.reason
    states = estimated_states(problem, expected.trajectory)
    P = covariances(problem, states, expected.beams.weight)
    apart = state_errors(estimated_states(problem, found.trajectory), states) / sigmas(P)
    assert np.abs(apart).max() < 0.5 * noise
    assert covariance_difference(found.trajectory, expected.trajectory) < 0.1 * noise


def test_the_last_keyframe_is_the_filters() -> None:
    """Nothing comes after it; before it, all that comes later makes the track more certain."""
    problem = survey(Grade.TACTICAL, LOUD)
    (plain,) = filter_problems([problem], "ekf")
    (smoothed,) = filter_problems([problem], "ekf", smoothed=True)
    assert smoothed.method == f"{plain.method} + rts"
    for name in Trajectory.__dataclass_fields__:
        own, other = (getattr(run.trajectory, name) for run in (smoothed, plain))
        np.testing.assert_array_equal(own[-1], other[-1], err_msg=name)
    before, after = plain.trajectory, smoothed.trajectory
    assert np.all(after.velocity_sigma_enu[:-1] < before.velocity_sigma_enu[:-1])
    gained = before.position_cov_enu - after.position_cov_enu
    scale = sigmas(before.position_cov_enu)
    gained /= scale[:, :, None] * scale[:, None, :]
    assert np.linalg.eigvalsh(gained).min() > -1e-9
    np.testing.assert_array_equal(smoothed.beams.weight, plain.beams.weight)
