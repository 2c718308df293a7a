"""Graphs from files, and smoothers that take a log pose by pose: against GTSAM and the batch."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import gtsam
import numpy as np
import pytest

from factors.similarity import GaussianKernel, Kernel, LogKernel
from ssm_graph.base.errors import DataError
from ssm_graph.base.frozen import Array
from ssm_graph.cli.main import main
from ssm_graph.systems.landmark_slam.graph_files import read_pose_graph
from ssm_graph.systems.landmark_slam.graphs import graph_of_problem, problem_of_graph
from ssm_graph.systems.landmark_slam.incremental import (
    Incremental,
    IncrementalSettings,
    smooth_incrementally,
)
from ssm_graph.systems.landmark_slam.models import Odometry, between, composed
from ssm_graph.systems.landmark_slam.problem import SlamNoise, SlamProblem, SlamStatus
from ssm_graph.systems.landmark_slam.range_starts import placed
from ssm_graph.systems.landmark_slam.smoother import (
    SmootherSettings,
    Values,
    smooth_landmarks,
)
from tests.unit.systems.test_landmark_smoother import NOISE, small

SQUARE = """VERTEX_SE2 0 1 2 0.5
EDGE_SE2 0 1 1 0.1 1.5 100 5 0 80 0 900
EDGE_SE2 1 2 1 0 1.6 100 5 0 80 0 900
EDGE_SE2 3 2 -1 0.1 -1.5 100 5 0 80 0 900
EDGE_SE2 0 3 0.1 1 -1.5 100 5 0 80 0 900
VERTEX_XY 7 0 0
EDGE_SE2_XY 1 7 2 1 25 0 25
EDGE_SE2_XY 2 7 -1 2 25 0 25
"""


def taken(
    problem: SlamProblem, noise: SlamNoise, kernel: Kernel, lag_s: float | None = None
) -> Incremental:
    """Take a log pose by pose."""
    return smooth_incrementally(
        graph_of_problem(problem, noise), IncrementalSettings(kernel, lag_s=lag_s)
    )


@pytest.mark.parametrize(("kernel", "share"), [(GaussianKernel(), 0.0), (LogKernel(5.0), 0.2)])
def test_pose_by_pose_ends_where_the_whole_log_does(kernel: Kernel, share: float) -> None:
    """Path, map, covariances and weights, with a fifth of the observations gross if weighed.

    Without weights those bend the odometry so far that GTSAM's logarithm of it shows.
    """
    rng = np.random.default_rng(4)
    problem, truth = small(rng)
    measured, gross = problem.measured.copy(), rng.random(60) < share
    measured[gross, 0] += 3.0
    problem = replace(problem, measured=measured)
    whole = smooth_landmarks(problem, NOISE, truth, SmootherSettings(kernel, finds_tail=False))
    found = taken(problem, NOISE, kernel).estimate
    sigma = np.sqrt(np.einsum("kii->ki", whole.pose_cov))
    assert found.status is SlamStatus.CONVERGED
    assert np.abs((found.pose - whole.pose) / sigma).max() < 0.05
    assert found.weights == pytest.approx(whole.weights, abs=0.02)
    assert found.landmark_cov == pytest.approx(whole.landmark_cov, rel=0.1, abs=1e-5)
    assert found.pose_cov[-1] == pytest.approx(whole.pose_cov[-1], rel=0.1, abs=1e-5)


def test_a_lag_longer_than_the_log_drops_nothing() -> None:
    """And a short one keeps the last pose, with fewer of the poses before in it."""
    problem, _ = small(np.random.default_rng(0))
    known = taken(problem, NOISE, GaussianKernel())
    whole = known.estimate
    long, short = (taken(problem, NOISE, GaussianKernel(), lag_s=lag) for lag in (100.0, 5.0))
    assert long.online == pytest.approx(known.online, abs=1e-6)
    sigma = np.sqrt(np.einsum("kii->ki", whole.pose_cov))
    assert np.abs((short.estimate.pose - whole.pose) / sigma)[-1].max() < 0.1
    assert np.abs(short.estimate.pose - whole.pose).max() > 1e-4
    before = np.trace(short.estimate.pose_cov[10, :2, :2])
    assert before > np.trace(whole.pose_cov[10, :2, :2])


def test_a_graph_of_a_file_is_gtsams(tmp_path: Path) -> None:
    """A pose graph with closures: information in the axes of the end, one relation backwards."""
    path = tmp_path / "square.g2o"
    path.write_text("\n".join(line for line in SQUARE.splitlines() if "XY" not in line))
    graph, _ = read_pose_graph(path)
    found = smooth_incrementally(graph, IncrementalSettings(GaussianKernel())).estimate
    factors, values = gtsam.readG2o(str(path))
    tight = gtsam.noiseModel.Isotropic.Sigma(3, 1e-3)
    factors.add(gtsam.PriorFactorPose2(0, gtsam.Pose2(1.0, 2.0, 0.5), tight))
    values = gtsam.Values()
    for k, pose in enumerate(found.pose):
        values.insert(k, gtsam.Pose2(*pose))
    theirs = gtsam.LevenbergMarquardtOptimizer(factors, values).optimize()
    for k, pose in enumerate(found.pose):
        other = theirs.atPose2(k)
        assert pose == pytest.approx([other.x(), other.y(), other.theta()], abs=2e-3), k
    assert graph.is_closure.tolist() == [False, False, False, True]
    assert found.pose[0] == pytest.approx([1.0, 2.0, 0.5], abs=1e-6)


def test_dialects_say_the_same(tmp_path: Path) -> None:
    """TORO has another order of its information, PyFG covariances, times, and names."""
    (tmp_path / "a.g2o").write_text("EDGE_SE2 0 1 1 0 0.5 100 5 1 80 2 900\n")
    (tmp_path / "a.toro").write_text("EDGE2 0 1 1 0 0.5 100 5 80 900 1 2\n")
    cov = np.linalg.inv(np.array([[100.0, 5.0, 1.0], [5.0, 80.0, 2.0], [1.0, 2.0, 900.0]]))
    half = " ".join(f"{cov[i, j]:.17g}" for i in range(3) for j in range(i, 3))
    (tmp_path / "a.pyfg").write_text(
        "VERTEX_SE2 10.5 A0 1 2 0\nVERTEX_SE2 11.5 A1 2 2 0.5\nVERTEX_XY L3 4 5\n"
        f"EDGE_SE2 10.5 A0 A1 1 0 0.5 {half}\nEDGE_RANGE 10.5 A0 L3 4.2 0.04\n"
    )
    first, second, third = (
        read_pose_graph(tmp_path / f"a.{suffix}")[0] for suffix in ("g2o", "toro", "pyfg")
    )
    assert second.step_cov == pytest.approx(first.step_cov)
    assert third.step_cov == pytest.approx(first.step_cov)
    assert third.time_s.tolist() == [0.0, 1.0]
    assert third.names == ("3",)
    assert third.measured[0, 0] == 4.2
    assert np.isnan(third.measured[0, 1])
    assert third.sigma[0, 0] == pytest.approx(0.2)
    assert third.truth[1].tolist() == [2.0, 2.0, 0.5]


def test_a_gross_closure_loses_its_weight(tmp_path: Path) -> None:
    """By the command; a landmark's row in x and y is a range and a bearing."""
    rows = [f"EDGE_SE2 {k} {k + 1} 1 0 {np.pi / 4} 400 0 0 400 0 2500" for k in range(15)]
    rows += [f"EDGE_SE2 {k} {k + 8} 0 0 0 400 0 0 400 0 2500" for k in range(8)]
    rows += ["EDGE_SE2 2 13 5 5 1 400 0 0 400 0 2500", "EDGE_SE2_XY 3 90 0 2 25 0 25"]
    path = tmp_path / "ring.g2o"
    path.write_text("\n".join(rows))
    graph, _ = read_pose_graph(path)
    assert graph.measured[0] == pytest.approx([2.0, np.pi / 2.0])
    assert graph.sigma[0] == pytest.approx([0.2, 0.1])
    found = smooth_incrementally(graph)
    assert found.closure_weights[-1] < 0.01
    assert found.closure_weights[:-1].min() > 0.9
    assert main(["slam", str(path), "--method", "isam2", "--out", str(tmp_path / "out")]) == 0
    assert main(["slam", str(path), "--method", "ekf", "--out", str(tmp_path / "no")]) == 2


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("EDGE_SE2 0 1 1 0 0.5 100 5 0 80 0", "a.g2o:1: EDGE_SE2: expected more numbers"),
        ("EDGE_SE2 0 1 1 0 0.5 100 5 0 -80 0 900", "positive definite"),
        ("EDGE_SE2 0 1 1 0 nan 100 5 0 80 0 900", "expected finite numbers"),
        ("EDGE_SE2 0 1 one 0 1 100 5 0 80 0 900", "expected numbers; got"),
        ("EDGE_SE2 1 1 1 0 0.5 100 5 0 80 0 900", "this is one with itself"),
        ("EDGE_SE2 0 b 1 0 0.5 100 5 0 80 0 900", "expected poses by number, got 'b'"),
        ("EDGE_SE2 0 2 1 0 0.5 100 5 0 80 0 900", "no odometry from pose|tied to the one before"),
        ("EDGE_SE3:QUAT 0 1 1 0 0", "expected a graph in the plane"),
        ("ODOMETRY 0 1", "expected VERTEX_SE2"),
        ("VERTEX_SE2 0 1 2 0.5", "expected relations of poses"),
    ],
)
def test_bad_graphs_are_refused(tmp_path: Path, line: str, said: str) -> None:
    """With file, line, and what was expected."""
    path = tmp_path / "a.g2o"
    lines = [line, "EDGE_SE2 1 2 1 0 0 1 0 0 1 0 1"] if "0 2 1 0" in line else [line]
    path.write_text("\n".join(lines))
    with pytest.raises(DataError, match=said):
        read_pose_graph(path)


