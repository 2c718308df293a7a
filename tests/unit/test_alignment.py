"""Alignment: the start is found from the data, with sigmas that hold, or the doubt is said."""

from __future__ import annotations

import math
import warnings
from dataclasses import replace

import numpy as np
import pytest

from ssm_graph.base.errors import ConfigError, DataError
from ssm_graph.base.frames import wrap_to_pi
from ssm_graph.mission.estimate import Status
from ssm_graph.mission.fault import DetectedFault, Treatment
from ssm_graph.mission.mission import Mission
from ssm_graph.mission.start.alignment import N_HYPOTHESES, SAFE_HEADING_SIGMA, align
from ssm_graph.mission.start.measured import body_velocities
from ssm_graph.simulation import (
    GnssSettings,
    Grade,
    OutlierKind,
    Outliers,
    SimulatedMission,
    scenario_config,
    simulate,
)
from ssm_graph.smoothers.mission import _choose, smooth
from tests.mission_fixture import make_mission


def simulated(grade: Grade, *, scenario: str = "demo", seconds: float = 330.0) -> SimulatedMission:
    """Return a mission with GNSS at its begin and 10 % outliers."""
    outliers = Outliers(OutlierKind.SPARSE, 0.1)
    gnss = GnssSettings(windows=((0.0, 40.0),))
    config = scenario_config(
        scenario, grade=grade, duration_s=seconds, outliers=outliers, gnss=gnss, seed=2
    )
    return simulate(config)


def without_initial(mission: Mission) -> Mission:
    """Return the mission as it comes from the field."""
    return replace(mission, initial=None)


@pytest.mark.parametrize("grade", list(Grade))
def test_the_start_is_found_within_its_sigmas(grade: Grade) -> None:
    """Roll, pitch and heading lie within three of the sigmas handed to the smoother."""
    run = simulated(grade)
    alignment = align(without_initial(run.mission))
    assert len(alignment.candidates) == 1
    start = alignment.candidates[0]
    truth = run.truth_at(np.array([start.time_s]))
    found = np.array([start.roll, start.pitch, start.heading])
    error = wrap_to_pi(found - truth.roll_pitch_heading[0])
    assert np.all(np.abs(error) < 3.0 * start.attitude_sigma)
    off = np.abs(start.velocity_enu - truth.velocity_enu[0])
    assert np.all(off < 3.0 * start.velocity_sigma_enu)


def test_good_gyros_feel_the_earth_and_poor_ones_follow_the_track() -> None:
    """The source of the heading is said, and fits the grade."""
    navigation = align(without_initial(simulated(Grade.NAVIGATION).mission))
    mems = align(without_initial(simulated(Grade.MEMS).mission))
    assert "gyrocompassing" in navigation.method
    assert "GNSS against DVL" in mems.method
    assert navigation.candidates[0].attitude_sigma[2] < mems.candidates[0].attitude_sigma[2]


def test_gyrocompassing_needs_no_motion_and_no_dvl() -> None:
    """A navigation-grade unit at rest on deck finds north by itself."""
    run = simulated(Grade.NAVIGATION, scenario="hover")
    silent = replace(run.mission.dvl, speed=np.full_like(run.mission.dvl.speed, np.nan))
    alignment = align(replace(without_initial(run.mission), dvl=silent))
    start = alignment.candidates[0]
    truth = run.truth_at(np.array([start.time_s])).roll_pitch_heading[0]
    assert abs(wrap_to_pi(start.heading - truth[2])) < math.radians(3.0)


@pytest.mark.slow
def test_an_unobservable_heading_is_tried_all_around_and_said() -> None:
    """A hovering MEMS vehicle cannot know its heading; no answer may pretend that it does."""
    run = simulated(Grade.MEMS, scenario="hover", seconds=60.0)
    mission = without_initial(run.mission)
    alignment = align(mission)
    assert len(alignment.candidates) == N_HYPOTHESES
    assert "hardly observable" in alignment.method
    headings = np.sort([start.heading for start in alignment.candidates])
    np.testing.assert_allclose(np.diff(headings), 2.0 * np.pi / N_HYPOTHESES)
    estimate = smooth(mission)
    said = estimate.reason + " ".join(estimate.notes)
    assert "ambiguous" in said or "hardly observable" in said
    sigma = estimate.trajectory.attitude_sigma[0, 2]
    assert estimate.status is Status.SUSPECT or sigma > SAFE_HEADING_SIGMA / 2.0


