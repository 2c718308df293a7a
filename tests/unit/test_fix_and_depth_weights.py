"""Fixes of GNSS and depths are weighed like beams: a wild one moves no answer."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from factors.similarity import WEIGHT_FLOOR, LogKernel
from ssm_graph.base.times import Indices
from ssm_graph.engine.error_state import POSITION
from ssm_graph.filters.navigation.named import filter_geodetic, filter_problems
from ssm_graph.graph.aids.depth import DepthMeans, Depths
from ssm_graph.graph.aids.gnss import Fixes
from ssm_graph.graph.first_values import first_values
from ssm_graph.io.mission_folder.vehicle import vehicle_of
from ssm_graph.io.raw_log.rows import messages_of
from ssm_graph.live.estimator import ONLINE, FixedLagSmoother
from ssm_graph.mission.estimate import Estimate, Status, Trajectory
from ssm_graph.mission.mission import Mission
from ssm_graph.mission.navigation import Navigation
from ssm_graph.mission.problem import Problem, build_problem
from ssm_graph.mission.start.measured import body_velocities, start_fixes
from ssm_graph.sensors.depth import DepthLog
from ssm_graph.sensors.gnss import GnssLog
from ssm_graph.simulation import DepthSettings, GnssSettings, Grade, SimulatedMission
from ssm_graph.smoothers.batch import SsmSmoother
from ssm_graph.smoothers.fixed_lag import FixedLagConfig, solve_fixed_lag
from tests.aids_fixture import weights_of
from tests.helpers import simulated, state_errors, true_states, with_initial

EARTH_M = 6.37e6


def gnss_of(mission: Mission) -> GnssLog:
    """Return the fixes."""
    assert mission.gnss is not None
    return mission.gnss


def depth_of(mission: Mission) -> DepthLog:
    """Return the depths."""
    assert mission.depth is not None
    return mission.depth


def with_wild(mission: Mission, fixes: Indices, readings: Indices) -> Mission:
    """Return the mission with fixes (F,) 50 m to the north, and depths (D,) 10 m too deep."""
    gnss, depth = gnss_of(mission), depth_of(mission)
    lat, deep = gnss.lat.copy(), depth.depth.copy()
    lat[fixes] += 50.0 / EARTH_M
    deep[readings] += 10.0
    return replace(mission, gnss=replace(gnss, lat=lat), depth=replace(depth, depth=deep))


def without(mission: Mission, fixes: Indices, readings: Indices) -> Mission:
    """Return the mission as if these had not been measured."""
    gnss, depth = gnss_of(mission), depth_of(mission)
    kept, read = np.ones(len(gnss.lat), bool), np.ones(len(depth.depth), bool)
    kept[fixes], read[readings] = False, False
    names = ("time_s", "lat", "lon", "height", "sigma_enu")
    return replace(
        mission,
        gnss=replace(gnss, **{name: getattr(gnss, name)[kept] for name in names}),
        depth=replace(depth, time_s=depth.time_s[read], depth=depth.depth[read]),
    )


def sigmas_apart(one: Trajectory, other: Trajectory) -> float:
    """Return the largest difference of position, velocity and attitude in the other's sigmas."""
    north_east_up = np.stack(
        [
            (one.lat - other.lat) * EARTH_M,
            (one.lon - other.lon) * EARTH_M * np.cos(other.lat),
            one.height - other.height,
        ],
        axis=1,
    )
    sigma = np.sqrt(np.diagonal(other.position_cov_enu, axis1=1, axis2=2))[:, [1, 0, 2]]
    velocity = (one.velocity_enu - other.velocity_enu) / other.velocity_sigma_enu
    attitude = (one.roll_pitch_heading - other.roll_pitch_heading) / other.attitude_sigma
    return float(np.max(np.abs([north_east_up / sigma, velocity, attitude])))


@cache
def surfaced(grade: Grade = Grade.TACTICAL) -> SimulatedMission:
    """Return a minute with fixes in its first and last third."""
    gnss = GnssSettings(windows=((0.0, 20.0), (40.0, 60.0)))
    depth = DepthSettings(rate_hz=1.0)
    return simulated(duration_s=60.0, grade=grade, gnss=gnss, depth=depth, seed=3)


def smoothed(problem: Problem) -> Estimate:
    """Return the batch's answer."""
    return SsmSmoother().solve(problem)


def newest(problem: Problem) -> Estimate:
    """Return each state of a window as it was the newest."""
    return solve_fixed_lag(problem, FixedLagConfig(5.0)).newest


def filtered(problem: Problem) -> Estimate:
    """Return the filter's answer."""
    return filter_problems([problem], "ssm-log")[0]


