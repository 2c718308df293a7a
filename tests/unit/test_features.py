"""Points seen by a sonar, from their folder to the answer: read, refused, weighed, found."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import gtsam
import numpy as np
import pytest

import ssm_graph as sg
from factors.feature_sighting import (
    direction_axes,
    feature_sighting_factor,
    place_of_sighting,
    sight_residual,
)
from ssm_graph.base.earth import LocalFrame
from ssm_graph.base.frozen import Array
from ssm_graph.io.mission_folder.vehicle import vehicle_of
from ssm_graph.io.raw_log.rows import messages_of
from ssm_graph.live.protocols.json_messages import decode_message, encode_message
from ssm_graph.mission.mission import Aids
from ssm_graph.sensors.features import FeatureLog, FeatureSighting
from ssm_graph.sensors.imu import ImuSample
from ssm_graph.simulation import AidSettings, Grade, GrossErrors, SimulatedMission, SpiralRoute
from ssm_graph.simulation.features import FeatureSettings
from ssm_graph.smoothers.faults.hypotheses import of_aid
from ssm_graph.smoothers.fixed_lag import FixedLagConfig, solve_fixed_lag
from tests.aids_fixture import weights_of
from tests.helpers import assert_consistent, assert_jacobians_match, rotation, simulated
from tests.online_fixture import joined, run

PLACES = ((5.0, 12.0, -27.0), (-22.0, -8.0, -26.0), (18.0, -30.0, -28.0), (-3.0, -33.0, -25.0))
"""Beside the spiral that the vehicle goes at 20 m of depth."""


@cache
def circling(rate: float = 0.0, seed: int = 0) -> SimulatedMission:
    """Return a mission that passes four points again and again, some sightings of others."""
    sonar = FeatureSettings(PLACES, interval_s=2.0, gross=GrossErrors(rate, (2.0, 20.0)))
    aids = AidSettings(others=(sonar,))
    return simulated(
        seed=seed, duration_s=100.0, route=SpiralRoute(), grade=Grade.TACTICAL, aids=aids
    )


def true_places(sim: SimulatedMission) -> Array:
    """Return the points (4, 3) in the axes of the mission, m."""
    frame = sim.mission.frame
    surface = LocalFrame(sim.config.lat, sim.config.lon, 0.0)
    return np.asarray(frame.p_n_from_geodetic(*surface.geodetic_from_p_n(np.array(PLACES))))


def found_places(estimate: sg.Estimate) -> tuple[Array, Array]:
    """Return places (4, 3) and their covariances (4, 3, 3)."""
    table = estimate.calibration
    assert table is not None
    rows = [
        [i for i, v in enumerate(table.values) if v.variable == f"feature_{number}"]
        for number in range(1, 5)
    ]
    places = np.array([[table.values[i].value for i in own] for own in rows])
    return places, np.array([np.asarray(table.covariance)[np.ix_(own, own)] for own in rows])


def test_jacobians() -> None:
    """Against differences, straight ahead, at the zenith, and off to the side."""
    for bearing, elevation, off in ((0.1, -0.3, 0.02), (2.5, 1.5, 0.1), (-1.0, 0.0, -0.4)):
        R_nb, p_n = rotation([0.2, -0.1, 1.3]), np.array([5.0, -3.0, 2.0])
        lever = np.array([0.8, 0.1, -0.2])
        axes = direction_axes(np.array(bearing), np.array(elevation))
        place = place_of_sighting(R_nb, p_n, lever_arm_b=lever, axes_b=axes, range_m=np.array(12.0))
        values = gtsam.Values()
        values.insert(0, gtsam.Pose3(gtsam.Rot3(R_nb), p_n))
        values.insert(1, place + off * np.array([1.0, -2.0, 0.5]))
        factor = feature_sighting_factor(
            *(0, 1),
            sigma=np.array([0.1, 0.02, 0.03]),
            range_m=12.0,
            bearing=bearing,
            elevation=elevation,
            lever_arm_b=lever,
            weight=0.7,
        )
        assert_jacobians_match(factor, values, rtol=1e-5)


def test_angles_are_positive_to_starboard_and_upwards() -> None:
    """A point to the right of the sight and above it is predicted too far there."""
    at = {"lever_arm_b": np.zeros(3), "axes_b": direction_axes(np.array(0.0), np.array(0.0))}
    R_nb = np.diag([1.0, -1.0, -1.0])  # level, x east: starboard is south
    place_n = np.array([10.0, -1.0, 2.0])
    found = sight_residual(R_nb, np.zeros(3), range_m=np.array(10.0), place_n=place_n, **at)
    assert found.error[1] == pytest.approx(np.arctan2(1.0, 10.0))
    assert found.error[2] == pytest.approx(np.arctan2(2.0, 10.0))


@pytest.mark.parametrize("rate", [0.0, 0.15])
def test_places_are_found_within_their_sigmas(rate: float) -> None:
    """Nobody states them; with sightings of other points too, which lose their weight."""
    sim = circling(rate)
    estimate = sg.smooth(sim.mission)
    places, cov = found_places(estimate)
    off = places - true_places(sim)
    nees = np.einsum("fi,fij,fj->f", off, np.linalg.inv(cov), off)
    assert_consistent(nees, dof=3)
    assert estimate.aids is not None
    weights, gross = weights_of(estimate.aids, "feature"), sim.aids.gross["features"]
    assert np.median(weights[~gross]) > 0.7
    if rate:
        assert gross.sum() >= 10
        assert np.quantile(weights[gross], 0.9) < 0.05


def test_a_track_is_held_by_points_that_nobody_knows() -> None:
    """Met again after a turn, they tell what dead reckoning has lost since the start."""
    sim = circling(0.15)
    gained = []
    for aids in (sim.mission.aids, Aids()):
        estimate = sg.smooth(replace(sim.mission, aids=aids))
        cov = np.trace(estimate.trajectory.position_cov_enu[:, :2, :2], axis1=1, axis2=2)
        gained.append(float(cov[-1] - cov[0]))
    assert gained[0] < 0.85 * gained[1]


@pytest.mark.slow
def test_a_window_finds_them_as_it_goes() -> None:
    """Each begins where its first sighting puts it."""
    sim = circling()
    newest = solve_fixed_lag(sg.build_problem(sim.mission), FixedLagConfig(lag_s=8.0)).newest
    reference = sim.mission.reference
    assert reference is not None
    metrics = sg.evaluate(newest.trajectory, reference)
    assert 0.3 < metrics.nees_position < 3.0
    assert newest.aids is not None
    assert np.median(weights_of(newest.aids, "feature")) > 0.5


def test_live_answers_leave_them_out_and_say_so() -> None:
    """They ask for no keyframes, and what says nothing is no aid that a position hangs on."""
    sim = circling()
    vehicle = vehicle_of(sim.mission)
    cut = [one for one in messages_of(sim.mission) if one.time_s < 12.0]
    late = [one for one in cut if isinstance(one, ImuSample | FeatureSighting) or one.time_s < 4.0]
    without = [one for one in late if not isinstance(one, FeatureSighting)]
    assert len(late) > len(without)
    (newest, delayed, smoother), (expected, keyframes, _) = (
        run(given, vehicle) for given in (late, without)
    )
    assert newest.since_aid_s == expected.since_aid_s > 7.0
    np.testing.assert_array_equal(joined(delayed, "time_s"), joined(keyframes, "time_s"))
    smoother.push(FeatureSighting(11.0, 2.5, 12.0, 0.0, 0.0))
    assert smoother.counts == {"features implausible": 1}
    (event,) = (event for event in smoother.take_events() if event.kind == "not_used")
    assert "[features]" in event.text


def test_what_is_no_place_is_not_said_in_metres() -> None:
    """Of what a lie of a sonar is, the sigmas of its components are told; of fixes metres."""
    for name, says in (("feature", False), ("GNSS", True)):
        told = [one.say(np.ones(one.combined.shape[1])) for one in of_aid(name, 3)]
        assert [" m " in text for text in told] == [says] * len(told)


def test_a_folder_and_messages_keep_all_of_it(tmp_path: Path) -> None:
    """Mounting, sigmas and sightings come back."""
    sim = simulated(duration_s=10.0, aids=circling().config.aids, route=SpiralRoute())
    expected = sim.mission.aids[FeatureLog]
    sg.write_mission(tmp_path / "m", sim.mission)
    log = sg.read_mission(tmp_path / "m").aids[FeatureLog]
    for name in ("time_s", "feature", "range_m", "bearing", "elevation", "mounting_rpy"):
        np.testing.assert_allclose(getattr(log, name), getattr(expected, name), rtol=1e-12)
    assert log.angle_sigma == pytest.approx(expected.angle_sigma)
    message = FeatureSighting(3.0, 7.0, 12.5, -0.3, 0.2)
    assert decode_message(encode_message(message).decode()) == message


def test_radians_and_numbers_that_are_none_are_refused(tmp_path: Path) -> None:
    """With what to do about them."""
    sim = simulated(duration_s=30.0, aids=circling().config.aids, route=SpiralRoute())
    log = sim.mission.aids[FeatureLog]
    small = replace(log, bearing=np.radians(log.bearing), elevation=np.radians(log.elevation))
    broken = replace(log, feature=log.feature + 0.5)
    for name, bad, told in (("a", small, "in radians"), ("b", broken, "whole number")):
        sg.write_mission(tmp_path / name, replace(sim.mission, aids=Aids(bad)))
        with pytest.raises(sg.DataError, match=told):
            sg.read_mission(tmp_path / name)
