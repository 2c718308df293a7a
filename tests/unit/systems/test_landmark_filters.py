"""Filters of pose and map: points of what moves against all points, forms against each other."""

from __future__ import annotations

import numpy as np
import pytest

from factors.similarity import LogKernel
from ssm_graph.base.errors import ConfigError
from ssm_graph.base.frozen import Array
from ssm_graph.filters.rules.noise_adaptive import (
    Evidence,
    GuardedScaling,
    LiteralScaling,
    NoiseLaw,
    SageHusa,
    VariationalBayes,
)
from ssm_graph.filters.rules.unscented import Spread, root_of, unscented
from ssm_graph.systems.landmark_slam.filters import Gate, MapFilter
from ssm_graph.systems.landmark_slam.methods import FILTERS
from ssm_graph.systems.landmark_slam.models import Bicycle, Odometry, between, composed
from ssm_graph.systems.landmark_slam.simulator import CASES, Path, Runs, Sigmas, World, simulate
from ssm_graph.systems.landmark_slam.study import path_of

STEPS = 150
START_COV = np.diag([0.05, 0.05, 0.02]) ** 2


@pytest.fixture(scope="module")
def path() -> Path:
    """Return the study's path, its beginning."""
    return path_of(STEPS)


@pytest.fixture(scope="module")
def runs(path: Path) -> Runs:
    """Return two runs."""
    reach = World().most_range_m
    return simulate(path, Sigmas(), CASES["stated"], range(2), reach_m=reach)


def filtered(name: str, path: Path, runs: Runs, **more: object) -> MapFilter:
    """Run a filter of the study over a path."""
    start = np.repeat(path.pose[:1], 2, axis=0)
    sigmas = Sigmas()
    slam = FILTERS[name].begin(
        Bicycle(),
        sigmas.control,
        sigmas.observation,
        start,
        capacity=len(path.landmarks),
        start_cov=START_COV,
        **more,
    )
    assert isinstance(slam, MapFilter)
    for k, view in enumerate(path.in_view):
        slam.predict(runs.control[k])
        if len(view):
            slam.update(view.tolist(), runs.observed[k])
    return slam


def test_points_of_what_moves_are_all_points(path: Path, runs: Runs) -> None:
    """The reduced transform is the full one with pose and landmarks in view first in the root."""
    reduced = filtered("ukf", path, runs)
    full = filtered("ukf-full", path, runs, in_view_first=True)
    assert reduced.ids == full.ids
    assert np.abs(reduced.mean - full.mean).max() < 1e-9
    assert np.abs(reduced.cov - full.cov).max() < 1e-9
    literal = filtered("ukf-full", path, runs)
    sigma = np.sqrt(np.einsum("bii->bi", reduced.cov))
    apart = np.abs(reduced.mean - literal.mean) / sigma
    assert 1e-6 < apart.max() < 0.05  # another root of the same covariance


def test_square_root_is_the_unscented_filter(path: Path, runs: Runs) -> None:
    """But for the negative part of what a transform adds."""
    usual, root = filtered("ukf", path, runs), filtered("sr-ukf", path, runs)
    sigma = np.sqrt(np.einsum("bii->bi", usual.cov))
    assert (np.abs(usual.mean - root.mean) / sigma).max() < 0.02
    assert np.linalg.eigvalsh(root.cov).min() > 0.0


@pytest.mark.parametrize("name", ["ekf", "iekf", "invariant", "ukf", "guarded", "vb", "sage-husa"])
def test_filters_come_near_and_say_how_near(name: str, path: Path, runs: Runs) -> None:
    """Every filter stays within five of its own sigmas; its map is where the landmarks are."""
    slam = filtered(name, path, runs)
    error = slam.pose - path.pose[-1]
    assert (np.abs(error) / np.sqrt(np.einsum("bii->bi", slam.pose_cov))).max() < 5.0
    off = np.linalg.norm(slam.landmarks() - path.landmarks[list(slam.ids)], axis=2)
    assert off.max() < 1.0
    assert slam.n_repaired == 0


def test_invariant_filter_learns_nothing_of_a_turn_of_everything() -> None:
    """A vehicle that stands and sees one landmark again and again keeps its heading's sigma."""
    sigmas, motion = Sigmas(), Odometry()
    control = np.array([[0.0, 0.0, 0.0, 1.0, 1.0, 1.0]])
    rng = np.random.default_rng(0)
    left = {}
    for name in ("ekf", "invariant"):
        slam = FILTERS[name].begin(
            motion,
            np.full(3, 1e-9),
            sigmas.observation,
            np.zeros((1, 3)),
            capacity=1,
            start_cov=np.diag([0.5, 0.5, 0.5]) ** 2,
        )
        for _ in range(300):
            slam.predict(control)
            noise = sigmas.observation * rng.standard_normal(2)
            slam.update([0], np.array([[[5.0, 0.3]]]) + noise)
        left[name] = float(np.sqrt(slam.pose_cov[0, 2, 2])) / 0.5
    assert left["invariant"] == pytest.approx(1.0, abs=1e-6)
    assert left["ekf"] < 0.9  # the usual one believes that it has learnt


