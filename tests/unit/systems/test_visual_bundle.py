"""Bundle adjustment against GTSAM, its two forms, its Jacobians and its posterior variances."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from numpy.typing import NDArray

from factors import so3
from ssm_graph.systems.visual_ranges import bundle_rows
from ssm_graph.systems.visual_ranges.bundle import Effort, Problem, adjust, sorted_views
from ssm_graph.systems.visual_ranges.geometry import pose_equations, pose_equations_numpy

Array = NDArray[np.float64]
SCALE = 400.0
"""pixels: one over the sigma of normalised coordinates"""


def made_problem(seed: int = 0, n_poses: int = 6, n_points: int = 60) -> Problem:
    """Return poses along a bent path that see a cloud, with noise in everything but two poses."""
    rng = np.random.default_rng(seed)
    points = rng.uniform([-2.0, -1.5, 3.0], [2.0, 1.5, 7.0], (n_points, 3))
    along = np.linspace(0.0, 1.0, n_poses)
    centre = np.stack([1.5 * along, 0.2 * np.sin(3.0 * along), 0.3 * along**2], axis=1)
    R = so3.exp(np.stack([0.05 * along, -0.25 * along, 0.1 * along], axis=1))
    t = -np.einsum("kij,kj->ki", R, centre)
    seen = rng.uniform(size=(n_poses, n_points)) < 0.7
    seen[[0, -1]] = True  # a point of one view has no depth
    pose, point = np.nonzero(seen)
    x_c = np.einsum("nij,nj->ni", R[pose], points[point]) + t[pose]
    xy = x_c[:, :2] / x_c[:, 2:] + rng.normal(0.0, 1.0 / SCALE, (len(pose), 2))
    views = sorted_views(pose, point, xy, np.full((len(pose), 2), SCALE), n_points)
    free = np.arange(n_poses) >= 2
    off = rng.normal(0.0, 0.01, (n_poses, 6)) * free[:, None]
    turn = so3.exp(off[:, 3:])
    moved_t = np.einsum("kij,kj->ki", turn, t) + off[:, :3]
    noisy = points + rng.normal(0.0, 0.05, points.shape)
    return Problem(turn @ R, moved_t, free, noisy, views)


def gtsam_optimum(problem: Problem) -> tuple[gtsam.Values, float]:
    """Return GTSAM's minimum of the same problem and its cost."""
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    K, noise = (
        gtsam.Cal3_S2(1.0, 1.0, 0.0, 0.0, 0.0),
        gtsam.noiseModel.Isotropic.Sigma(2, 1 / SCALE),
    )
    for k, (R, t) in enumerate(zip(problem.R_cw, problem.t_cw, strict=True)):
        pose = gtsam.Pose3(gtsam.Rot3(R), t).inverse()
        values.insert(gtsam.symbol("x", k), pose)
        if not problem.free[k]:
            graph.add(gtsam.NonlinearEqualityPose3(gtsam.symbol("x", k), pose))
    for i, X in enumerate(problem.points):
        values.insert(gtsam.symbol("l", i), X)
    views = problem.views
    for k, i, xy in zip(views.pose, views.point, views.xy, strict=True):
        x, p = gtsam.symbol("x", int(k)), gtsam.symbol("l", int(i))
        graph.add(gtsam.GenericProjectionFactorCal3_S2(xy, noise, x, p, K))
    params = gtsam.LevenbergMarquardtParams()
    params.setRelativeErrorTol(1e-15)
    params.setAbsoluteErrorTol(1e-15)
    found = gtsam.LevenbergMarquardtOptimizer(graph, values, params).optimize()
    return found, graph.error(found)


def test_the_optimum_is_gtsams() -> None:
    """Least squares: cost to 1e-6 relative, poses and points to 1e-6."""
    problem = made_problem()
    found = adjust(problem, Effort(steps=60, settled=1e-14, posterior_from=None, dof=float("inf")))
    wanted, cost = gtsam_optimum(problem)
    assert found.cost == pytest.approx(cost, rel=1e-6)
    for k in range(len(problem.R_cw)):
        pose = wanted.atPose3(gtsam.symbol("x", k)).inverse()
        np.testing.assert_allclose(found.R_cw[k], pose.rotation().matrix(), atol=1e-6)
        np.testing.assert_allclose(found.t_cw[k], pose.translation(), atol=1e-6)
    places = [wanted.atPoint3(gtsam.symbol("l", i)) for i in range(len(problem.points))]
    np.testing.assert_allclose(found.points, places, atol=1e-6)


def test_loops_and_numpy_are_one() -> None:
    """The compiled form and NumPy's give the same errors, system and variances."""
    p = made_problem(1)
    rng = np.random.default_rng(0)
    weight = rng.uniform(0.1, 1.2, len(p.views.point))
    column = np.where(p.free, np.cumsum(p.free) - 1, -1)
    state = (p.R_cw, p.t_cw, p.points, p.views)
    np.testing.assert_allclose(
        bundle_rows.errors(*state), bundle_rows.errors_numpy(*state), rtol=0, atol=1e-9
    )
    a = bundle_rows.reduced(*state, weight, column, 1e-3)
    b = bundle_rows.reduced_numpy(*state, weight, column, 1e-3)
    for name, one, other in zip(a._fields, a, b, strict=True):
        size = np.abs(other).max()
        np.testing.assert_allclose(one, other, rtol=0, atol=1e-10 * size, err_msg=name)
    covariance: Array = np.asarray(np.linalg.inv(b.matrix), dtype=np.float64)
    np.testing.assert_allclose(
        bundle_rows.variances(*state, a, column, covariance),
        bundle_rows.variances_numpy(*state, b, column, covariance),
        rtol=1e-8,
    )


