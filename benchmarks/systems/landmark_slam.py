"""Landmark SLAM: smoother and noise on simulated runs, real logs against their truth."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.report import ROOT, Option, Report, mean_text, note, ratio_text, table
from ssm_graph.base.frozen import Array
from ssm_graph.systems.landmark_slam.association import Association
from ssm_graph.systems.landmark_slam.methods import INCREMENTAL
from ssm_graph.systems.landmark_slam.solve import Asked, Solved, solve_input
from ssm_graph.systems.landmark_slam.study import Scores, run_batch

CASES = ("stated", "R3", "Q3", "gross10", "gross30")
METHODS = ("smoother", "smoother-em", "smoother-oracle")
SIGMAS = ("distance", "steering", "range", "bearing")
WAYS = {
    "smoother": Asked(),
    "smoother, noise as guessed": Asked(learns_observations=False),
    "isam2, nothing dropped": Asked("isam2"),
    "fixed lag of 60 s": Asked("fixed-lag", lag_s=60.0),
    "on-line filter, similarity weights": Asked("ekf-weighted"),
    "literal noise-adaptive filter": Asked("naukf"),
    "smoother, landmarks without names": Asked(association=Association.JOINT),
}
DATA = Path(os.environ.get("SSM_GRAPH_DATA", ROOT.parent / "shared" / "data")) / "systems"


def simulated(runs: int, steps: int, first_seed: int) -> Iterator[str]:
    """Yield the tables of the simulated runs."""
    rows, noises = [], []
    for case in CASES:
        cells = {}
        for method in METHODS:
            parts = []
            for seed in range(first_seed, first_seed + runs):
                note(f"{case}, {method}, seed {seed}")
                parts.append(run_batch((case, method, seed, 1, steps)))
            cells[method] = {
                n: np.concatenate([np.asarray(part[n], float) for part in parts])
                for n in Scores._fields
                if n in ("position_m", "nees", "noise")
            }
            cells[method]["cpu_s"] = np.array([float(part["cpu_s"]) for part in parts])
        oracle = cells["smoother-oracle"]["position_m"]
        for method in METHODS:
            own = cells[method]
            rows.append(
                (
                    case,
                    method,
                    mean_text(own["position_m"]),
                    ratio_text(own["position_m"], oracle),
                    mean_text(own["nees"]),
                    f"{own['cpu_s'].mean():.1f}",
                )
            )
        found: Array = cells["smoother-em"]["noise"]
        noises.append((case, *(mean_text(found[:, i]) for i in range(len(SIGMAS)))))
    yield "Runs of the study; the oracle knows the sigmas and which observations are gross."
    yield ""
    header = ("case", "method", "position rms, m", "over oracle", "NEES/3", "CPU s a run")
    yield from table(header, rows)
    yield ""
    yield "Sigmas of smoother-em in true ones:"
    yield ""
    yield from table(("case", *SIGMAS), noises)


def real(folder: Path, robots: Sequence[int]) -> Iterator[str]:
    """Yield the table of robots."""
    rows = []
    for robot in robots:
        for name, asked in WAYS.items():
            note(f"robot {robot}, {name}")
            began = time.process_time()
            asked = replace(asked, robot=robot)
            rows.append(_told(str(robot), name, solve_input(folder, asked), began))
    yield ""
    yield f"{folder.name}, unknown landmarks, frame of the start; noise guessed, see `recorded.py`,"
    yield "that of the smoother's observations found in the log where nothing else is said."
    yield ""
    header = ("robot", "method", "position rms, m", "aligned, m", "heading rms, deg")
    yield from table((*header, "association wrong, left out", "CPU s"), rows)


def _told(robot: str, name: str, solved: Solved, began: float) -> tuple[str, ...]:
    score, errors = solved.score, solved.errors
    assert score is not None
    return (
        robot,
        name,
        f"{score.position_m:.3f}",
        f"{score.aligned_m:.3f}",
        "none" if score.heading_deg is None else f"{score.heading_deg:.1f}",
        "names known" if errors is None else f"{errors.n_wrong}, {errors.n_left_out} of {errors.n}",
        f"{time.process_time() - began:.1f}",
    )


def victoria(folder: Path) -> Iterator[str]:
    """Yield the table of Victoria Park: as a graph, and its raw log against GPS."""
    rows = []
    for source in (folder / "gtsam_victoria_park.txt", folder):
        for method in ("smoother", "ekf-weighted", *INCREMENTAL):
            if source == folder and method in INCREMENTAL:
                continue
            note(f"{source.name}, {method}")
            began = time.process_time()
            solved = solve_input(source, Asked(method))
            score = solved.score
            rows.append(
                (
                    source.name,
                    method,
                    str(len(solved.problem.time_s)),
                    f"{time.process_time() - began:.1f}",
                    "no truth" if score is None else f"{score.aligned_m:.2f}",
                    "; ".join(solved.answer.notes),
                )
            )
    yield ""
    yield "Victoria Park; of the raw log the rms against GPS after a turn and a shift."
    yield ""
    yield from table(("input", "method", "poses", "CPU s", "aligned, m", "notes"), rows)


def main() -> None:
    """Run and write the page."""
    report = Report(
        __file__,
        "Landmark SLAM",
        __doc__,
        Option("--runs", 4, "simulated runs of each case"),
        Option("--steps", 2000, "of each run"),
        Option("--first-seed", 2000, "of the simulated runs"),
        Option("--robots", [1, 2, 3, 4, 5], "of MRCLAM 6; without data none"),
    )
    arguments = report.args
    lines = [*simulated(arguments.runs, arguments.steps, arguments.first_seed)]
    folder = DATA / "mrclam" / "MRCLAM_Dataset6"
    if folder.is_dir() and arguments.robots:
        lines += real(folder, arguments.robots)
        lines += victoria(DATA / "victoria_park")
    report.write(lines)


if __name__ == "__main__":
    main()