def geodetic(problem: Problem) -> Estimate:
    """Return that of the filter in geodetic coordinates."""
    return filter_geodetic([problem], [surfaced().mission.imu])[0]


MIDDLE = np.array([30]), np.array([29])
"""A fix and a depth amid others."""


@pytest.mark.parametrize("estimate", [smoothed, newest, filtered, geodetic])
def test_a_wild_fix_and_a_wild_depth_move_nothing(estimate: object) -> None:
    """By less than a fifth of a sigma from what comes out without them; the weights say it."""
    assert callable(estimate)
    mission = surfaced().mission
    found: Estimate = estimate(build_problem(with_wild(mission, *MIDDLE)))
    expected: Estimate = estimate(build_problem(without(mission, *MIDDLE)))
    assert found.status is Status.CONVERGED, found.reason
    assert sigmas_apart(found.trajectory, expected.trajectory) < 0.2
    if estimate is geodetic:
        return
    assert found.aids is not None
    for name, wild in zip(("GNSS", "depth"), MIDDLE, strict=True):
        weight = weights_of(found.aids, name)
        assert weight[wild].max() < 1e-2
        assert np.delete(weight, wild).min() > 0.2
        assert found.aids.counts()[name] == (len(weight), 1)


@pytest.mark.parametrize("first", [(np.array([0]), np.array([], int)), (np.array([0]),) * 2])
def test_a_wild_first_fix_does_not_derail_the_smoother(first: tuple[Indices, Indices]) -> None:
    """Of a start known to 10 km, which believes it: the next ones together are right."""
    mission = surfaced().mission
    start = mission.initial
    assert start is not None
    off = with_initial(
        mission,
        lat=start.lat + 8000.0 / EARTH_M,
        lon=start.lon - 9000.0 / EARTH_M,
        position_sigma_enu=np.full(3, 1e4),
    )
    found, expected = (
        smoothed(build_problem(m)) for m in (with_wild(off, *first), without(off, *first))
    )
    assert found.status is Status.CONVERGED, found.reason
    assert sigmas_apart(found.trajectory, expected.trajectory) < 0.2


def test_the_first_pass_doubts_its_place_after_three_fixes() -> None:
    """The wild first one is believed by a start of 10 km; then three agree against it."""
    sim = surfaced()
    wild = with_wild(sim.mission, np.array([0]), np.array([], int))
    problem = build_problem(with_initial(wild, position_sigma_enu=np.full(3, 1e4)))
    first = first_values(problem, kernel=LogKernel())
    fixes = first.aid_weights[-len(gnss_of(wild).lat) :]
    assert fixes[0] > 0.9
    assert fixes[1:3].max() < 0.01
    assert fixes[3:].min() > 0.2
    errors = state_errors(first.states, true_states(problem, sim))
    assert np.linalg.norm(errors[-1, POSITION]) < 1.0


@pytest.mark.parametrize("grade", [Grade.NAVIGATION, Grade.MEMS], ids=lambda grade: grade.name)
def test_a_tenth_of_wild_ones_are_found(grade: Grade) -> None:
    """At random; as good as without them, and nothing is suspect."""
    mission, rng = surfaced(grade).mission, np.random.default_rng(5)
    fixes, readings = (
        np.flatnonzero(rng.random(n) < 0.1)
        for n in (len(gnss_of(mission).lat), len(depth_of(mission).depth))
    )
    assert min(len(fixes), len(readings)) >= 3
    found = smoothed(build_problem(with_wild(mission, fixes, readings)))
    expected = smoothed(build_problem(without(mission, fixes, readings)))
    assert found.status is Status.CONVERGED, found.reason
    assert sigmas_apart(found.trajectory, expected.trajectory) < 0.4
    assert found.aids is not None
    assert weights_of(found.aids, "GNSS")[fixes].max() < 1e-2
    assert weights_of(found.aids, "depth")[readings].max() < 1e-2


def last_answer(mission: Mission) -> Navigation:
    """Return the newest answer of a vehicle that was told everything, the start known."""
    estimator = FixedLagSmoother(vehicle_of(mission), replace(ONLINE, lag_s=5.0))
    for message in sorted(messages_of(mission), key=lambda message: message.time_s):
        estimator.push(message)
    answer = estimator.newest()
    assert answer is not None
    return answer


def test_on_the_vehicle_as_well() -> None:
    """The last but one of the fixes and of the depths: the answer is that without them."""
    mission = surfaced().mission
    logs = gnss_of(mission).lat, depth_of(mission).depth
    fix, reading = (np.array([len(log) - 2]) for log in logs)
    found = last_answer(with_wild(mission, fix, reading))
    expected = last_answer(without(mission, fix, reading))
    apart = np.array(
        [
            (found.lon - expected.lon) * EARTH_M * np.cos(expected.lat),
            (found.lat - expected.lat) * EARTH_M,
            found.height - expected.height,
        ]
    )
    assert np.all(np.abs(apart) < 0.2 * expected.position_sigma_enu)


