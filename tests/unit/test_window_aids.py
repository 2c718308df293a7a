"""Every aid of the batch in the window of a fixed-lag smoother, offline and on the vehicle."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ssm_graph.graph.measurements import aids_of
from ssm_graph.io.mission_folder.vehicle import vehicle_of
from ssm_graph.io.raw_log.rows import messages_of
from ssm_graph.live.estimator import ONLINE, FixedLagSmoother
from ssm_graph.mission.estimate import AidTable, Estimate
from ssm_graph.mission.mission import Aids, Mission
from ssm_graph.mission.problem import build_problem
from ssm_graph.sensors.compass import HeadingErrors
from ssm_graph.sensors.standstill import HOLDS_S, RestLog, Standstill
from ssm_graph.simulation import (
    AidSettings,
    CompassSettings,
    GnssSettings,
    GrossErrors,
    RangingSettings,
    SimulatedMission,
    UsblSettings,
)
from ssm_graph.simulation.magnetometer import MagnetometerSettings
from ssm_graph.smoothers.batch import SmootherConfig, SsmSmoother
from ssm_graph.smoothers.fixed_lag import FixedLagConfig, solve_fixed_lag
from ssm_graph.smoothers.keyframe import keyframes_of, sensors_of
from tests.aids_fixture import KNOWN, usbl, weights_of, with_every_aid
from tests.helpers import simulated

WHOLE = FixedLagConfig(1e3, tolerance=1e-7)


def of_known(**changes: object) -> SimulatedMission:
    """Return a mission with every aid, of which nothing is to be estimated."""
    aids = AidSettings(
        usbl=UsblSettings(interval_s=2.1, gross=GrossErrors(0.3, (20.0, 100.0))),
        ranging=RangingSettings((KNOWN,), interval_s=1.3, gross=GrossErrors(0.2, (5.0, 50.0))),
        compass=CompassSettings(errors=HeadingErrors()),
        standstills=(Standstill(4.0, 5.5, sigma=0.5),),
        others=(MagnetometerSettings(gross=GrossErrors(0.2, (5e-6, 50e-6))),),
    )
    config = {
        "duration_s": 10.0,
        "aids": aids,
        "gnss": GnssSettings(windows=((0.0, 9.0),)),
        "seed": 2,
    }
    return simulated(**(config | changes))


def table_of(estimate: Estimate) -> AidTable:
    """Return what became of the aids."""
    assert estimate.aids is not None
    return estimate.aids


def test_a_window_of_the_whole_mission_weighs_every_aid_as_the_batch() -> None:
    """Same states, sigmas, innovations and weights, gross errors among the measurements."""
    problem = build_problem(of_known().mission)
    batch = SsmSmoother(SmootherConfig(tolerance=1e-7)).solve(problem)
    whole = solve_fixed_lag(problem, WHOLE).delayed
    mine, other = whole.trajectory, batch.trajectory
    sigma = other.velocity_sigma_enu
    assert np.max(np.abs(mine.velocity_enu - other.velocity_enu) / sigma) < 1e-5
    np.testing.assert_allclose(mine.height, other.height, rtol=0.0, atol=1e-6)
    np.testing.assert_allclose(mine.velocity_sigma_enu, sigma, rtol=1e-6)
    own, table = table_of(whole), table_of(batch)
    assert set(own.aid) == {
        *("depth", "GNSS"),
        *("USBL", "range", "heading", "standstill", "magnetometer"),
    }
    assert own.aid == table.aid
    assert own.component == table.component
    np.testing.assert_array_equal(own.time_s, table.time_s)
    np.testing.assert_allclose(own.weight, table.weight, rtol=0.0, atol=1e-5)
    np.testing.assert_allclose(own.innovation, table.innovation, rtol=0.0, atol=1e-5)
    assert own.weight.min() < 0.05


def test_constants_of_aids_are_carried_in_the_state_as_the_batch_finds_them() -> None:
    """Place of a beacon, errors of a compass: to a fiftieth of a sigma."""
    problem = build_problem(with_every_aid(duration_s=12.0).mission)
    batch = SsmSmoother().solve(problem)
    config = replace(WHOLE, max_iterations=20, tolerance=1e-4)
    whole = solve_fixed_lag(problem, config).delayed
    assert batch.calibration is not None
    assert whole.calibration is not None
    found = {value.label: value for value in whole.calibration.values}
    assert {"beacon_7_east_m", "heading_offset_deg", "magnetometer_hard_iron_x_ut"} <= set(found)
    for value in batch.calibration.values:
        assert abs(found[value.label].value - value.value) < 0.02 * value.sigma, value.label
        assert found[value.label].sigma == pytest.approx(value.sigma, rel=0.02), value.label
    np.testing.assert_allclose(table_of(whole).weight, table_of(batch).weight, atol=0.02)


def test_with_a_short_lag_gross_fixes_count_for_nothing() -> None:
    """At once, and when they leave the window; the others bound the drift of the position."""
    sim = simulated(duration_s=60.0, aids=usbl(rate=0.3, interval_s=3.0), seed=5)
    for estimate in solve_fixed_lag(build_problem(sim.mission), FixedLagConfig(6.0)):
        weight = weights_of(table_of(estimate), "USBL")
        gross = sim.aids.gross["usbl"]
        assert weight[gross].max() < 0.1
        assert np.median(weight[~gross]) > 0.8


def test_keyframes_carry_the_slices_of_the_tables() -> None:
    """Every row of every table once, in order."""
    problem = build_problem(of_known().mission)
    keyframes, sensors = list(keyframes_of(problem)), sensors_of(problem)
    for aid in aids_of(problem):
        assert len(sensors.aids[aid.name]) == 0
        slices = [keyframe.aids[aid.name] for keyframe in keyframes if aid.name in keyframe.aids]
        whole = sensors.aids[aid.name].joined(slices)
        for name in aid.columns():
            np.testing.assert_array_equal(getattr(whole, name), getattr(aid, name))
    speeds = np.concatenate([keyframe.beams.speed for keyframe in keyframes])
    np.testing.assert_array_equal(speeds, problem.beams.speed)


def live(mission: Mission) -> FixedLagSmoother:
    """Return a vehicle's estimator at the end, told in order of stamps, stored and restored."""
    messages = sorted(messages_of(mission), key=lambda message: message.time_s)
    vehicle = vehicle_of(mission)
    estimator = FixedLagSmoother(vehicle)
    half = len(messages) // 2
    for message in messages[:half]:
        estimator.push(message)
    arrays, meta = estimator.checkpoint()
    estimator = FixedLagSmoother.restore(vehicle, None, arrays, meta)
    for message in messages[half:]:
        estimator.push(message)
    assert estimator.counts == {}
    return estimator


