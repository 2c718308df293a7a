"""GTSAM's own fixed-lag smoothers on the keyframes of the live estimator."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from enum import Enum
from typing import NamedTuple

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, V, X

from benchmarks.speed.tasks import add_beams
from ssm_graph.base.frozen import Array
from ssm_graph.engine.states import States
from ssm_graph.graph.aids.depth import DepthMeans
from ssm_graph.graph.gtsam_graph import prior_graph
from ssm_graph.graph.inertial_rows import InertialRows
from ssm_graph.imu.preintegration import InertialChain, Preintegrated, gravity_between
from ssm_graph.io.mission_folder.vehicle import vehicle_of
from ssm_graph.io.raw_log.rows import messages_of
from ssm_graph.live.estimator.buffers import Buffers
from ssm_graph.live.estimator.keyframes import KeyframeMaker
from ssm_graph.live.estimator.start import sensors_of_vehicle
from ssm_graph.mission.answer import trajectory_at
from ssm_graph.mission.estimate import Trajectory
from ssm_graph.mission.mission import Mission
from ssm_graph.mission.problem import NO_EXTRAS, ProblemConfig, build_problem, start_of
from ssm_graph.smoothers.keyframe import Keyframe, Sensors
from ssm_graph.smoothers.window_aids import row_states


class Kind(Enum):
    """Which of GTSAM's smoothers."""

    INCREMENTAL = "IncrementalFixedLagSmoother"
    BATCH = "BatchFixedLagSmoother"


@dataclass(frozen=True, slots=True)
class TheirConfig:
    """Settings of GTSAM's smoothers; QR throughout."""

    kind: Kind = Kind.INCREMENTAL
    lag_s: float = 30.0
    relinearize_threshold: float = 0.1
    """Of the incremental smoother, as the next three; 0.1 is GTSAM's default"""
    relinearize_skip: int = 10
    """GTSAM's default"""
    extra_updates: int = 0
    """Further updates without factors at each keyframe, as GTSAM's users do to settle"""
    wildfire: float = 0.001
    max_iterations: int = 100
    """Of the batch smoother's Levenberg-Marquardt"""
    reads_covariance: bool = True

    def __str__(self) -> str:
        if self.kind is Kind.BATCH:
            return f"{self.kind.value}, at most {self.max_iterations} iterations"
        return (
            f"{self.kind.value}, threshold {self.relinearize_threshold:g}, skip "
            f"{self.relinearize_skip}, {self.extra_updates} extra updates"
        )


class TheirRun(NamedTuple):
    """What GTSAM's smoother made of a stream."""

    trajectory: Trajectory
    """Newest state of each keyframe"""
    front_s: Array
    """(K,) s, to make the keyframe: preintegration and the mean gyro reading"""
    update_s: Array
    """(K,) s, factors, update, newest state"""
    covariance_s: Array
    """(K,) s, to read the newest state's covariance, NaN where it was not read"""
    cpu_s: Array
    """(K,) s, processor time of all three"""
    failure: str
    """Empty for a stream that ended as it should"""
    wall_s: float


class Timed(NamedTuple):
    """A keyframe, and what it took to make it."""

    keyframe: Keyframe
    chain: InertialChain
    """The inertial data before it, for GTSAM's factor"""
    seconds: float
    cpu_s: float


def keyframes_live(mission: Mission) -> Iterator[Timed]:
    """Yield the keyframes that the live estimator makes, after the first one."""
    vehicle = vehicle_of(mission)
    buffers = Buffers(vehicle)
    maker = KeyframeMaker(buffers, mission.frame, ProblemConfig(), begin_s=0.0)
    assert mission.initial is not None
    last_s = mission.initial.time_s
    for message in messages_of(mission):
        buffers.add(message)
        while len(buffers.imu) > 10:
            begin, cpu = time.perf_counter(), time.process_time()
            measured = maker.next_after(last_s)
            if measured is None:
                break
            keyframe = maker.make(measured, last_s=last_s)
            took = time.perf_counter() - begin, time.process_time() - cpu
            yield Timed(keyframe, maker.chain(last_s, measured.time_s), *took)
            last_s = measured.time_s
            buffers.drop_before(last_s - 5.0)


