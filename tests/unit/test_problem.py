"""From mission to problem: rows of beams, fixes and depths, the gyro at a ping, settings."""

from __future__ import annotations

import dataclasses
import math
import re
from typing import Any

import numpy as np
import pytest

from ssm_graph.base.errors import ConfigError, DataError
from ssm_graph.imu.ping_motion import mean_gyro
from ssm_graph.mission.problem import ProblemConfig, build_problem
from ssm_graph.sensors.depth import DepthLog
from ssm_graph.sensors.imu import ImuLog
from ssm_graph.simulation import (
    IMU_NOISE,
    DepthSettings,
    DvlSettings,
    GnssSettings,
    Grade,
    Loss,
    TransitRoute,
    default_mount,
)
from tests.helpers import simulated, with_initial, without_beams


def test_beams_are_rows_in_the_order_of_their_keyframes() -> None:
    """Every finite speed appears once, with its own sigma, direction and keyframe."""
    sim = simulated(dropout_rate=0.4, seed=5)
    dvl = sim.mission.dvl
    rng = np.random.default_rng(0)
    sigma = rng.uniform(0.001, 0.01, dvl.sigma.shape)
    mission = dataclasses.replace(sim.mission, dvl=dataclasses.replace(dvl, sigma=sigma))
    problem = build_problem(mission)
    beams = problem.beams
    ping, beam = np.nonzero(np.isfinite(dvl.speed))
    np.testing.assert_array_equal(beams.beam, beam)
    np.testing.assert_array_equal(beams.speed, dvl.speed[ping, beam])
    np.testing.assert_array_equal(beams.sigma, sigma[ping, beam])
    np.testing.assert_allclose(beams.beam_b, dvl.mount.beams_b[beam], rtol=1e-15)
    np.testing.assert_allclose(problem.keyframe_s[beams.keyframe], dvl.time_s[ping], atol=1e-9)
    assert np.all(np.diff(beams.keyframe) >= 0)


def test_time_offset_moves_beams_to_when_they_were_taken() -> None:
    """Written late by 0.1 s and said so: the same problem as stamped right."""
    mount = dataclasses.replace(default_mount(), time_offset_s=0.125)
    late = build_problem(simulated(dvl=DvlSettings(mount=mount, late_s=0.125)).mission)
    right = build_problem(simulated().mission)
    np.testing.assert_allclose(late.keyframe_s, right.keyframe_s, atol=1e-12)
    for name in ("speed", "gyro_b", "beam_b"):
        np.testing.assert_allclose(
            getattr(late.beams, name), getattr(right.beams, name), atol=1e-12
        )


def test_without_beams_depth_or_gnss() -> None:
    """Each aid may be missing."""
    problem = build_problem(without_beams(simulated(depth=None).mission))
    assert len(problem.beams.speed) == 0
    assert problem.beams.gyro_b.shape == problem.beams.beam_b.shape == (0, 3)
    assert problem.depths is None
    assert problem.fixes is None
    np.testing.assert_allclose(np.diff(problem.keyframe_s), 1.0)


def test_keyframes_in_a_bottom_loss_come_at_the_interval_asked_for() -> None:
    """40 s without bottom lock: keyframes every 4 s instead."""
    sim = simulated(duration_s=60.0, losses=(Loss(start_s=10.5, end_s=50.5),))
    problem = build_problem(sim.mission, ProblemConfig(keyframe_interval_s=4.1))
    spacing = np.diff(problem.keyframe_s)
    assert spacing.max() == pytest.approx(4.1)
    assert problem.n_keyframes == 61 - 40 + 9


def test_a_start_in_the_middle() -> None:
    """Keyframes begin there; what came before is noted, not used."""
    sim = simulated(gnss=GnssSettings(windows=((0.0, 30.0),)))
    truth = sim.truth_at([12.5])
    mission = with_initial(
        sim.mission,
        time_s=12.5,
        lat=float(truth.lat[0]),
        lon=float(truth.lon[0]),
        height=float(truth.height[0]),
    )
    problem = build_problem(mission)
    assert problem.keyframe_s[0] == 12.5
    assert problem.depths is not None
    assert problem.depths.time_s[0] >= 12.5
    assert "12 pings outside the smoothed span 12.500..30.000 s left out" in problem.notes
    other = build_problem(sim.mission, start=mission.initial)
    np.testing.assert_array_equal(other.keyframe_s, problem.keyframe_s)


