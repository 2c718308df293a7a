"""Faults that the live estimator has to live through; `benchmarks/faults.py` has them all."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ssm_graph.messages import DepthReading, Health, ImuSample, Message, Ping
from ssm_graph.online import ONLINE, FixedLagSmoother
from tests.online_fixture import SHORT, messages, stream


def pushed(given: list[Message], duration_s: float = 12.0) -> FixedLagSmoother:
    """Return an estimator that was given all messages."""
    smoother = FixedLagSmoother(stream(duration_s)[1], SHORT)
    for message in given:
        smoother.push(message)
    return smoother


def kinds(smoother: FixedLagSmoother) -> set[str]:
    """Return the kinds of the events that were told."""
    return {event.kind for event in smoother.take_events()}


def test_a_clock_far_ahead_begins_anew() -> None:
    """No inertial data for 30 s, or a clock set forward: begun anew, without raising."""
    given = [replace(m, time_s=m.time_s + 30.0 * (m.time_s > 6.0)) for m in messages()]
    smoother = pushed(given)
    assert smoother.status()[0] is Health.ALIGNING
    assert {"clock_gap", "lost"} <= kinds(smoother)


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
        replace(m, speed=tuple(-x for x in m.speed))
        if isinstance(m, Ping) and m.time_s > 6.0
        else m
        for m in messages()
    ]
    smoother = pushed(given)
    health, reason = smoother.status()
    assert health is Health.BAD
    assert "recovered" in reason
    assert {"doubt", "recovered"} <= kinds(smoother)
    newest, before = smoother.newest(), pushed(list(messages())).newest()
    assert newest is not None
    assert before is not None
    assert np.min(newest.position_sigma_enu[:2]) > 1.0 > np.max(before.position_sigma_enu)


@pytest.mark.slow
def test_a_depth_sensor_in_another_unit_moves_nothing_else() -> None:
    """It is tried once whether the height was wrong; then the depth is what is left out."""
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
    assert abs(newest.height - other.height) < 2.0


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
