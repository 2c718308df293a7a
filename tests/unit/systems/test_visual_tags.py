"""A path from few marks and ranges alone: its rows, and where it ends on simulated marks."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from factors.so3 import exp
from ssm_graph.systems.visual_ranges.camera import Camera
from ssm_graph.systems.visual_ranges.ranges import Ranges, screened_ranges
from ssm_graph.systems.visual_ranges.similarity3 import umeyama
from ssm_graph.systems.visual_ranges.tag_path import DENSITY, TagWeights, one_pass, widened
from ssm_graph.systems.visual_ranges.tag_rows import (
    DIM,
    TagProblem,
    TagSightings,
    TagValues,
    motion_rows,
    range_rows,
    sighting_rows,
)
from ssm_graph.systems.visual_ranges.tag_start import tag_path

Array = NDArray[np.float64]


def _any_problem() -> tuple[TagProblem, TagValues]:
    rng = np.random.default_rng(5)
    K, T, J = 4, 3, 2
    problem = TagProblem(
        np.array([0.0, 0.1, 0.25, 0.3]),
        np.array([0, 0, 1, 2, 3, 3]),
        np.array([0, 1, 1, 2, 0, 2]),
        rng.normal(0.0, 0.1, (6, 2, 2)),
        1e-3,
        0.12,
        np.array([0, 1, 2, 3]),
        rng.uniform(-0.05, 0.05, 4),
        np.array([0, 1, 0, 1]),
        rng.uniform(2.0, 5.0, 4),
        np.full(4, 0.1),
        np.array([0.1, -0.05, 0.02]),
    )
    values = TagValues(
        exp(rng.normal(0.0, 0.3, (K, 3))),
        rng.normal(0.0, 0.3, (K, 3)),
        rng.normal(size=(K, 3)),
        rng.normal(size=(K, 3)),
        np.array([0.0, 0.0, 4.0]) + rng.normal(0.0, 0.5, (T, 3)),
        rng.normal(0.0, 3.0, (J, 3)),
        rng.normal(0.0, 0.1, (K, J)),
        0.01,
        rng.normal(0.0, 0.01, 3),
        0.02,
    )
    return problem, values


def test_rows_are_the_slopes_of_their_errors() -> None:
    """Jacobians of sightings, ranges and motion equal central differences, to 1e-6."""
    problem, values = _any_problem()
    K, n, C, h = len(values.place), values.dim, values.n_constants, 1e-6
    density = np.array([2.0, 1.0, 4e-4])

    def errors(step: np.ndarray, constants: np.ndarray) -> np.ndarray:
        at = values.moved(step, constants)
        own = sighting_rows(problem, at).error, range_rows(problem, at).error
        return np.concatenate([*own, motion_rows(problem.time_s, at, density)[1].ravel()])

    slopes = []
    for i in range(K * n + C):
        change = np.zeros(K * n + C)
        change[i] = h
        ends = [
            errors(sign * change[: K * n].reshape(K, n), sign * change[K * n :])
            for sign in (1.0, -1.0)
        ]
        slopes.append((ends[0] - ends[1]) / (2.0 * h))
    wanted = np.array(slopes).T
    made = np.zeros_like(wanted)
    row = 0
    for own in (sighting_rows(problem, values), range_rows(problem, values)):
        for k, slope in zip(own.knot, own.rows, strict=True):
            made[row, k * n : (k + 1) * n], made[row, K * n :] = slope[:n], slope[n:]
            row += 1
    for k, block in enumerate(motion_rows(problem.time_s, values, density)[0]):
        made[row : row + n, k * n : (k + 2) * n] = block
        row += n
    assert n == DIM + 2
    largest = np.abs(wanted).max(axis=1)[:, None]
    np.testing.assert_allclose(made / largest, wanted / largest, atol=1e-6)


def test_ranges_that_place_no_anchor_keep_their_sigmas() -> None:
    """Sightings alone go on."""
    problem, values = _any_problem()
    values = values._replace(anchors=np.zeros((0, 3)), biases=np.zeros((4, 0)))
    weights = TagWeights(np.ones(6), np.ones(4), np.array(DENSITY))
    found = widened(problem, one_pass(problem, values, weights))
    np.testing.assert_array_equal(found.range_sigma, problem.range_sigma)
    assert found.seen_sigma > problem.seen_sigma


def _walk(seed: int, last_s: float) -> tuple[TagSightings, Ranges, Array, Array, Array]:
    """Return marks on the walls of a room and ranges to three corners, lever arm, and the truth."""
    rng = np.random.default_rng(seed)
    camera = Camera(1920, 1080, 1077.0, 1077.0, 937.0, 533.0)
    lever, base = np.array([-0.1, -0.1, 0.05]), np.array([0.12, 0.0, 0.0])
    anchors = np.array([[3.0, 3.0, 1.6], [-3.0, 3.0, 0.4], [-3.0, -3.0, 1.7], [3.0, -3.0, 0.2]])
    wall = rng.uniform(-3.0, 3.0, 40)
    side = np.arange(40) % 4 * np.pi / 2.0
    tags = np.stack(
        [3.0 * np.cos(side) - wall * np.sin(side), 3.0 * np.sin(side) + wall * np.cos(side),
         rng.uniform(0.3, 2.3, 40)], axis=1,
    )  # fmt: skip

    def pose(time_s: Array) -> tuple[Array, Array]:
        a = 0.35 * time_s
        place = np.stack([1.5 * np.cos(a), 1.3 * np.sin(1.3 * a), 1.3 + 0.4 * np.sin(2.1 * a)], 1)
        heading = 1.2 * a + 0.3 * np.sin(a)
        level = np.stack([np.sin(heading), -np.cos(heading), 0.0 * a], axis=1)
        down = np.broadcast_to([0.0, 0.0, -1.0], level.shape)
        ahead = np.stack([np.cos(heading), np.sin(heading), 0.0 * a], axis=1)
        return np.stack([level, down, ahead], axis=2), place

    rows: list[tuple[float, int, Array, Array]] = []
    for time_s in np.arange(0.0, last_s, 0.13):
        R, p = (x[0] for x in pose(np.array([time_s])))
        x_c = (tags - p) @ R
        both = [camera.project(x_c), camera.project((x_c - base) @ exp(np.array([0, 1e-3, 0])))]
        seen = camera.contains(both[0]) & camera.contains(both[1]) & (x_c[:, 2] > 0.5)
        for j in np.flatnonzero(seen & (rng.uniform(size=40) < 0.6)):
            left, right = (side[j] + rng.normal(0.0, 0.5, 2) for side in both)
            rows.append((time_s, 100 + int(j), left, right))
    time_s = np.sort(rng.uniform(0.0, last_s, int(40 * last_s)))
    which = rng.integers(0, 4, len(time_s))
    R, p = pose(time_s)
    away = np.linalg.norm(p + R @ lever - anchors[which], axis=1)
    measured = away - 0.05 + rng.normal(0.0, 0.08, len(away))
    ranges = screened_ranges(time_s, [f"A{j}" for j in which], measured)
    columns = [np.array(column) for column in zip(*rows, strict=True)]
    sightings = TagSightings(camera, columns[0], columns[1], columns[2], columns[3], 0.12)
    return sightings, ranges, lever, pose(np.unique(columns[0]))[1], anchors


@pytest.mark.slow
def test_marks_and_ranges_make_a_metric_path() -> None:
    """Two or three marks an image and ranges to unknown anchors hold a path to some centimetres."""
    sightings, ranges, lever, true, anchors = _walk(3, 9.0)
    found = tag_path(sightings, ranges, lever)
    at = np.searchsorted(found.time_s, np.unique(sightings.time_s))
    to_world = umeyama(found.place[at], true, with_scale=False)
    off = np.linalg.norm(to_world.apply(found.place[at]) - true, axis=1)
    assert np.sqrt(np.mean(off**2)) < 0.05
    order = [ranges.names.index(f"A{j}") for j in range(4)]
    assert np.linalg.norm(to_world.apply(found.anchors[order]) - anchors, axis=1).max() < 0.5
