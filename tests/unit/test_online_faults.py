"""Faults that the live estimator has to live through; `benchmarks/faults/` has them all."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from ssm_graph.live.estimator import ONLINE, FixedLagSmoother
from ssm_graph.live.estimator.intake import Intake
from ssm_graph.mission.events import EventLog
from ssm_graph.mission.navigation import Health, Navigation
from ssm_graph.sensors.depth import DepthReading
from ssm_graph.sensors.dvl import Ping
from ssm_graph.sensors.gnss import Fix
from ssm_graph.sensors.imu import FrozenAxis, ImuSample, frozen_now
from ssm_graph.sensors.messages import Message
from tests.online_fixture import SHORT, messages, stream


def pushed(given: list[Message], duration_s: float = 12.0) -> FixedLagSmoother:
    """Return an estimator that was given all messages."""
    smoother = FixedLagSmoother(stream(duration_s)[1], SHORT)
    for message in given:
        smoother.push(message)
    return smoother


@cache
def undisturbed() -> Navigation:
    """Return the last answer to the messages as they are."""
    newest = pushed(list(messages())).newest()
    assert newest is not None
    return newest


def kinds(smoother: FixedLagSmoother) -> set[str]:
    """Return the kinds of the events that were told."""
    return {event.kind for event in smoother.take_events()}


def test_a_clock_far_ahead_begins_anew() -> None:
    """No inertial data for 30 s, or a clock set forward: begun anew, without raising."""
    given = [replace(m, time_s=m.time_s + 30.0 * (m.time_s > 6.0)) for m in messages()]
    smoother = pushed(given)
    assert smoother.status()[0] is Health.ALIGNING
    assert {"clock_gap", "lost"} <= kinds(smoother)


def test_a_clock_of_the_inertial_data_that_is_set_forward_a_little_is_told() -> None:
    """Once, with by how much; nothing is told of samples that come one after the other."""
    for set_s, expected in ((0.0, []), (0.2, ["no inertial sample for 0.2 s"])):
        events = EventLog()
        intake = Intake(stream(12.0)[1], events)
        for sample in (m for m in messages() if isinstance(m, ImuSample)):
            intake.accept(replace(sample, time_s=sample.time_s + set_s * (sample.time_s > 11.0)))
        told = [event.text.split(":")[0] for event in events.take() if event.kind == "imu_skipped"]
        assert told == expected


def test_pings_off_the_water_do_not_count() -> None:
    """An estimator without a current answers as if they had not come, and says so."""
    water = [
        replace(m, time_s=m.time_s + 0.3, speed=(2.0, 2.1, 2.2, 2.3), is_water=True)
        for m in messages()
        if isinstance(m, Ping)
    ]
    smoother = pushed(sorted([*messages(), *water], key=lambda m: m.time_s))
    newest, expected = smoother.newest(), undisturbed()
    assert newest is not None
    assert newest.lat == expected.lat
    np.testing.assert_array_equal(newest.velocity_enu, expected.velocity_enu)
    assert smoother.counts["dvl water_track"] == len(water)
    assert "dvl_water_track" in kinds(smoother)


def test_two_receivers_at_one_port() -> None:
    """Of two fixes of one moment the first counts, the other is counted and told; later ones do."""
    fixes = [m for m in messages() if isinstance(m, Fix)]
    others = [replace(fix, lat=fix.lat + 1e-6, height=fix.height + 1.0) for fix in fixes]
    smoother = pushed(sorted([*messages(), *others, *others[:3]], key=lambda m: m.time_s))
    newest, expected = smoother.newest(), undisturbed()
    assert newest is not None
    assert (newest.lat, newest.lon, newest.height) == (expected.lat, expected.lon, expected.height)
    assert smoother.counts["gnss contrary"] == len(fixes) + 3
    assert "gnss repeated" not in smoother.counts
    assert "gnss_contrary" in kinds(smoother)
    later = [replace(fix, time_s=fix.time_s + 0.3) for fix in fixes[:-1]]
    smoother = pushed(sorted([*messages(), *later], key=lambda m: m.time_s))
    assert not [what for what in smoother.counts if what.startswith("gnss")]
    assert (newest := smoother.newest()) is not None
    assert newest.position_sigma_enu[0] < expected.position_sigma_enu[0]


def test_a_frozen_report_counts_once() -> None:
    """Every copy with a new stamp is refused, not every other one."""
    pings = [m for m in messages() if isinstance(m, Ping) and m.time_s > 6.0]
    given = [
        replace(pings[0], time_s=m.time_s) if isinstance(m, Ping) and m.time_s > 6.0 else m
        for m in messages()
    ]
    smoother = pushed(given)
    assert smoother.counts["dvl repeated_speeds"] == len(pings) - 1
    health, reason = smoother.status()
    assert health is Health.DEGRADED
    assert "no beam" in reason


def test_an_answer_that_is_being_recovered_is_bad() -> None:
    """Beams of the wrong sign agree with each other: begun anew, the position doubted, not used."""
    given = [
        replace(m, speed=(-m.speed[0], -m.speed[1], -m.speed[2], -m.speed[3]))
        if isinstance(m, Ping) and m.time_s > 6.0
        else m
        for m in messages()
    ]
    smoother = pushed(given)
    health, reason = smoother.status()
    assert health is Health.BAD
    assert "recovered" in reason
    assert {"doubt", "recovered"} <= kinds(smoother)
    newest = smoother.newest()
    assert newest is not None
    assert np.min(newest.position_sigma_enu[:2]) > np.max(undisturbed().position_sigma_enu)


@pytest.mark.parametrize("off_s", [365 * 86400.0, -50 * 365 * 86400.0])
def test_a_single_wrong_stamp_is_counted_once_and_harms_nothing(off_s: float) -> None:
    """Messages of another year are refused; the answer is what it is without them."""
    given: list[Message] = []
    for k, message in enumerate(messages()):
        given.append(message)
        if k % 101 == 100:
            given.append(replace(message, time_s=message.time_s + off_s))
    smoother = pushed(given)
    assert sum(smoother.counts.values()) == len(given) - len(messages())
    mine, theirs = smoother.newest(), undisturbed()
    assert mine is not None
    assert (mine.health, mine.lat, mine.lon) == (theirs.health, theirs.lat, theirs.lon)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_bad_numbers_are_refused_and_told(bad: float) -> None:
    """Wherever they stand; every answer stays finite."""
    given: list[Message] = []
    for k, m in enumerate(messages()):
        given.append(m)
        if k % 97 == 50:
            given += [
                ImuSample(m.time_s, (bad, 0.0, 0.0), (0.0, 0.0, -9.8)),
                Ping(bad, (0.1, 0.2, 0.3, 0.4)),
                DepthReading(m.time_s, bad),
                Fix(m.time_s, 0.7, 2.2, bad, (1.0, 1.0, 1.0)),
            ]
    smoother = pushed(given)
    assert sum(smoother.counts.values()) == len(given) - len(messages())
    assert {f"{x}_not_finite" for x in ("imu", "dvl", "depth", "gnss")} <= kinds(smoother)
    newest = smoother.newest()
    assert newest is not None
    assert newest.health is Health.GOOD
    assert np.isfinite([newest.lat, newest.lon, newest.height, *newest.velocity_enu]).all()


def test_inertial_data_that_end_are_bad_at_once() -> None:
    """The other sensors go on, the answer must not be used."""
    given = [m for m in messages() if not (isinstance(m, ImuSample) and m.time_s > 8.0)]
    smoother = pushed(given)
    health, reason = smoother.status()
    assert health is Health.BAD
    assert "no inertial data" in reason


def test_a_gyro_that_repeats_itself_is_said_and_covered() -> None:
    """Named within a second and a half, the turn since it began is unknown; sound data say none."""
    given = [
        replace(m, gyro_b=(*m.gyro_b[:2], 0.01)) if isinstance(m, ImuSample) and m.time_s > 9 else m
        for m in messages()
    ]
    smoother = pushed([m for m in given if m.time_s < 9.8])
    assert "again and again" not in smoother.status()[1]
    smoother = pushed([m for m in given if m.time_s < 10.8])
    health, reason = smoother.status()
    assert health is Health.DEGRADED
    assert "gyros give one reading again and again about z" in reason
    newest = smoother.newest()
    assert newest is not None
    assert newest.attitude_sigma[2] > 1.1 * undisturbed().attitude_sigma[2]
    assert frozen_now(np.zeros((200, 7))) == []


def test_resolution_freezes_nothing() -> None:
    """Readings in steps, as often equal before, are left alone; a stretch amid noise is not."""
    rows = np.column_stack([0.01 * np.arange(1000), np.zeros((1000, 6))])
    rows[:, 1:] = np.random.default_rng(3).standard_normal((1000, 6))
    rows[850:, 3] = rows[850, 3]
    assert frozen_now(rows) == [FrozenAxis(True, 2, rows[850, 0], rows[-1, 0])]
    assert frozen_now(rows[:940]) == []
    rows[:850, 3] = np.floor(np.arange(850) / 2)
    assert frozen_now(rows) == []


def test_a_late_sample_counts_at_once() -> None:
    """One that comes after its successors, with no keyframe between: the newest answer has it."""
    given = list(messages())
    samples = [k for k, m in enumerate(given) if isinstance(m, ImuSample)]
    late = given.pop(samples[-3])
    without = pushed(given).newest()
    newest = pushed([*given, late]).newest()
    assert without is not None
    assert newest is not None
    np.testing.assert_allclose(
        newest.roll_pitch_heading, undisturbed().roll_pitch_heading, rtol=0.0, atol=1e-12
    )
    assert not np.allclose(
        without.roll_pitch_heading, newest.roll_pitch_heading, rtol=0.0, atol=1e-6
    )


@pytest.mark.slow
def test_a_depth_sensor_in_another_unit_moves_nothing_else() -> None:
    """It is tried once whether the height was wrong; then the depth is what is left out.

    From then on gravity alone says how high the vehicle is, to tens of metres.
    """
    given = [
        replace(m, depth=100.0 * m.depth) if isinstance(m, DepthReading) and m.time_s > 10.0 else m
        for m in messages(40.0)
    ]
    smoother, good = pushed(given, 40.0), pushed(list(messages(40.0)), 40.0)
    assert smoother.status()[0] is Health.DEGRADED
    assert [e.kind for e in smoother.take_events()].count("recovered") == 1
    newest, other = smoother.newest(), good.newest()
    assert newest is not None
    assert other is not None
    assert abs(newest.lat - other.lat) * 6.4e6 < 0.5
    assert newest.position_sigma_enu[2] < 100.0
    assert abs(newest.height - other.height) < 2.0 * newest.position_sigma_enu[2]


@pytest.mark.slow
def test_after_a_gap_no_heading_comes_out_of_nothing() -> None:
    """As the gap leaves the window nothing has shown the heading: its sigma stays as it was.

    Linearised anew where the prior was not, the window took its own corrections for measurements.
    """
    duration_s, begin_s, end_s, lag_s = 40.0, 25.0, 29.0, 5.0
    smoother = FixedLagSmoother(stream(duration_s)[1], replace(ONLINE, lag_s=lag_s))
    before = None
    for message in messages(duration_s):
        if not (isinstance(message, ImuSample) and begin_s < message.time_s <= end_s):
            smoother.push(message)
        if before is None and message.time_s > end_s + 0.5 * lag_s:
            before = smoother.newest()
    after = smoother.newest()
    assert before is not None
    assert after is not None
    assert after.attitude_sigma[2] > 0.8 * before.attitude_sigma[2]