def test_no_start_is_refused_with_a_way_out() -> None:
    """Without an initial state the message points to alignment."""
    mission = dataclasses.replace(simulated().mission, initial=None)
    with pytest.raises(ConfigError, match=r"no \[initial\].*align"):
        build_problem(mission)


def test_inertial_gaps_are_noted() -> None:
    """How many, how long, where, and what was done about it."""
    sim = simulated()
    imu = sim.mission.imu
    kept = (imu.time_s < 9.97) | (imu.time_s > 10.43)
    log = ImuLog(0.0, imu.noise, imu.time_s[kept], imu.gyro_b[kept], imu.accel_b[kept])
    problem = build_problem(dataclasses.replace(sim.mission, imu=log))
    (note,) = [note for note in problem.notes if "gap" in note]
    assert re.search(r"\b1\b.*longest of 0\.50 s at 9\.950 s", note)
    assert "larger process noise" in note


def test_fixes_become_positions_with_covariances_along_the_local_level() -> None:
    """6 km from the origin up leans by 1 mrad, and so does the covariance."""
    sim = simulated(
        duration_s=600.0,
        imu_rate_hz=10.0,
        route=TransitRoute(speed=10.0),
        gnss=GnssSettings(rate_hz=0.1, sigma_vertical=3.0, windows=((0.0, 1e9),)),
    )
    problem = build_problem(sim.mission)
    fixes, gnss = problem.fixes, sim.mission.gnss
    assert fixes is not None
    assert gnss is not None
    np.testing.assert_allclose(
        fixes.position_n, problem.frame.p_n_from_geodetic(gnss.lat, gnss.lon, gnss.height)
    )
    up_n = problem.frame.R_nl_at(fixes.position_n)[:, :, 2]
    spread = np.einsum("ki,kij,kj->k", up_n, fixes.covariance_n, up_n)
    np.testing.assert_allclose(spread, 9.0, rtol=1e-12)
    np.testing.assert_allclose(np.linalg.eigvalsh(fixes.covariance_n)[:, :2], 0.25, rtol=1e-9)
    assert abs(float(up_n[-1, 2]) - 1.0) > 1e-7


def test_depths_go_to_the_next_keyframe() -> None:
    """Three times as many readings as pings: none is known before it was taken.

    Each is with the first keyframe at its time or after it, though another one be nearer.
    """
    problem = build_problem(simulated(depth=DepthSettings(rate_hz=3.0)).mission)
    assert problem.depths is not None
    time_s, keyframe = problem.depths.time_s, problem.depths.keyframe
    early_s = problem.keyframe_s[keyframe] - time_s
    assert early_s.min() == pytest.approx(0.0, abs=1e-9)
    assert early_s.max() == pytest.approx(2.0 / 3.0)
    assert np.all(problem.keyframe_s[keyframe - 1] < time_s)


def test_depths_outside_the_span_are_not_used() -> None:
    """Readings before the start and after the end of the inertial data."""
    mission = simulated().mission
    time_s = np.array([-1.0, 0.0, 15.0, 30.0, 31.0])
    log = DepthLog(sigma=0.05, time_s=time_s, depth=np.full(5, 30.0), lever_arm_b=np.zeros(3))
    problem = build_problem(dataclasses.replace(mission, depth=log))
    assert problem.depths is not None
    np.testing.assert_array_equal(problem.depths.time_s, [0.0, 15.0, 30.0])


def ramp_log(rate_hz: float) -> ImuLog:
    """Return 2 s of a rate that grows by 1 rad/s^2 on the first axis."""
    edges = np.arange(0, round(2.0 * rate_hz) + 1) / rate_hz
    gyro_b = np.zeros((len(edges) - 1, 3))
    gyro_b[:, 0] = 0.5 * (edges[1:] + edges[:-1])
    return ImuLog(0.0, IMU_NOISE[Grade.MEMS], edges[1:], gyro_b, np.zeros_like(gyro_b))