def test_landmarks_heard_by_ranges_are_placed() -> None:
    """From odometry alone, and then smoothed, in both ways."""
    problem, truth = small(np.random.default_rng(2), n_poses=40)
    measured = problem.measured.copy()
    measured[:, 1] = np.nan
    heard = replace(problem, measured=measured)
    nowhere: Array = np.full((4, 2), np.nan)
    places = placed(heard, NOISE.observation, heard.dead_reckoned(), nowhere)
    assert np.abs(places - truth.landmarks).max() < 1.0
    whole = smooth_landmarks(heard, NOISE, Values(heard.dead_reckoned(), places))
    found = taken(heard, NOISE, LogKernel(5.0)).estimate
    assert np.abs(whole.landmarks - truth.landmarks).max() < 0.6
    assert found.landmarks == pytest.approx(whole.landmarks, abs=0.02)


def test_fewer_poses_miss_by_the_same() -> None:
    """Increments put together: their noise is what elimination gives, to second order."""
    rng = np.random.default_rng(1)
    K, motion = 7, Odometry()
    control = np.hstack([np.tile([0.5, 0.05, 0.3], (K - 1, 1)), np.ones((K - 1, 3))])
    noise = SlamNoise(np.array([0.02, 0.01, 0.015]), NOISE.observation)
    seen = np.array([0, K - 1])
    problem = SlamProblem(
        np.arange(float(K)), motion, control, seen, np.zeros(2, int), np.ones((2, 2)), ("1",),
        np.array([1.0, 2.0, 0.7]), np.full(3, 1e-3),
    )  # fmt: skip
    short, unit, kept = problem.condensed(noise)
    assert kept.tolist() == [0, K - 1]
    ends = np.tile(problem.start, (4000, 1))
    for step in control:
        ends = composed(ends, motion.increment(step, noise.control * rng.normal(size=(4000, 3))))
    errors = between(problem.start, ends) - short.control[0, :3]
    white = np.linalg.inv(short.motion.basis(short.control)[0] * unit.control)
    assert np.cov(white @ errors.T) == pytest.approx(np.eye(3), abs=0.12)
    spread = problem.expanded(problem.dead_reckoned()[kept], kept)
    assert spread == pytest.approx(problem.dead_reckoned(), abs=1e-12)


