"""The witness beside a live estimator: the batch's sets, alarms by name, answers that leave it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from ssm_graph.base.errors import ConfigError
from ssm_graph.base.frozen import Array
from ssm_graph.io.mission_folder.vehicle import vehicle_of
from ssm_graph.io.raw_log.rows import messages_of
from ssm_graph.live.estimator import ONLINE, FixedLagSmoother
from ssm_graph.live.estimator.buffers import Buffers
from ssm_graph.mission.estimate import Found
from ssm_graph.mission.mission import Mission
from ssm_graph.mission.navigation import Event, Health, Navigation
from ssm_graph.sensors.imu import ImuSample
from ssm_graph.sensors.messages import Message
from ssm_graph.simulation import Fault, FaultShape, Sensor, SimulatedMission, with_faults
from ssm_graph.systems.sensor_network.live import Witnessed, start_of
from ssm_graph.systems.sensor_network.witness import WitnessBounds, witness
from tests.live_fixture import a_navigation
from tests.witness_fixture import a_survey

END_S = 62.0
EARTH_M = 6.37e6


@pytest.fixture(scope="module")
def simulated() -> SimulatedMission:
    """Return a survey with fixes and depth."""
    return a_survey(seed=31, end_s=END_S, imu_rate_hz=50.0)


class TruthTeller:
    """Stands in for an estimator: its answers are the truth, led ``north_m`` aside from 20 s on."""

    shift_s = 0.0

    def __init__(self, simulated: SimulatedMission, north_m: float = 0.0) -> None:
        self._simulated, self._north_m = simulated, north_m
        self._buffers = Buffers(vehicle_of(simulated.mission))

    def received(self, begin_s: float, end_s: float) -> Mission:
        """Return what was pushed."""
        frame = self._simulated.mission.frame
        return self._buffers.mission(frame, begin_s=begin_s, until_s=end_s)

    def push(self, message: Message) -> None:
        """Take a message, but none that is stamped beyond the end, or not at all."""
        if message.time_s <= END_S:
            self._buffers.add(message)

    def newest(self) -> Navigation | None:
        """Return the truth at the last inertial sample."""
        at_s = self._buffers.imu.last_s
        if at_s < 1.0:
            return None
        now = self._simulated.truth_at(np.array([min(at_s, END_S)]))
        return a_navigation(
            at_s,
            lat=float(now.lat[0]) + (self._north_m / EARTH_M if at_s > 20.0 else 0.0),
            lon=float(now.lon[0]),
            height=float(now.height[0]),
            velocity_enu=now.velocity_enu[0],
            roll_pitch_heading=now.roll_pitch_heading[0],
            attitude_sigma=np.radians([0.1, 0.1, 0.5]),
        )

    def found(self) -> Found:
        """Return nothing."""
        return Found()

    def status(self) -> tuple[Health, str]:
        """Say what an estimator says before its answer."""
        return Health.ALIGNING, "not yet"

    def take_events(self) -> Sequence[Event]:
        """Return nothing."""
        return ()

    def take_delayed(self) -> Sequence[Any]:
        """Return nothing."""
        return ()

    def finish(self) -> Sequence[Any]:
        """Return nothing."""
        return ()

    def checkpoint(self) -> tuple[Mapping[str, Array], Mapping[str, Any]]:
        """Return nothing."""
        return {}, {}


def run(live: Witnessed, mission: Mission) -> list[Navigation]:
    """Push a mission; return the answers, one for each block that was judged."""
    judged: list[Navigation] = []
    for message in messages_of(mission):
        before = live.last
        live.push(message)
        if live.last is not before:
            answer = live.newest()
            assert answer is not None
            judged.append(answer)
    return judged


def test_block_by_block_it_comes_to_the_sets_of_the_whole(simulated: SimulatedMission) -> None:
    """Beside the estimator itself: those of the recorded mission, from the same first answer."""
    mission, end_s = simulated.mission, 28.0
    live, first = Witnessed(FixedLagSmoother(vehicle_of(mission), ONLINE)), None
    for message in messages_of(mission):
        if message.time_s > end_s:
            break
        live.push(message)
        first = first or live.newest()
    assert first is not None
    whole = witness(mission, start_of(first, first.time_s))
    assert live.last is not None
    assert live.last.time_s[0] == whole.time_s[1] > 20.0
    np.testing.assert_allclose(live.last.half_widths[0], whole.half_widths[1], rtol=1e-6)
    answer = live.newest()
    assert answer is not None
    assert answer.health is Health.GOOD
    corner_m = math.hypot(*whole.half_widths[1, :2])
    assert 2.0 * corner_m > answer.witness_m > whole.half_widths[1, 0]
    assert answer.witness_s == whole.time_s[1]


def test_the_true_answer_is_within_what_is_told(simulated: SimulatedMission) -> None:
    """In every block, without an event; a checkpoint's new start is the estimator's own."""
    live = Witnessed(TruthTeller(simulated))
    judged = run(live, simulated.mission)
    assert [answer.witness_s for answer in judged] == sorted({a.witness_s for a in judged})
    assert len(judged) >= 5
    assert all(0.3 < answer.witness_m < 4.0 for answer in judged)
    assert not live.take_events()


def test_stamps_of_nowhere_begin_no_block_early(simulated: SimulatedMission) -> None:
    """A sample or a fix of another time, or of none: the estimator refuses it, nothing is told."""
    told: list[Message] = []
    for message in messages_of(simulated.mission):
        if len(told) % 997 == 0:
            told += [replace(message, time_s=t) for t in (math.nan, message.time_s + 1000.0)]
        told.append(message)
    live, plain = (Witnessed(TruthTeller(simulated)) for _ in range(2))
    for message in told:
        live.push(message)
    run(plain, simulated.mission)
    assert not live.take_events()
    assert live.last is not None
    assert plain.last is not None
    assert np.array_equal(live.last.shape, plain.last.shape)


def test_an_alarm_names_sensor_and_time_and_voids_the_promise(simulated: SimulatedMission) -> None:
    """Fixes that jump by 9 m; the level is infinite from then on."""
    fault = Fault(
        sensor=Sensor.GNSS,
        shape=FaultShape.CONSTANT,
        size=(9.0, 0.0, 0.0),
        start_s=25.0,
        end_s=END_S,
    )
    mission = with_faults(simulated.mission, [fault], truth=simulated.truth_at).mission
    live = Witnessed(TruthTeller(simulated))
    judged = run(live, mission)
    (event,) = live.take_events()
    assert event.kind == "bound_false_GNSS"
    assert 25.0 < event.time_s < 36.0
    assert "GNSS" in event.text
    assert "DVL" in event.text
    for answer in judged:
        assert math.isinf(answer.witness_m) == (answer.witness_s >= event.time_s)


def test_an_answer_that_leaves_the_set_is_told(simulated: SimulatedMission) -> None:
    """20 m to the north: an event, and the answer is no longer GOOD."""
    live = Witnessed(TruthTeller(simulated, north_m=20.0))
    judged = run(live, simulated.mission)
    assert "answer_outside" in {event.kind for event in live.take_events()}
    assert judged[0].health is Health.GOOD
    assert judged[-1].health is Health.DEGRADED
    assert "left the set" in judged[-1].reason
    assert live.status() == (Health.DEGRADED, judged[-1].reason)


def test_over_a_gap_of_inertial_data_it_begins_anew(simulated: SimulatedMission) -> None:
    """No bound holds over it."""
    imu = simulated.mission.imu
    kept = (imu.time_s < 15.0) | (imu.time_s > 16.5)
    gap = replace(imu, time_s=imu.time_s[kept], gyro_b=imu.gyro_b[kept], accel_b=imu.accel_b[kept])
    live = Witnessed(TruthTeller(simulated))
    told: list[Message] = [
        m for m in messages_of(simulated.mission) if not isinstance(m, ImuSample)
    ]
    told += [
        m for m in messages_of(replace(simulated.mission, imu=gap)) if isinstance(m, ImuSample)
    ]
    for message in sorted(told, key=lambda m: m.time_s):
        live.push(message)
    kinds = [event.kind for event in live.take_events()]
    assert kinds == ["witness_begun_anew"]
    assert live.last is not None
    assert live.last.time_s[-1] > 40.0


def test_a_lag_that_is_too_short_is_refused(simulated: SimulatedMission) -> None:
    """The estimator would have forgotten the block's data."""
    with pytest.raises(ConfigError, match="lag of 16 s or more"):
        Witnessed(TruthTeller(simulated), WitnessBounds(), lag_s=5.0)