@pytest.mark.parametrize("rate_hz", [10.0, 20.0, 100.0, 400.0])
def test_gyro_at_a_ping_is_centred_on_it(rate_hz: float) -> None:
    """A linear rate is read without lag, wherever the ping falls between samples."""
    time_s = np.array([0.5, 0.613, 1.0, 1.3333])
    got = mean_gyro(ramp_log(rate_hz), time_s)
    # Within a sample the mean rate is held, so a window that cuts samples errs by their curvature.
    np.testing.assert_allclose(got[:, 0], time_s, rtol=0.0, atol=0.13 / rate_hz)
    np.testing.assert_array_equal(got[:, 1:], 0.0)


def test_gyro_window_shrinks_at_the_ends() -> None:
    """Nearer than half a window to an end the lag is half a sample at the most."""
    time_s = np.array([0.0, 0.02, 1.98, 2.0])
    got = mean_gyro(ramp_log(100.0), time_s)
    np.testing.assert_allclose(got[:, 0], time_s, rtol=0.0, atol=0.5 / 100.0 + 1e-12)


def test_gyro_window_averages_noise() -> None:
    """Ten samples of 100 Hz: a third of their noise."""
    rng = np.random.default_rng(0)
    edges = np.arange(0, 20001) / 100.0
    gyro_b = rng.normal(size=(20000, 3))
    log = ImuLog(0.0, IMU_NOISE[Grade.MEMS], edges[1:], gyro_b, np.zeros_like(gyro_b))
    got = mean_gyro(log, np.arange(1.0, 199.0, 0.11))
    assert float(np.std(got)) == pytest.approx(math.sqrt(0.1), rel=0.05)


def test_gyro_of_a_single_sample() -> None:
    """One sample is its own mean at any time."""
    log = ImuLog(0.0, IMU_NOISE[Grade.MEMS], [0.05], [[1.0, 2.0, 3.0]], np.zeros((1, 3)))  # type: ignore[arg-type]
    got = mean_gyro(log, np.array([0.0, 0.02, 0.05]))
    np.testing.assert_allclose(got, np.tile([1.0, 2.0, 3.0], (3, 1)))


def test_a_merge_rate_that_waves_do_not_survive_is_refused() -> None:
    """Heights from 1 Hz are wrong, and nothing says so."""
    with pytest.raises(ConfigError, match="merge_rate_hz: expected 5 Hz or more, got 1;"):
        ProblemConfig(merge_rate_hz=1.0)


@pytest.mark.parametrize("name", ["merge_rate_hz", "keyframe_interval_s"])
@pytest.mark.parametrize("value", [0.0, -1.0, math.nan, math.inf])
def test_bad_settings_are_refused(name: str, value: float) -> None:
    """By name, with what was expected."""
    changes: dict[str, Any] = {name: value}
    with pytest.raises(ConfigError, match=rf"{name}: expected a number above zero, got {value}"):
        ProblemConfig(**changes)


def test_start_after_the_data_is_refused() -> None:
    """Through the whole of build_problem."""
    with pytest.raises(DataError, match="leaves no inertial data"):
        build_problem(with_initial(simulated().mission, time_s=99.0))


@pytest.mark.parametrize("log", ["imu", "dvl", "depth", "gnss"])
@pytest.mark.parametrize("row", [0, 1, -1])
def test_a_time_that_is_no_number_is_called_so(log: str, row: int) -> None:
    """And not one that does not increase, as its neighbours do."""
    mission = simulated(gnss=GnssSettings(windows=((0.0, 30.0),))).mission
    time_s = getattr(mission, log).time_s.copy()
    time_s[row] = math.nan
    changed = dataclasses.replace(getattr(mission, log), time_s=time_s)
    at = row % len(time_s)
    with pytest.raises(DataError, match=rf"{log}.time_s, row {at}: expected a finite number, got"):
        build_problem(dataclasses.replace(mission, **{log: changed}))


def test_inertial_data_that_begin_at_no_time_are_refused() -> None:
    """By their own name."""
    mission = simulated(gnss=GnssSettings(windows=((0.0, 30.0),))).mission
    imu = dataclasses.replace(mission.imu, start_s=math.nan)
    with pytest.raises(DataError, match=r"imu.start_s, row 0: expected a finite number, got nan"):
        build_problem(dataclasses.replace(mission, imu=imu))
