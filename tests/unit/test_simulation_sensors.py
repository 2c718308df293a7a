"""Sensor models: what is read from perfect motion, and how large the errors are."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from ssm_graph.base.earth import LocalFrame
from ssm_graph.base.errors import ConfigError
from ssm_graph.base.frames import R_lb_from_roll_pitch_heading
from ssm_graph.base.frozen import Array
from ssm_graph.simulation import (
    CALM,
    IMU_NOISE,
    START_SIGMAS,
    DepthSettings,
    DiveRoute,
    DvlSettings,
    GnssSettings,
    Grade,
    HoverRoute,
    SurveyRoute,
    Trajectory,
    Waves,
    default_mount,
    janus_beams,
)
from ssm_graph.simulation.aids import depth_log, gnss_log
from ssm_graph.simulation.dvl_model import beam_ranges, ping_times, true_beam_speeds
from ssm_graph.simulation.inertial import averaged_imu, imu_errors, initial_state
from ssm_graph.simulation.randomness import spawn_streams

LAT, LON = math.radians(-33.0), math.radians(18.0)
SURVEY = Trajectory(SurveyRoute(), Waves(), LAT, LON)
DIVE = Trajectory(DiveRoute(), Waves(), LAT, LON)
TIMES = np.linspace(3.0, 400.0, 31)


def assert_chi_square(standardised: Array) -> None:
    """Check that independent unit normals ``standardised`` have unit variance."""
    low, high = chi2.ppf([5e-4, 1.0 - 5e-4], df=standardised.size)
    assert low < np.sum(standardised**2) < high


def velocity_b(trajectory: Trajectory) -> Array:
    """Return the velocity of the body origin in body axes, from the published truth."""
    truth = trajectory.truth(TIMES)
    roll, pitch, heading = truth.roll_pitch_heading.T
    R_lb = R_lb_from_roll_pitch_heading(roll, pitch, heading)
    return np.asarray(np.einsum("kji,kj->ki", R_lb, truth.velocity_enu))


@pytest.mark.parametrize(("rate_hz", "atol"), [(100.0, 2e-13), (10.0, 1e-10)])
def test_three_nodes_are_enough(rate_hz: float, atol: float) -> None:
    """More quadrature nodes change nothing that counts."""
    three = averaged_imu(SURVEY, rate_hz=rate_hz, n_samples=300)
    eight = averaged_imu(SURVEY, rate_hz=rate_hz, n_samples=300, n_nodes=8)
    np.testing.assert_allclose(three[0], eight[0], atol=atol)
    np.testing.assert_allclose(three[1], eight[1], atol=atol)


def test_samples_are_averages() -> None:
    """A slow sample is the mean of the fast ones in it; chunks leave no seams."""
    slow = averaged_imu(SURVEY, rate_hz=20.0, n_samples=500)
    fast = averaged_imu(SURVEY, rate_hz=200.0, n_samples=5000)
    for one, many in zip(slow, fast, strict=True):
        np.testing.assert_allclose(one, many.reshape(-1, 10, 3).mean(axis=1), atol=1e-11)


def test_imu_errors_have_their_densities() -> None:
    """Bias, white noise and walk against chi-square bounds; the seed is the trial number."""
    noise, rate_hz, n = IMU_NOISE[Grade.TACTICAL], 50.0, 200
    trials = [
        imu_errors(noise, rate_hz=rate_hz, n_samples=n, streams=spawn_streams(seed))
        for seed in range(100)
    ]
    for which, density, bias_sigma, walk in (
        (0, noise.gyro_density, noise.gyro_bias_sigma, noise.gyro_bias_density),
        (1, noise.accel_density, noise.accel_bias_sigma, noise.accel_bias_density),
    ):
        white = np.array([trial[which].noise for trial in trials])
        bias = np.array([trial[which].bias for trial in trials])
        # Means over 4 s: white noise integrates to density * sqrt(4 s), whatever the rate.
        assert_chi_square(white.mean(axis=1) / (density / math.sqrt(n / rate_hz)))
        assert_chi_square(white[:, ::20] / (density * math.sqrt(rate_hz)))
        drift = bias[:, -1] - bias[:, 0]
        assert_chi_square(drift / (walk * math.sqrt((n - 1) / rate_hz)))
        assert_chi_square(bias[:, 0] / math.hypot(bias_sigma, walk / math.sqrt(rate_hz)))


def test_initial_errors_have_their_sigmas() -> None:
    """Position, velocity and Euler-angle errors are drawn from what is stated."""
    truth, sigmas = SURVEY.truth(0.0), START_SIGMAS[Grade.MEMS]
    frame = LocalFrame(truth.lat[0], truth.lon[0], truth.height[0])
    errors = []
    for seed in range(100):
        state = initial_state(truth, sigmas, rng=spawn_streams(seed).initial)
        angles = np.array([state.roll, state.pitch, state.heading])
        errors.append(
            np.concatenate(
                [
                    frame.p_n_from_geodetic(state.lat, state.lon, state.height)
                    / state.position_sigma_enu,
                    (state.velocity_enu - truth.velocity_enu[0]) / state.velocity_sigma_enu,
                    (angles - truth.roll_pitch_heading[0]) / state.attitude_sigma,
                ]
            )
        )
    for column in np.array(errors).T:
        assert_chi_square(column)


def test_initial_state_without_errors_is_the_truth() -> None:
    """The sigmas are stated all the same."""
    truth = SURVEY.truth(0.0)
    state = initial_state(truth, START_SIGMAS[Grade.NAVIGATION], rng=None)
    assert (state.lat, state.lon, state.height) == (truth.lat[0], truth.lon[0], truth.height[0])
    np.testing.assert_array_equal(state.velocity_enu, truth.velocity_enu[0])
    np.testing.assert_allclose(np.degrees(state.attitude_sigma), [0.06, 0.06, 0.3])


def test_grades_get_worse_in_every_respect() -> None:
    """Each grade is better than the next."""
    for better, worse in zip(list(Grade)[:-1], list(Grade)[1:], strict=True):
        for name in ("gyro_density", "accel_density", "gyro_bias_sigma", "accel_bias_sigma"):
            assert getattr(IMU_NOISE[better], name) < getattr(IMU_NOISE[worse], name)
        assert START_SIGMAS[better].heading < START_SIGMAS[worse].heading


def test_janus_beams_point_down_and_around() -> None:
    """30 degrees from z, azimuth from x (forward) to y (starboard)."""
    beams = janus_beams(azimuth=[0.0, math.radians(90.0), math.radians(180.0), math.radians(270)])
    sine, cosine = 0.5, math.sqrt(0.75)
    expected = [[sine, 0, cosine], [0, sine, cosine], [-sine, 0, cosine], [0, -sine, cosine]]
    np.testing.assert_allclose(beams, expected, atol=1e-15)


def test_beams_without_lever_arm_project_the_velocity() -> None:
    """Positive along the beam, away from the transducer."""
    mount = replace(default_mount(), lever_arm_b=np.zeros(3))
    speed = true_beam_speeds(SURVEY, DvlSettings(mount=mount), TIMES)
    np.testing.assert_allclose(speed, velocity_b(SURVEY) @ mount.beams_b.T, atol=1e-13)


def test_lever_arm_acts_as_a_rigid_body() -> None:
    """The instrument's own motion equals ``v + omega x l`` with the rate relative to the Earth."""
    settings = DvlSettings()
    h = 1e-3
    omega_eb_b = (SURVEY.R_eb(TIMES - h).inv() * SURVEY.R_eb(TIMES + h)).as_rotvec() / (2.0 * h)
    v_b = velocity_b(SURVEY) + np.cross(omega_eb_b, settings.mount.lever_arm_b)
    speed = true_beam_speeds(SURVEY, settings, TIMES)
    np.testing.assert_allclose(speed, v_b @ settings.mount.beams_b.T, atol=1e-7)


