"""A loop closed: a graph of similarities spreads the drift, points follow, double points join."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple

import gtsam
import numpy as np
from numpy.typing import NDArray

from factors.metric_step import metric_step_factor
from ssm_graph.systems.visual_ranges.camera import Camera
from ssm_graph.systems.visual_ranges.geometry import in_camera
from ssm_graph.systems.visual_ranges.loops import Match, bit_distances, mutual, points_of
from ssm_graph.systems.visual_ranges.similarity3 import Sim3
from ssm_graph.systems.visual_ranges.visual_map import VisualMap

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

TURN_SIGMA: Final = 0.01
"""rad, of the turn between two key frames that follow each other."""
STEP_SIGMA: Final = 0.02
"""Of the way between them, a share of it; of the depth seen for those that stand still."""
SCALE_SIGMA: Final = 0.01
"""Of the logarithm of their scales' ratio."""
LOOP_TURN_SIGMA: Final = 0.003
"""rad, of the pose found by some dozens of points."""
LOOP_STEP_SIGMA: Final = 0.005
"""Share of the depth seen."""
NEAR_PX: Final = 6.0
"""An old point and a corner so near to each other may be one, if they look alike."""
ALIKE_BITS: Final = 50


class Step(NamedTuple):
    """Dead reckoning between two key frames; see :func:`factors.metric_step.metric_step_factor`."""

    first: int
    second: int
    step: Array
    """(3,) axes of the first, map units"""
    sigma: float
    weight: float


class Closed(NamedTuple):
    """What closing did."""

    change: list[Sim3]
    """(K,) by key frame, where its surroundings went: old map to new map."""
    n_fused: int
    """Points that were there twice."""


def close_loop(
    world: VisualMap, match: Match, camera: Camera, steps: Sequence[Step] = ()
) -> Closed:
    """Spread the correction over all key frames since the match; points go with their key frame.

    ``steps`` of dead reckoning hold the map's scale meanwhile.

    Poses and points of ``world`` are changed; a bundle adjustment over all should follow.
    """
    change = _optimised(world, match, steps)
    R = np.stack([one.R for one in change])
    t = np.stack([one.t for one in change])
    scale = np.array([one.scale for one in change])
    born = world.points["born"]
    place = world.points["place"]
    place[:] = scale[born, None] * np.einsum("pij,pj->pi", R[born], place) + t[born]
    centre = -np.einsum("kji,kj->ki", world.frames["R_cw"], world.frames["t_cw"])
    centre = scale[:, None] * np.einsum("kij,kj->ki", R, centre) + t
    R_cw = np.einsum("kij,klj->kil", world.frames["R_cw"], R)
    world.set_poses(np.arange(world.n_frames), R_cw, -np.einsum("kij,kj->ki", R_cw, centre))
    world.frames["depth"][:] *= scale
    world.frames["grown"][:] *= scale
    return Closed(change, _fused(world, match, camera))


