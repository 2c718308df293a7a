"""Faults that the live estimator has to live through; `benchmarks/faults.py` has them all."""

from __future__ import annotations

from dataclasses import replace

from ssm_graph.messages import Health, Message, Ping
from ssm_graph.online import FixedLagSmoother
from tests.online_fixture import SHORT, messages, stream


def pushed(given: list[Message]) -> FixedLagSmoother:
    """Return an estimator that was given all messages."""
    smoother = FixedLagSmoother(stream()[1], SHORT)
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
