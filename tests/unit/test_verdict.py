"""The verdict: silent on good answers, and each contradiction named for what it is."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
import pytest

from factors.similarity import LogKernel
from ssm_graph.base.frozen import Array
from ssm_graph.engine.states import States
from ssm_graph.graph.linearize import GraphLinearizer
from ssm_graph.graph.measurements import doubts_of_aids
from ssm_graph.mission.answer import SUSPECT_STRETCH_S
from ssm_graph.mission.estimate import Status
from ssm_graph.mission.fault import DetectedFault, Treatment
from ssm_graph.mission.problem import Problem, build_problem
from ssm_graph.simulation import (
    DiveRoute,
    Fault,
    FaultShape,
    GnssSettings,
    Grade,
    SimulatedMission,
    TransitRoute,
)
from ssm_graph.smoothers.faults.search import FaultSearch
from ssm_graph.smoothers.faults.windows import (
    informative,
    most_by_noise,
    noisy_or_compared,
    parity_of,
)
from ssm_graph.smoothers.mission import smooth
from ssm_graph.smoothers.settings import SmootherConfig
from ssm_graph.smoothers.verdict import LEAST_EFFICIENCY, contradictions, efficiency
from tests.helpers import outcome, simulated, true_states, with_imu, with_initial


@cache
def long_mission() -> tuple[SimulatedMission, Problem, States]:
    """Return 200 s with all aids, and the truth."""
    sim = simulated(duration_s=200.0, gnss=GnssSettings(windows=((0.0, 100.0),)), seed=1)
    problem = build_problem(sim.mission)
    return sim, problem, true_states(problem, sim)


def doubts_at(problem: Problem, states: States, *, weights: Array | None = None) -> list[str]:
    """Return what the data say against these states and weights."""
    linearizer = GraphLinearizer(problem)
    linearizer.follow(states)
    rows = linearizer.beam_rows(states)
    weights = np.ones(len(rows.error)) if weights is None else weights
    aids = linearizer.weighted
    square = aids.squares(states)
    of_aids = LogKernel().weight(square, dim=aids.dim)
    judged = aids.judged(states, problem.keyframe_s, square, of_aids)
    return [*contradictions(linearizer, states, rows, weights), *doubts_of_aids(judged)]


def workhorse(rng: np.random.Generator, n: int) -> Array:
    """Return noise with the tails of a Workhorse's error velocity, of variance 1."""
    return np.asarray(rng.standard_t(4.3, n) * np.sqrt(1.0 - 2.0 / 4.3))


def moved(states: States, **changes: Array) -> States:
    """Return states with some arrays changed."""
    arrays: dict[str, Any] = {name: getattr(states, name) for name in states._fields}
    return States.of(**(arrays | changes))


def test_readings_far_noisier_than_stated_say_no_more_than_their_variance() -> None:
    """Four times the noise for a third of the time: a sixteenth there, elsewhere no bound."""
    rng, kernel = np.random.default_rng(0), LogKernel()
    is_noisy = np.arange(3000) // 1000 == 1
    t = (np.where(is_noisy, 4.0, 1.0) * rng.standard_normal(3000)) ** 2
    weights = kernel.weight(t)
    most = most_by_noise(t, weights, np.arange(3000.0))
    assert np.isinf(most[~is_noisy]).all()
    assert np.mean((most * weights)[is_noisy]) == pytest.approx(1.0 / 16.0, rel=0.1)
    assert np.isinf(most_by_noise(t[1000:1010], weights[1000:1010], np.arange(10.0))).all()


@pytest.mark.parametrize("is_freed", [False, True])
def test_noise_that_a_lie_leaves_is_not_said(*, is_freed: bool) -> None:
    """Eight sigmas on two beams of four are all beams' noise, or none where they were freed."""
    rng, kernel = np.random.default_rng(1), LogKernel()
    time_s, beam = np.repeat(np.arange(400.0), 4), np.tile(np.arange(4), 400)
    is_off = (beam % 2 == 0) & (time_s >= 200.0)
    t = np.where(is_off, 8.0 * np.sin(time_s), rng.standard_normal(1600)) ** 2
    weights, freed = kernel.weight(t), is_off & is_freed
    says, found = informative("DVL", t, weights, time_s, kernel, freed=freed)
    assert (not found) == is_freed
    assert (np.mean((says * weights)[is_off]) < 0.05) == is_freed
    assert np.min(says[time_s < 200.0]) >= LEAST_EFFICIENCY


