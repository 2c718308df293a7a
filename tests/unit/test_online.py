"""The live estimator: the same answer in whatever order messages come, and the offline one's."""

from __future__ import annotations

import json
import random
from collections import Counter
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from ssm_graph.live.estimator import ONLINE, FixedLagSmoother
from ssm_graph.live.estimator.answers import Delayed
from ssm_graph.live.estimator.course import FRESH_S, SPARSE_S, Course
from ssm_graph.mission.navigation import Health, Navigation
from ssm_graph.mission.problem import build_problem
from ssm_graph.sensors.depth import DepthReading
from ssm_graph.sensors.dvl import Ping
from ssm_graph.sensors.gnss import Fix
from ssm_graph.sensors.imu import ImuSample
from ssm_graph.sensors.messages import Message
from ssm_graph.smoothers.fixed_lag import solve_fixed_lag
from ssm_graph.smoothers.window import FixedLagConfig
from tests.online_fixture import SHORT, joined, messages, run, stream


def assert_same(mine: Navigation, other: Navigation, *, sigmas: float) -> None:
    """Compare answers in the sigmas of one of them."""
    assert mine.time_s == other.time_s
    for name in ("velocity_enu", "roll_pitch_heading"):
        sigma = getattr(other, "velocity_sigma_enu" if name == "velocity_enu" else "attitude_sigma")
        off = np.abs(getattr(mine, name) - getattr(other, name)) / sigma
        assert np.max(off) < sigmas
    north_m = (mine.lat - other.lat) * 6.4e6
    assert abs(north_m) < sigmas * other.position_sigma_enu[1] + 1e-8
    np.testing.assert_allclose(mine.position_sigma_enu, other.position_sigma_enu, rtol=sigmas)


@cache
def in_order() -> tuple[Navigation, list[Delayed]]:
    """Return the newest answer and all delayed states after all messages in their order."""
    newest, delayed, _ = run(messages(), stream()[1])
    return newest, delayed


def test_it_is_the_offline_fixed_lag_smoother() -> None:
    """On the same mission, solved to the end: the same delayed states, to what else is different.

    Online, what follows a ping at once has not been seen, so that its gyro mean and the slopes of
    the last samples differ by rounding; keyframes without a ping stand elsewhere.
    """
    sim, vehicle = stream()
    exact = FixedLagConfig(lag_s=3.0)
    _, delayed, _ = run(messages(), vehicle, exact)
    offline = solve_fixed_lag(build_problem(sim.mission), exact).delayed.trajectory
    time_s = joined(delayed, "time_s")
    # The last ping is not covered by inertial data yet: what left the window before saw the same.
    same = np.isin(np.round(offline.time_s, 6), np.round(time_s, 6)) & (offline.time_s < 8.0)
    assert same.sum() > 14
    at = np.searchsorted(time_s, offline.time_s[same] - 1e-6)
    off = joined(delayed, "velocity_enu")[at] - offline.velocity_enu[same]
    assert np.max(np.abs(off) / offline.velocity_sigma_enu[same]) < 0.01


def test_settings_of_a_vehicle_are_near_the_exact_ones() -> None:
    """Three passes, linearised and reweighed where it matters: a tenth of a sigma at most."""
    _, vehicle = stream()
    thrifty, _ = in_order()
    exact, _, _ = run(messages(), vehicle, FixedLagConfig(lag_s=3.0))
    assert_same(thrifty, exact, sigmas=0.1)


def shuffled(seed: int) -> list[Message]:
    """Return the messages late, each kind by its own delay, and some of them twice."""
    rng = random.Random(seed)
    most_s = {ImuSample: 0.0, Ping: 1.5, Fix: 2.5}
    late = {id(m): rng.random() * most_s.get(type(m), 1.5) for m in messages()}
    late |= {id(m): 0.3 * rng.random() for m in rng.sample(messages(), 60)}
    ordered = sorted(messages(), key=lambda m: m.time_s + late[id(m)])
    for message in rng.sample(messages(), 40):
        at = next(i for i, m in enumerate(ordered) if m is message)
        ordered.insert(min(at + rng.randrange(1, 20), len(ordered)), message)
    return ordered


@pytest.mark.parametrize("seed", range(2))
def test_out_of_order_is_in_order(seed: int) -> None:
    """Late messages within the lag, and repeated ones, change nothing, to rounding."""
    _, vehicle = stream()
    ordered, delayed = in_order()
    newest, other, smoother = run(shuffled(seed), vehicle)
    assert not any("too_late" in kind for kind in smoother.counts)
    assert_same(newest, ordered, sigmas=1e-8)
    for name in ("time_s", "lat", "velocity_enu", "velocity_sigma_enu", "weight"):
        np.testing.assert_allclose(joined(other, name), joined(delayed, name), rtol=0, atol=1e-9)


@pytest.mark.slow
def test_what_comes_late_by_more_than_is_kept_in_full_changes_nothing() -> None:
    """Of steps that are no longer fresh one in two seconds is kept: the rest is made anew."""
    _, vehicle = stream(24.0, 4.0)
    config, given = replace(ONLINE, lag_s=15.0), messages(24.0, 4.0)
    running = FixedLagSmoother(vehicle, config)
    for message in given:
        running.push(message)
    ordered = running.newest()
    assert ordered is not None
    assert running._course is not None
    kept_s = [step.time_s for step in running._course._steps]
    assert len(kept_s) < 4.0 * FRESH_S + (config.lag_s - FRESH_S) / (0.5 * SPARSE_S) + 3
    assert np.all(np.diff(kept_s) <= SPARSE_S)
    pings = [m for m in given if isinstance(m, Ping)]
    late = {id(pings[i]): 5.3 + 2.0 * n for n, i in enumerate((20, 31, 41, 50))}
    delayed = running.finish()
    given = tuple(sorted(given, key=lambda m: m.time_s + late.get(id(m), 0.0)))
    newest, other, smoother = run(given, vehicle, config)
    assert not any("too_late" in kind for kind in smoother.counts)
    assert_same(newest, ordered, sigmas=1e-8)
    for name in ("time_s", "lat", "velocity_enu", "velocity_sigma_enu", "weight"):
        np.testing.assert_allclose(joined(other, name), joined(delayed, name), rtol=0, atol=1e-9)