def test_a_graph_without_closures_is_a_log(tmp_path: Path) -> None:
    """So that filters and the smoother of a log take it."""
    path = tmp_path / "line.g2o"
    path.write_text("\n".join(x for x in SQUARE.splitlines() if not x.startswith("EDGE_SE2 0 3")))
    graph, _ = read_pose_graph(path)
    problem, noise = problem_of_graph(graph)
    again = graph_of_problem(problem, noise)
    assert again.step_cov == pytest.approx(graph.step_cov, abs=2e-8)
    assert again.step == pytest.approx(graph.step[[0, 1, 2]])
    assert again.sigma == pytest.approx(graph.sigma)


def test_a_graph_that_tells_nothing_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Odometry alone; sigmas beyond what numbers hold."""
    path, out = tmp_path / "a.g2o", str(tmp_path / "out")
    path.write_text("EDGE_SE2 0 1 1 0 0.5 100 5 0 80 0 900\nEDGE_SE2_XY 0 1 2 1 25 0 25\n")
    assert main(["slam", str(path), "--out", out]) == 3
    assert "got odometry alone; has a landmark the number of a pose" in capsys.readouterr().err
    assert main(["slam", str(path), "--robot", "2", "--out", out]) == 2
    rigid = "1e300 0 0 1e300 0 1e300"
    path.write_text(f"EDGE_SE2 0 1 1 0 0 {rigid}\nEDGE_SE2 1 0 1 0 0 1 0 0 1 0 1\n")
    assert main(["slam", str(path), "--out", out]) == 5
    assert "iSAM2 at pose 1" in capsys.readouterr().err


def test_what_is_not_taken_has_no_weight() -> None:
    """One pose alone; a closure to a pose that the lag has dropped."""
    problem, _ = small(np.random.default_rng(0))
    here = problem.keyframe == 0
    one = replace(
        problem, time_s=problem.time_s[:1], control=problem.control[:0],
        keyframe=problem.keyframe[here], landmark=problem.landmark[here],
        measured=problem.measured[here],
    )  # fmt: skip
    assert taken(one, NOISE, GaussianKernel()).estimate.pose[0] == pytest.approx(one.start)
    graph = graph_of_problem(problem, NOISE)
    last = len(graph.time_s) - 1
    closed = replace(
        graph, pairs=np.vstack([graph.pairs, [0, last]]), step=np.vstack([graph.step, np.zeros(3)]),
        step_cov=np.concatenate([graph.step_cov, np.eye(3)[None]]),
    )  # fmt: skip
    found = smooth_incrementally(closed, IncrementalSettings(lag_s=5.0))
    assert found.closure_weights.tolist() == [0.0]
    assert "the lag had dropped, left out: 1" in found.estimate.notes[-1]