@pytest.mark.parametrize(("noisy", "who"), [({1}, "DVL beam 2"), ({0, 1, 2, 3}, "DVL")])
def test_each_beam_has_a_noise_of_its_own(noisy: set[int], who: str) -> None:
    """Three times as stated for half the time: its readings say about a ninth, others as before."""
    rng, kernel = np.random.default_rng(2), LogKernel()
    time_s, beam = np.repeat(np.arange(400.0), 4), np.tile(np.arange(4), 400)
    is_off = np.isin(beam, list(noisy)) & (time_s >= 200.0)
    t = (np.where(is_off, 3.0, 1.0) * rng.standard_normal(1600)) ** 2
    weights = kernel.weight(t)
    says, (found,) = informative("DVL", t, weights, time_s, kernel, beam=beam)
    assert (found.sensor, found.end_s) == (who, 399.0)
    assert 200.0 <= found.begin_s < 270.0
    late = is_off & (time_s >= found.begin_s)
    assert np.mean((says * weights)[late]) < 0.2  # by weights alone 0.5
    assert np.min(says[~is_off]) >= LEAST_EFFICIENCY


@pytest.mark.parametrize(("noise", "sensor"), [(1.0, "IMU"), (3.0, "DVL")])
def test_beams_that_agree_are_not_called_noisy(noise: float, sensor: str) -> None:
    """A velocity that nobody predicted is in no beam's noise, nor is one beam's offset."""
    _, problem, _ = long_mission()
    beams, rng = problem.beams, np.random.default_rng(3)
    own = beams.sigma * noise * rng.standard_normal(len(beams.speed))
    moved_b = rng.standard_normal((beams.ping.max() + 1, 3))
    speed = np.einsum("mi,mi->m", beams.beam_b, moved_b[beams.ping]) + own + 0.1 * (beams.beam == 1)
    beams = dataclasses.replace(beams, speed=speed)
    assert np.std(parity_of(beams)) == pytest.approx(noise, rel=0.2)
    said = DetectedFault("DVL", "errs", 0.0, 200.0, 1e4, 800, Treatment.WIDENED)
    time_s = problem.keyframe_s[beams.keyframe]
    assert noisy_or_compared(said, beams, time_s).sensor == sensor
    early, late = time_s < 140.0, dataclasses.replace(said, begin_s=140.0)
    quiet = dataclasses.replace(beams, speed=np.where(early, speed - own * (1 - 1 / noise), speed))
    assert noisy_or_compared(late, quiet, time_s).sensor == sensor
    of_three = beams.beam < 3
    assert noisy_or_compared(said, beams.take(of_three), time_s[of_three]).sensor == "DVL"


@pytest.mark.parametrize("n", [30, 60, 150])
def test_few_readings_are_not_noisy_by_chance(n: int) -> None:
    """Of thirty the median square is twice its mean once in twenty; three times the noise shows."""
    rng, kernel, time_s = np.random.default_rng(5), LogKernel(), np.arange(float(n))
    for noise, is_usual in ((1.0, True), (3.0, False)):
        t = (noise * rng.standard_normal((200, n))) ** 2
        found = [np.isinf(most_by_noise(one, kernel.weight(one), time_s)).all() for one in t]
        assert np.mean(found) == 1.0 if is_usual else np.mean(found) < 0.3


@pytest.mark.parametrize(
    ("noise", "expected"),
    [(lambda rng, n: rng.standard_normal(n), 0.908), (workhorse, 1.256)],
    ids=["normal", "Student"],
)
def test_the_efficiency_of_a_kernel(noise: Callable[..., Array], expected: float) -> None:
    """The spread of the mean that the log kernel makes of a hundred readings, and by quadrature."""
    rng, kernel = np.random.default_rng(0), LogKernel()
    errors = noise(rng, 400_000)
    t = errors**2
    assert efficiency(t, kernel.weight(t), kernel) == pytest.approx(expected, rel=0.02)
    sets, mean = errors.reshape(4000, 100), np.zeros(4000)
    for _ in range(30):
        weights = kernel.weight((sets - mean[:, None]) ** 2)
        mean = np.sum(weights * sets, axis=1) / np.sum(weights, axis=1)
    claimed = 1.0 / np.sum(weights, axis=1)
    assert np.mean(mean**2) == pytest.approx(np.mean(claimed) / expected, rel=0.07)


