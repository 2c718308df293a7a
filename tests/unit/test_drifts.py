"""Slow errors of DVL and GNSS: whose noise counts, and what the simulator draws."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ssm_graph.base.errors import ConfigError
from ssm_graph.filters.navigation.named import filter_problems
from ssm_graph.mission.estimate import Status
from ssm_graph.mission.problem import build_problem, with_dvl, with_white_noise
from ssm_graph.sensors.drift import Drift
from ssm_graph.simulation import DriftSettings, DvlSettings, GnssSettings
from ssm_graph.simulation.randomness import draw_drift
from ssm_graph.smoothers.batch import SsmSmoother
from tests.helpers import drifting, simulated

OF_DVL, OF_GNSS = Drift(0.006, 20.0, 0.25), Drift(0.5, 120.0, 0.2)
GNSS = GnssSettings(surface_depth_m=1e9)


def test_only_what_models_a_drift_leaves_it_out_of_the_noise() -> None:
    """The problem states the noise of all, and keeps it; what is made white stays as it is."""
    mission = simulated(gnss=GNSS).mission
    plain = build_problem(mission)
    stated = build_problem(drifting(mission, OF_DVL, OF_GNSS))
    white = with_white_noise(stated)
    assert plain.fixes is not None
    assert stated.fixes is not None
    assert white.fixes is not None
    np.testing.assert_array_equal(stated.beams.sigma, plain.beams.sigma)
    np.testing.assert_array_equal(stated.fixes.covariance_n, plain.fixes.covariance_n)
    np.testing.assert_allclose(white.beams.sigma, 0.25 * plain.beams.sigma)
    np.testing.assert_allclose(white.fixes.covariance_n, 0.04 * plain.fixes.covariance_n)
    again, other = with_white_noise(white), with_dvl(stated, mission)
    assert again.fixes is not None
    np.testing.assert_array_equal(again.beams.sigma, white.beams.sigma)
    np.testing.assert_array_equal(again.fixes.covariance_n, white.fixes.covariance_n)
    np.testing.assert_array_equal(other.beams.sigma, plain.beams.sigma)


def test_without_a_drift_all_noise_is_white() -> None:
    """A share alone changes nothing."""
    mission = simulated(gnss=GNSS).mission
    problem = build_problem(drifting(mission, Drift(white_share=0.2), Drift(white_share=0.2)))
    white = with_white_noise(problem)
    np.testing.assert_array_equal(white.beams.sigma, problem.beams.sigma)
    assert not white.extras


def test_filters_answer_as_without_a_drift() -> None:
    """They count the noise as it is stated."""
    mission = simulated(gnss=GNSS).mission
    problems = [build_problem(m) for m in (mission, drifting(mission, OF_DVL, OF_GNSS))]
    plain, told = (filter_problems([problem], "ssm-log")[0] for problem in problems)
    np.testing.assert_array_equal(plain.trajectory.lat, told.trajectory.lat)
    np.testing.assert_array_equal(
        plain.trajectory.position_cov_enu, told.trajectory.position_cov_enu
    )


def test_a_slow_error_of_the_velocity_is_no_outlier() -> None:
    """A DVL off by 0.1 m/s loses all its beams, unless it may be off."""
    sim = simulated(gnss=GNSS)
    dvl = sim.mission.dvl
    off = dvl.speed + dvl.mount.beams_d @ np.array([0.1, -0.05, 0.0])
    mission = replace(sim.mission, dvl=replace(dvl, speed=off))
    told = drifting(mission, Drift(0.1, 60.0), Drift())
    clean, lost, kept = (
        SsmSmoother().solve(build_problem(m)) for m in (sim.mission, mission, told)
    )
    assert lost.status is Status.SUSPECT
    assert kept.status is Status.CONVERGED, kept.reason
    assert kept.beams.weight.min() > 0.2
    change = kept.trajectory.velocity_enu - clean.trajectory.velocity_enu
    assert np.abs(change).max() < 0.1
    assert kept.calibration is None


def test_simulated_drifts_have_their_sigma_and_forget() -> None:
    """Over an hour: standard deviation, and what is left after one correlation time."""
    time_s = np.arange(0.0, 36000.0, 2.0)
    settings = DriftSettings(sigma=0.5, correlation_s=20.0)
    drift = draw_drift(settings, time_s, np.random.default_rng(1))
    assert drift.std() == pytest.approx(0.5, rel=0.05)
    assert np.mean(drift[10:] * drift[:-10]) == pytest.approx(0.25 * np.exp(-1.0), rel=0.15)
    with pytest.raises(ConfigError, match="correlation_s"):
        DriftSettings(sigma=0.5, correlation_s=0.0)


def test_a_drift_changes_no_other_error() -> None:
    """It has a stream of its own, and is common to the beams."""
    drift = DriftSettings(sigma=0.1, correlation_s=10.0)
    plain = simulated(gnss=GNSS).mission
    moved = simulated(gnss=replace(GNSS, drift=drift), dvl=DvlSettings(drift=drift)).mission
    added = moved.dvl.speed - plain.dvl.speed
    seen = added @ np.linalg.pinv(plain.dvl.mount.beams_d).T
    np.testing.assert_allclose(seen @ plain.dvl.mount.beams_d.T, added, atol=1e-12)
    assert seen.std() == pytest.approx(0.1, rel=0.6)
    assert plain.gnss is not None
    assert moved.gnss is not None
    assert not np.array_equal(moved.gnss.lat, plain.gnss.lat)
    np.testing.assert_array_equal(moved.imu.gyro_b, plain.imu.gyro_b)
