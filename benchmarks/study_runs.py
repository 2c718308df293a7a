"""One run of a study: simulate a mission, smooth it by every method, compare it with its truth."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, fields
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchmarks.study_cases import Method, case_config
from ssm_graph.data import Array
from ssm_graph.errors import SolverError
from ssm_graph.estimate import Estimate
from ssm_graph.evaluation import evaluate
from ssm_graph.problem.problem import Problem, build_problem
from ssm_graph.simulation import Grade, SimulatedMission, simulate
from ssm_graph.smoothers.batch import SmootherConfig, SsmSmoother

REJECTED_WEIGHT = 0.05
"""A beam with less weight than this is out."""
LARGE_OFFSET = 0.5
"""m/s, 100 sigma: outliers from here on must be rejected."""


class RunKey(NamedTuple):
    """What tells one run of a study from another."""

    case: str
    grade: str
    method: str
    seed: int


@dataclass(frozen=True, slots=True)
class Run:
    """Result of one method on one mission; NaN where there is none."""

    case: str
    grade: str
    method: str
    seed: int
    status: str
    """Name of a :class:`Status`, ``FAILED`` for a SolverError, ``CRASHED`` for anything else."""
    reason: str
    iterations: int = 0
    build_s: float = math.nan
    """Wall time of building the problem, shared by the methods, s."""
    solve_s: float = math.nan
    """Wall time of smoothing, s."""
    n_epochs: int = 0
    rms_horizontal_m: float = math.nan
    end_error_m: float = math.nan
    rms_vertical_m: float = math.nan
    rms_velocity_m_per_s: float = math.nan
    nees_final: float = math.nan
    """Position NEES of the last epoch, divided by 3."""
    nees_mean: float = math.nan
    """Position NEES, divided by 3, mean over epochs."""
    inside_east: float = math.nan
    """Share of epochs with the error within three sigmas."""
    inside_north: float = math.nan
    inside_up: float = math.nan
    n_large_outliers: int = 0
    """Outliers of 0.5 m/s and more that the method got to see."""
    n_large_rejected: int = 0
    """Those of them that ended with a weight below 0.05."""
    good_weight: float = math.nan
    """Mean weight of good beams."""
    good_rejected: float = math.nan
    """Share of good beams with a weight below 0.05."""

    @property
    def key(self) -> RunKey:
        """What tells this run from the others."""
        return RunKey(self.case, self.grade, self.method, self.seed)

    @property
    def has_result(self) -> bool:
        """Whether there is a trajectory at all, whatever it is worth."""
        return math.isfinite(self.rms_horizontal_m)

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON, None instead of NaN."""
        values = {spec.name: getattr(self, spec.name) for spec in fields(self)}
        return {
            name: None if isinstance(value, float) and not math.isfinite(value) else value
            for name, value in values.items()
        }

    @staticmethod
    def from_dict(values: dict[str, Any]) -> Run:
        """Invert :meth:`to_dict`."""
        full: dict[str, Any] = {
            name: math.nan if value is None else value for name, value in values.items()
        }
        return Run(**full)


@dataclass(frozen=True, slots=True)
class Job:
    """A mission and the methods to try on it: they share its simulation."""

    case: str
    grade: Grade
    seed: int
    methods: tuple[Method, ...]
    duration_s: float


def do_job(job: Job) -> list[Run]:
    """Run one job; a method that fails is a result as well."""
    config = case_config(job.case, job.grade, seed=job.seed, duration_s=job.duration_s)
    sim = simulate(config)
    problems: dict[bool, tuple[Problem, float]] = {}
    runs = []
    for method in job.methods:
        key = RunKey(job.case, job.grade.name, method.name, job.seed)
        try:
            if method.is_oracle not in problems:
                problems[method.is_oracle] = _timed_problem(sim, method)
            problem, build_s = problems[method.is_oracle]
            settings = SmootherConfig(kernel=method.kernel, similarity=method.similarity)
            runs.append(compare(key, sim, SsmSmoother(settings).solve(problem), build_s=build_s))
        except SolverError as error:
            runs.append(Run(*key, status="FAILED", reason=str(error)))
        except Exception as error:  # a defect of ours must not end a study of hours, nor be lost
            runs.append(Run(*key, status="CRASHED", reason=f"{type(error).__name__}: {error}"))
    return runs


def _timed_problem(sim: SimulatedMission, method: Method) -> tuple[Problem, float]:
    begin = time.perf_counter()
    problem = build_problem(sim.without_outliers() if method.is_oracle else sim.mission)
    return problem, time.perf_counter() - begin


def compare(key: RunKey, sim: SimulatedMission, estimate: Estimate, *, build_s: float) -> Run:
    """Compare an estimate with the truth at its own keyframes, and its weights with the faults."""
    trajectory = estimate.trajectory
    metrics = evaluate(trajectory, sim.truth_at(trajectory.time_s))
    offset, is_outlier = beam_truth(sim, estimate)
    is_large = is_outlier & (np.abs(offset) >= LARGE_OFFSET)
    rejected = estimate.beams.weight < REJECTED_WEIGHT
    good = ~is_outlier
    return Run(
        *key,
        status=estimate.status.name,
        reason=estimate.reason,
        iterations=len(estimate.iterations),
        build_s=build_s,
        solve_s=estimate.wall_s,
        n_epochs=metrics.n_epochs,
        rms_horizontal_m=metrics.rmse_horizontal_m,
        end_error_m=metrics.end_error_m,
        rms_vertical_m=metrics.rmse_vertical_m,
        rms_velocity_m_per_s=metrics.rmse_velocity_m_per_s,
        nees_final=float(metrics.errors.nees_position[-1]) / 3.0,
        nees_mean=metrics.nees_position,
        inside_east=metrics.inside_3_sigma[0],
        inside_north=metrics.inside_3_sigma[1],
        inside_up=metrics.inside_3_sigma[2],
        n_large_outliers=int(is_large.sum()),
        n_large_rejected=int((is_large & rejected).sum()),
        good_weight=float(estimate.beams.weight[good].mean()) if good.any() else math.nan,
        good_rejected=float(rejected[good].mean()) if good.any() else math.nan,
    )


def beam_truth(sim: SimulatedMission, estimate: Estimate) -> tuple[Array, NDArray[np.bool_]]:
    """Return offset (m/s) and outlier flag (M,) of every row of the estimate's beam table."""
    middle = 0.5 * (sim.ping_time_s[:-1] + sim.ping_time_s[1:])
    ping = np.searchsorted(middle, estimate.beams.time_s)
    beam = estimate.beams.beam.astype(np.intp) - 1
    return sim.beam_offset[ping, beam], sim.is_outlier[ping, beam]