def test_scale_and_misalignment_act_as_stated() -> None:
    """The written mount stays; the true one is turned after it, and speeds are stretched."""
    mount = replace(default_mount(), lever_arm_b=np.zeros(3))
    turn = (0.01, -0.02, 0.03)
    settings = DvlSettings(mount=mount, scale_error=0.02, misalignment=turn)
    R_bd = mount.R_bd @ Rotation.from_rotvec(turn).as_matrix()
    expected = 1.02 * velocity_b(SURVEY) @ (mount.beams_d @ R_bd.T).T
    np.testing.assert_allclose(true_beam_speeds(SURVEY, settings, TIMES), expected, atol=1e-13)


def test_ranges_reach_the_sea_floor() -> None:
    """In calm water at rest all four are the altitude over the cosine of the Janus angle."""
    rest = Trajectory(HoverRoute(sway_m=0.0, yaw=0.0, depth_m=15.0), CALM, LAT, LON)
    mount = replace(default_mount(), R_bd=np.eye(3))
    settings = DvlSettings(mount=mount, seabed_depth_m=45.3)
    ranges = beam_ranges(rest, settings, TIMES)
    np.testing.assert_allclose(ranges, 30.0 / math.cos(math.radians(30.0)), atol=1e-6)
    aground = beam_ranges(rest, replace(settings, seabed_depth_m=10.0), TIMES)
    assert np.isnan(aground).all()