@pytest.mark.parametrize("grade", Grade, ids=lambda grade: grade.name)
def test_the_truth_is_not_doubted(grade: Grade) -> None:
    """At every grade, everything measured."""
    sim = simulated(grade=grade, gnss=GnssSettings(windows=((0.0, 99.0),)), imu_rate_hz=100.0)
    problem = build_problem(sim.mission)
    assert doubts_at(problem, true_states(problem, sim)) == []


def test_more_than_half_of_the_beams_rejected() -> None:
    """Half is still outliers, one more is not."""
    _, problem, states = long_mission()
    weights = np.ones(len(problem.beams.speed))
    weights[::2] = 0.05
    assert doubts_at(problem, states, weights=weights) == []
    weights[1] = 0.05
    (doubt,) = doubts_at(problem, states, weights=weights)
    assert doubt.startswith("50 % of the 800 beam speeds contradict the answer")


def test_a_long_stretch_of_rejected_beams() -> None:
    """Three of four beams of each ping for more than a minute; a minute less a ping is silent."""
    _, problem, states = long_mission()
    for n_pings, expected in ((round(SUSPECT_STRETCH_S) + 1, 1), (round(SUSPECT_STRETCH_S), 0)):
        weights = np.ones((200, 4))
        weights[50 : 50 + n_pings, :3] = 0.05
        doubts = doubts_at(problem, states, weights=weights.ravel())
        assert len(doubts) == expected
    weights = np.ones((200, 4))
    weights[50:120, :3] = 0.05
    (doubt,) = doubts_at(problem, states, weights=weights.ravel())
    assert "from 51.0 s to 120.0 s" in doubt


def test_one_good_ping_ends_a_stretch() -> None:
    """Two stretches of 50 s are not one of 100."""
    _, problem, states = long_mission()
    weights = np.ones((200, 4))
    weights[50:150, :3] = 0.05
    weights[100] = 1.0
    assert doubts_at(problem, states, weights=weights.ravel()) == []


def test_trusted_beams_that_miss() -> None:
    """20 sigma off with full weight is named; the same beams without weight are not."""
    _, problem, states = long_mission()
    speed = problem.beams.speed.copy()
    bad = np.zeros(len(speed), bool)
    bad[::10] = True
    speed[bad] += 0.2
    wrong = dataclasses.replace(problem, beams=dataclasses.replace(problem.beams, speed=speed))
    (doubt,) = doubts_at(wrong, states)
    assert "miss the answer by 12." in doubt
    assert doubts_at(wrong, states, weights=np.where(bad, 1e-4, 1.0)) == []


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("position or attitude", {"heading": 0.2}),
        ("position or attitude", {"lat": 1e-6}),
        ("velocity", {"velocity_enu": np.array([0.6, 0.0, 0.0])}),
    ],
)
def test_a_contradicted_start_is_named(name: str, change: dict[str, Any]) -> None:
    """Tens of sigmas between the answer and the initial state."""
    sim, _, states = long_mission()
    initial = sim.mission.initial
    assert initial is not None
    changes = {key: getattr(initial, key) + value for key, value in change.items()}
    problem = build_problem(with_initial(sim.mission, **changes))
    (doubt,) = doubts_at(problem, states)
    assert doubt.startswith(f"the initial {name} is contradicted by the data (chi-square")


def test_a_contradicted_bias_is_named() -> None:
    """A turn-on bias of tens of its sigmas."""
    _, problem, states = long_mission()
    bias = states.bias + np.repeat([30.0, 0.0], 3) * problem.imu_noise_bias_sigma
    doubts = doubts_at(problem, moved(states, bias=bias))
    assert any(doubt.startswith("the initial bias is contradicted") for doubt in doubts)


