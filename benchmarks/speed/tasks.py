"""What is timed: our smoother, the script that a GTSAM user would write, and the native floor.

Every task runs in a fresh process of its own, reads the mission from a file, and returns its times
with the peak memory of that process.
"""

from __future__ import annotations

import itertools
import pickle
import resource
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, V, X

import ssm_graph.smoothers.batch as batch
from benchmarks.missions import survey
from benchmarks.report import rms
from factors.dvl_beam import dvl_beam_factor
from factors.similarity import LogKernel
from ssm_graph.base.earth import LocalFrame
from ssm_graph.base.frozen import Array
from ssm_graph.base.stepwise import Steps
from ssm_graph.engine.chain import Chain
from ssm_graph.engine.states import States
from ssm_graph.graph.first_values import first_values
from ssm_graph.graph.gtsam_graph import (
    chain_ordering,
    graph_without_beams,
    gtsam_values,
    prior_graph,
)
from ssm_graph.graph.linearize import GraphLinearizer
from ssm_graph.mission.mission import Mission
from ssm_graph.mission.problem import Beams, Problem, build_problem, initial_moments
from ssm_graph.sensors.imu import ImuNoise
from ssm_graph.simulation import Grade

CAUCHY = gtsam.noiseModel.mEstimator.Cauchy.Create(2.3849)
"""With the usual constant: 95 % efficiency without outliers."""


def plain_graph(mission: Mission, problem: Problem) -> gtsam.NonlinearFactorGraph:
    """Return the graph: default preintegration of the raw samples, robust beams, depth, prior.

    Gravity is that of the origin throughout, samples are not merged, nothing is compensated.
    """
    graph = prior_graph(problem)
    _add_inertial(graph, mission, problem.keyframe_s)
    beams, omega_ie_n = problem.beams, problem.frame.omega_ie_n
    add_beams(graph, beams, beams.keyframe.tolist(), omega_ie_n=omega_ie_n)
    _add_depth(graph, mission, problem.keyframe_s)
    return graph


def dead_reckoned(graph: gtsam.NonlinearFactorGraph, problem: Problem) -> gtsam.Values:
    """Return first values by the inertial prediction alone, from the initial state."""
    start = initial_moments(problem.start, problem.frame, bias_sigma=problem.imu_noise_bias_sigma)
    state = gtsam.NavState(gtsam.Pose3(gtsam.Rot3(start.R_nb), start.p_n), start.v_n)
    bias = gtsam.imuBias.ConstantBias()
    states = [state]
    for i in range(graph.size()):
        factor = graph.at(i)
        if isinstance(factor, gtsam.CombinedImuFactor):
            states.append(factor.preintegratedMeasurements().predict(states[-1], bias))
    values = gtsam.Values()
    for k, state in enumerate(states):
        values.insert(X(k), state.pose())
        values.insert(V(k), state.velocity())
        values.insert(B(k), bias)
    return values


def _params(noise: ImuNoise, frame: LocalFrame) -> gtsam.PreintegrationCombinedParams:
    params = gtsam.PreintegrationCombinedParams(frame.g_n_at(np.zeros(3)))
    params.setOmegaCoriolis(frame.omega_ie_n)
    eye = np.eye(3)
    params.setGyroscopeCovariance(noise.gyro_density**2 * eye)
    params.setAccelerometerCovariance(noise.accel_density**2 * eye)
    params.setIntegrationCovariance(1e-10 * eye)
    params.setBiasOmegaCovariance(noise.gyro_bias_density**2 * eye)
    params.setBiasAccCovariance(noise.accel_bias_density**2 * eye)
    return params


def _add_inertial(graph: gtsam.NonlinearFactorGraph, mission: Mission, keyframe_s: Array) -> None:
    imu = mission.imu
    params = _params(imu.noise, mission.frame)
    dt = np.diff(imu.time_s, prepend=imu.start_s).tolist()
    # The pings of this benchmark fall on the end of an inertial sample: nothing to cut.
    first = np.searchsorted(imu.time_s, keyframe_s + 1e-6).tolist()
    for k, (begin, end) in enumerate(itertools.pairwise(first)):
        measured = gtsam.PreintegratedCombinedMeasurements(params, gtsam.imuBias.ConstantBias())
        for i in range(begin, end):
            measured.integrateMeasurement(imu.accel_b[i], imu.gyro_b[i], dt[i])
        graph.add(gtsam.CombinedImuFactor(X(k), V(k), X(k + 1), V(k + 1), B(k), B(k + 1), measured))


def add_beams(
    graph: gtsam.NonlinearFactorGraph,
    beams: Beams,
    keyframes: Iterable[int],
    *,
    omega_ie_n: Array,
) -> None:
    """Add a robust factor for every beam of a problem, or of one of its keyframes."""
    for i, k in enumerate(keyframes):
        factor = dvl_beam_factor(
            *(X(k), V(k), B(k)),
            sigma=float(beams.sigma[i]),
            speed=float(beams.speed[i]),
            gyro_b=beams.gyro_b[i],
            beam_b=beams.beam_b[i],
            lever_arm_b=beams.lever_arm_b,
            omega_ie_n=omega_ie_n,
            loss=CAUCHY,
        )
        graph.add(factor)


def _add_depth(graph: gtsam.NonlinearFactorGraph, mission: Mission, keyframe_s: Array) -> None:
    log = mission.depth
    if log is None:
        return
    noise = gtsam.noiseModel.Diagonal.Precisions(np.array([0.0, 0.0, log.sigma**-2]))
    for k, time_s in enumerate(keyframe_s[1:].tolist(), start=1):
        i = min(int(np.searchsorted(log.time_s, time_s - 1e-6)), len(log.time_s) - 1)
        target_n = np.array([0.0, 0.0, -log.depth[i] - mission.frame.height])
        graph.add(gtsam.GPSFactorArm(X(k), target_n, log.lever_arm_b, noise))


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

    The tolerance is relative and absolute, of the cost; None for GTSAM's own, 1e-5.
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
