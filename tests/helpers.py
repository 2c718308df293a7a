"""Checks that several tests share, and the truth of simulated missions in the graph's terms."""

from __future__ import annotations

import dataclasses
from typing import Any

import gtsam
import numpy as np
from hypothesis import settings
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from ssm_graph.base.errors import SolverError
from ssm_graph.base.frames import R_lb_from_roll_pitch_heading
from ssm_graph.base.frozen import Array
from ssm_graph.engine.error_state import STATE_DIM
from ssm_graph.engine.states import States
from ssm_graph.graph.linearize import GraphLinearizer
from ssm_graph.mission.estimate import Status, Trajectory
from ssm_graph.mission.mission import InitialState, Mission
from ssm_graph.mission.problem import Problem
from ssm_graph.sensors.drift import Drift
from ssm_graph.sensors.imu import ImuLog
from ssm_graph.simulation import SimulatedMission, SimulationConfig, simulate
from ssm_graph.smoothers.batch import SsmSmoother

STEADY = settings(derandomize=True, max_examples=50)
"""For property tests: the same examples every time, however busy the machine is."""


def assert_jacobians_match(
    factor: gtsam.NonlinearFactor,
    values: gtsam.Values,
    *,
    step: float = 1e-4,
    rtol: float = 1e-6,
) -> None:
    """Compare a factor's Jacobians with central differences along the manifold.

    ``rtol`` is relative to the largest entry of each variable's block, everything whitened.
    """
    assert isinstance(factor, gtsam.NoiseModelFactor)
    linear = factor.linearize(values)
    analytic, _ = linear.jacobian()
    column = 0
    for key in list(linear.keys()):
        size = values.zeroVectors().at(key).size
        block = analytic[:, column : column + size]
        column += size
        numeric = np.empty_like(block)
        for axis in range(size):
            ends = []
            for signed in (step, -step):
                delta = gtsam.VectorValues()
                delta.insert(key, signed * np.eye(size)[axis])
                ends.append(factor.whitenedError(values.retract(delta)))
            numeric[:, axis] = (ends[0] - ends[1]) / (2.0 * step)
        scale = max(float(np.abs(numeric).max()), 1e-9)
        np.testing.assert_allclose(block / scale, numeric / scale, rtol=0.0, atol=rtol)
    assert column == analytic.shape[1]


def assert_consistent(
    nees: Array, *, dof: int, confidence: float = 0.999, independent: int | None = None
) -> None:
    """Check the mean of NEES samples of ``dof`` degrees of freedom against its interval.

    The interval is that of ``independent`` samples (all of them by default), two-sided.
    """
    count = len(nees) if independent is None else independent
    tail = 0.5 * (1.0 - confidence)
    low, high = chi2.ppf([tail, 1.0 - tail], df=count * dof) / count
    mean = float(np.mean(nees))
    assert low < mean < high, f"mean NEES {mean:.3f} of {dof}, not in [{low:.3f}, {high:.3f}]"


def rotation(vector: Any) -> Array:
    """Return the rotation matrix of a rotation vector, rad."""
    return np.asarray(Rotation.from_rotvec(vector).as_matrix())


def simulated(**changes: Any) -> SimulatedMission:
    """Return a mission of half a minute at 20 Hz, or of whatever else is asked for."""
    return simulate(SimulationConfig(**({"duration_s": 30.0, "imu_rate_hz": 20.0} | changes)))


def without_beams(mission: Mission) -> Mission:
    """Return the mission with every beam speed missing."""
    speed = np.full_like(mission.dvl.speed, np.nan)
    return dataclasses.replace(mission, dvl=dataclasses.replace(mission.dvl, speed=speed))


def drifting(mission: Mission, of_dvl: Drift, of_gnss: Drift) -> Mission:
    """Return the mission with slow errors stated for DVL and GNSS."""
    mount = dataclasses.replace(mission.dvl.mount, drift=of_dvl)
    gnss = mission.gnss
    if gnss is not None:
        calibration = dataclasses.replace(gnss.calibration, drift=of_gnss)
        gnss = dataclasses.replace(gnss, calibration=calibration)
    return dataclasses.replace(
        mission, dvl=dataclasses.replace(mission.dvl, mount=mount), gnss=gnss
    )


def with_initial(mission: Mission, **changes: Any) -> Mission:
    """Return the mission with another initial state."""
    assert isinstance(mission.initial, InitialState)
    return dataclasses.replace(mission, initial=dataclasses.replace(mission.initial, **changes))


def with_imu(mission: Mission, **changes: Any) -> Mission:
    """Return the mission with fields of its inertial data changed."""
    imu: ImuLog = dataclasses.replace(mission.imu, **changes)
    return dataclasses.replace(mission, imu=imu)


def outcome(problem: Problem) -> tuple[Status, str]:
    """Return how smoothing ended, and why; an error counts as divergence."""
    try:
        estimate = SsmSmoother().solve(problem)
    except SolverError as error:
        return Status.DIVERGED, str(error)
    return estimate.status, estimate.reason


def states_from_geodetic(
    problem: Problem,
    place: Any,
    *,
    gyro_bias: Array,
    accel_bias: Array,
) -> States:
    """Return keyframe states from anything with lat, lon, height, velocity and angles."""
    frame = problem.frame
    p_n = frame.p_n_from_geodetic(place.lat, place.lon, place.height)
    R_nl = frame.R_nl_at(p_n)
    R_nb = R_nl @ R_lb_from_roll_pitch_heading(*place.roll_pitch_heading.T)
    v_n = np.einsum("kij,kj->ki", R_nl, place.velocity_enu)
    return States.of(R_nb, p_n, v_n, np.hstack([accel_bias, gyro_bias]))


def true_states(problem: Problem, sim: SimulatedMission) -> States:
    """Return the truth at the keyframes, true biases included."""
    time_s = problem.keyframe_s
    sample = np.clip(np.searchsorted(sim.mission.imu.time_s, time_s), 0, len(sim.gyro_bias) - 1)
    return states_from_geodetic(
        problem,
        sim.truth_at(time_s),
        gyro_bias=sim.gyro_bias[sample],
        accel_bias=sim.accel_bias[sample],
    )


def estimated_states(problem: Problem, trajectory: Trajectory) -> States:
    """Return the states behind an estimate's trajectory."""
    return states_from_geodetic(
        problem,
        trajectory,
        gyro_bias=trajectory.gyro_bias,
        accel_bias=trajectory.accel_bias,
    )


def state_errors(estimated: States, truth: States) -> Array:
    """Return the errors (K, 15) of states in the order of the error state."""
    R_bn = np.swapaxes(estimated.R_nb, 1, 2)
    phi = Rotation.from_matrix(R_bn @ truth.R_nb).as_rotvec()
    moved = np.einsum("kij,kj->ki", R_bn, truth.p_n - estimated.p_n)
    return np.hstack([phi, moved, truth.v_n - estimated.v_n, truth.bias - estimated.bias])


def covariances(problem: Problem, states: States, weights: Array) -> Array:
    """Return the covariance (K, 15, 15) of the whole error state at an answer."""
    linearizer = GraphLinearizer(problem)
    linearizer.follow(states)
    return linearizer.solve(states, linearizer.beam_rows(states), weights).covariance(STATE_DIM)