def test_fixes_that_miss_by_thrice_their_sigmas_are_said() -> None:
    """They keep half their weight each, and are many: from when to when, and by how much."""
    mission = simulated(duration_s=120.0, gnss=GnssSettings(windows=((0.0, 119.0),))).mission
    gnss = gnss_of(mission)
    off = np.where(np.arange(len(gnss.lat)) >= 80, 2.5 / EARTH_M, 0.0)
    estimate = smoothed(build_problem(replace(mission, gnss=replace(gnss, lat=gnss.lat + off))))
    assert estimate.status is Status.SUSPECT
    assert "GNSS measurements from " in estimate.reason
    assert "of their own sigmas (median)" in estimate.reason


@pytest.mark.parametrize("wild", [0, 2, 4])
def test_a_reading_is_outvoted_by_the_others_of_its_keyframe(wild: int) -> None:
    """Five readings a second while diving at 1 m/s: the mean is of four; of two it is of both."""
    sim = simulated(duration_s=10.0, depth=DepthSettings(rate_hz=5.0))
    log, keyframe_s = depth_of(sim.mission), np.arange(11.0)
    log = replace(log, depth=10.0 + log.time_s)
    deep = log.depth.copy()
    row = int(np.flatnonzero(log.time_s > 4.0 + 1e-6)[wild])
    deep[row] += 10.0
    kept = Depths.of(replace(log, depth=deep), sim.mission.imu, keyframe_s)
    whole = Depths.of(log, sim.mission.imu, keyframe_s)
    assert set(whole.time_s) - set(kept.time_s) == {log.time_s[row]}
    means = DepthMeans.of_readings(kept, keyframe_s, sim.mission.frame)
    assert means.count[means.keyframe == 5] == 4
    two = np.isin(np.arange(len(deep)), (row, row + 1))
    pair = replace(log, time_s=log.time_s[two], depth=deep[two])
    assert len(Depths.of(pair, sim.mission.imu, keyframe_s).depth) == 2


def test_a_start_is_not_found_from_a_wild_first_fix() -> None:
    """It disagrees with those of the next seconds; of two alone either may be right."""
    mission = surfaced().mission
    wild = with_wild(mission, np.array([0]), np.array([], int))
    found = start_fixes(wild, body_velocities(wild))
    assert found.time_s[0] == gnss_of(mission).time_s[1]
    assert len(found.time_s) == len(gnss_of(mission).lat) - 1
    two = without(wild, np.arange(2, len(gnss_of(mission).lat)), np.array([], int))
    assert len(start_fixes(two, body_velocities(two)).time_s) == 2


def test_every_fix_is_one_measurement_of_three_components() -> None:
    """One weight for it, as for an acoustic one."""
    problem = build_problem(surfaced().mission)
    estimate = smoothed(problem)
    assert estimate.aids is not None
    assert isinstance(problem.fixes, Fixes)
    of_gnss = np.array(estimate.aids.aid) == "GNSS"
    weight = estimate.aids.weight[of_gnss].reshape(-1, 3)
    assert len(weight) == len(problem.fixes)
    np.testing.assert_array_equal(weight, np.repeat(weight[:, :1], 3, axis=1))


@pytest.mark.slow
def test_what_is_beyond_the_gate_of_a_window_is_listed_and_never_counts() -> None:
    """Many depths of another unit against a height that nothing else holds: not by a millimetre."""
    mission = surfaced().mission
    depth, start = depth_of(mission), mission.initial
    assert start is not None
    bad = np.where(depth.time_s > 20.0, 100.0 * depth.depth, depth.depth)
    config = FixedLagConfig(5.0, gate_sigmas=6.0)
    fixes = np.flatnonzero(gnss_of(mission).time_s > 20.0)
    no_fixes = without(mission, fixes, np.array([], int))
    found, expected = (
        solve_fixed_lag(build_problem(replace(no_fixes, depth=log)), config).delayed
        for log in (
            replace(depth, depth=bad),
            depth_of(without(mission, fixes, np.flatnonzero(depth.time_s > 20.0))),
        )
    )
    np.testing.assert_allclose(found.trajectory.height, expected.trajectory.height, atol=1e-3)
    assert found.aids is not None
    weight = weights_of(found.aids, "depth")
    assert len(weight) == len(depth.depth)
    assert weight[depth.time_s > 20.5].max() == WEIGHT_FLOOR
    assert "depth measurements contradict" in found.reason
