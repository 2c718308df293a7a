"""Beams that repeat one reading, recorded and live."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ssm_graph.mission.problem import build_problem
from ssm_graph.sensors.dvl import Ping
from ssm_graph.sensors.dvl_readings import STUCK_PINGS, stuck_beams
from tests.helpers import simulated
from tests.online_fixture import SHORT, joined, messages, run, stream


def speeds(n: int = 40, *, seed: int = 0) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    """Return sound beam speeds (n, 4), m/s."""
    return np.random.default_rng(seed).normal(size=(n, 4))


def test_a_beam_that_repeats_itself_is_stuck() -> None:
    """From the first of the equal readings to the last, and no other beam."""
    speed = speeds()
    speed[10:20, 2] = speed[10, 2]
    expected = np.zeros((40, 4), bool)
    expected[10:20, 2] = True
    np.testing.assert_array_equal(stuck_beams(speed), expected)


def test_a_few_repeats_are_chance() -> None:
    """One fewer than is asked for."""
    speed = speeds()
    speed[10 : 10 + STUCK_PINGS - 1, 2] = 0.5
    assert not stuck_beams(speed).any()


def test_a_vehicle_at_rest_is_not_stuck() -> None:
    """Where nothing changes at all, or noise is below the resolution, all beams repeat."""
    assert not stuck_beams(np.zeros((100, 4))).any()
    coarse = np.round(1e-4 * speeds(1000) + 0.2, 3)
    assert not stuck_beams(coarse).any()


def test_missing_readings_end_a_row() -> None:
    """NaN is no reading, and a ping without any other beam proves nothing."""
    speed = speeds()
    speed[5:35, 1] = 0.3
    speed[12, 1] = speed[20, 1] = speed[28, 1] = np.nan
    assert not stuck_beams(speed)[12:28].any()
    alone = speeds()
    alone[:, 1:] = np.nan
    alone[:, 0] = 0.3
    assert not stuck_beams(alone).any()


def test_a_recorded_stuck_beam_is_left_out_and_said() -> None:
    """A slow one among them, near the true value, which no robust weight would find."""
    mission = simulated(duration_s=60.0).mission
    speed = mission.dvl.speed.copy()
    speed[20:50, 3] = speed[20, 3]
    problem = build_problem(replace(mission, dvl=replace(mission.dvl, speed=speed)))
    left_out = np.isin(problem.keyframe_s[problem.beams.keyframe], mission.dvl.valid_s[20:50])
    assert set(problem.beams.beam[left_out].tolist()) == {0, 1, 2}
    assert any("beam 4: 30" in note for note in problem.notes)


def test_a_live_stuck_beam_is_left_out_from_its_first_repeat_on() -> None:
    """In order or not: the ping that proves it changes what was made of those before."""
    given = [
        replace(m, speed=(m.speed[0], 0.25, m.speed[2], m.speed[3]))
        if isinstance(m, Ping) and 3.0 < m.time_s < 9.0
        else m
        for m in messages()
    ]
    vehicle = stream()[1]
    config = replace(SHORT, lag_s=6.0)
    newest, delayed, smoother = run(given, vehicle, config)
    events = {event.kind: event.text for event in smoother.take_events()}
    assert "beam 2 repeats 0.25 m/s" in events["beam_2_stuck"]
    missing = [
        replace(m, speed=(m.speed[0], np.nan, m.speed[2], m.speed[3]))
        if isinstance(m, Ping) and 3.0 < m.time_s < 9.0
        else m
        for m in messages()
    ]
    without, expected, _ = run(missing, vehicle, config)
    np.testing.assert_allclose(
        joined(delayed, "velocity_enu"), joined(expected, "velocity_enu"), rtol=0.0, atol=1e-9
    )
    assert newest.lat == without.lat
    pings = [m for m in given if isinstance(m, Ping)]
    late = pings[14]
    disordered = [m for m in given if m is not late]
    at = next(i for i, m in enumerate(disordered) if m.time_s > late.time_s + 0.9)
    moved, _, _ = run([*disordered[:at], late, *disordered[at:]], vehicle, config)
    np.testing.assert_allclose(moved.velocity_enu, newest.velocity_enu, rtol=0.0, atol=1e-10)
