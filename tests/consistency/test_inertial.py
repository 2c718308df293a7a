"""Perfect sensors and nothing else: the inertial chain over a rotating, curved Earth.

Centimetres after an hour and 7 km need everything right at once: coning and sculling, the turn
within a sample, Earth rate, Coriolis terms, gravity's size and direction at every place.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from factors.similarity import LogKernel
from ssm_graph.base.frozen import Array
from ssm_graph.engine.states import States
from ssm_graph.graph.first_values import first_values
from ssm_graph.imu.preintegration import gtsam_gravity
from ssm_graph.mission.problem import Problem, ProblemConfig, build_problem
from ssm_graph.simulation import SimulatedMission, TransitRoute, Waves
from ssm_graph.smoothers.batch import SsmSmoother
from tests.helpers import estimated_states, simulated, true_states, without_beams

RAW = None
"""Merge nothing."""


def unaided(*, duration_s: float, lat_deg: float, rate_hz: float) -> SimulatedMission:
    """Return a straight run at 2 m/s in waves, perfect sensors, every beam missing, no depth."""
    sim = simulated(
        route=TransitRoute(speed=2.0),
        waves=Waves(),
        duration_s=duration_s,
        lat=math.radians(lat_deg),
        imu_rate_hz=rate_hz,
        perfect_sensors=True,
        draw_initial_errors=False,
        depth=None,
        reference_rate_hz=0.1,
    )
    return dataclasses.replace(sim, mission=without_beams(sim.mission))


def problem_of(sim: SimulatedMission, *, merge_hz: float | None) -> Problem:
    """Return the problem with samples merged to ``merge_hz``, or not at all."""
    rate_hz = merge_hz or sim.config.imu_rate_hz
    return build_problem(sim.mission, ProblemConfig(merge_rate_hz=rate_hz))


def final_error(problem: Problem, states: States, sim: SimulatedMission) -> tuple[float, float]:
    """Return the horizontal and vertical error at the end, m."""
    last = dataclasses.replace(problem, keyframe_s=problem.keyframe_s[-1:])
    truth = true_states(last, sim).p_n[0]
    error: Array = problem.frame.R_nl_at(truth).T @ (states.p_n[-1] - truth)
    return float(np.hypot(error[0], error[1])), abs(float(error[2]))


def reckoned(sim: SimulatedMission, *, merge_hz: float | None) -> tuple[float, float]:
    """Return the errors at the end of the first pass: dead reckoning, without any measurement."""
    problem = problem_of(sim, merge_hz=merge_hz)
    first = first_values(problem, kernel=LogKernel())
    assert len(first.weights) == 0
    return final_error(problem, first.states, sim)


def test_waves_are_those_of_the_claim() -> None:
    """Roll of 4 and pitch of 3 degrees at 6 to 8 s, heave of 0.3 m."""
    waves = Waves()
    assert math.degrees(waves.roll) == pytest.approx(4.0)
    assert math.degrees(waves.pitch) == pytest.approx(3.0)
    assert waves.heave_m == pytest.approx(0.3)
    for period in (waves.roll_period_s, waves.pitch_period_s, waves.heave_period_s):
        assert 6.0 <= period <= 8.0


@pytest.mark.parametrize(("rate_hz", "merge_hz"), [(20.0, RAW), (100.0, 20.0)])
def test_ten_minutes(rate_hz: float, merge_hz: float | None) -> None:
    """The fast variant at one latitude: a millimetre level and up."""
    sim = unaided(duration_s=600.0, lat_deg=45.7, rate_hz=rate_hz)
    horizontal, vertical = reckoned(sim, merge_hz=merge_hz)
    assert horizontal < 1e-3
    assert vertical < 1e-3


@pytest.mark.slow
@pytest.mark.parametrize(
    ("lat_deg", "rate_hz", "merge_hz", "vertical_limit"),
    [
        (80.0, 20.0, RAW, 0.5),
        (80.0, 100.0, 20.0, 0.05),
        (0.0, 20.0, RAW, 0.5),
        (-60.0, 200.0, 20.0, 0.05),
    ],
)
def test_one_hour_over_7_km(
    lat_deg: float, rate_hz: float, merge_hz: float | None, vertical_limit: float
) -> None:
    """The claim of the package, with the figures of the issue: all rates, and all latitudes."""
    sim = unaided(duration_s=3600.0, lat_deg=lat_deg, rate_hz=rate_hz)
    horizontal, vertical = reckoned(sim, merge_hz=merge_hz)
    assert horizontal < 0.01
    assert vertical < vertical_limit


@pytest.mark.slow
def test_the_smoother_agrees_over_an_hour() -> None:
    """With nothing measured the batch solution is the dead reckoning itself, and better.

    Its gravity is that of the path it ends with. The forward pass has that of the predicted path,
    and what heave makes of the difference grows with the height's own instability.
    """
    sim = unaided(duration_s=3600.0, lat_deg=80.0, rate_hz=100.0)
    problem = problem_of(sim, merge_hz=20.0)
    first = first_values(problem, kernel=LogKernel())
    estimate = SsmSmoother().solve(problem)
    assert estimate.status.is_good, estimate.reason
    states = estimated_states(problem, estimate.trajectory)
    horizontal, vertical = final_error(problem, states, sim)
    assert horizontal < 0.01
    assert vertical < 0.005
    assert np.abs(states.p_n - first.states.p_n)[:, :2].max() < 0.01
    assert np.abs(states.p_n - first.states.p_n).max() < 0.05


@pytest.mark.parametrize("term", ["gravity", "rate", "merging"])
def test_the_claim_rests_on_each_term(term: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """10 min without one of them are off by far more than the limits above.

    Constant gravity; samples whose coning and sculling are left out; no ``omega x (omega x p)``.
    """
    sim = unaided(duration_s=600.0, lat_deg=45.7, rate_hz=20.0)
    if term == "gravity":
        monkeypatch.setattr(
            "ssm_graph.graph.first_values.gtsam_gravity",
            lambda frame, p_n: gtsam_gravity(frame, np.zeros_like(p_n)),
        )
        monkeypatch.setattr(
            "ssm_graph.graph.first_values.gravity_gradient", lambda *_: np.zeros((3, 3))
        )
    elif term == "rate":
        monkeypatch.setattr(
            "ssm_graph.graph.first_values.gtsam_gravity", lambda frame, p_n: frame.g_n_at(p_n)
        )
    else:
        monkeypatch.setattr("ssm_graph.imu.increments._slopes", lambda _, rate: np.zeros_like(rate))
    horizontal, vertical = reckoned(sim, merge_hz=RAW)
    assert horizontal > 0.02 or vertical > 0.1
