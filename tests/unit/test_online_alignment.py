"""Alignment on the vehicle: in small steps, and the start that a whole smoothing would give."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from functools import cache
from types import FrameType, SimpleNamespace

import numpy as np
import pytest

from ssm_graph.base.frozen import Array
from ssm_graph.base.stepwise import Steps, finished
from ssm_graph.io.mission_folder.vehicle import vehicle_of
from ssm_graph.io.raw_log.rows import messages_of
from ssm_graph.live.estimator import FixedLagSmoother, start
from ssm_graph.live.estimator.intake import Intake
from ssm_graph.live.estimator.start import MOST_MS, Beginning, Starter
from ssm_graph.mission.estimate import Status
from ssm_graph.mission.events import EventLog
from ssm_graph.mission.navigation import Health, Navigation
from ssm_graph.mission.problem import ProblemConfig, build_problem
from ssm_graph.mission.start.alignment import N_HYPOTHESES, align
from ssm_graph.mission.vehicle import Vehicle
from ssm_graph.sensors.depth import DepthReading
from ssm_graph.sensors.imu import ImuSample
from ssm_graph.sensors.messages import Message
from ssm_graph.simulation import (
    DepthProfile,
    DvlSettings,
    GnssSettings,
    Grade,
    HoverRoute,
    SimulatedMission,
    SimulationConfig,
    SurveyRoute,
    simulate,
)
from ssm_graph.smoothers.fixed_lag import run_fixed_lag
from ssm_graph.smoothers.mission import smooth, smooth_steps
from ssm_graph.smoothers.settings import SmootherConfig
from ssm_graph.smoothers.window import FixedLagConfig
from tests.online_fixture import SHORT

AT_SURFACE = DepthProfile(0.3, 0.3)


@cache
def moving() -> SimulatedMission:
    """Return a vehicle whose heading shows at once: it crosses the surface under fixes."""
    route = SurveyRoute(line_m=400.0, depth=AT_SURFACE)
    return _simulated(route, duration_s=24.0, imu_rate_hz=50.0, dvl_rate_hz=2.0)


@cache
def hovering() -> SimulatedMission:
    """Return one that stays where it is: every heading is tried. At rates of real instruments."""
    route = HoverRoute(depth_m=0.3)
    return _simulated(route, duration_s=15.0, imu_rate_hz=100.0, dvl_rate_hz=5.0)


def _simulated(
    route: SurveyRoute | HoverRoute, *, duration_s: float, imu_rate_hz: float, dvl_rate_hz: float
) -> SimulatedMission:
    return simulate(
        SimulationConfig(
            duration_s=duration_s,
            imu_rate_hz=imu_rate_hz,
            grade=Grade.MEMS,
            route=route,
            gnss=GnssSettings(),
            dvl=DvlSettings(rate_hz=dvl_rate_hz),
        )
    )


def given(sim: SimulatedMission) -> tuple[Vehicle, list[Message]]:
    """Return the vehicle, which does not know where it is, and its messages."""
    return replace(vehicle_of(sim.mission), initial=None), list(messages_of(sim.mission))


def pushed(
    messages: list[Message], vehicle: Vehicle, smoother: FixedLagSmoother | None = None
) -> FixedLagSmoother:
    """Return an estimator that was given messages."""
    smoother = smoother or FixedLagSmoother(vehicle, SHORT)
    for message in messages:
        smoother.push(message)
    return smoother


def last_of(smoother: FixedLagSmoother) -> Navigation:
    """Return the newest answer, which is there."""
    newest = smoother.newest()
    assert newest is not None, smoother.status()
    return newest


def numbers(newest: Navigation) -> Array:
    """Return the state and its sigmas (19,)."""
    return np.array(
        [
            *(newest.time_s, newest.lat, newest.lon, newest.height),
            *(*newest.velocity_enu, *newest.roll_pitch_heading, *newest.position_sigma_enu),
            *(*newest.velocity_sigma_enu, *newest.attitude_sigma),
        ]
    )


def begun_with(messages: list[Message], vehicle: Vehicle) -> tuple[float, float, Beginning]:
    """Return with data up to when an alignment was begun, when it ended, and where it led."""
    events = EventLog()
    intake, starter = Intake(vehicle, events), Starter(vehicle, ProblemConfig(), events)
    begun_s = -np.inf
    for message in messages:
        intake.accept(message)
        was_working = starter.is_working
        beginning = starter.find(intake.buffers)
        if starter.is_working and not was_working:
            begun_s = message.time_s
        if beginning is not None:
            return begun_s, message.time_s, beginning
    raise AssertionError(starter.reason)


@pytest.fixture
def unhurried(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let alignments take a few seconds of data, as those of more data do."""
    monkeypatch.setattr(start, "SHARE", 0.1)


