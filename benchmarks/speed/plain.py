"""The factor graph of the same mission as a GTSAM user would write it: one factor a beam."""

from __future__ import annotations

import itertools
from collections.abc import Iterable

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, V, X

from factors.dvl_beam import dvl_beam_factor
from ssm_graph.base.earth import LocalFrame
from ssm_graph.base.frozen import Array
from ssm_graph.graph.gtsam_graph import prior_graph
from ssm_graph.mission.mission import Mission
from ssm_graph.mission.problem import Beams, Problem, initial_moments
from ssm_graph.sensors.imu import ImuNoise

CAUCHY = gtsam.noiseModel.mEstimator.Cauchy.Create(2.3849)
"""With the usual constant: 95 % efficiency without outliers."""


def plain_graph(mission: Mission, problem: Problem) -> gtsam.NonlinearFactorGraph:
    """Return the graph: default preintegration of the raw samples, robust beams, depth, prior.

    Gravity is that of the origin throughout, samples are not merged, nothing is compensated.
    """
    graph = prior_graph(problem)
    _add_inertial(graph, mission, problem.keyframe_s)
    beams, omega_ie_n = problem.beams, problem.frame.omega_ie_n
    keyframes = beams.keyframe.tolist()
    add_beams(graph, beams, keyframes, omega_ie_n=omega_ie_n)
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
