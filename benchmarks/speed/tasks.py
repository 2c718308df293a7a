"""What is timed: our smoother, the script that a GTSAM user would write, and the native floor.

Every task runs in a fresh process of its own, reads the mission from a file, and returns its times
with the peak memory of that process.
"""

from __future__ import annotations

import pickle
import resource
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
from gtsam.symbol_shorthand import V, X

import ssm_graph.smoothers.batch as batch
from benchmarks.missions import survey
from benchmarks.report import rms
from benchmarks.speed.plain import dead_reckoned, plain_graph
from factors.similarity import LogKernel
from ssm_graph.base.frozen import Array
from ssm_graph.base.stepwise import Steps
from ssm_graph.engine.chain import Chain
from ssm_graph.engine.states import States
from ssm_graph.graph.first_values import first_values
from ssm_graph.graph.gtsam_graph import chain_ordering, graph_without_beams, gtsam_values
from ssm_graph.graph.linearize import GraphLinearizer
from ssm_graph.mission.mission import Mission
from ssm_graph.mission.problem import Problem, build_problem
from ssm_graph.simulation import Grade


class PlainStart(Enum):
    """Where the plain GTSAM script starts."""

    FIRST_PASS = "the first values of our smoother, as a gift"
    DEAD_RECKONING = "the inertial prediction alone, which is what its user has"


@dataclass(slots=True)
class Timing:
    """Result of one task."""

    parts: dict[str, float] = field(default_factory=dict)
    """Wall time of each part, s."""
    n_keyframes: int = 0
    n_iterations: int = 0
    status: str = ""
    rms_horizontal_m: float = float("nan")
    idle_mb: float = 0.0
    """Peak memory with the mission in memory, before any work."""
    peak_mb: float = 0.0

    @property
    def total(self) -> float:
        """Sum of the parts, s."""
        return sum(self.parts.values())

    @contextmanager
    def part(self, name: str) -> Iterator[None]:
        """Add the wall time of a block."""
        begin = time.perf_counter()
        try:
            yield
        finally:
            elapsed = time.perf_counter() - begin
            self.parts[name] = self.parts.get(name, 0.0) + elapsed


def write_mission(path: Path, minutes: float, seed: int) -> None:
    """Simulate the mission of the benchmark: navigation grade, 10 % of the pings with an outlier.

    Written to a file, so that the simulator's memory is not taken for the smoother's.
    """
    mission = survey(60.0 * minutes, Grade.NAVIGATION, seed=seed).mission
    path.write_bytes(pickle.dumps(mission))


def time_ours(path: Path) -> Timing:
    """Time our smoother with the default kernel, part by part."""
    mission, timing = _begin(path)
    with timing.part("build: merge and preintegrate"):
        problem = build_problem(mission)
    parts: dict[str, float] = {}
    begin = time.perf_counter()
    with _timed_calls(parts):
        estimate = batch.SsmSmoother().solve(problem)
    elapsed = time.perf_counter() - begin
    timing.parts |= parts
    timing.parts["everything else"] = elapsed - sum(parts.values())
    timing.n_iterations = len(estimate.iterations)
    timing.status = estimate.status.name
    tr = estimate.trajectory
    p_n = problem.frame.p_n_from_geodetic(tr.lat, tr.lon, tr.height)
    return _end(timing, problem, mission, p_n)


@contextmanager
def _timed_calls(parts: dict[str, float]) -> Iterator[None]:
    """Put a clock on the steps of the loop while the block runs; they do not call each other."""
    steps: tuple[tuple[Any, str, str], ...] = (
        (batch, "first_values_steps", "first pass"),
        (GraphLinearizer, "follow", "linearise: depth targets"),
        (GraphLinearizer, "beam_rows", "linearise: beams"),
        (GraphLinearizer, "inertial_rows", "linearise: inertial data"),
        (Chain, "eliminate_steps", "eliminate by QR"),
        (Chain, "solve_steps", "solve, marginals"),
        (GraphLinearizer, "cost", "cost"),
        (States, "moved", "retract"),
        (batch, "trajectory_from_states", "result"),
    )
    originals = [(owner, name, getattr(owner, name)) for owner, name, _ in steps]
    for (owner, name, original), (_, _, label) in zip(originals, steps, strict=True):
        setattr(owner, name, _with_clock(original, parts, label))
    try:
        yield
    finally:
        for owner, name, original in originals:
            setattr(owner, name, original)