def test_the_vehicle_is_aided_as_the_smoother_offline() -> None:
    """By fixes that come late, through a checkpoint; beacon and compass found with them."""
    sim = with_every_aid(duration_s=12.0)
    estimator = live(sim.mission)
    assert estimator._course is not None
    newest, calibration = estimator._course.newest.window.newest, estimator.found().calibration
    problem = build_problem(sim.mission)
    offline = solve_fixed_lag(problem, ONLINE).newest
    assert calibration is not None
    assert offline.calibration is not None
    track = offline.trajectory
    k = int(np.argmin(np.abs(track.time_s - newest.time_s[0])))
    assert track.time_s[k] == pytest.approx(newest.time_s[0], abs=1e-6)
    sigma = np.sqrt(np.diagonal(track.position_cov_enu[k]))
    p_n = problem.frame.p_n_from_geodetic(track.lat[k], track.lon[k], track.height[k])
    assert np.all(np.abs(newest.states.p_n[0] - p_n) < 1e-3 * sigma)
    for own, other in zip(calibration.values, offline.calibration.values, strict=True):
        assert own.label == other.label
        assert abs(own.value - other.value) < 0.2 * other.sigma, own.label
        assert own.sigma == pytest.approx(other.sigma, rel=0.1), own.label
    tables = [part.aids for part in estimator.finish() if part.aids is not None]
    for name in ("depth", "GNSS", "USBL", "range", "heading", "standstill", "magnetometer"):
        n_rows = sum(table.aid.count(name) for table in tables)
        assert n_rows == pytest.approx(table_of(offline).aid.count(name), abs=3)


def told_at_rest() -> Mission:
    """Return a mission that says that it stands for 2 s, with a sigma of its own at last."""
    time_s = np.arange(4.0, 6.4, 0.3)
    sigma = np.full(len(time_s), np.nan)
    sigma[-1] = 0.3
    return replace(
        simulated(duration_s=12.0, seed=4).mission, aids=Aids(RestLog(0.5, time_s, sigma))
    )


def test_who_says_that_he_stands_is_believed_for_a_second() -> None:
    """As a stated standstill, by batch and window; on the vehicle the answer is the same."""
    mission = told_at_rest()
    problem = build_problem(mission)
    batch = SsmSmoother(SmootherConfig(tolerance=1e-7)).solve(problem)
    table = table_of(batch)
    is_rest = np.array(table.aid) == "standstill"
    rest_s = np.unique(table.time_s[is_rest])
    assert rest_s[0] >= 4.0
    assert rest_s[-1] <= 6.3 + HOLDS_S
    assert len(rest_s) >= 3
    assert 0.0 < weights_of(table, "standstill").min() < 0.9  # the vehicle drifts at some 1 m/s
    stills = (Standstill(rest_s[0], rest_s[-2], 0.5), Standstill(rest_s[-1], rest_s[-1] + 0.1, 0.3))
    still = replace(mission, aids=Aids(*stills))
    other = SsmSmoother(SmootherConfig(tolerance=1e-7)).solve(build_problem(still))
    sigma = other.trajectory.velocity_sigma_enu
    off = np.abs(batch.trajectory.velocity_enu - other.trajectory.velocity_enu)
    assert np.max(off / sigma) < 1e-6
    whole = solve_fixed_lag(problem, WHOLE).delayed
    np.testing.assert_allclose(table_of(whole).weight, table.weight, rtol=0.0, atol=1e-5)
    estimator = live(mission)
    assert estimator._course is not None
    newest, track = estimator._course.newest.window.newest, solve_fixed_lag(problem, ONLINE).newest
    k = int(np.argmin(np.abs(track.trajectory.time_s - newest.time_s[0])))
    answer = track.trajectory
    p_n = problem.frame.p_n_from_geodetic(answer.lat[k], answer.lon[k], answer.height[k])
    sigma = np.sqrt(np.diagonal(answer.position_cov_enu[k]))
    assert np.all(np.abs(newest.states.p_n[0] - p_n) < 1e-3 * sigma)
    rows = [part.aids for part in estimator.finish() if part.aids is not None]
    found = {time_s for part in rows for time_s in part.time_s[np.array(part.aid) == "standstill"]}
    np.testing.assert_allclose(sorted(found), rest_s, rtol=0.0, atol=1e-9)