def _optimised(world: VisualMap, match: Match, steps: Sequence[Step]) -> list[Sim3]:
    """Return by key frame the similarity from where it is to where the graph puts it."""
    n = world.n_frames
    poses = [world.pose(k).inverse() for k in range(n)]
    nodes = [gtsam.Similarity3(gtsam.Rot3(R), t, 1.0) for R, t in poses]
    depth = np.maximum(world.frames["depth"], 1e-6)
    graph = gtsam.NonlinearFactorGraph()
    fixed = gtsam.noiseModel.Isotropic.Sigma(7, 1e-6)
    graph.add(gtsam.PriorFactorSimilarity3(0, nodes[0], fixed))
    for step in (1, 4):
        for i in range(n - step):
            way = float(np.linalg.norm(poses[i + step].t_cw - poses[i].t_cw))
            sigma = STEP_SIGMA * max(way, 0.05 * float(depth[i]))
            model = _model(TURN_SIGMA, sigma, SCALE_SIGMA, step)
            between = nodes[i].between(nodes[i + step])
            graph.add(gtsam.BetweenFactorSimilarity3(i, i + step, between, model))
    for one in steps:
        keys = (one.first, one.second)
        graph.add(metric_step_factor(keys, sigma=one.sigma, step=one.step, weight=one.weight))
    q, m = match.key_frame, match.matched
    c = match.correction
    wanted = c.apply(poses[q].t_cw)
    moved = gtsam.Similarity3(gtsam.Rot3(c.R @ poses[q].R_cw), wanted / c.scale, c.scale)
    sigma = LOOP_STEP_SIGMA * float(depth[m])
    model = _model(LOOP_TURN_SIGMA, sigma, max(match.scale_sigma, 0.002), 1)
    graph.add(gtsam.BetweenFactorSimilarity3(m, q, nodes[m].between(moved), model))
    values = gtsam.Values()
    for k, node in enumerate(nodes):
        values.insert(k, node)
    found = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    change = []
    for k, (R_wc, centre) in enumerate(poses):
        node = found.atSimilarity3(k)
        s, R_new = node.scale(), node.rotation().matrix()
        R = R_new @ R_wc.T
        change.append(Sim3(R, s * node.translation() - s * (R @ centre), s))
    return change


def _model(turn: float, step: float, scale: float, n: int) -> gtsam.noiseModel.Diagonal:
    """Return the noise of an edge over ``n`` key frames, in GTSAM's order turn, step, scale."""
    sigmas = np.array([turn] * 3 + [step] * 3 + [scale]) * np.sqrt(n)
    return gtsam.noiseModel.Diagonal.Sigmas(sigmas)


def _fused(world: VisualMap, match: Match, camera: Camera) -> int:
    """Join what the two ends of the loop see twice; return how many points went."""
    before = int(world.points["valid"].sum())
    _join(world, match.rows, match.points)
    old = points_of(world, _around(world, match.matched))
    for k in _around(world, match.key_frame):
        if k <= match.matched:
            continue
        rows, points = _near(world, k, old[world.points["valid"][old]], camera)
        _join(world, rows, points)
    return before - int(world.points["valid"].sum())


def _around(world: VisualMap, k: int) -> list[int]:
    shared = world.shared(k)
    best = np.argsort(-shared, kind="stable")[:10]
    return sorted({k, *(int(other) for other in best if shared[other] >= 15)})


def _near(world: VisualMap, k: int, points: Indices, camera: Camera) -> tuple[Indices, Indices]:
    """Return key points of a key frame and the old points that they may show."""
    x_c = in_camera(world.pose(k), world.points["place"][points])
    x_c[x_c[:, 2] <= 1e-6] = np.nan
    seen = camera.project(x_c)
    is_in = camera.contains(seen)
    points, seen = points[is_in], seen[is_in]
    rows = np.arange(*world.rows_of(k).indices(world.rows.size))
    if min(len(points), len(rows)) < 2:
        return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
    away = np.linalg.norm(world.rows["pixel"][rows][:, None] - seen[None], axis=2)
    distance = bit_distances(
        world.rows["descriptor"][rows], world.rows["descriptor"][world.points["row"][points]]
    )
    left, right = mutual(np.where(away < NEAR_PX, distance, 999).astype(np.int32), ALIKE_BITS)
    return rows[left], points[right]


def _join(world: VisualMap, rows: Indices, points: Indices) -> None:
    """Let key points show old points: their own points, if any, become one with these."""
    valid = world.points["valid"][points]
    rows, points = rows[valid], points[valid]
    own = world.rows["point"][rows]
    double = (own >= 0) & (own != points)
    if double.any():
        world.fuse(points[double], own[double])
    seen_by = world.rows["point"][rows]
    for row, point in zip(rows[seen_by < 0].tolist(), points[seen_by < 0].tolist(), strict=True):
        frame = world.rows_of(int(world.rows["frame"][row]))
        if point not in world.rows["point"][frame]:
            world.rows["point"][row] = point
            world.points["views"][point] += 1
