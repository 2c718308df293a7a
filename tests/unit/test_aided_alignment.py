"""Alignment with a compass and with a standstill."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from ssm_graph.base.frames import wrap_to_pi
from ssm_graph.mission.estimate import Status
from ssm_graph.mission.mission import Aids
from ssm_graph.mission.start.alignment import align
from ssm_graph.mission.start.measured import body_velocities
from ssm_graph.sensors.compass import HeadingErrors
from ssm_graph.sensors.standstill import Standstill
from ssm_graph.simulation import (
    AidSettings,
    CompassSettings,
    GnssSettings,
    Grade,
    GrossErrors,
    HoverRoute,
    SimulatedMission,
    scenario_config,
    simulate,
)
from ssm_graph.smoothers.mission import smooth

COMPASS = CompassSettings(
    errors=HeadingErrors(offset_sigma=math.radians(3.0)),
    declination=math.radians(-7.0),
    gross=GrossErrors(0.2, (0.3, 1.0)),
)


def hovering(
    grade: Grade, *, compass: CompassSettings | None, **changes: object
) -> SimulatedMission:
    """Return station keeping with GNSS, whose start is not known."""
    config = scenario_config(
        "hover",
        grade=grade,
        duration_s=200.0,
        gnss=GnssSettings(windows=((0.0, 200.0),)),
        aids=AidSettings(compass=compass),
        seed=3,
        **changes,
    )
    sim = simulate(config)
    return replace(sim, mission=replace(sim.mission, initial=None))


def test_a_compass_gives_the_heading_that_nothing_else_does() -> None:
    """Of MEMS gyros on a vehicle that stays where it is; disturbed as it is now and then."""
    sim = hovering(Grade.MEMS, compass=COMPASS)
    alignment = align(sim.mission)
    assert "the compass" in alignment.method
    (start,) = alignment.candidates
    truth = sim.truth_at(np.array([start.time_s])).roll_pitch_heading[0, 2]
    assert abs(wrap_to_pi(start.heading - truth)) < start.attitude_sigma[2]
    assert start.attitude_sigma[2] < math.radians(12.0)
    without = align(replace(sim.mission, aids=Aids()))
    assert len(without.candidates) > 1
    estimate = smooth(sim.mission)
    assert estimate.status is Status.CONVERGED
    end = estimate.trajectory
    true = sim.truth_at(end.time_s).roll_pitch_heading[:, 2]
    error = wrap_to_pi(end.roll_pitch_heading[:, 2] - true)
    assert np.all(np.abs(error) < 3.0 * end.attitude_sigma[:, 2])


def test_a_directional_gyro_says_nothing_of_the_start() -> None:
    """Its origin is its own: the heading stays open, and is estimated all the same."""
    errors = HeadingErrors(offset_sigma=math.pi, rate_sigma=math.radians(10.0) / 3600.0)
    sim = hovering(Grade.MEMS, compass=CompassSettings(errors=errors))
    assert "hypotheses" in align(sim.mission).method
    assert "compass" not in align(sim.mission).method


def test_good_gyros_need_no_compass() -> None:
    """Theirs is the smaller sigma."""
    sim = hovering(Grade.NAVIGATION, compass=COMPASS)
    assert "gyrocompassing" in align(sim.mission).method


def test_a_standstill_is_a_velocity_of_zero() -> None:
    """In the place of the pings within it, whatever these say."""
    sim = hovering(Grade.TACTICAL, compass=None, route=HoverRoute())
    still = Standstill(20.0, 40.5)
    at_rest = body_velocities(replace(sim.mission, aids=Aids(still)))
    inside = (at_rest.time_s >= 20.0) & (at_rest.time_s <= 40.5)
    assert inside.sum() >= 21
    assert not at_rest.v_b[inside].any()
    assert np.all(np.diff(at_rest.time_s) > 0.0)
    plain = body_velocities(sim.mission)
    kept = (plain.time_s < 20.0) | (plain.time_s > 40.5)
    np.testing.assert_array_equal(at_rest.v_b[~inside], plain.v_b[kept])