def test_jacobians_by_differences() -> None:
    """To 1e-7 of their size, by pose from the left and by point."""
    p = made_problem(2, n_poses=3, n_points=8)
    _, by_pose, by_point = bundle_rows.jacobians(p.R_cw, p.t_cw, p.points, p.views)
    step = 1e-6
    size = np.abs(by_pose).max()
    for axis in range(6):
        xi = np.zeros(6)
        ends = []
        for sign in (1.0, -1.0):
            xi[axis] = sign * step
            turn = so3.exp(xi[3:])
            ends.append(
                bundle_rows.errors_numpy(turn @ p.R_cw, p.t_cw @ turn.T + xi[:3], p.points, p.views)
            )
        slope = (ends[0] - ends[1]) / (2.0 * step)
        np.testing.assert_allclose(by_pose[:, :, axis], slope, atol=1e-7 * size)
    for axis in range(3):
        shift = step * np.eye(3)[axis]
        ahead = bundle_rows.errors_numpy(p.R_cw, p.t_cw, p.points + shift, p.views)
        behind = bundle_rows.errors_numpy(p.R_cw, p.t_cw, p.points - shift, p.views)
        slope = (ahead - behind) / (2.0 * step)
        np.testing.assert_allclose(by_point[:, :, axis], slope, atol=1e-7 * size)


def dense_variances(p: Problem) -> Array:
    """Return half the trace of ``J P J'`` of each view, by the inverse of everything at once."""
    _, by_pose, by_point = bundle_rows.jacobians(p.R_cw, p.t_cw, p.points, p.views)
    column = np.where(p.free, np.cumsum(p.free) - 1, -1)
    n_pose, n = 6 * int(p.free.sum()), len(p.views.point)
    J = np.zeros((n, 2, n_pose + 3 * len(p.points)))
    for o in range(n):
        k, i = column[p.views.pose[o]], p.views.point[o]
        if k >= 0:
            J[o, :, 6 * k : 6 * k + 6] = by_pose[o]
        J[o, :, n_pose + 3 * i : n_pose + 3 * i + 3] = by_point[o]
    rows = J.reshape(2 * n, -1)
    P = np.linalg.inv(rows.T @ rows)
    return np.asarray(0.5 * np.einsum("nka,ab,nkb->n", J, P, J))


def test_posterior_variances_are_those_of_the_whole_inverse() -> None:
    """Poses, points and what they share, without ever forming the whole system."""
    p = made_problem(3, n_poses=5, n_points=25)
    column = np.where(p.free, np.cumsum(p.free) - 1, -1)
    state = (p.R_cw, p.t_cw, p.points, p.views)
    system = bundle_rows.reduced(*state, np.ones(len(p.views.point)), column, 0.0)
    covariance: Array = np.asarray(np.linalg.inv(system.matrix), dtype=np.float64)
    found = bundle_rows.variances(*state, system, column, covariance)
    np.testing.assert_allclose(found, dense_variances(p), rtol=1e-5)


def test_wrong_views_get_little_weight() -> None:
    """Weights take out gross errors that least squares would follow."""
    p = made_problem(4)
    rng = np.random.default_rng(5)
    wrong = rng.choice(len(p.views.point), 20, replace=False)
    xy = p.views.xy.copy()
    xy[wrong] += rng.choice([-1.0, 1.0], (20, 2)) * 30.0 / SCALE
    spoiled = replace(p, views=p.views._replace(xy=xy))
    robust = adjust(spoiled, Effort(steps=30))
    clean = adjust(p, Effort(steps=30))
    assert robust.weight[wrong].max() < 0.1
    assert np.median(np.delete(robust.weight, wrong)) > 0.7
    off = np.abs(robust.t_cw - clean.t_cw).max()
    plain = adjust(spoiled, Effort(steps=30, dof=float("inf")))
    assert off < 0.2 * np.abs(plain.t_cw - clean.t_cw).max()


def test_pose_equations_are_one() -> None:
    """The compiled form of the pose's equations and NumPy's agree, points behind the camera too."""
    p = made_problem(6)
    rng = np.random.default_rng(0)
    points = np.vstack([p.points, [[0.0, 0.0, -3.0]]])
    xy, scale = rng.normal(0.0, 0.3, (len(points), 2)), np.full((len(points), 2), SCALE)
    state = (p.R_cw[3], p.t_cw[3], points, xy, scale)
    for one, other in zip(pose_equations(*state), pose_equations_numpy(*state), strict=True):
        size = np.abs(other[np.isfinite(other)]).max()
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-12 * size)
