"""What a wrong sigma costs, and what adapting the beams' sigmas gives back.

``python benchmarks/noise.py --keep`` (some five minutes). Every mission is solved with the sigmas
of beams or inertial sensors stated right, three times too small and three times too large.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from dataclasses import fields, replace
from itertools import product
from pathlib import Path
from typing import NamedTuple

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np

from benchmarks.report import machine
from benchmarks.speed import table
from factors.kernels import KERNELS
from ssm_graph.base.frozen import Array
from ssm_graph.evaluation import evaluate, paired_ratio
from ssm_graph.mission.estimate import since_first_ping
from ssm_graph.mission.mission import Mission
from ssm_graph.mission.problem import build_problem
from ssm_graph.sensors.imu import ImuNoise
from ssm_graph.simulation import Grade, OutlierKind, Outliers, scenario_config, simulate
from ssm_graph.smoothers.batch import SmootherConfig, SsmSmoother
from ssm_graph.study.code import code_version

RESULTS = Path(__file__).resolve().parent / "results"
GRADES = (Grade.NAVIGATION, Grade.TACTICAL, Grade.MEMS)
RIGHT = "right"
STATED = {
    RIGHT: (1.0, 1.0),
    "beams / 3": (1.0 / 3.0, 1.0),
    "beams x 3": (3.0, 1.0),
    "inertial / 3": (1.0, 1.0 / 3.0),
    "inertial x 3": (1.0, 3.0),
}
"""Stated over true sigma of beams and of inertial densities."""
OUTLIERS = {"clean": Outliers(), "sparse10": Outliers(OutlierKind.SPARSE, 0.1)}


class Run(NamedTuple):
    """One mission solved in one way."""

    horizontal_m: float
    nees: float
    """Of position, by three"""
    factor: float
    """Estimated over true sigma of the beams, mean"""
    warned: tuple[bool, bool]
    """Of beams, of inertial data"""
    wall_s: float
    is_converged: bool


def stated(mission: Mission, beams: float, inertial: float) -> Mission:
    """Return the mission with sigmas and densities stated so many times as large."""
    noise = mission.imu.noise
    densities = [field.name for field in fields(ImuNoise) if field.name.endswith("density")]
    changes = {name: inertial * getattr(noise, name) for name in densities}
    return replace(
        mission,
        dvl=replace(mission.dvl, sigma=beams * mission.dvl.sigma),
        imu=replace(mission.imu, noise=replace(noise, **changes)),
    )


def runs_of(
    grade: Grade, outliers: Outliers, seed: int, duration_s: float, kernels: list[str]
) -> Iterator[tuple[tuple[str, str, bool], Run]]:
    """Solve one mission in all ways; yield how and what came out."""
    config = scenario_config(
        "survey", grade=grade, seed=seed, duration_s=duration_s, outliers=outliers
    )
    sim = simulate(config)
    for name, (beams, inertial) in STATED.items():
        problem = build_problem(stated(sim.mission, beams, inertial))
        for kernel, adapt in product(kernels, (False, True)):
            estimate = SsmSmoother(
                SmootherConfig(KERNELS[kernel].kernel(), adapt_noise=adapt)
            ).solve(problem)
            trajectory = since_first_ping(estimate.trajectory)
            metrics = evaluate(trajectory, sim.truth_at(trajectory.time_s))
            assert estimate.noise is not None
            yield (
                (name, kernel, adapt),
                Run(
                    metrics.rmse_horizontal_m,
                    metrics.nees_position,
                    float(np.mean(estimate.noise.beam_factor)) * beams,
                    (
                        any("ask for sigmas" in note for note in estimate.notes),
                        any("densities of [imu]" in note for note in estimate.notes),
                    ),
                    estimate.wall_s,
                    estimate.status.is_good,
                ),
            )


def line(case: str, how: tuple[str, str, bool], runs: list[Run], right: list[Run]) -> list[str]:
    """Return one row of the table; ratios are to the same kernel with the right sigmas."""
    ours: Array = np.array([run.horizontal_m for run in runs])
    other: Array = np.array([run.horizontal_m for run in right])
    ratio = paired_ratio(ours, other, rng=np.random.default_rng(0))
    name, kernel, adapt = how
    n = len(runs)
    return [
        case,
        name,
        kernel,
        "yes" if adapt else "no",
        f"{ratio.value:.3f} [{ratio.low:.3f}, {ratio.high:.3f}]",
        f"{np.mean([run.nees for run in runs]):.2f}",
        f"{np.mean([run.factor for run in runs]):.3f}",
        f"{sum(run.warned[0] for run in runs)} / {sum(run.warned[1] for run in runs)} of {n}",
        f"{np.mean([run.wall_s for run in runs]):.2f}",
        f"{sum(not run.is_converged for run in runs)} of {n}",
    ]


def main() -> None:
    """Run, print, and keep the table on request."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=8, metavar="N")
    parser.add_argument("--duration", type=float, default=600.0, metavar="SECONDS")
    parser.add_argument("--kernels", default="log", metavar="A,B", help="default: %(default)s")
    parser.add_argument("--keep", action="store_true", help=f"write {RESULTS / 'noise.md'}")
    arguments = parser.parse_args()
    rows = []
    for grade, (case, outliers) in product(GRADES, OUTLIERS.items()):
        found: dict[tuple[str, str, bool], list[Run]] = {}
        for seed in range(arguments.seeds):
            for how, run in runs_of(
                grade, outliers, seed, arguments.duration, arguments.kernels.split(",")
            ):
                found.setdefault(how, []).append(run)
        label = f"{grade.name.lower()}, {case}"
        rows += [line(label, how, runs, found[RIGHT, how[1], False]) for how, runs in found.items()]
        print(f"{label} done", file=sys.stderr, flush=True)
    heading = [
        "mission",
        "stated sigma",
        "kernel",
        "adapted",
        "horizontal rms, ratio to right",
        "NEES/3 epochs",
        "beam sigma found / true",
        "warned: beams / inertial",
        "s",
        "not converged",
    ]
    text = "\n".join(
        [
            "# Sigmas stated wrong by a factor of three",
            "",
            f"    python benchmarks/noise.py --seeds {arguments.seeds} --duration "
            f"{arguments.duration:g} --kernels {arguments.kernels} --keep",
            "",
            f"Code: {code_version()}. {machine()}.",
            "",
            "Ratios are those of the mean horizontal rms to the same kernel with the right sigmas,",
            "with the 95 % interval of a paired bootstrap. Warned: runs with a note on the noise.",
            "",
            *table(heading, rows),
            "",
        ]
    )
    print(text)
    if arguments.keep:
        (RESULTS / "noise.md").write_text(text)


if __name__ == "__main__":
    main()