def test_pings_come_on_time() -> None:
    """Whole seconds by default, to the very end; jitter keeps them in order and in bounds."""
    np.testing.assert_array_equal(
        ping_times(DvlSettings(), end_s=60.0, rng=None), np.arange(1.0, 61.0)
    )
    fast = DvlSettings(rate_hz=8.0, first_s=0.01, jitter_s=0.06)
    time_s = ping_times(fast, end_s=100.0, rng=np.random.default_rng(1))
    assert np.all(np.diff(time_s) > 0.0)
    assert time_s[0] > 0.0
    assert time_s[-1] <= 100.0
    assert np.ptp(np.diff(time_s)) > 0.1


def test_depth_is_that_of_the_sensor() -> None:
    """Depth with its lever arm, from the local frame's own geometry."""
    settings = DepthSettings(lever_arm_b=(1.0, 0.5, -0.4))
    log = depth_log(DIVE, settings, end_s=50.0, rng=None)
    assert len(log.time_s) == 100
    truth = DIVE.truth(log.time_s)
    roll, pitch, heading = truth.roll_pitch_heading.T
    R_lb = R_lb_from_roll_pitch_heading(roll, pitch, heading)
    up = (R_lb @ np.array(settings.lever_arm_b))[:, 2]
    np.testing.assert_allclose(log.depth, -(truth.height + up), atol=1e-6)


def test_gnss_sees_the_antenna_at_the_surface_only() -> None:
    """Fixes while the route is shallow, at the antenna."""
    settings = GnssSettings()
    log = gnss_log(DIVE, settings, end_s=1200.0, rng=None)
    assert log is not None
    assert np.all(DIVE.path_depth(log.time_s) < 0.5)
    assert log.time_s.min() < 20.0
    assert log.time_s.max() > 1180.0
    truth = DIVE.truth(log.time_s)
    for k in (0, -1):
        frame = LocalFrame(truth.lat[k], truth.lon[k], truth.height[k])
        R_lb = R_lb_from_roll_pitch_heading(*truth.roll_pitch_heading[k])
        got = frame.p_n_from_geodetic(log.lat[k], log.lon[k], log.height[k])
        np.testing.assert_allclose(got, R_lb @ log.lever_arm_b, atol=1e-8)
    assert gnss_log(SURVEY, settings, end_s=100.0, rng=None) is None


def test_noise_of_the_aids() -> None:
    """Drawn from the sigmas stated; a window more leaves the other fixes as they were."""
    exact = depth_log(SURVEY, DepthSettings(rate_hz=10.0), end_s=100.0, rng=None)
    noisy = depth_log(
        SURVEY, DepthSettings(rate_hz=10.0), end_s=100.0, rng=np.random.default_rng(2)
    )
    assert_chi_square((noisy.depth - exact.depth) / noisy.sigma)
    one = GnssSettings(rate_hz=10.0, windows=((20.0, 60.0),))
    two = replace(one, windows=((0.0, 10.0), (20.0, 60.0)))
    logs = [
        gnss_log(SURVEY, settings, end_s=100.0, rng=np.random.default_rng(3))
        for settings in (one, two)
    ]
    clean = gnss_log(SURVEY, one, end_s=100.0, rng=None)
    assert logs[0] is not None
    assert logs[1] is not None
    assert clean is not None
    np.testing.assert_array_equal(logs[0].lat, logs[1].lat[-len(logs[0].lat) :])
    frame = LocalFrame(LAT, LON, 0.0)
    error = frame.p_n_from_geodetic(logs[0].lat, logs[0].lon, logs[0].height)
    error = error - frame.p_n_from_geodetic(clean.lat, clean.lon, clean.height)
    assert_chi_square(error / logs[0].sigma_enu)


def test_impossible_sensors_are_refused() -> None:
    """The message names the setting and what was expected."""
    with pytest.raises(ConfigError, match=r"DvlSettings\.jitter_s: expected less than half"):
        DvlSettings(jitter_s=0.6)
    with pytest.raises(ConfigError, match=r"DvlSettings\.scale_error"):
        DvlSettings(scale_error=2.0)
    with pytest.raises(ConfigError, match=r"DepthSettings\.sigma"):
        DepthSettings(sigma=0.0)
    with pytest.raises(ConfigError, match=r"GnssSettings\.windows"):
        GnssSettings(windows=((5.0, 5.0),))
    with pytest.raises(ConfigError, match=r"GnssSettings\.lever_arm_b"):
        GnssSettings(lever_arm_b=(math.nan, 0.0, 0.0))
