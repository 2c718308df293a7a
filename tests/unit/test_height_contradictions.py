"""Depth and fixes that contradict each other: nothing but the height, at most, is begun anew."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from ssm_graph.base.frozen import Array
from ssm_graph.io.mission_folder.vehicle import vehicle_of
from ssm_graph.io.raw_log.rows import messages_of
from ssm_graph.live.estimator import FixedLagSmoother
from ssm_graph.live.estimator.watch import Watch
from ssm_graph.mission.navigation import Health
from ssm_graph.sensors.depth import DepthReading
from ssm_graph.sensors.gnss import Fix
from ssm_graph.sensors.imu import ImuSample
from ssm_graph.sensors.messages import Message
from ssm_graph.simulation import DvlSettings, Fault, FaultShape, Sensor, with_faults
from tests.helpers import simulated
from tests.online_fixture import SHORT, messages, stream

FROM_S, TO_S = 2.0, 18.0
"""Fixes come once a second, until 20 s."""


def pushed(given: Iterator[Message]) -> FixedLagSmoother:
    """Return the estimator after the first part of the mission, which has fixes."""
    smoother = FixedLagSmoother(stream(40.0)[1], SHORT)
    for message in given:
        if message.time_s < TO_S:
            smoother.push(message)
    return smoother


def watch_of(smoother: FixedLagSmoother) -> Watch:
    """Return what is remembered at the newest step."""
    assert smoother._course is not None
    return smoother._course.newest.watch


def off(smoother: FixedLagSmoother) -> tuple[float, float]:
    """Return how far the newest answer is off, level and in height, m."""
    newest = smoother.newest()
    assert newest is not None
    truth = stream(40.0)[0].truth_at(np.array([newest.time_s]))
    level: Array = 6.37e6 * np.hypot(
        newest.lat - truth.lat[0], (newest.lon - truth.lon[0]) * np.cos(newest.lat)
    )
    return float(level), newest.height - float(truth.height[0])


def test_false_depths_that_fixes_contradict_are_not_followed() -> None:
    """Two of them with every inertial sample outvote the sensor; nothing begins anew for them."""

    def flooded() -> Iterator[Message]:
        for message in messages(40.0):
            if isinstance(message, ImuSample) and message.time_s > FROM_S:
                yield from (DepthReading(message.time_s - 1e-5 * k, 20.0) for k in (1, 2))
            yield message

    smoother = pushed(flooded())
    assert watch_of(smoother).depths_refused > 25
    level, up = off(smoother)
    assert level < 1.0
    assert abs(up) < 0.5
    newest = smoother.newest()
    assert newest is not None
    assert newest.health is Health.DEGRADED
    assert "depth contradicts the prediction" in newest.reason
    assert "recovered" not in {event.kind for event in smoother.take_events()}


def heights_off(*, has_depth: bool) -> Iterator[Message]:
    """Yield the mission with fixes that are 40 m too high from some time on."""
    for message in messages(40.0):
        if isinstance(message, Fix) and message.time_s > FROM_S:
            yield replace(message, height=message.height + 40.0)
        elif has_depth or not isinstance(message, DepthReading):
            yield message


def test_of_fixes_whose_height_alone_is_wrong_the_rest_counts() -> None:
    """The depth agrees with the height, so it stays; the place is what fixes say all the same."""
    smoother = pushed(heights_off(has_depth=True))
    watch = watch_of(smoother)
    assert watch.heights_refused > 10
    assert watch.fixes_refused == 0
    assert watch.last_fix_s > TO_S - 1.5
    level, up = off(smoother)
    assert level < 1.0
    assert abs(up) < 0.5
    newest = smoother.newest()
    assert newest is not None
    assert "the height of" in newest.reason
    assert "recovered" not in {event.kind for event in smoother.take_events()}


def test_a_height_that_only_fixes_know_follows_them_and_nothing_else_does() -> None:
    """Five contradict it, and it begins anew; that is no sign of a wrong heading."""
    smoother = pushed(heights_off(has_depth=False))
    watch = watch_of(smoother)
    level, up = off(smoother)
    assert abs(up - 40.0) < 2.0
    assert level < 1.0
    assert watch.moved == ()
    assert watch.contradicted is not None
    assert [event.kind for event in smoother.take_events()].count("recovered") == 1


def test_a_frozen_depth_does_not_pull_at_the_height_wherever_a_wave_brings_it_past() -> None:
    """It agrees there for a moment, twice in every wave; the height is never beyond 5 sigma."""
    sim = simulated(duration_s=90.0, dvl=DvlSettings(noise=0.005), seed=5)
    frozen = Fault(sensor=Sensor.DEPTH, shape=FaultShape.STUCK, start_s=20.0, end_s=70.0)
    mission = with_faults(sim.mission, (frozen,), truth=sim.truth_at, seed=5).mission
    smoother = FixedLagSmoother(vehicle_of(mission))
    off = []
    for message in messages_of(mission):
        smoother.push(message)
        newest = smoother.newest() if isinstance(message, DepthReading) else None
        if newest is not None:
            height = float(sim.truth_at(np.array([newest.time_s])).height[0])
            off.append(abs(newest.height - height) / newest.position_sigma_enu[2])
    assert max(off) < 5.0
    told = [event.text for event in smoother.take_events()]
    assert any("left out until it agrees" in text for text in told)