def test_many_late_messages_have_a_step_made_anew_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """A flood of old depths costs no more than one of them, and the answer is the same."""
    made, step = Counter[float](), Course._step

    def counting(self: Course, measured: Any) -> Any:
        made[measured.time_s] += 1
        return step(self, measured)

    monkeypatch.setattr(Course, "_step", counting)
    _, vehicle = stream()
    given_s = messages()[-1].time_s
    late = [m for m in messages() if isinstance(m, DepthReading) and m.time_s > given_s - 2.0]
    flood = [replace(m, time_s=m.time_s + 1e-3 * k) for m in late for k in range(1, 30)]
    given = sorted((*messages(), *flood), key=lambda m: m.time_s)
    expected, _, _ = run(given, vehicle)
    made.clear()
    held = {id(m) for m in flood}
    smoother = FixedLagSmoother(vehicle, SHORT)
    for message in (*(m for m in messages() if id(m) not in held), *reversed(flood)):
        smoother.push(message)
    newest = smoother.newest()
    assert newest is not None
    assert max(made.values()) == 2
    assert expected is not None
    assert_same(newest, expected, sigmas=1e-8)


def test_a_filter_takes_late_messages_and_restarts_as_well() -> None:
    """With a lag of zero, messages may be late by a second."""
    _, vehicle = stream()
    config = replace(SHORT, lag_s=0.0)
    expected, _, _ = run(messages(), vehicle, config)
    late = {id(m): 0.7 if isinstance(m, Ping) else 0.0 for m in messages()}
    ordered = sorted(messages(), key=lambda m: m.time_s + late[id(m)])
    newest, _, _ = run(ordered, vehicle, config)
    assert_same(newest, expected, sigmas=1e-8)
    before = FixedLagSmoother(vehicle, config)
    for message in messages()[:150]:
        before.push(message)
    arrays, meta = before.checkpoint()
    after = FixedLagSmoother.restore(vehicle, config, arrays, meta)
    for message in messages()[150:]:
        after.push(message)
    restarted = after.newest()
    assert restarted is not None
    assert_same(restarted, expected, sigmas=1e-8)


@pytest.mark.parametrize("share", [0.02, 0.3, 0.8])
def test_a_restart_gives_the_same_answer(share: float) -> None:
    """From the plain arrays and the messages since; delayed states are there once."""
    _, vehicle = stream()
    expected, all_delayed = in_order()
    cut = int(share * len(messages()))
    before = FixedLagSmoother(vehicle, SHORT)
    for message in messages()[:cut]:
        before.push(message)
    delayed = before.take_delayed()
    arrays, meta = before.checkpoint()
    after = FixedLagSmoother.restore(vehicle, SHORT, arrays, json.loads(json.dumps(meta)))
    for message in messages()[max(cut - 30, 0) :]:  # some of them a second time
        after.push(message)
    newest = after.newest()
    assert newest is not None
    assert_same(newest, expected, sigmas=1e-6)
    delayed = [*delayed, *after.finish()]
    np.testing.assert_array_equal(joined(delayed, "time_s"), joined(all_delayed, "time_s"))
    np.testing.assert_allclose(joined(delayed, "weight"), joined(all_delayed, "weight"), atol=1e-4)


def test_the_newest_state_is_that_of_the_last_sample() -> None:
    """Between keyframes it follows the inertial data, its uncertainty grows, and truth is in it."""
    sim, vehicle = stream()
    smoother = FixedLagSmoother(vehicle, SHORT)
    seen = []
    for message in messages():
        smoother.push(message)
        newest = smoother.newest()
        if isinstance(message, ImuSample) and newest is not None:
            assert newest.time_s == message.time_s
            seen.append(newest)
    settled = seen[len(seen) // 4 :]
    truth = sim.truth_at(np.array([n.time_s for n in settled]))
    off = np.array([n.velocity_enu for n in settled]) - truth.velocity_enu
    sigma = np.array([n.velocity_sigma_enu for n in settled])
    assert np.mean(np.abs(off) < 3.0 * sigma) > 0.99
    steps = np.diff([n.position_sigma_enu[0] for n in settled])
    assert np.mean(steps > 0.0) > 0.5
    assert {n.health for n in settled} == {Health.GOOD}
    assert all(n.confidence > 0.5 for n in settled)


def test_delayed_states_are_better_than_the_newest() -> None:
    """They know what came after them."""
    sim, _ = stream()
    _, delayed = in_order()
    filtered = solve_fixed_lag(build_problem(sim.mission), replace(ONLINE, lag_s=0.0)).newest
    rms = []
    for time_s, velocity in (
        (joined(delayed, "time_s"), joined(delayed, "velocity_enu")),
        (filtered.trajectory.time_s, filtered.trajectory.velocity_enu),
    ):
        used = time_s > 1.0
        off = (velocity - sim.truth_at(time_s).velocity_enu)[used]
        rms.append(float(np.sqrt(np.mean(off**2))))
    assert rms[0] < 0.9 * rms[1]