class Theirs:
    """One of GTSAM's smoothers, fed keyframe by keyframe."""

    def __init__(self, mission: Mission, config: TheirConfig) -> None:
        self.config, self._frame = config, mission.frame
        self._sensors: Sensors = sensors_of_vehicle(vehicle_of(mission), mission.frame)
        self._inertial = InertialRows(mission.frame, NO_EXTRAS)
        problem = build_problem(mission)
        start = start_of(problem)
        self.states = States.at_start(start)
        self.covariance = start.covariance
        self._k = 0
        self.smoother = self._make()
        self._update(prior_graph(problem), self.states, problem.start.time_s)

    def _make(self) -> gtsam.IncrementalFixedLagSmoother | gtsam.BatchFixedLagSmoother:
        config = self.config
        if config.kind is Kind.BATCH:
            params = gtsam.LevenbergMarquardtParams()
            params.setLinearSolverType("MULTIFRONTAL_QR")
            params.setMaxIterations(config.max_iterations)
            return gtsam.BatchFixedLagSmoother(config.lag_s, params)
        isam = gtsam.ISAM2Params()
        isam.setOptimizationParams(gtsam.ISAM2GaussNewtonParams(config.wildfire))
        isam.setFactorization("QR")
        isam.setRelinearizeThreshold(config.relinearize_threshold)
        isam.relinearizeSkip = config.relinearize_skip
        isam.findUnusedFactorSlots = True
        return gtsam.IncrementalFixedLagSmoother(config.lag_s, isam)

    def add(self, keyframe: Keyframe, measured: Preintegrated) -> None:
        """Take a keyframe and the inertial data before it; the newest state follows."""
        predicted = self._predicted(keyframe)
        i, j = self._k, self._k + 1
        graph = gtsam.NonlinearFactorGraph()
        graph.add(gtsam.GalileanCombinedImuFactor(X(i), V(i), X(j), V(j), B(i), B(j), measured))
        beams = keyframe.beams
        add_beams(graph, beams, len(beams) * [j], omega_ie_n=self._frame.omega_ie_n)
        depth = keyframe.aids.get(DepthMeans.name)
        if isinstance(depth, DepthMeans):
            self._add_depth(graph, depth, predicted, j)
        self._k = j
        self._update(graph, predicted, keyframe.time_s)
        for _ in range(self.config.extra_updates):
            self.smoother.update()
        self.states = self._newest()

    def gravity_before(self, keyframe: Keyframe) -> Array:
        """Return gravity (1, 3) midway to where a keyframe is predicted."""
        pair = self.states.followed_by(self._predicted(keyframe))
        return gravity_between(self._frame, pair.p_n)

    def _predicted(self, keyframe: Keyframe) -> States:
        assert keyframe.inertial is not None
        return self._inertial.predict(keyframe.inertial, self.states).states

    def _update(self, graph: gtsam.NonlinearFactorGraph, at: States, time_s: float) -> None:
        k, values = self._k, gtsam.Values()
        values.insert(X(k), gtsam.Pose3(gtsam.Rot3(at.R_nb[0]), at.p_n[0]))
        values.insert(V(k), at.v_n[0])
        values.insert(B(k), gtsam.imuBias.ConstantBias(at.bias[0, :3], at.bias[0, 3:]))
        self.smoother.update(graph, values, {key(k): time_s for key in (X, V, B)})

    def _add_depth(
        self,
        graph: gtsam.NonlinearFactorGraph,
        depth: DepthMeans,
        predicted: States,
        k: int,
    ) -> None:
        """Add the mean of the readings, carried along the track as ours are, once."""
        before, at = (row_states(self._sensors, states) for states in (self.states, predicted))
        depth = depth.led_along(before, at)
        target_n, up_n = depth.target_n, depth.up_n
        root = np.zeros((3, 3))
        root[0] = up_n[0] * depth.root_information[0, 0]
        noise = gtsam.noiseModel.Gaussian.SqrtInformation(root, False)
        graph.add(gtsam.GPSFactorArm(X(k), target_n[0], depth.lever_arm_b, noise))

    def _newest(self) -> States:
        k, smoother = self._k, self.smoother
        pose, v_n = smoother.calculateEstimatePose3(X(k)), smoother.calculateEstimateVector(V(k))
        bias = smoother.calculateEstimateConstantBias(B(k))
        return States(
            pose.rotation().matrix()[None],
            pose.translation()[None],
            v_n[None],
            np.concatenate([bias.accelerometer(), bias.gyroscope()])[None],
            np.zeros((1, 0)),
        )

    def read_covariance(self) -> Array:
        """Return the marginal covariance (15, 15) of the newest state, blocks by variable only."""
        assert isinstance(self.smoother, gtsam.IncrementalFixedLagSmoother)
        covariance = np.zeros((15, 15))
        for key, at in ((X, slice(0, 6)), (V, slice(6, 9)), (B, slice(9, 15))):
            covariance[at, at] = self.smoother.marginalCovariance(key(self._k))
        return covariance


def run_theirs(mission: Mission, config: TheirConfig, *, most_wall_s: float = np.inf) -> TheirRun:
    """Feed a mission keyframe by keyframe until it ends, GTSAM gives up, or time runs out."""
    theirs, failure = Theirs(mission, config), ""
    time_s: list[float] = []
    states: list[States] = []
    covariances: list[Array] = []
    seconds: list[tuple[float, float, float, float]] = []
    reads = config.reads_covariance and config.kind is Kind.INCREMENTAL
    covariance, begun = np.full((15, 15), np.nan), time.perf_counter()
    for timed in keyframes_live(mission):
        begin, cpu = time.perf_counter(), time.process_time()
        try:
            measured = timed.chain.measured(theirs.gravity_before(timed.keyframe))[0]
            theirs.add(timed.keyframe, measured)
            updated = time.perf_counter()
            if reads:
                covariance = theirs.read_covariance()
        except (RuntimeError, ValueError, IndexError) as error:
            text = " ".join(str(error).split())[:160]
            failure = f"{type(error).__name__} at {timed.keyframe.time_s:.1f} s: {text}"
            break
        read_s = time.perf_counter() - updated if reads else np.nan
        spent_s = timed.cpu_s + time.process_time() - cpu
        if not all(np.all(np.isfinite(column)) for column in theirs.states):
            failure = f"not finite from {timed.keyframe.time_s:.1f} s on"
            break
        time_s.append(timed.keyframe.time_s)
        states.append(theirs.states)
        covariances.append(covariance)
        seconds.append((timed.seconds, updated - begin, read_s, spent_s))
        if time.perf_counter() - begun > most_wall_s:
            failure = f"stopped at {timed.keyframe.time_s:.1f} s: out of time"
            break
    wall_s = time.perf_counter() - begun
    trajectory = trajectory_at(
        mission.frame,
        np.array(time_s),
        States(*(np.concatenate(c) for c in zip(*states, strict=True))),
        np.array(covariances),
        n_beams=np.full(len(time_s), 4.0),
    )
    front_s, update_s, covariance_s, cpu_s = np.array(seconds).reshape(-1, 4).T
    return TheirRun(trajectory, front_s, update_s, covariance_s, cpu_s, failure, wall_s)