def test_gate_refuses_and_opens_again(path: Path) -> None:
    """A gross observation is left out; one that stays is let in after enough refusals."""
    slam = FILTERS["ekf"].begin(
        Bicycle(),
        Sigmas().control,
        Sigmas().observation,
        path.pose[:1],
        capacity=1,
        start_cov=1e-6 * np.eye(3),
        robust=Gate(reacquire=3),
    )
    z = np.array([[[5.0, 0.1]]])
    slam.update([7], z)
    slam.update([7], z)
    weights = [slam.update([7], z + np.array([2.0, 0.0])).weights[0, 0] for _ in range(4)]
    assert weights[:3] == [0.0, 0.0, 0.0]
    assert 0.0 < weights[3] < 1.0


def test_similarity_weights_in_a_filter() -> None:
    """An observation far off counts little."""
    slam = FILTERS["ekf"].begin(
        Bicycle(),
        Sigmas().control,
        Sigmas().observation,
        np.zeros((1, 3)),
        capacity=1,
        start_cov=1e-6 * np.eye(3),
        robust=LogKernel(5.0),
    )
    for _ in range(5):
        slam.update([0], np.array([[[5.0, 0.0]]]))
    assert slam.update([0], np.array([[[8.0, 0.0]]])).weights[0, 0] < 0.05


def evidence(rng: np.random.Generator, sigma: Array, steps: int) -> list[Evidence]:
    """Return what observations of a known map tell of their noise."""
    found = []
    for _ in range(steps):
        d = sigma * rng.standard_normal((1, 5, 2))
        nothing = np.zeros((1, 5, 2, 2))
        nis, dof = np.array([10.0]), np.array([10.0])
        found.append(Evidence(d, d, nothing, nothing, np.ones((1, 5)), nis, dof))
    return found


@pytest.mark.parametrize(
    "law",
    [
        LiteralScaling(100, scales_q=False),
        GuardedScaling(prior_count=5.0),
        SageHusa(memory=100),
        VariationalBayes(0.995),
    ],
    ids=lambda law: type(law).__name__,
)
def test_laws_find_the_noise_of_observations(law: NoiseLaw) -> None:
    """Stated three times too small, found within 15 % of the sigma."""
    true = np.array([0.3, 0.06])
    noise = law.begin(np.array([0.1]), true / 3.0, 1)
    for found in evidence(np.random.default_rng(4), true, 600):
        noise.take(found)
    sigma = np.sqrt(np.diagonal(noise.observation[0]))
    assert sigma == pytest.approx(true, rel=0.15)
    assert noise.control[0, 0, 0] == pytest.approx(0.01)


def test_a_window_of_one_step_is_refused() -> None:
    """Of one observation there is no covariance."""
    with pytest.raises(ConfigError, match="window: expected 2 steps or more, got 1"):
        LiteralScaling(1).begin(np.ones(1), np.ones(2), 1)


def test_unscented_moments_of_a_quadratic() -> None:
    """Mean ``sum P``, exact; the covariance of a linear function is exact too."""
    rng = np.random.default_rng(2)
    root = np.tril(rng.normal(size=(3, 3)))
    P = root @ root.T
    found = unscented(lambda x: x**2, np.zeros(3), root_of(P).root, spread=Spread())
    assert found.mean == pytest.approx(np.diagonal(P))
    A = rng.normal(size=(2, 3))
    linear = unscented(lambda x: x @ A.T, np.ones(3), root_of(P).root, spread=Spread())
    assert linear.cov == pytest.approx(A @ P @ A.T)


def test_root_of_what_has_none_is_repaired_and_counted() -> None:
    """A covariance that is not positive definite gets a root near it."""
    P = np.stack([np.eye(2), np.array([[1.0, 1.0 + 1e-9], [1.0 + 1e-9, 1.0]]), -np.eye(2)])
    found = root_of(P)
    assert found.n_repaired == 2
    assert found.root[1] @ found.root[1].T == pytest.approx(P[1], abs=1e-5)
    assert np.all(np.isfinite(found.root))


def test_increments_go_back_and_forth() -> None:
    """``between`` undoes ``composed``, over half a turn too."""
    rng = np.random.default_rng(1)
    pose, step = rng.normal(size=(20, 3)), rng.uniform(-3.0, 3.0, (20, 3))
    assert between(pose, composed(pose, step)) == pytest.approx(step)


def test_slopes_of_motions_are_those_of_differences() -> None:
    """Of pose and noise, for both motions."""
    rng = np.random.default_rng(3)
    pose = rng.normal(size=3)
    for motion, control in (
        (Bicycle(1.3), np.array([0.4, 0.2])),
        (Odometry(), np.array([0.3, 0.1, 0.2, 0.5, 0.6, 0.7])),
    ):
        q = len(motion.labels)
        _, by_pose, by_noise = motion.slopes(pose, control)
        for i in range(3):
            step = 1e-6 * np.eye(3)[i]
            ahead, behind = (motion.move(pose + s, control, np.zeros(q)) for s in (step, -step))
            assert by_pose[:, i] == pytest.approx((ahead - behind) / 2e-6, abs=1e-8)
        for i in range(q):
            step = 1e-6 * np.eye(q)[i]
            ahead, behind = (motion.move(pose, control, s) for s in (step, -step))
            assert by_noise[:, i] == pytest.approx((ahead - behind) / 2e-6, abs=1e-8)
