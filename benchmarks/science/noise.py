"""What a wrong sigma costs, and what adapting the beams' sigmas gives back.

``python -m benchmarks.science.noise --keep`` (some five minutes; a quick look is ``--seeds 2
--duration 30``). Every mission is solved with the sigmas of beams or inertial sensors stated right,
three times too small and three times too large.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import fields, replace
from itertools import product
from typing import NamedTuple

import numpy as np

from benchmarks.missions import survey
from benchmarks.report import Option, Report, note, ratio_text, table
from factors.kernels import KERNELS
from ssm_graph import Mission, SmootherConfig, SsmSmoother, build_problem, evaluate
from ssm_graph.mission.estimate import since_first_ping
from ssm_graph.sensors.imu import ImuNoise
from ssm_graph.simulation import Grade

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
OUTLIERS = {"clean": 0.0, "sparse10": 0.1}


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
    grade: Grade, outliers: float, seed: int, duration_s: float, kernels: list[str]
) -> Iterator[tuple[tuple[str, str, bool], Run]]:
    """Solve one mission in all ways; yield how and what came out."""
    sim = survey(duration_s, grade, seed=seed, outliers=outliers)
    for name, (beams, inertial) in STATED.items():
        problem = build_problem(stated(sim.mission, beams, inertial))
        for kernel, adapt in product(kernels, (False, True)):
            config = SmootherConfig(KERNELS[kernel].kernel(), adapt_noise=adapt)
            estimate = SsmSmoother(config).solve(problem)
            trajectory = since_first_ping(estimate.trajectory)
            metrics = evaluate(trajectory, sim.truth_at(trajectory.time_s))
            assert estimate.noise is not None
            said = " ".join(estimate.notes)
            found = Run(
                metrics.rmse_horizontal_m,
                metrics.nees_position,
                float(np.mean(estimate.noise.beam_factor)) * beams,
                ("ask for sigmas" in said, "densities of [imu]" in said),
                estimate.wall_s,
                estimate.status.is_good,
            )
            yield (name, kernel, adapt), found


def line(case: str, how: tuple[str, str, bool], runs: list[Run], right: list[Run]) -> list[str]:
    """Return one row of the table; ratios are to the same kernel with the right sigmas."""
    name, kernel, adapt = how
    n = len(runs)
    return [
        case,
        name,
        kernel,
        "yes" if adapt else "no",
        ratio_text([run.horizontal_m for run in runs], [run.horizontal_m for run in right]),
        f"{np.mean([run.nees for run in runs]):.2f}",
        f"{np.mean([run.factor for run in runs]):.3f}",
        f"{sum(run.warned[0] for run in runs)} / {sum(run.warned[1] for run in runs)} of {n}",
        f"{np.mean([run.wall_s for run in runs]):.2f}",
        f"{sum(not run.is_converged for run in runs)} of {n}",
    ]


HEADER = ["mission", "stated sigma", "kernel", "adapted", "horizontal rms, ratio to right"]
HEADER += ["NEES/3 epochs", "beam sigma found / true", "warned: beams / inertial", "s"]
HEADER += ["not converged"]
LEGEND = """\
Ratios are those of the mean horizontal rms to the same kernel with the right sigmas,
with the 95 % interval of a paired bootstrap. Warned: runs with a note on the noise.
"""


def main() -> None:
    """Run all missions and write the table."""
    report = Report(
        *(__file__, "Sigmas stated wrong by a factor of three", __doc__),
        Option("--seeds", 8, "missions of each kind"),
        Option("--duration", 600.0, "of a mission, s"),
        Option("--kernels", "log", "names with commas between them"),
    )
    args = report.args
    rows = []
    for grade, (case, outliers) in product(GRADES, OUTLIERS.items()):
        found: dict[tuple[str, str, bool], list[Run]] = {}
        for seed in range(args.seeds):
            for how, run in runs_of(grade, outliers, seed, args.duration, args.kernels.split(",")):
                found.setdefault(how, []).append(run)
        label = f"{grade.name.lower()}, {case}"
        rows += [line(label, how, runs, found[RIGHT, how[1], False]) for how, runs in found.items()]
        note(f"{label} done")
    report.write([LEGEND, *table(HEADER, rows)])


if __name__ == "__main__":
    main()
