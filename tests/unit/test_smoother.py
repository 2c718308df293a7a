"""The similarity loop: limits, the plain optimiser as its oracle, settings, side effects."""

from __future__ import annotations

import copy
import dataclasses
from typing import Any

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import B, V, X

from factors.similarity import ExpKernel, GaussianKernel, Kernel, LogKernel, SqrtKernel
from ssm_graph.base.errors import ConfigError
from ssm_graph.base.frozen import Array
from ssm_graph.engine.states import States
from ssm_graph.graph.first_values import first_values
from ssm_graph.graph.gtsam_graph import gtsam_graph, gtsam_values
from ssm_graph.mission.estimate import Estimate, Iteration, Status
from ssm_graph.mission.problem import Problem, build_problem
from ssm_graph.simulation import GnssSettings, Grade, Loss, OutlierKind, Outliers
from ssm_graph.smoothers.batch import Similarity, SmootherConfig, SsmSmoother
from tests.helpers import (
    estimated_states,
    rotation,
    simulated,
    state_errors,
    true_states,
    without_beams,
)

GNSS = GnssSettings(windows=((0.0, 10.0),))
SPARSE = Outliers(OutlierKind.SPARSE, rate=0.1)
KERNELS = (LogKernel(), SqrtKernel(), ExpKernel(), GaussianKernel())


def smoothed(problem: Problem, **settings: Any) -> Estimate:
    """Return the estimate with changed settings."""
    return SsmSmoother(SmootherConfig(**settings)).solve(problem)


def posterior_sigmas(estimate: Estimate) -> Array:
    """Return standard deviations of position along east, north, up (K, 3)."""
    return np.sqrt(np.diagonal(estimate.trajectory.position_cov_enu, axis1=1, axis2=2))


@pytest.mark.parametrize("kernel", KERNELS, ids=str)
def test_no_noise_recovers_the_truth(kernel: Kernel) -> None:
    """Perfect sensors: what is left is the gyro's mean over a ping, 1e-5 m/s, in a minute."""
    sim = simulated(
        duration_s=60.0, perfect_sensors=True, draw_initial_errors=False, imu_rate_hz=100.0
    )
    problem = build_problem(sim.mission)
    estimate = smoothed(problem, kernel=kernel)
    assert estimate.status is Status.CONVERGED
    errors = state_errors(estimated_states(problem, estimate.trajectory), true_states(problem, sim))
    assert np.abs(errors[:, 3:6]).max() < 2e-3
    assert np.abs(errors[:, 6:9]).max() < 1e-4
    assert np.abs(errors[:, :3]).max() < 1e-4
    assert np.abs(estimate.beams.innovation).max() < 1e-3


def optimised(graph: gtsam.NonlinearFactorGraph, start: gtsam.Values, n: int) -> States:
    """Return the states after plain Gauss-Newton with QR."""
    params = gtsam.GaussNewtonParams()
    params.setLinearSolverType("MULTIFRONTAL_QR")
    params.setRelativeErrorTol(0.0)
    params.setAbsoluteErrorTol(0.0)
    params.setMaxIterations(8)
    values = gtsam.GaussNewtonOptimizer(graph, start, params).optimize()
    poses = [values.atPose3(X(k)) for k in range(n)]
    return States.of(
        np.array([pose.rotation().matrix() for pose in poses]),
        np.array([pose.translation() for pose in poses]),
        np.array([values.atVector(V(k)) for k in range(n)]),
        np.array([values.atConstantBias(B(k)).vector() for k in range(n)]),
    )


