"""The geodetic filter over whole missions: drift, honesty, outliers."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from factors.similarity import GaussianKernel
from ssm_graph.base.frozen import Array
from ssm_graph.engine.states import States
from ssm_graph.evaluation.statistics import chi2_interval
from ssm_graph.filters.geodetic.filter import (
    GeodeticConfig,
    GeodeticHistory,
    run_geodetic,
    to_navigation,
)
from ssm_graph.mission.problem import build_problem
from ssm_graph.simulation import (
    Grade,
    OutlierKind,
    Outliers,
    SimulatedMission,
    scenario_config,
    simulate,
)
from tests.helpers import state_errors, true_states, without_beams

pytestmark = pytest.mark.slow

N_RUNS = 16


def test_twenty_minutes_of_perfect_sensors() -> None:
    """A survey in waves by inertial sensors alone: 0.2 mm horizontally, measured."""
    sim = simulate(
        scenario_config("survey", perfect_sensors=True, draw_initial_errors=False, depth=None)
    )
    mission = without_beams(sim.mission)
    problem = build_problem(mission)
    states = to_navigation(problem, run_geodetic([problem], [mission.imu]), 0)
    error = states.p_n - true_states(problem, sim).p_n
    assert problem.keyframe_s[-1] == pytest.approx(1200.0)
    assert np.hypot(error[:, 0], error[:, 1]).max() < 1e-3
    assert np.abs(error[:, 2]).max() < 1e-3


@cache
def clean(grade: Grade) -> tuple[SimulatedMission, ...]:
    """Return three minutes of survey without outliers, many times."""
    return tuple(
        simulate(scenario_config("survey", grade=grade, seed=seed, duration_s=180.0))
        for seed in range(N_RUNS)
    )


def filtered(sims: tuple[SimulatedMission, ...], config: GeodeticConfig) -> GeodeticHistory:
    """Filter missions side by side."""
    problems = [build_problem(sim.mission) for sim in sims]
    return run_geodetic(problems, [sim.mission.imu for sim in sims], config)


def final_nees(sims: tuple[SimulatedMission, ...], history: GeodeticHistory) -> Array:
    """Return the NEES (B,) of all 15 states at the last keyframe."""
    nees = []
    for run, sim in enumerate(sims):
        problem = build_problem(sim.mission)
        states = to_navigation(problem, history, run)
        error = state_errors(States.of(*states[:4]), true_states(problem, sim))[-1]
        nees.append(error @ np.linalg.solve(states.covariance[-1], error))
    return np.array(nees)


@pytest.mark.parametrize("grade", [Grade.NAVIGATION, Grade.TACTICAL, Grade.INDUSTRIAL])
def test_covariance_is_honest(grade: Grade) -> None:
    """Clean data, least squares: NEES of all states within its chi-square interval."""
    history = filtered(clean(grade), GeodeticConfig(kernel=GaussianKernel()))
    nees = final_nees(clean(grade), history)
    assert nees.mean() / 15.0 in chi2_interval(15, N_RUNS, 0.999)


def test_outliers_do_not_move_the_track() -> None:
    """A tenth of all pings with a wrong beam: the horizontal error stays honest."""
    sims = tuple(
        simulate(
            scenario_config(
                "survey",
                grade=Grade.TACTICAL,
                seed=seed,
                duration_s=180.0,
                outliers=Outliers(OutlierKind.SPARSE, rate=0.1),
                dropout_rate=0.05,
            )
        )
        for seed in range(N_RUNS)
    )
    history = filtered(sims, GeodeticConfig())
    nees = []
    for run, sim in enumerate(sims):
        problem = build_problem(sim.mission)
        states = to_navigation(problem, history, run)
        error = (states.p_n - true_states(problem, sim).p_n)[-1]
        R_nb = states.R_nb[-1]
        covariance = R_nb @ states.covariance[-1, 3:6, 3:6] @ R_nb.T
        nees.append(error[:2] @ np.linalg.solve(covariance[:2, :2], error[:2]))
    assert np.mean(nees) / 2.0 in chi2_interval(2, N_RUNS, 0.999)