def _with_clock(
    function: Callable[..., Any], parts: dict[str, float], label: str
) -> Callable[..., Any]:
    def timed(*args: Any, **kwargs: Any) -> Any:
        begin = time.perf_counter()
        result = function(*args, **kwargs)
        parts[label] = parts.get(label, 0.0) + time.perf_counter() - begin
        return result

    def timed_steps(*args: Any, **kwargs: Any) -> Steps[Any]:
        begin = time.perf_counter()
        result = yield from function(*args, **kwargs)
        parts[label] = parts.get(label, 0.0) + time.perf_counter() - begin
        return result

    return timed_steps if function.__name__.endswith("_steps") else timed


def time_plain(
    path: Path, start: PlainStart = PlainStart.FIRST_PASS, tolerance: float | None = None
) -> Timing:
    """Time the plain GTSAM script; where it starts is given to it for nothing.

    Parameters
    ----------
    path : file of the mission.
    start : first values.
    tolerance : relative and absolute, of the cost; None for GTSAM's own, 1e-5.
    """
    mission, timing = _begin(path)
    problem = build_problem(mission)
    with timing.part("preintegrate and build"):
        graph = plain_graph(mission, problem)
    if start is PlainStart.FIRST_PASS:
        initial = gtsam_values(first_values(problem, kernel=LogKernel()).states)
    else:
        initial = dead_reckoned(graph, problem)
    params = gtsam.LevenbergMarquardtParams()
    params.setLinearSolverType("MULTIFRONTAL_QR")
    if tolerance is not None:
        params.setRelativeErrorTol(tolerance)
        params.setAbsoluteErrorTol(tolerance)
    with timing.part("optimise"):
        optimizer = gtsam.LevenbergMarquardtOptimizer(graph, initial, params)
        values = optimizer.optimize()
    timing.n_iterations = optimizer.iterations()
    timing.status = f"error {graph.error(initial):.4g} to {graph.error(values):.4g}"
    p_n = gtsam.utilities.extractPose3(values)[:, 9:]
    return _end(timing, problem, mission, p_n)


def time_floor(path: Path, n_passes: int) -> Timing:
    """Time as many native passes as ours took, with built-in factors in place of the beams.

    A range between the pose and the "point" of the velocity vector is one row on pose and velocity,
    as a beam is: its cost is that of a beam written in C++, its meaning none. Nothing is updated.
    """
    mission, timing = _begin(path)
    with timing.part("build: merge and preintegrate"):
        problem = build_problem(mission)
    states = first_values(problem, kernel=LogKernel()).states
    graph, ordering = graph_without_beams(problem, states), chain_ordering(problem.n_keyframes)
    beams = problem.beams
    distance = np.linalg.norm(states.v_n - states.p_n, axis=1)
    for k, sigma in zip(beams.keyframe.tolist(), beams.sigma.tolist(), strict=True):
        noise = gtsam.noiseModel.Isotropic.Sigma(1, sigma)
        graph.add(gtsam.RangeFactor3D(X(k), V(k), float(distance[k]), noise))
    for _ in range(n_passes):
        with timing.part("linearise"):
            linear = graph.linearize(gtsam_values(states))
        with timing.part("eliminate by QR and solve"):
            delta = linear.eliminateMultifrontal(ordering, gtsam.EliminateQR).optimize()
    timing.n_iterations = n_passes
    timing.status = "finite" if np.all(np.isfinite(delta.vector())) else "not finite"
    return _end(timing, problem, mission, None)


def _begin(path: Path) -> tuple[Mission, Timing]:
    mission: Mission = pickle.loads(path.read_bytes())
    return mission, Timing(idle_mb=_peak_mb())


def _end(timing: Timing, problem: Problem, mission: Mission, p_n: Array | None) -> Timing:
    timing.n_keyframes = problem.n_keyframes
    timing.peak_mb = _peak_mb()
    reference = mission.reference
    if p_n is not None and reference is not None:
        true_n = problem.frame.p_n_from_geodetic(reference.lat, reference.lon, reference.height)
        # Keyframes are at whole seconds, where the reference has a sample.
        at = np.searchsorted(reference.time_s, problem.keyframe_s - 1e-6)
        error = p_n - true_n[at]
        timing.rms_horizontal_m = rms(np.linalg.norm(error[:, :2], axis=1))
    return timing


def _peak_mb() -> float:
    # Linux counts in kB. A process begins with the size that its parent had: keep that one small.
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
