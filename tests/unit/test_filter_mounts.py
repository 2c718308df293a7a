"""Filters with DVLs of any number of beams, in any directions."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from functools import cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ssm_graph.base.errors import ConfigError
from ssm_graph.base.frozen import Array
from ssm_graph.filters.navigation.filter import Grouping
from ssm_graph.filters.navigation.named import FILTERS, filter_geodetic, filter_problems
from ssm_graph.mission.estimate import Estimate, Status
from ssm_graph.mission.mission import Mission
from ssm_graph.mission.problem import build_problem
from ssm_graph.simulation import (
    DvlSettings,
    Grade,
    OutlierKind,
    Outliers,
    SimulatedMission,
    default_mount,
    janus_beams,
)
from tests.helpers import simulated

BEAMS = {"velocity": np.eye(3), "three beams": janus_beams(3)}
MOUNTS = pytest.mark.parametrize("mount", BEAMS)
TURN = Rotation.from_rotvec([0.4, -0.8, 0.3]).as_matrix()
METHODS = [*FILTERS, "geodetic"]
AMPLIFY = {"ssmkf-sqrt", "ssmkf-exp"}
"""Those that give the prediction up with an outlier's ping: rounding grows without end there."""
WHOLE_PING = [name for name in FILTERS if FILTERS[name].grouping is Grouping.PER_PING]


@cache
def survey(beams: str | int) -> SimulatedMission:
    """Return 15 s in waves, seen by an instrument of these beams, a fifth of the pings bad."""
    beams_d = BEAMS[beams] if isinstance(beams, str) else janus_beams(beams)
    return simulated(
        duration_s=15.0,
        grade=Grade.TACTICAL,
        dvl=DvlSettings(mount=default_mount(beams_d)),
        outliers=Outliers(OutlierKind.SPARSE, rate=0.2),
    )


def filtered_together(missions: Sequence[Mission], name: str) -> list[Estimate]:
    """Return the estimates of a filter, the missions as one batch."""
    problems = [build_problem(mission) for mission in missions]
    if name == "geodetic":
        return filter_geodetic(problems, [mission.imu for mission in missions])
    return filter_problems(problems, name)


def filtered(mission: Mission, name: str) -> Estimate:
    """Return the estimate of a filter."""
    return filtered_together([mission], name)[0]


def without_outliers(sim: SimulatedMission) -> Mission:
    """Return the mission without its bad beams."""
    dvl = sim.mission.dvl
    speed = np.where(sim.is_outlier, np.nan, dvl.speed)
    return dataclasses.replace(sim.mission, dvl=dataclasses.replace(dvl, speed=speed))


def off(sim: SimulatedMission, estimate: Estimate) -> Array:
    """Return the errors of the velocities, in their sigmas."""
    track = estimate.trajectory
    error = track.velocity_enu - sim.truth_at(track.time_s).velocity_enu
    return np.asarray(error / track.velocity_sigma_enu)


@cache
def four_beams(name: str) -> Estimate:
    """Return what a filter makes of the mission as four beams see it."""
    return filtered(without_outliers(survey(4)), name)


@MOUNTS
@pytest.mark.parametrize("name", METHODS)
def test_every_filter_takes_three_beams_and_a_velocity(name: str, mount: str) -> None:
    """As near to the truth as its own sigmas say, on the mission that four beams also see."""
    sim = survey(mount)
    mission = without_outliers(sim)
    estimate = filtered(mission, name)
    assert estimate.status is Status.CONVERGED, estimate.reason
    assert np.abs(off(sim, estimate)).max() < 5.0
    assert set(estimate.beams.beam) == {1.0, 2.0, 3.0}
    assert len(estimate.beams.weight) == np.isfinite(mission.dvl.speed).sum()
    ours, four = estimate.trajectory, four_beams(name).trajectory
    sigma = ours.velocity_sigma_enu + four.velocity_sigma_enu
    assert np.abs((ours.velocity_enu - four.velocity_enu) / sigma).max() < 5.0


@MOUNTS
@pytest.mark.parametrize("name", ["ekf-gate-beam", "rstkf", "mckf", "ssm-log", "geodetic"])
def test_bad_beams_lose_their_weight(name: str, mount: str) -> None:
    """Of three as of four, while the track stays with the truth."""
    sim = survey(mount)
    estimate, problem = filtered(sim.mission, name), build_problem(sim.mission)
    assert np.abs(off(sim, estimate)).max() < 6.0
    bad = sim.is_outlier[problem.beams.ping, problem.beams.beam]
    assert bad.sum() >= 2
    assert estimate.beams.weight[bad].max() < 0.1
    assert np.median(estimate.beams.weight[~bad]) > 0.7


@pytest.mark.parametrize("name", sorted(set(WHOLE_PING) - AMPLIFY))
def test_beams_along_other_axes_say_the_same(name: str) -> None:
    """A velocity turned into three other perpendicular beams: no other ping to such a rule."""
    sim = survey("velocity")
    dvl = sim.mission.dvl
    mount = dataclasses.replace(dvl.mount, beams_d=TURN @ dvl.mount.beams_d)
    turned = dataclasses.replace(dvl, mount=mount, speed=dvl.speed @ TURN.T)
    plain = filtered(sim.mission, name).trajectory
    other = filtered(dataclasses.replace(sim.mission, dvl=turned), name).trajectory
    np.testing.assert_allclose(other.velocity_enu, plain.velocity_enu, rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(other.velocity_sigma_enu, plain.velocity_sigma_enu, rtol=1e-7)


@pytest.mark.parametrize("n_beams", [1, 2, 5, 8])
def test_one_to_eight_beams(n_beams: int) -> None:
    """One beam is better than none, and eight better than five."""
    fewer = filtered(without_outliers(survey(n_beams)), "ekf")
    more = filtered(without_outliers(survey(n_beams + 1 if n_beams < 8 else 7)), "ekf")
    sigmas = [e.trajectory.velocity_sigma_enu[-1].max() for e in (fewer, more)]
    assert bool(sigmas[0] > sigmas[1]) is (n_beams < 8)


@pytest.mark.parametrize("name", ["ekf", "geodetic"])
def test_runs_of_three_beams_side_by_side_are_those_alone(name: str) -> None:
    """A batch of velocity and three beams: both are three numbers a ping."""
    missions = [without_outliers(survey(mount)) for mount in BEAMS]
    for mission, found in zip(missions, filtered_together(missions, name), strict=True):
        alone = filtered(mission, name).trajectory
        np.testing.assert_allclose(found.trajectory.velocity_enu, alone.velocity_enu, atol=1e-12)


@pytest.mark.parametrize("name", ["ekf", "geodetic"])
def test_other_numbers_of_beams_are_not_filtered_together(name: str) -> None:
    """Refused with the numbers and a way out."""
    missions = [survey(mount).mission for mount in ("three beams", 4)]
    with pytest.raises(ConfigError, match="same number of beams in all of 2, got 3, 4; filter"):
        filtered_together(missions, name)
