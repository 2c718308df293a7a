"""Landmark SLAM: smoother and noise on simulated runs, real logs against their truth.

A page for each part: `online` is of what goes pose by pose, on MRCLAM.
"""

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
from ssm_graph.systems.landmark_slam.filtered import filtered
from ssm_graph.systems.landmark_slam.methods import INCREMENTAL
from ssm_graph.systems.landmark_slam.problem import SlamNoise, SlamProblem
from ssm_graph.systems.landmark_slam.smoother import Values, smooth_landmarks
from ssm_graph.systems.landmark_slam.solve import Asked, Solved, solve_input
from ssm_graph.systems.landmark_slam.study import Scores, run_batch

CASES = ("stated", "R3", "Q3", "gross10", "gross30")
METHODS = ("smoother", "smoother-em", "smoother-oracle")
SIGMAS = ("distance", "steering", "range", "bearing")
WAYS = {
    "mrclam": {
        "smoother": Asked(),
        "smoother, landmarks without names": Asked(association=Association.JOINT),
        "smoother, noise as guessed": Asked(learns_observations=False),
        "on-line filter, similarity weights": Asked("ekf-weighted"),
        "literal noise-adaptive filter": Asked("naukf"),
    },
    "online": {
        "isam2, nothing dropped": Asked("isam2"),
        "fixed lag of 60 s": Asked("fixed-lag", lag_s=60.0),
    },
}
PARTS = ("simulated", *WAYS, "victoria")
NEWEST = 10
"""Times, evenly spread, at which the newest pose is looked at: each is a solution of its own."""
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


def real(robots: Sequence[tuple[int, int]], ways: dict[str, Asked]) -> Iterator[str]:
    """Yield the table of robots, each (number of the set, its own), and what sums it up."""
    rows, scores = [], []
    for number, robot in robots:
        for name, asked in ways.items():
            began = time.process_time()
            solved = solve_input(_mrclam(number), replace(asked, robot=robot))
            rows.append(_told(f"{number}-{robot}", name, solved, began))
            note(" | ".join(rows[-1]))
            assert solved.score is not None
            scores.append((name, solved.score.position_m, solved.score.aligned_m))
    yield "MRCLAM, set and robot; unknown landmarks, frame of the start; noise guessed, see"
    yield "`recorded.py`, that of the smoother's observations from the log where no more is said."
    yield ""
    header = ("robot", "method", "position rms, m", "aligned, m", "heading rms, deg")
    yield from table((*header, "association wrong, left out", "status", "CPU s"), rows)
    yield ""
    sums = []
    for name in ways:
        own = np.array([score[1:] for score in scores if score[0] == name])
        middle, worst = np.median(own, axis=0), own.max(axis=0)
        over = own[:, 1] / [score[2] for score in scores if score[0] == next(iter(ways))]
        numbers = (middle[0], worst[0], middle[1], worst[1], np.median(over), over.max())
        sums.append((name, *(f"{x:.3f}" for x in numbers)))
    of_position = ("position: median of robots", "worst")
    of_aligned = ("aligned: median", "worst", f"aligned, over {next(iter(ways))}: median", "worst")
    yield from table(("method", *of_position, *of_aligned), sums)


def _mrclam(number: int) -> Path:
    return DATA / "mrclam" / f"MRCLAM_Dataset{number}"


def newest(robots: Sequence[tuple[int, int]]) -> Iterator[str]:
    """Yield the table of what the newest pose is worth, whoever finds it."""
    rows = []
    for number, robot in robots:
        note(f"robot {number}-{robot}, newest pose")
        folder = _mrclam(number)
        whole = solve_input(folder, Asked(robot=robot))
        problem, noise = whole.problem, whole.answer.noise
        at = np.linspace(0, len(problem.time_s) - 1, NEWEST + 1).astype(int)[1:]
        at = at[np.isfinite(whole.truth[at, 0])]
        begin = Values(whole.answer.pose, whole.answer.landmarks, whole.answer.drift)
        until = [_until(problem, noise, begin, int(k)) for k in at]
        learnt = filtered(problem, noise, "ekf-weighted").pose[at]
        guessed = solve_input(folder, Asked("ekf-weighted", robot=robot)).answer.pose[at]
        errors = [
            float(np.sqrt(np.mean(np.sum((pose - whole.truth[at])[:, :2] ** 2, axis=1))))
            for pose in (whole.answer.pose[at], np.array(until), learnt, guessed)
        ]
        rows.append((f"{number}-{robot}", str(len(at)), *(f"{error:.3f}" for error in errors)))
    yield ""
    yield f"The newest pose at {NEWEST} times: rms in the frame of the start, m. The"
    yield "batch has all that was seen until then, and the noise that the whole log tells."
    yield ""
    header = ("robot", "times", "smoother of the whole log", "batch until then")
    yield from table((*header, "filter, the same noise", "filter, noise guessed"), rows)


def _until(problem: SlamProblem, noise: SlamNoise, begin: Values, k: int) -> Array:
    """Return pose k (3,) by all that was seen until then."""
    seen = int(np.searchsorted(problem.keyframe, k, side="right"))
    names, landmark = np.unique(problem.landmark[:seen], return_inverse=True)
    cut = replace(
        problem,
        time_s=problem.time_s[: k + 1],
        control=problem.control[:k],
        keyframe=problem.keyframe[:seen],
        landmark=landmark,
        measured=problem.measured[:seen],
        names=tuple(problem.names[i] for i in names),
        observation_scale=problem.scales[:seen],
    )
    first = Values(begin.pose[: k + 1], begin.landmarks[names], begin.drift)
    return np.asarray(smooth_landmarks(cut, noise, first).pose[-1])


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
        solved.answer.status.name,
        f"{time.process_time() - began:.1f}",
    )


def victoria(folder: Path) -> Iterator[str]:
    """Yield the table of Victoria Park: as a graph, and its raw log against GPS."""
    rows = []
    for source in (folder / "gtsam_victoria_park.txt", folder):
        for method in ("smoother", "ekf-weighted", *INCREMENTAL):
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
        Option("--robots", [1, 2, 3, 4, 5], "of MRCLAM 6"),
        Option("--robots-of-7", [4, 5], "of MRCLAM 7"),
        Option("--parts", list(PARTS), "a page each; real logs where the data are there", PARTS),
    )
    asked = report.args
    robots = [(6, robot) for robot in asked.robots] + [(7, robot) for robot in asked.robots_of_7]
    robots = [one for one in robots if _mrclam(one[0]).is_dir()]
    for part in asked.parts:
        if part == "simulated":
            lines = [*simulated(asked.runs, asked.steps, asked.first_seed)]
        elif part in WAYS and robots:
            lines = [*real(robots, WAYS[part]), *(newest(robots) if part == "online" else ())]
        elif part == "victoria" and (DATA / "victoria_park").is_dir():
            lines = [*victoria(DATA / "victoria_park")]
        else:
            continue
        report.write(lines, part=part, of=part)


if __name__ == "__main__":
    main()
