"""Is the smoother's single step the filter? ``python benchmarks/equivalence.py``.

Ten missions with outliers, dropouts, a bottom loss and a GNSS start, three grades in turn, each
estimated by the graph in single steps and by the filter in gains and covariances, which linearises
anew at each pass as the graph does or, as ``ssm-log``, once; and, with measurements linearised
once, by the graph and by the geodetic filter. Differences are the largest over all keyframes and
components, in posterior sigmas.
"""

from __future__ import annotations

import argparse
import platform
import sys
from collections.abc import Sequence
from dataclasses import replace
from itertools import cycle, islice
from pathlib import Path
from typing import NamedTuple

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np

from factors.similarity import LogKernel, Similarity
from ssm_graph.engine.error_state import POSITION, VELOCITY, Linearised
from ssm_graph.engine.states import NavigationStates
from ssm_graph.filters.geodetic.filter import GeodeticConfig, run_geodetic, to_navigation
from ssm_graph.filters.geodetic.mechanisation import Feedback
from ssm_graph.filters.navigation.filter import FilterHistory, Grouping, run_filter
from ssm_graph.filters.rules.ssm import SsmUpdate
from ssm_graph.mission.problem import Problem, build_problem
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

ALL = 10
"""Missions of the whole page."""
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
    return [
        simulate(
            scenario_config(
                "survey",
                grade=grade,
                seed=seed,
                duration_s=duration_s,
                outliers=Outliers(OutlierKind.SPARSE, rate=0.1),
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


def report(count: int, duration_s: float) -> str:
    """Return both comparisons as Markdown."""
    runs = [(sim, build_problem(sim.mission)) for sim in missions(count, duration_s)]
    lines = [
        f"`python benchmarks/equivalence.py --missions {count} --duration {duration_s:g}`",
        "",
        f"{platform.machine()}, Python {platform.python_version()}; {count} missions of "
        f"{duration_s:g} s, 10 % of the pings with an outlier, 5 % of the beams missing, 30 s "
        "without bottom lock, GNSS for the first 30 s; kernel log(dof=5).",
        *([f"A part of the page: {ALL} missions are the whole."] if count < ALL else []),
        "",
        "## Single step of the graph against the filter in NumPy",
        "",
        "| seed | grade | similarity | state, posterior sigmas | covariance, of √(P_ii P_jj) | "
        "weights | keyframes with other iteration counts | state of the filter linearised once, "
        "posterior sigmas |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for seed, (sim, problem) in enumerate(runs):
        for similarity in Similarity:
            d = against_filter(problem, similarity)
            lines.append(
                f"| {seed} | {sim.config.grade.name.lower()} | {similarity.name.lower()} | "
                f"{d.state:.1e} | {d.covariance:.1e} | {d.weight:.1e} | {d.n_iterations} | "
                f"{d.once:.3f} |"
            )
    lines += [
        "",
        "## Single step of the graph against the geodetic filter",
        "",
        "Largest difference over the mission: velocity / horizontal position, posterior sigmas.",
        "",
        "| seed | grade | linearised once, complete feedback | linearised once, the paper's "
        "feedback | Gauss-Newton, complete feedback |",
        "|---|---|---|---|---|",
    ]
    pairs = (
        (Linearised.ONCE, Feedback.COMPLETE),
        (Linearised.ONCE, Feedback.PAPER),
        (Linearised.EACH_PASS, Feedback.COMPLETE),
    )
    for seed, (sim, problem) in enumerate(runs):
        cells = [against_geodetic(problem, sim, *pair) for pair in pairs]
        texts = " | ".join(f"{velocity:.3f} / {position:.3f}" for velocity, position in cells)
        lines.append(f"| {seed} | {sim.config.grade.name.lower()} | {texts} |")
    return "\n".join(lines) + "\n"


def main(argv: Sequence[str] | None = None) -> int:
    """Print the comparison; ``--keep`` writes it to benchmarks/results as well."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--missions", type=int, default=ALL)
    parser.add_argument("--duration", type=float, default=1200.0, help="of a mission, s")
    parser.add_argument("--keep", action="store_true", help="write results/equivalence.md")
    args = parser.parse_args(argv)
    text = report(args.missions, args.duration)
    print(text)
    if args.keep:
        path = Path(__file__).resolve().parent / "results" / "equivalence.md"
        path.write_text("# Single-step equivalence\n\n" + text, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
