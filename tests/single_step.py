"""The graph in single steps beside the filters that were written without it."""

from __future__ import annotations

from dataclasses import replace
from itertools import cycle, islice
from typing import NamedTuple

import numpy as np

from factors.similarity import LogKernel, Similarity
from ssm_graph.engine.error_state import POSITION, VELOCITY, Linearised
from ssm_graph.engine.states import NavigationStates
from ssm_graph.filters.geodetic.filter import GeodeticConfig, run_geodetic, to_navigation
from ssm_graph.filters.geodetic.mechanisation import Feedback
from ssm_graph.filters.navigation.filter import FilterHistory, Grouping, run_filter
from ssm_graph.filters.rules.ssm import SsmUpdate
from ssm_graph.mission.problem import Problem
from ssm_graph.simulation import (
    GnssSettings,
    Grade,
    Loss,
    OutlierKind,
    Outliers,
    SimulatedMission,
    scenario_config,
    simulate,
)
from ssm_graph.smoothers.fixed_lag import FixedLagConfig, run_fixed_lag

GRADES = (Grade.NAVIGATION, Grade.TACTICAL, Grade.INDUSTRIAL)


class Difference(NamedTuple):
    """Largest differences of one mission between graph and filter."""

    state: float
    """posterior sigmas"""
    covariance: float
    """of the square root of both variances"""
    weight: float
    n_iterations: int
    """keyframes with another number of iterations"""
    once: float
    """posterior sigmas, of the state from that of the filter that linearises once"""


def missions(count: int, duration_s: float) -> list[SimulatedMission]:
    """Return missions of three grades in turn, seeds from 0."""
    outliers = Outliers(OutlierKind.SPARSE, rate=0.1)
    return [
        simulate(
            scenario_config(
                "survey",
                duration_s=duration_s,
                grade=grade,
                seed=seed,
                outliers=outliers,
                dropout_rate=0.05,
                losses=(Loss(0.5 * duration_s, 0.5 * duration_s + 30.0),),
                gnss=GnssSettings(windows=((0.0, 30.0),)),
            )
        )
        for seed, grade in enumerate(islice(cycle(GRADES), count))
    ]


def against_filter(problem: Problem, similarity: Similarity) -> Difference:
    """Compare the graph's single steps with the filter."""
    kernel = LogKernel()
    graph = run_fixed_lag(problem, FixedLagConfig(0.0, kernel, similarity))
    rule = SsmUpdate(kernel, similarity=similarity)
    history, once = (
        run_filter([problem], replace(rule, linearised=how), grouping=Grouping.PER_BEAM)
        for how in (Linearised.EACH_PASS, Linearised.ONCE)
    )
    newest, beams = graph.newest, problem.beams
    sigma = np.sqrt(np.diagonal(newest.covariance, axis1=1, axis2=2))
    unit = sigma[:, :, None] * sigma[:, None, :]
    weight = history.weight[beams.keyframe, 0, beams.beam]

    def state_of(other: FilterHistory) -> float:
        own = other.posterior
        states = NavigationStates(own.R_nb[:, 0], own.p_n[:, 0], own.v_n[:, 0], own.bias[:, 0])
        return float(np.max(np.abs(newest.states.navigation.deviation_of(states)) / sigma))

    return Difference(
        state_of(history),
        float(np.max(np.abs(history.posterior.covariance[:, 0] - newest.covariance) / unit)),
        float(np.max(np.abs(weight - newest.weight))),
        int(np.sum(history.n_iterations[:, 0] != graph.n_iterations)),
        state_of(once),
    )


def against_geodetic(
    problem: Problem, sim: SimulatedMission, linearised: Linearised, feedback: Feedback
) -> tuple[float, float]:
    """Return the largest differences in velocity and horizontal position, sigmas."""
    graph = run_fixed_lag(problem, FixedLagConfig(0.0, linearised=linearised))
    config = GeodeticConfig(feedback=feedback)
    history = run_geodetic([problem], [sim.mission.imu], config)
    other = to_navigation(problem, history, 0)
    P = graph.newest.covariance
    velocity_sigma = np.sqrt(np.diagonal(P[:, VELOCITY, VELOCITY], axis1=1, axis2=2))
    states = graph.newest.states
    R_nb = states.R_nb
    position_cov_n = R_nb @ P[:, POSITION, POSITION] @ np.swapaxes(R_nb, 1, 2)
    position_sigma = np.sqrt(np.diagonal(position_cov_n, axis1=1, axis2=2))[:, :2]
    velocity = np.abs(other.v_n - states.v_n) / velocity_sigma
    position = np.abs(other.p_n - states.p_n)[:, :2] / position_sigma
    return float(np.max(velocity)), float(np.max(position))