def test_gnss_and_depth_that_miss_are_named() -> None:
    """Each with its own hint."""
    sim, _, states = long_mission()
    gnss, depth = sim.mission.gnss, sim.mission.depth
    assert gnss is not None
    assert depth is not None
    far = dataclasses.replace(
        sim.mission, gnss=dataclasses.replace(gnss, lat=gnss.lat + 20.0 / 6.4e6)
    )
    (doubt,) = doubts_at(build_problem(far), states)
    assert doubt.startswith("100 % of the 99 GNSS measurements contradict the answer")
    assert "datum or lever arm" in doubt
    deep = dataclasses.replace(
        sim.mission, depth=dataclasses.replace(depth, depth=depth.depth + 0.5)
    )
    (doubt,) = doubts_at(build_problem(deep), states)
    assert doubt.startswith("100 % of the 200 depth measurements contradict the answer")
    assert "zero, sign and unit" in doubt


def test_inertial_data_that_miss_are_named() -> None:
    """A missing quarter of a degree per second over 200 s is no bias of any stated size."""
    sim, _, states = long_mission()
    gyro_b = sim.mission.imu.gyro_b + np.array([0.0, 0.0, 4e-3])
    problem = build_problem(with_imu(sim.mission, gyro_b=gyro_b))
    doubts = doubts_at(problem, states)
    assert any(doubt.startswith("inertial data miss the answer by") for doubt in doubts)


def test_no_beams_no_doubt() -> None:
    """Nothing measured, nothing contradicted."""
    sim = simulated(depth=None)
    dvl = sim.mission.dvl
    lost = dataclasses.replace(dvl, speed=np.full_like(dvl.speed, np.nan))
    problem = build_problem(dataclasses.replace(sim.mission, dvl=lost))
    assert doubts_at(problem, true_states(problem, sim)) == []


@pytest.mark.parametrize(
    ("grade", "off", "says"),
    [
        (
            Grade.NAVIGATION,
            {"velocity_enu": np.array([0.3, -0.4, 0.0])},
            "its velocity is off by 0.5",
        ),
        (Grade.NAVIGATION, {"heading": np.radians(10.0)}, "its attitude is off by 1"),
        (Grade.TACTICAL, {"heading": np.radians(10.0)}, "its"),
    ],
)
def test_what_the_start_alone_says_of_a_sensor_is_doubted(
    grade: Grade, off: dict[str, Any], says: str
) -> None:
    """A start that is off by ten sigmas and more looks like a bottom that moves all the time."""
    mission = simulated(duration_s=60.0, grade=grade, seed=1).mission
    assert mission.initial is not None
    changes = {key: getattr(mission.initial, key) + value for key, value in off.items()}
    estimate = smooth(with_initial(mission, **changes), SmootherConfig(fault_search=FaultSearch()))
    assert estimate.status is Status.SUSPECT
    assert f"the start: {says}" in estimate.reason


def test_what_fixes_say_of_a_sensor_is_not_doubted_for_the_start() -> None:
    """The bottom moves all the time, and fixes tell."""
    moves = Fault(shape=FaultShape.MOVING_BOTTOM, size=(0.2, 0.3, 0.0))
    seen = GnssSettings(windows=((0.0, 60.0),))
    mission = simulated(duration_s=60.0, gnss=seen, faults=(moves,), seed=1).mission
    estimate = smooth(mission, SmootherConfig(fault_search=FaultSearch()))
    assert any(fault.sensor == "DVL" and not fault.is_suspect for fault in estimate.faults)
    assert "the start" not in " ".join(estimate.notes)


@pytest.mark.parametrize("grade", Grade, ids=lambda grade: grade.name)
@pytest.mark.parametrize(
    "route", [TransitRoute(), DiveRoute()], ids=lambda route: type(route).__name__
)
@pytest.mark.parametrize("turn_deg", [180.0, 90.0])
def test_a_hopeless_heading_never_ends_well(grade: Grade, route: Any, turn_deg: float) -> None:
    """A moving vehicle without GNSS, its heading wrong by far: the outcome says so.

    Either the status is not good and the reason names the contradiction, or there is no answer at
    all but an error that points to the heading.
    """
    sim = simulated(grade=grade, route=route, seed=1)
    assert sim.mission.initial is not None
    heading = sim.mission.initial.heading + np.radians(turn_deg)
    status, reason = outcome(build_problem(with_initial(sim.mission, heading=heading)))
    assert status in (Status.SUSPECT, Status.MAX_ITERATIONS, Status.DIVERGED)
    assert not status.is_good
    assert "heading" in reason
    assert "contradict" in reason or status is Status.DIVERGED
