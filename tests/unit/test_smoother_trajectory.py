"""From keyframe states to a trajectory: values, and covariances against numerical Jacobians."""

from __future__ import annotations

import numpy as np

from ssm_graph.base.frames import wrap_to_pi
from ssm_graph.base.frozen import Array
from ssm_graph.engine.error_state import STATE_DIM
from ssm_graph.engine.states import States
from ssm_graph.mission.answer import trajectory_from_states
from ssm_graph.mission.problem import Problem, build_problem
from ssm_graph.simulation import DiveRoute, Waves
from tests.helpers import simulated, true_states


def tilted() -> tuple[Problem, States, States]:
    """Return a short mission in heavy waves, its true states, and the same 20 km further."""
    sim = simulated(duration_s=5.0, route=DiveRoute(), waves=Waves(roll=0.6, pitch=0.5), seed=2)
    problem = build_problem(sim.mission)
    truth = true_states(problem, sim)
    moved = truth.p_n + np.array([1.5e4, -1.3e4, 0.0])
    return problem, truth, States.of(truth.R_nb, moved, truth.v_n, truth.bias)


def random_covariance(n: int) -> Array:
    """Return covariances (n, 15, 15) without any symmetry, small enough to be linear."""
    root = 1e-3 * np.random.default_rng(0).normal(size=(n, STATE_DIM, STATE_DIM))
    return np.asarray(root @ np.swapaxes(root, 1, 2))


def test_values_are_those_of_the_truth() -> None:
    """There and back: the simulator's own position, velocity and angles."""
    sim = simulated(duration_s=5.0, route=DiveRoute())
    problem = build_problem(sim.mission)
    states = true_states(problem, sim)
    covariance = random_covariance(problem.n_keyframes)
    trajectory = trajectory_from_states(problem, states, covariance)
    truth = sim.truth_at(problem.keyframe_s)
    np.testing.assert_allclose(trajectory.lat, truth.lat, rtol=0.0, atol=1e-14)
    np.testing.assert_allclose(trajectory.lon, truth.lon, rtol=0.0, atol=1e-14)
    np.testing.assert_allclose(trajectory.height, truth.height, rtol=0.0, atol=1e-8)
    np.testing.assert_allclose(trajectory.velocity_enu, truth.velocity_enu, atol=1e-12)
    difference = wrap_to_pi(trajectory.roll_pitch_heading - truth.roll_pitch_heading)
    np.testing.assert_allclose(difference, 0.0, atol=1e-12)
    np.testing.assert_array_equal(trajectory.accel_bias, states.bias[:, :3])
    np.testing.assert_array_equal(trajectory.gyro_bias, states.bias[:, 3:])
    assert trajectory.n_beams.sum() == len(problem.beams.speed)


def test_a_negative_variance_is_an_infinite_sigma() -> None:
    """What a filter that is lost may end with says nothing of the attitude, and does not crash."""
    problem, truth, _ = tilted()
    covariance = random_covariance(problem.n_keyframes)
    covariance[2, :3, :3] = -np.eye(3)
    sigma = trajectory_from_states(problem, truth, covariance).attitude_sigma
    assert np.all(np.isinf(sigma[2]))
    assert np.all(np.isfinite(sigma[[0, 1, 3]]))


def test_covariances_are_those_of_what_they_describe() -> None:
    """Each error state moved by itself: how east, north, up and the angles move gives ``J P J'``.

    Tilted by half a radian and 20 km from the frame's origin, where no two frames are aligned.
    """
    problem, _, states = tilted()
    n = problem.n_keyframes
    P = random_covariance(n)
    at = trajectory_from_states(problem, states, P)
    R_nl = problem.frame.R_nl_at(states.p_n)
    step = 1e-5
    position_D, velocity_D, angles_D = (np.empty((n, 3, STATE_DIM)) for _ in range(3))
    for axis in range(STATE_DIM):
        ends = []
        for sign in (step, -step):
            moved = states.moved(np.tile(sign * np.eye(STATE_DIM)[axis], (n, 1)))
            ends.append((moved, trajectory_from_states(problem, moved, P)))
        (plus, at_plus), (minus, at_minus) = ends
        position_D[:, :, axis] = np.einsum("kji,kj->ki", R_nl, plus.p_n - minus.p_n)
        velocity_D[:, :, axis] = at_plus.velocity_enu - at_minus.velocity_enu
        angles_D[:, :, axis] = wrap_to_pi(at_plus.roll_pitch_heading - at_minus.roll_pitch_heading)
    position, velocity, angles = (
        (D / (2.0 * step)) @ P @ np.swapaxes(D / (2.0 * step), 1, 2)
        for D in (position_D, velocity_D, angles_D)
    )
    scale = np.abs(position).max()
    np.testing.assert_allclose(at.position_cov_enu / scale, position / scale, atol=1e-6)
    for sigma, covariance in ((at.velocity_sigma_enu, velocity), (at.attitude_sigma, angles)):
        expected = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
        # Level axes turn with the position, by a radian in 6400 km: left out, as is their spread.
        np.testing.assert_allclose(sigma, expected, rtol=1e-5)
