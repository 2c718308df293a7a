"""Drifts and calibrations of the live estimator: as offline, however messages come."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from ssm_graph.base.errors import DataError
from ssm_graph.base.frozen import Array
from ssm_graph.engine.error_state import STATE_DIM
from ssm_graph.io.mission_folder.vehicle import vehicle_of
from ssm_graph.io.raw_log.rows import messages_of
from ssm_graph.live.estimator import ONLINE, FixedLagSmoother
from ssm_graph.live.estimator.recovery import Doubted, reanchored
from ssm_graph.mission.calibration import DVL_MOUNTING, DVL_SCALE
from ssm_graph.mission.estimate import Calibration
from ssm_graph.mission.navigation import Health
from ssm_graph.mission.problem import build_problem
from ssm_graph.mission.vehicle import Vehicle
from ssm_graph.sensors.dvl import Ping
from ssm_graph.sensors.messages import Message
from ssm_graph.simulation import GnssSettings, Loss
from ssm_graph.smoothers.fixed_lag import run_fixed_lag
from tests.calibration_cases import MOUNTING, SCALE
from tests.water_fixture import in_current
from tests.window_fixture import asked, off

LAG = replace(ONLINE, lag_s=8.0)
TRUTH = {DVL_SCALE: np.array([SCALE]), DVL_MOUNTING: MOUNTING}


@cache
def stream() -> tuple[Vehicle, tuple[Message, ...]]:
    """Return a vehicle that is off and asks for it, and what it sends."""
    mission = asked(off(duration_s=40.0).mission)
    return vehicle_of(mission), tuple(messages_of(mission))


def after(given: Sequence[Message], vehicle: Vehicle | None = None) -> FixedLagSmoother:
    """Return the estimator after some messages."""
    smoother = FixedLagSmoother(vehicle or stream()[0], LAG)
    for message in given:
        smoother.push(message)
    return smoother


@cache
def at_the_end() -> FixedLagSmoother:
    """Return the estimator after all messages, to look at."""
    return after(stream()[1])


def found(smoother: FixedLagSmoother) -> Calibration:
    """Return the calibration, which is asked for."""
    calibration = smoother.found().calibration
    assert calibration is not None
    return calibration


def values(smoother: FixedLagSmoother) -> Array:
    """Return all values that were found."""
    return np.array([value.value for value in found(smoother).values])


def test_it_finds_the_truth_and_what_fixed_lag_finds() -> None:
    """Within three sigmas of the truth, and a hundredth of what it is offline."""
    smoother = at_the_end()
    assert smoother.status()[0] is Health.GOOD
    calibration = found(smoother)
    for name, truth in TRUTH.items():
        sigma = np.array([value.sigma for value in calibration.values if value.variable == name])
        assert np.all(np.abs(calibration.of(name) - truth) < 3.0 * sigma), name
    assert smoother._course is not None
    newest = smoother._course.newest.window.newest
    offline = run_fixed_lag(build_problem(asked(off(duration_s=40.0).mission)), LAG).newest
    (k,) = np.flatnonzero(np.abs(offline.time_s - newest.time_s[0]) < 1e-3)
    sigma = np.sqrt(np.diag(newest.covariance[0]))
    off_extra = (offline.states.walks[k] - newest.states.walks[0]) / sigma[STATE_DIM:]
    off_state = offline.states.take(np.array([k])).navigation.deviation_of(newest.states.navigation)
    assert np.abs(off_extra).max() < 0.01
    assert np.abs(off_state[0] / sigma[:STATE_DIM]).max() < 0.01


def test_late_pings_change_nothing() -> None:
    """Half a second late, they lead to the same calibration."""
    messages = stream()[1]
    due = [(m.time_s + (0.5 if isinstance(m, Ping) else 0.0), i) for i, m in enumerate(messages)]
    late = after([messages[i] for _, i in sorted(due)])
    np.testing.assert_allclose(values(late), values(at_the_end()), rtol=0.0, atol=1e-9)


def test_a_restored_estimator_goes_on_as_the_one_that_was_kept() -> None:
    """Arrays and plain numbers hold all of it, and another vehicle is refused."""
    vehicle, messages = stream()
    half = len(messages) // 2
    smoother = after(messages[:half])
    arrays, meta = smoother.checkpoint()
    restored = FixedLagSmoother.restore(vehicle, LAG, arrays, meta)
    for message in messages[half:]:
        smoother.push(message)
        restored.push(message)
    np.testing.assert_allclose(values(restored), values(smoother), rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(
        found(restored).covariance, found(smoother).covariance, rtol=1e-6, atol=1e-12
    )
    plain = replace(vehicle, mount=vehicle.mount.as_stated())
    with pytest.raises(DataError, match=r"expected keyframes of 23 states, .* got 34"):
        FixedLagSmoother.restore(plain, LAG, arrays, meta)


@pytest.mark.parametrize("what", list(Doubted))
def test_a_new_begin_keeps_what_was_found(what: Doubted) -> None:
    """Of the instruments, whatever of the vehicle's state is doubted."""
    smoother = at_the_end()
    course = smoother._course
    assert course is not None
    measured = course._maker.next_after(course.newest.time_s - 1.5)
    assert measured is not None
    step = next(s for s in reversed(course._steps) if s.time_s < measured.time_s - 0.1)
    keyframe = course._maker.make(measured, last_s=step.time_s)
    kept = step.reserve.led_on(keyframe, step.window.inertial).older
    begun = reanchored(step.window, keyframe, kept, what).newest
    at = step.window.sensors.extras.columns(DVL_SCALE).start
    sigma = float(np.sqrt(begun.covariance[0, at, at]))
    assert abs(begun.states.walks[0, at - STATE_DIM] - SCALE) < 3.0 * sigma
    assert sigma < 0.5 * stream()[0].mount.scale_sigma