def test_hypotheses_find_the_heading_that_later_fixes_tell() -> None:
    """GNSS at the end decides between headings that its begin leaves open."""
    run = simulated(Grade.MEMS, seconds=120.0)
    gnss = run.mission.gnss
    assert gnss is not None
    kept = (gnss.time_s < 3.0) | (gnss.time_s > 30.0)
    sparse = replace(
        gnss,
        time_s=gnss.time_s[kept],
        lat=gnss.lat[kept],
        lon=gnss.lon[kept],
        height=gnss.height[kept],
        sigma_enu=gnss.sigma_enu[kept],
    )
    estimate = smooth(replace(without_initial(run.mission), gnss=sparse))
    assert estimate.status is Status.CONVERGED, estimate.reason
    truth = run.truth_at(estimate.trajectory.time_s[:1]).roll_pitch_heading[0, 2]
    error = wrap_to_pi(estimate.trajectory.roll_pitch_heading[0, 2] - truth)
    assert abs(error) < 3.0 * estimate.trajectory.attitude_sigma[0, 2]


def test_a_heading_that_needs_a_lie_is_no_rival_of_one_that_needs_none() -> None:
    """A pull of the fixes explains what a start that is wrong by 180 degrees leaves."""
    mission = simulated(Grade.TACTICAL, seconds=60.0).mission
    honest, alignment = smooth(mission), align(without_initial(mission))
    pull = DetectedFault("GNSS", "from nothing on", 0.0, 60.0, 60.0, 2, Treatment.FREED)
    turned = honest.trajectory.roll_pitch_heading + np.array([0.0, 0.0, math.pi])
    trajectory = replace(honest.trajectory, roll_pitch_heading=turned)
    lying = replace(honest, trajectory=trajectory, cost=honest.cost - 5.0, faults=(pull,))
    chosen = _choose([lying, honest], alignment)
    assert not chosen.faults
    assert chosen.status is honest.status
    both = _choose([lying, replace(honest, faults=(pull,))], alignment)
    assert both.status is Status.SUSPECT
    assert "heading ambiguous" in both.reason


def test_what_cannot_be_aligned_is_refused() -> None:
    """Without GNSS, or with fixes outside of the inertial data, the message says what to add."""
    mission = without_initial(simulated(Grade.NAVIGATION, seconds=60.0).mission)
    with pytest.raises(ConfigError, match="add \\[initial\\]"):
        align(replace(mission, gnss=None))
    gnss = mission.gnss
    assert gnss is not None
    with pytest.raises(DataError, match="clocks"):
        align(replace(mission, gnss=replace(gnss, time_s=gnss.time_s + 1e6)))


def test_no_ping_yet_is_no_velocity_and_no_warning() -> None:
    """A live estimator looks before the first ping has come."""
    mission = make_mission()
    dvl = mission.dvl
    none = {name: getattr(dvl, name)[:0] for name in ("time_s", "speed", "sigma", "range_m")}
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = body_velocities(replace(mission, dvl=replace(dvl, **none)))
    assert found.v_b.shape == (0, 3)


def test_body_velocities_leave_contradicting_pings_out() -> None:
    """A single bad beam breaks the array's parity, and its ping does not count."""
    run = simulated(Grade.NAVIGATION, scenario="survey", seconds=120.0)
    velocities = body_velocities(run.mission)
    truth = run.truth_at(velocities.time_s)
    speed = np.linalg.norm(truth.velocity_enu, axis=1)
    assert np.max(np.abs(np.linalg.norm(velocities.v_b, axis=1) - speed)) < 0.05
    bad = run.ping_time_s[run.is_outlier.any(axis=1)]
    assert len(bad) > 5
    assert not np.isin(bad, velocities.time_s).any()