def test_the_start_is_that_of_a_whole_smoothing() -> None:
    """Of the data that it was begun with, to the last bit, whatever comes meanwhile."""
    vehicle, messages = given(moving())
    begun_s, ended_s, beginning = begun_with(messages, vehicle)
    assert ended_s > begun_s + 0.2
    intake = Intake(vehicle, EventLog())
    for message in messages:
        if message.time_s <= begun_s:
            intake.accept(message)
    mission = intake.buffers.mission(beginning.frame)
    problem = build_problem(mission, start=smooth(mission).start)
    run = run_fixed_lag(problem, FixedLagConfig(0.0, tolerance=1e-3)).newest
    assert beginning.time_s == run.time_s[-1]
    assert begun_s - 1.0 < beginning.time_s <= begun_s
    expected = run.states.take(np.s_[-1:]).moments(run.covariance[-1])
    for ours, whole in zip(beginning.moments, expected, strict=True):
        np.testing.assert_array_equal(ours, whole)


def test_steps_do_not_change_the_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    """What came during the alignment counts as if it had come after: the answer at the end."""
    vehicle, messages = given(moving())
    in_steps = pushed(messages, vehicle)
    monkeypatch.setattr(start, "SHARE", np.inf)
    monkeypatch.setattr(start, "MOST_MS", np.inf)
    at_once = pushed(messages, vehicle)
    np.testing.assert_array_equal(numbers(last_of(in_steps)), numbers(last_of(at_once)))
    kinds, others = ([e.kind for e in s.take_events()] for s in (in_steps, at_once))
    assert kinds == others
    times, others_s = (
        np.concatenate([d.trajectory.time_s for d in s.finish()]) for s in (in_steps, at_once)
    )
    np.testing.assert_array_equal(times, others_s)


@pytest.mark.usefixtures("unhurried")
@pytest.mark.slow
def test_it_is_said_to_align_until_nothing_is_left_to_catch_up_with() -> None:
    """No answer of the past is given for that of now."""
    vehicle, messages = given(moving())
    smoother = FixedLagSmoother(vehicle, SHORT)
    behind = 0
    for message in messages:
        smoother.push(message)
        newest = smoother.newest()
        if newest is None:
            assert smoother.status()[0] is Health.ALIGNING
            behind += "catching up" in smoother.status()[1]
        elif isinstance(message, ImuSample):
            assert newest.time_s == message.time_s
    assert behind > 3
    assert last_of(smoother).health is Health.GOOD


def test_a_sensor_that_contradicts_the_rest_is_begun_without() -> None:
    """Depths of elsewhere from the begin on: told, and the answer is where fixes put it."""
    vehicle, messages = given(moving())
    off = [replace(m, depth=m.depth + 20.0) if isinstance(m, DepthReading) else m for m in messages]
    smoother = pushed(off, vehicle)
    newest = last_of(smoother)
    truth = moving().truth_at(np.array([newest.time_s]))
    assert abs(newest.height - float(truth.height[0])) < 3.0
    assert newest.health is Health.DEGRADED
    said = [event.text for event in smoother.take_events() if event.kind == "aligned"]
    assert len(said) == 1
    assert "without depth, which contradicts the rest" in said[0]