def test_it_aligns_with_instruments_that_are_off() -> None:
    """Without an initial state, what alignment found of the instruments is gone on from."""
    vehicle, messages = stream()
    smoother = after(messages, replace(vehicle, initial=None))
    kinds = {event.kind for event in smoother.take_events()}
    navigation = smoother.newest()
    assert navigation is not None, smoother.status()
    assert "aligned" in kinds
    sigma = np.array([v.sigma for v in found(smoother).values if v.variable == DVL_SCALE])
    assert abs(found(smoother).of(DVL_SCALE) - SCALE) < 3.0 * sigma
    assert sigma < 0.5 * vehicle.mount.scale_sigma


def test_the_water_carries_the_velocity_where_the_ground_is_lost() -> None:
    """Bottom lock is lost and said to be, an aid counts, the current is found, as offline."""
    sim = in_current(duration_s=80.0, losses=(Loss(30.0, 120.0),))
    vehicle = vehicle_of(sim.mission)
    smoother = after(tuple(messages_of(sim.mission)), vehicle)
    navigation = smoother.newest()
    assert navigation is not None
    assert not navigation.bottom_lock
    assert navigation.health is Health.DEGRADED
    assert "off the ground" in navigation.reason
    assert navigation.since_aid_s < 2.0
    assert navigation.velocity_sigma_enu[:2].max() < 0.1
    current = smoother.found().current
    assert current is not None
    truth = sim.current.at(np.array([navigation.time_s]))[0]
    assert np.all(np.abs(current.velocity_enu[0] - truth) < 4.0 * current.sigma_enu[0])
    assert smoother._course is not None
    newest = smoother._course.newest.window.newest
    offline = run_fixed_lag(build_problem(sim.mission), LAG).newest
    (k,) = np.flatnonzero(np.abs(offline.time_s - newest.time_s[0]) < 1e-3)
    sigma = np.sqrt(np.diag(newest.covariance[0]))[STATE_DIM:]
    assert np.all(np.abs(offline.states.walks[k] - newest.states.walks[0]) < 0.01 * sigma)


def test_a_current_is_aligned_and_restored_with() -> None:
    """Whether pings off the water have come yet or not."""
    gnss = GnssSettings(windows=((0.0, 35.0),))
    sim = in_current(duration_s=60.0, losses=(Loss(40.0, 60.0),), gnss=gnss)
    vehicle = replace(vehicle_of(sim.mission), initial=None)
    given = tuple(messages_of(sim.mission))
    smoother = after(given, vehicle)
    assert smoother.newest() is not None, smoother.status()
    current = smoother.found().current
    assert current is not None
    assert current.sigma_enu[0, 0] < 0.1
    arrays, meta = smoother.checkpoint()
    again = FixedLagSmoother.restore(vehicle, LAG, arrays, meta).found().current
    assert again is not None
    np.testing.assert_allclose(again.velocity_enu, current.velocity_enu, rtol=0.0, atol=1e-9)
