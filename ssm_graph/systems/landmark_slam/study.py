"""The study of the paper, in every reading of its noise: many runs, in batches, resumable.

A trial is a batch of runs of one case by one method. Errors are those of the pose at every step and
of the landmarks seen so far; runs are drawn from their seeds alone, paired over methods and cases.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from factors.bearing_range import half_turn
from factors.similarity import GaussianKernel
from ssm_graph.base import chi2
from ssm_graph.base.errors import ConfigError
from ssm_graph.base.frozen import Array
from ssm_graph.base.units import DEGREE
from ssm_graph.study.ledger import Key, Row
from ssm_graph.systems.landmark_slam.filtered import first_values
from ssm_graph.systems.landmark_slam.filters import MapFilter
from ssm_graph.systems.landmark_slam.graphs import graph_of_problem
from ssm_graph.systems.landmark_slam.incremental import (
    LAG_S,
    IncrementalSettings,
    smooth_incrementally,
)
from ssm_graph.systems.landmark_slam.methods import FILTERS, INCREMENTAL, SMOOTHERS, check_method
from ssm_graph.systems.landmark_slam.models import Bicycle
from ssm_graph.systems.landmark_slam.noise import estimate_noise
from ssm_graph.systems.landmark_slam.problem import SlamNoise, SlamProblem
from ssm_graph.systems.landmark_slam.simulator import (
    CASES,
    NoiseCase,
    Path,
    Runs,
    Sigmas,
    World,
    make_path,
    simulate,
    true_sigmas,
)
from ssm_graph.systems.landmark_slam.smoother import SmootherSettings, smooth_landmarks

STUDY_CASES: Final = ("stated", "G1", "U1", "E1", "A1", "R3", "Q3")
BATCH: Final = 25
"""Runs that go through a filter together."""
FIRST: Final = "ekf-weighted"
"""Filter at whose answer a smoother begins."""
CURVE_POINTS: Final = 200
FIRST_SEED: Final = 1000
"""Of those reported; settings were chosen on seeds below 100."""
NEES_BAND: Final = tuple(float(x) for x in chi2.ppf([0.025, 0.975], 3) / 3.0)
"""Of NEES / 3 of a pose, 95 %."""


@dataclass(frozen=True, slots=True)
class StudyPlan:
    """What is run."""

    cases: tuple[str, ...] = STUDY_CASES
    methods: tuple[str, ...] = ()
    n_runs: int = 50
    n_steps: int = 2000
    first_seed: int = FIRST_SEED

    def __post_init__(self) -> None:
        for name in self.methods:
            check_method(name)
        unknown = [name for name in self.cases if name not in CASES]
        if unknown:
            raise ConfigError(f"cases: got {unknown[0]!r}; known are {', '.join(CASES)}")
        if self.n_runs < 1:
            raise ConfigError(f"runs: expected 1 or more, got {self.n_runs}; try 50")

    def keys(self) -> list[Key]:
        """Return the trials."""
        end = self.first_seed + self.n_runs
        return [
            (case, method, first, min(BATCH, end - first), self.n_steps)
            for first in range(self.first_seed, end, BATCH)
            for case in self.cases
            for method in self.methods
        ]


class Scores(NamedTuple):
    """Of a batch: each (B,) but for the curves."""

    position_m: Array
    """Root mean square over the run."""
    heading_deg: Array
    landmark_m: Array
    """Mean distance at the end."""
    nees: Array
    """Mean of NEES / 3 of the pose."""
    nees_out: Array
    """Share of steps whose NEES / 3 lies outside its 95 % band."""
    nis: Array
    """Mean of NIS a row."""
    curves: Array
    """(3, P) mean over the runs of position [m], heading [deg], landmark error [m]"""
    n_repaired: int
    noise: Array
    """(B, 4) sigma at the end in true ones: distance, steering, range, bearing."""


@lru_cache(maxsize=2)
def path_of(n_steps: int) -> Path:
    """Return the path of the study."""
    return make_path(World(n_steps=n_steps))


def curve_steps(n_steps: int) -> NDArray[np.intp]:
    """Return the steps at which curves have points."""
    return np.unique(np.linspace(0, n_steps - 1, min(CURVE_POINTS, n_steps)).astype(np.intp))


def run_batch(key: Key) -> Row:
    """Do a trial: (case, method, first seed, runs, steps)."""
    case, method, first, count, n_steps = (
        str(key[0]),
        str(key[1]),
        int(key[2]),
        int(key[3]),
        int(key[4]),
    )
    path = path_of(n_steps)
    seeds = range(first, first + count)
    runs = simulate(path, Sigmas(), CASES[case], seeds, reach_m=World().most_range_m)
    began = time.process_time()
    if method in SMOOTHERS:
        scores = smoothed_scores(path, runs, CASES[case], method)
    else:
        scores = filtered_scores(path, runs, CASES[case], method)
    row: dict[str, Any] = {
        name: np.asarray(value).tolist() for name, value in scores._asdict().items()
    }
    return {**row, "cpu_s": time.process_time() - began}


def filtered_scores(path: Path, runs: Runs, case: NoiseCase, method: str) -> Scores:
    """Run a filter over a batch."""
    chosen, count = FILTERS[method], runs.control.shape[1]
    sigmas = true_sigmas(Sigmas(), case) if chosen.is_told else Sigmas()
    start = np.repeat(path.pose[:1], count, axis=0)
    slam = chosen.begin(
        Bicycle(World().wheel_base_m),
        sigmas.control,
        sigmas.observation,
        start,
        capacity=len(path.landmarks),
        start_cov=1e-12 * np.eye(3),
    )
    n_steps = len(path.control)
    poses, covs = np.empty((n_steps, count, 3)), np.empty((n_steps, count, 3, 3))
    at_curve, map_error = set(curve_steps(n_steps).tolist()), []
    seen: list[int] = []
    nis, dof = np.zeros(count), np.zeros(count)
    for k in range(n_steps):
        slam.predict(runs.control[k])
        view = path.in_view[k].tolist()
        if view:
            found = slam.update(view, runs.observed[k])
            nis, dof = nis + found.nis, dof + found.dof
            seen += [i for i in view if i not in seen]
        poses[k], covs[k] = slam.pose, slam.pose_cov
        if k in at_curve:
            map_error.append(_map_error(slam, seen, path, count))
    noise = slam.noise
    ends = [np.sqrt(np.einsum("bii->bi", x)) for x in (noise.control, noise.observation)]
    truth = true_sigmas(Sigmas(), case)
    relative = np.hstack(ends) / np.concatenate([truth.control, truth.observation])
    error = _pose_error(poses, path)
    return _scores(
        error, covs, np.array(map_error), nis / np.maximum(dof, 1.0), slam.n_repaired, relative
    )


def _map_error(slam: Any, seen: Sequence[int], path: Path, count: int) -> Array:
    if not seen:
        return np.zeros(count)
    if isinstance(slam, MapFilter):
        places = slam.landmarks()
        off = places - path.landmarks[list(slam.ids)]
    else:
        off = np.stack([slam.landmark(i)[0] - path.landmarks[i] for i in seen], axis=1)
    return np.asarray(np.linalg.norm(off, axis=-1).mean(axis=1))


def _pose_error(poses: Array, path: Path) -> Array:
    error = poses - path.pose[1:, None]
    error[..., 2] = half_turn(error[..., 2])
    return error


def _scores(
    error: Array, covs: Array, map_error: Array, nis: Array, n_repaired: int, noise: Array
) -> Scores:
    """Return scores of errors (K, B, 3), covariances (K, B, 3, 3), map errors (P, B)."""
    distance = np.linalg.norm(error[..., :2], axis=-1)
    turn = np.abs(error[..., 2]) / DEGREE
    nees = np.einsum("kbi,kbi->kb", error, np.linalg.solve(covs, error[..., None])[..., 0]) / 3.0
    at = curve_steps(len(error))
    low, high = NEES_BAND
    return Scores(
        np.sqrt(np.mean(distance**2, axis=0)),
        np.sqrt(np.mean(turn**2, axis=0)),
        map_error[-1],
        nees.mean(axis=0),
        np.mean((nees < low) | (nees > high), axis=0),
        nis,
        np.stack([distance[at].mean(axis=1), turn[at].mean(axis=1), map_error.mean(axis=1)]),
        n_repaired,
        noise,
    )


def problem_of_run(path: Path, runs: Runs, run: int) -> tuple[SlamProblem, NDArray[np.intp]]:
    """Return a run as a log, and which landmark of the map each of its own is."""
    keyframe = np.repeat(np.arange(1, len(path.control) + 1), [len(v) for v in path.in_view])
    ids, landmark = np.unique(np.concatenate(path.in_view), return_inverse=True)
    problem = SlamProblem(
        np.asarray(np.arange(len(path.pose)) * World().step_s, dtype=np.float64),
        Bicycle(World().wheel_base_m),
        runs.control[:, run],
        keyframe,
        landmark,
        np.concatenate([z[run] for z in runs.observed]),
        tuple(str(i) for i in ids),
        path.pose[0].copy(),
        np.full(3, 1e-6),
    )
    return problem, ids


def smoothed_scores(path: Path, runs: Runs, case: NoiseCase, method: str) -> Scores:
    """Smooth each run of a batch."""
    count, truth = runs.control.shape[1], true_sigmas(Sigmas(), case)
    errors, covs, maps, noises = [], [], [], []
    for b in range(count):
        problem, ids = problem_of_run(path, runs, b)
        told = truth if method == "smoother-oracle" else Sigmas()
        noise = SlamNoise(told.control, told.observation)
        if method == "smoother-oracle":
            gross = np.concatenate([mark[b] for mark in runs.is_gross])
            problem = problem.associated(np.where(gross, -1, problem.landmark), problem.names)
            settings = SmootherSettings(GaussianKernel())
            answer = smooth_landmarks(problem, noise, first_values(problem, noise), settings)
        elif method == "smoother-em":
            answer = estimate_noise(problem, noise, first_values(problem, noise)).estimate
        elif method in INCREMENTAL:
            lag_s = LAG_S if method == "fixed-lag" else None
            graph, how = graph_of_problem(problem, noise), IncrementalSettings(lag_s=lag_s)
            answer = smooth_incrementally(graph, how).estimate
        else:
            answer = smooth_landmarks(problem, noise, first_values(problem, noise))
        errors.append(_pose_error(answer.pose[1:, None], path))
        covs.append(answer.pose_cov[1:, None])
        maps.append(np.linalg.norm(answer.landmarks - path.landmarks[ids], axis=1).mean())
        used = np.concatenate([answer.noise.control, answer.noise.observation])
        noises.append(used / np.concatenate([truth.control, truth.observation]))
    n_points = len(curve_steps(len(path.control)))
    return _scores(
        np.concatenate(errors, axis=1),
        np.concatenate(covs, axis=1),
        np.tile(np.array(maps), (n_points, 1)),
        np.zeros(count),  # a smoother has no innovations
        0,
        np.array(noises),
    )


class Cell(NamedTuple):
    """All runs of a case by a method, in the order of their seeds."""

    scores: Mapping[str, Array]
    curves: Array
    n_repaired: int
    cpu_s: float


def cells_of(plan: StudyPlan, rows: Mapping[Key, Row]) -> dict[tuple[str, str], Cell]:
    """Return the batches of a study put together; a batch that failed leaves its cell out."""
    cells: dict[tuple[str, str], Cell] = {}
    names = [n for n in Scores._fields if n not in ("curves", "n_repaired")]
    for case in plan.cases:
        for method in plan.methods:
            own = [row for key, row in rows.items() if key[:2] == (case, method)]
            if not own or any("error" in row for row in own):
                continue
            counts = [len(row["nees"]) for row in own]
            scores = {n: np.concatenate([np.asarray(row[n], float) for row in own]) for n in names}
            curves = np.average([row["curves"] for row in own], axis=0, weights=counts)
            cells[case, method] = Cell(
                scores,
                np.asarray(curves),
                sum(int(row["n_repaired"]) for row in own),
                sum(float(row["cpu_s"]) for row in own),
            )
    return cells