def test_without_a_sensor_the_heading_has_to_be_known_as_well(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """An answer that is right and knows no heading is none to begin with."""
    sigmas = iter([0.01, 1.0])

    def smoothed(*_: object, **__: object) -> Steps[object]:
        yield 0.0
        sigma = next(sigmas)
        status = Status.SUSPECT if sigma < 0.1 else Status.CONVERGED
        found = SimpleNamespace(attitude_sigma=np.full((1, 3), sigma))
        return SimpleNamespace(status=status, trajectory=found, reason="depth", notes=())

    monkeypatch.setattr(start, "smooth_steps", smoothed)
    monkeypatch.setattr(start, "replace", lambda made, **_: made)
    starter = Starter(given(moving())[0], ProblemConfig(), EventLog())
    assert finished(starter._align_steps(moving().mission)) is None
    assert "move while GNSS is there" in starter.reason


def calls(function: object, *args: object) -> int:
    """Return how many functions, of Python or C, a call of a function calls in all."""
    count = 0

    def counted(_frame: FrameType, event: str, _argument: object) -> None:
        nonlocal count
        count += event in ("call", "c_call")

    assert callable(function)
    before = sys.getprofile()
    sys.setprofile(counted)
    try:
        function(*args)
    finally:
        sys.setprofile(before)
    return count


def test_no_push_does_much_work() -> None:
    """Eight headings are tried, and no message waits for more than a little of it."""
    vehicle, messages = given(hovering())
    mission = replace(hovering().mission, initial=None)
    assert len(align(mission).candidates) == N_HYPOTHESES
    smoother = FixedLagSmoother(vehicle)
    work = np.array([calls(smoother.push, message) for message in messages])
    assert work.sum() > 500_000
    assert work.max() < 20_000
    assert "heading sigma" in smoother.status()[1]


def sizes(steps: Steps[object]) -> Array:
    """Return the sizes of all steps."""
    return np.array(list(steps))


@pytest.mark.slow
def test_steps_are_small_however_long_the_data() -> None:
    """A step is a keyframe's, or goes through all of them at once and is small for each."""
    whole = replace(hovering().mission, initial=None)
    found, n_pings = sizes(smooth_steps(whole, SmootherConfig())), len(whole.dvl.time_s)
    assert found.min() > 0.0
    assert 1.0 < found.max() < 0.031 * n_pings
    minutes = 150.0 / (n_pings / 5.0)
    assert minutes * found.max() + MOST_MS < 50.0


def test_finished_returns_the_answer_or_raises() -> None:
    """All steps are made; an error of the computation is the caller's."""

    def count(fails: bool) -> Steps[int]:
        for _ in range(3):
            yield 1.0
        if fails:
            raise ValueError("after three")
        return 3

    assert finished(count(fails=False)) == 3
    with pytest.raises(ValueError, match="after three"):
        finished(count(fails=True))


def cut_at(messages: list[Message], time_s: float) -> int:
    """Return how many messages come up to a time."""
    return sum(message.time_s <= time_s for message in messages)


@pytest.mark.usefixtures("unhurried")
def test_a_restart_in_the_midst_of_an_alignment_changes_nothing() -> None:
    """It goes on where it was with the data that it had, and ends at the same sample."""
    vehicle, messages = given(moving())
    begun_s, ended_s, _ = begun_with(messages, vehicle)
    cut = cut_at(messages, 0.5 * (begun_s + ended_s))
    before = pushed(messages[:cut], vehicle)
    assert before.status()[0] is Health.ALIGNING
    arrays, meta = before.checkpoint()
    after = FixedLagSmoother.restore(vehicle, SHORT, arrays, json.loads(json.dumps(meta)))
    assert after.status() == before.status()
    rest = messages[cut : cut_at(messages, ended_s + 1.0)]
    for message in rest:
        for smoother in (before, after):
            smoother.push(message)
        assert after.status() == before.status()
    np.testing.assert_array_equal(numbers(last_of(after)), numbers(last_of(before)))


@pytest.mark.usefixtures("unhurried")
def test_a_restart_while_catching_up_gives_the_same_answer() -> None:
    """What is left to catch up with is in the checkpoint."""
    vehicle, messages = given(moving())
    smoother = FixedLagSmoother(vehicle, SHORT)
    arrays = None
    for k, message in enumerate(messages):
        smoother.push(message)
        if arrays is None and "catching up" in smoother.status()[1] and smoother.newest() is None:
            arrays, cut = smoother.checkpoint(), k + 1
    assert arrays is not None
    after = pushed(messages[cut:], vehicle, FixedLagSmoother.restore(vehicle, SHORT, *arrays))
    ours, whole = numbers(last_of(after)), numbers(last_of(smoother))
    np.testing.assert_allclose(ours, whole, rtol=0.0, atol=1e-6 * float(whole[-1]))


@pytest.mark.usefixtures("unhurried")
def test_a_gap_in_the_midst_of_an_alignment_begins_it_anew() -> None:
    """What the vehicle did meanwhile is not known: the heading is found from what comes after."""
    vehicle, messages = given(moving())
    begun_s, ended_s, _ = begun_with(messages, vehicle)
    cut, gap_s = cut_at(messages, 0.5 * (begun_s + ended_s)), 30.0
    later = [replace(m, time_s=m.time_s + gap_s) for m in messages]
    smoother = pushed(messages[:cut] + later, vehicle)
    aligned_s = [event.time_s for event in smoother.take_events() if event.kind == "aligned"]
    assert len(aligned_s) == 1
    assert last_of(smoother).health is Health.GOOD
    assert smoother.finish()[0].trajectory.time_s[0] > later[0].time_s + 10.0