@pytest.mark.parametrize("grade", [Grade.NAVIGATION, Grade.MEMS], ids=lambda grade: grade.name)
def test_gaussian_kernel_is_the_plain_smoother(
    grade: Grade, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without robust weights the loop ends where GTSAM's own optimiser ends, from elsewhere.

    Up to the gradient of gravity, which GTSAM's factor does not know.
    """
    monkeypatch.setattr(
        "ssm_graph.graph.inertial_rows.gravity_gradient", lambda _: np.zeros((3, 3))
    )
    sim = simulated(duration_s=15.0, grade=grade, gnss=GNSS, dropout_rate=0.1, seed=2)
    problem = build_problem(sim.mission)
    # Heights are good to 1e-9 m, the rounding of the radius of the Earth: 3e-8 of their sigma.
    estimate = smoothed(problem, kernel=GaussianKernel(), tolerance=1e-7)
    assert estimate.status is Status.CONVERGED
    states = estimated_states(problem, estimate.trajectory)
    truth = true_states(problem, sim)
    rng = np.random.default_rng(0)
    n = problem.n_keyframes
    start = States.of(
        truth.R_nb @ rotation(1e-3 * rng.normal(size=(n, 3))),
        truth.p_n + 0.1 * rng.normal(size=(n, 3)),
        truth.v_n + 0.01 * rng.normal(size=(n, 3)),
        truth.bias,
    )
    plain = optimised(gtsam_graph(problem, states), gtsam_values(start), n)
    difference = np.abs(state_errors(states, plain))
    trajectory = estimate.trajectory
    assert np.max(difference[:, 3:6] / posterior_sigmas(estimate)) < 1e-6
    assert np.max(difference[:, :3] / trajectory.attitude_sigma.min(axis=1)[:, None]) < 1e-6
    assert np.max(difference[:, 6:9] / trajectory.velocity_sigma_enu) < 1e-6


@pytest.mark.parametrize("kernel", [LogKernel(), ExpKernel(), SqrtKernel()], ids=str)
def test_plain_m_estimator_is_stationary_for_its_own_cost(kernel: Kernel) -> None:
    """Weights by the residual alone: the gradient of cost minus similarity vanishes.

    An independent check of the whole loop: the cost is summed over factors, with each beam's
    ``-f(t)`` in place of its square, and differentiated numerically.
    """
    sim = simulated(duration_s=10.0, outliers=SPARSE, seed=4)
    problem = build_problem(sim.mission)
    estimate = smoothed(
        problem, kernel=kernel, similarity=Similarity.PLAIN, tolerance=1e-7, max_iterations=200
    )
    assert estimate.status is Status.CONVERGED
    states = estimated_states(problem, estimate.trajectory)
    graph = gtsam_graph(problem, states)
    n_beams = len(problem.beams.speed)
    n_others = graph.size() - n_beams

    def cost(values: gtsam.Values) -> float:
        others = sum(graph.at(i).error(values) for i in range(n_others))
        t = 2.0 * np.array([graph.at(n_others + i).error(values) for i in range(n_beams)])
        return float(others - np.sum(kernel.similarity(t)))

    rng = np.random.default_rng(1)
    sigma = posterior_sigmas(estimate)
    for _ in range(4):
        delta = gtsam.VectorValues()
        for k in range(problem.n_keyframes):
            delta.insert(X(k), np.r_[np.zeros(3), 1e-3 * sigma[k] * rng.normal(size=3)])
            delta.insert(V(k), 1e-5 * rng.normal(size=3))
            delta.insert(B(k), np.zeros(6))
        ends = [cost(gtsam_values(states).retract(delta.scale(s))) for s in (1.0, -1.0)]
        curvature = ends[0] + ends[1] - 2.0 * cost(gtsam_values(states))
        # At a minimum the odd part is far below the even one.
        assert curvature > 0.0
        assert abs(ends[0] - ends[1]) < 1e-3 * curvature


@pytest.mark.parametrize("similarity", Similarity, ids=lambda s: s.name)
def test_reported_weights_belong_to_the_reported_residuals(similarity: Similarity) -> None:
    """Weight, squared length and innovation of every row fit together."""
    sim = simulated(outliers=SPARSE, seed=1)
    problem = build_problem(sim.mission)
    kernel = LogKernel(4.0)
    beams = smoothed(problem, kernel=kernel, similarity=similarity).beams
    np.testing.assert_allclose(beams.weight, kernel.weight(beams.mahalanobis_sq), rtol=1e-12)
    residual_sq = (beams.innovation / problem.beams.sigma) ** 2
    if similarity is Similarity.PLAIN:
        np.testing.assert_allclose(beams.mahalanobis_sq, residual_sq, rtol=1e-9)
    else:
        spread = beams.mahalanobis_sq - residual_sq
        assert spread.min() > 0.0
        # At least the posterior of a beam among three good ones, at most its own prior.
        assert 0.01 < np.median(spread) < 1.0
    np.testing.assert_allclose(beams.time_s, problem.keyframe_s[problem.beams.keyframe])
    assert set(beams.beam) == {1.0, 2.0, 3.0, 4.0}


def test_outliers_are_told_from_good_beams() -> None:
    """Outliers of 100 sigma and more end below 0.05, good beams keep their weight."""
    sim = simulated(duration_s=60.0, outliers=SPARSE, seed=7)
    problem = build_problem(sim.mission)
    estimate = smoothed(problem)
    bad = sim.is_outlier[np.isfinite(sim.mission.dvl.speed)]
    assert estimate.beams.weight[bad].max() < 0.05
    assert 0.95 < estimate.beams.weight[~bad].mean() < 1.10


@pytest.mark.parametrize("grade", Grade, ids=lambda grade: grade.name)
@pytest.mark.parametrize("kernel", KERNELS, ids=str)
def test_every_kernel_converges_on_clean_data(kernel: Kernel, grade: Grade) -> None:
    """From the default start."""
    estimate = smoothed(build_problem(simulated(grade=grade, seed=5).mission), kernel=kernel)
    assert estimate.status is Status.CONVERGED, estimate.reason
    assert len(estimate.iterations) < 12


@pytest.mark.parametrize("grade", Grade, ids=lambda grade: grade.name)
@pytest.mark.parametrize("kernel", KERNELS, ids=str)
def test_every_kernel_settles_with_outliers(kernel: Kernel, grade: Grade) -> None:
    """Robust kernels converge; least squares settles on an answer that is called suspect."""
    sim = simulated(grade=grade, seed=5, outliers=SPARSE)
    estimate = smoothed(build_problem(sim.mission), kernel=kernel)
    wanted = Status.SUSPECT if kernel == GaussianKernel() else Status.CONVERGED
    assert estimate.status is wanted, estimate.reason


def test_one_iteration_stops_at_the_limit() -> None:
    """Whatever the state of the updates; the reason gives their size."""
    estimate = smoothed(build_problem(simulated().mission), max_iterations=1)
    assert estimate.status is Status.MAX_ITERATIONS
    assert not estimate.status.is_good
    assert len(estimate.iterations) == 1
    assert f"{estimate.iterations[0].update_sigmas:.1e}" in estimate.reason


def test_iterations_are_reported_as_they_happen() -> None:
    """Number, limit and what happened, once each; the kernel asked for takes over."""
    calls: list[tuple[int, int, Iteration]] = []
    problem = build_problem(simulated(outliers=SPARSE).mission)
    estimate = SsmSmoother(SmootherConfig(kernel=ExpKernel(3.0), max_iterations=40)).solve(
        problem, on_iteration=lambda *call: calls.append(call)
    )
    assert [number for number, _, _ in calls] == list(range(1, len(estimate.iterations) + 1))
    assert {limit for _, limit, _ in calls} == {40}
    assert tuple(iteration for _, _, iteration in calls) == estimate.iterations
    last = estimate.iterations[-1]
    assert max(last.update_sigmas, last.weight_change) < 1e-3
    assert last.kernel == estimate.kernel == "exp(width=3)"


def fields_of(estimate: Estimate) -> dict[str, Any]:
    """Return everything in an estimate but the time it took."""
    flat: dict[str, Any] = {}
    for spec in dataclasses.fields(estimate):
        value = getattr(estimate, spec.name)
        if spec.name in ("trajectory", "beams", "start", "noise", "aids", "posterior"):
            for inner in dataclasses.fields(value):
                flat[f"{spec.name}.{inner.name}"] = getattr(value, inner.name)
        elif spec.name != "wall_s":
            flat[spec.name] = value
    return flat


def assert_bit_identical(a: Estimate, b: Estimate) -> None:
    """Compare two estimates down to the last bit."""
    first, second = fields_of(a), fields_of(b)
    assert first.keys() == second.keys()
    for name, value in first.items():
        np.testing.assert_array_equal(value, second[name], err_msg=name)


def test_same_mission_same_answer() -> None:
    """Bit by bit, from a new problem, and from the same one solved before by another kernel."""
    sim = simulated(outliers=SPARSE, gnss=GNSS, seed=8)
    problem = build_problem(sim.mission)
    first = smoothed(problem)
    smoothed(problem, kernel=ExpKernel(), max_iterations=3)
    assert_bit_identical(first, smoothed(problem))
    assert_bit_identical(first, smoothed(build_problem(sim.mission)))


def test_a_problem_is_not_changed_by_solving_it() -> None:
    """Every array of it is as before."""
    problem = build_problem(simulated(outliers=SPARSE, gnss=GNSS).mission)
    parts = [problem, problem.start, problem.beams, problem.depths, problem.fixes]
    arrays = {
        (type(part).__name__, spec.name): getattr(part, spec.name)
        for part in parts
        for spec in dataclasses.fields(part)  # type: ignore[arg-type]
        if isinstance(getattr(part, spec.name), np.ndarray)
    }
    assert len(arrays) > 15
    before = copy.deepcopy(arrays)
    smoothed(problem)
    for key, array in arrays.items():
        np.testing.assert_array_equal(array, before[key], err_msg=str(key))


@pytest.mark.parametrize("missing", ["beams", "depth", "gnss", "everything"])
def test_each_aid_may_be_missing(missing: str) -> None:
    """Smoothing goes on with what there is, and with sigmas that say so."""
    sim = simulated(grade=Grade.TACTICAL, gnss=GNSS, seed=3)
    mission = sim.mission
    full = smoothed(build_problem(mission))
    if missing in ("depth", "everything"):
        mission = dataclasses.replace(mission, depth=None)
    if missing in ("gnss", "everything"):
        mission = dataclasses.replace(mission, gnss=None)
    if missing in ("beams", "everything"):
        mission = without_beams(mission)
    problem = build_problem(mission)
    estimate = smoothed(problem)
    assert estimate.status is Status.CONVERGED, estimate.reason
    assert np.all(posterior_sigmas(estimate)[-1] >= 0.999 * posterior_sigmas(full)[-1])
    axis = 2 if missing == "depth" else 0
    assert posterior_sigmas(estimate)[-1, axis] > 1.02 * posterior_sigmas(full)[-1, axis]
    errors = state_errors(estimated_states(problem, estimate.trajectory), true_states(problem, sim))
    # Body axes against east, north, up: the length is the same.
    assert np.linalg.norm(errors[-1, 3:6]) < 5.0 * np.linalg.norm(posterior_sigmas(estimate)[-1])


def test_sigmas_grow_in_a_bottom_loss_and_shrink_after_it() -> None:
    """The vertical speed, without depth, knows nothing but beams: a minute without any."""
    loss = Loss(start_s=30.5, end_s=90.5)
    sim = simulated(duration_s=120.0, grade=Grade.MEMS, losses=(loss,), depth=None)
    trajectory = smoothed(build_problem(sim.mission)).trajectory
    sigma = trajectory.velocity_sigma_enu[:, 2]
    before, middle, after = np.searchsorted(trajectory.time_s, [29.0, 60.0, 92.0])
    assert sigma[middle] > 3.0 * sigma[before]
    assert sigma[middle] > 3.0 * sigma[after]
    assert trajectory.n_beams[middle] == 0.0
    assert trajectory.n_beams[before] == trajectory.n_beams[after] == 4.0


def test_estimate_says_what_was_done() -> None:
    """Method, kernel, start, notes and times."""
    sim = simulated(gnss=GNSS)
    assert sim.mission.initial is not None
    problem = build_problem(sim.mission)
    estimate = smoothed(problem)
    assert estimate.method == "smoother"
    assert estimate.kernel == str(SmootherConfig().kernel)
    assert estimate.start is sim.mission.initial
    assert estimate.wall_s > 0.0
    np.testing.assert_array_equal(estimate.trajectory.time_s, problem.keyframe_s)
    assert np.isfinite(estimate.cost)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"max_iterations": 0}, "max_iterations: expected 1 or more, got 0"),
        ({"tolerance": 0.0}, r"tolerance: expected a number in \(0, 1\), got 0"),
        ({"tolerance": 1.0}, "tolerance"),
        ({"tolerance": float("nan")}, "tolerance"),
    ],
)
def test_bad_settings_are_refused(settings: dict[str, Any], message: str) -> None:
    """By name, with what was expected."""
    with pytest.raises(ConfigError, match=message):
        SmootherConfig(**settings)


def test_first_values_are_no_worse_than_the_answer_needs() -> None:
    """From the first pass a handful of iterations is enough, also with outliers."""
    sim = simulated(duration_s=60.0, outliers=SPARSE)
    problem = build_problem(sim.mission)
    first = first_values(problem, kernel=LogKernel())
    estimate = smoothed(problem)
    answer = estimated_states(problem, estimate.trajectory)
    assert np.abs(state_errors(first.states, answer)[1:, 6:9]).max() < 0.05
    assert len(estimate.iterations) <= 8


def test_a_depth_log_that_is_over_before_the_first_ping() -> None:
    """It says nothing, and does not spoil the answer."""
    mission = simulated(duration_s=10.0).mission
    depth = mission.depth
    assert depth is not None
    early = dataclasses.replace(depth, time_s=depth.time_s - 1e3)
    estimate = smoothed(build_problem(dataclasses.replace(mission, depth=early)))
    without = smoothed(build_problem(dataclasses.replace(mission, depth=None)))
    assert estimate.status is Status.CONVERGED
    np.testing.assert_array_equal(estimate.trajectory.lat, without.trajectory.lat)
