"""Loops: words, geometry, the judges that refuse false ones, the correction, maps on disk."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ssm_graph.base.errors import DataError
from ssm_graph.systems.visual_ranges.binary_words import PlaceIndex, WordTree, hamming
from ssm_graph.systems.visual_ranges.camera import Camera
from ssm_graph.systems.visual_ranges.loop_closing import close_loop
from ssm_graph.systems.visual_ranges.loop_settings import LoopSettings
from ssm_graph.systems.visual_ranges.loops import (
    LoopFinder,
    Match,
    RangeJudgement,
    bit_distances,
    place_camera,
)
from ssm_graph.systems.visual_ranges.map_files import load_map, save_map, world_of
from ssm_graph.systems.visual_ranges.result import FrameState, MapSnapshot, VisualResult
from ssm_graph.systems.visual_ranges.similarity3 import IDENTITY, Sim3, umeyama
from ssm_graph.systems.visual_ranges.visual_map import VisualMap

pytest.importorskip("cv2")
Array = NDArray[np.float64]
CAMERA = Camera(640, 480, 460.0, 460.0, 319.5, 239.5)
N_LAP = 40
RADIUS = 6.0
DRIFT = Sim3(Rotation.from_rotvec([0.02, 0.1, -0.03]).as_matrix(), np.array([0.3, 0.1, -0.4]), 1.08)
"""Of the second lap: what the loop has to take back."""


def noisy(descriptors: NDArray[np.uint8], rng: np.random.Generator) -> NDArray[np.uint8]:
    """Return descriptors with 4 % of their bits turned."""
    turned = rng.random((len(descriptors), 256)) < 0.04
    return descriptors ^ np.packbits(turned, axis=1)


def laps(
    *, turns: float = 1.3, is_repeated: bool = False, all_drift: Sim3 = DRIFT
) -> tuple[MapSnapshot, Array]:
    """Return a map of a walk round a ring, looking outwards, that drifts bit by bit, and the truth.

    Points of the second lap are others than those of the first, as those of a drifted map are,
    though they are the same corners. Where the walls repeat, corners look alike every third of the
    ring.
    """
    rng = np.random.default_rng(4)
    n_walls, n_frames = 1500, int(N_LAP * turns)
    angle = rng.uniform(0.0, 2.0 * np.pi, n_walls)
    radius = RADIUS + rng.uniform(3.0, 6.0, n_walls)
    looks = rng.integers(0, 256, (n_walls, 32), dtype=np.uint8)
    height = rng.uniform(-2, 2, n_walls)
    if is_repeated:
        third = n_walls // 3
        angle = np.concatenate([angle[:third] / 3 + k * 2 * np.pi / 3 for k in range(3)])
        radius, height, looks = (np.concatenate([x[:third]] * 3) for x in (radius, height, looks))
    corners = np.stack([radius * np.cos(angle), height, radius * np.sin(angle)], 1)
    turn = 2.0 * np.pi * np.arange(n_frames) / N_LAP
    out = np.stack([np.cos(turn), 0 * turn, np.sin(turn)], 1)
    R_wc = np.stack([np.cross([0, 1.0, 0], out), np.tile([0, 1.0, 0], (n_frames, 1)), out], 2)
    centre = RADIUS * out
    step = Rotation.from_matrix(all_drift.R).as_rotvec()
    share = np.arange(n_frames) / (n_frames - 1)
    number: dict[tuple[int, int], int] = {}
    points: list[Array] = []
    rows = []
    R_cw, t_cw = np.empty((n_frames, 3, 3)), np.empty((n_frames, 3))
    for k in range(n_frames):
        drift = Sim3(
            Rotation.from_rotvec(step * share[k]).as_matrix(), all_drift.t * share[k],
            all_drift.scale ** share[k],
        )  # fmt: skip
        R_cw[k] = (drift.R @ R_wc[k]).T
        t_cw[k] = -R_cw[k] @ drift.apply(centre[k])
        seen = CAMERA.project((corners - centre[k]) @ R_wc[k])
        inside = np.flatnonzero(CAMERA.contains(seen, 8.0))
        for corner in inside:
            key = (int(corner), (k + 10) // N_LAP)
            if key not in number:
                number[key] = len(points)
                points.append(drift.apply(corners[corner]))
        pixels = seen[inside] + rng.normal(0.0, 0.3, (len(inside), 2))
        which = [number[int(c), (k + 10) // N_LAP] for c in inside]
        rows.append((pixels, noisy(looks[inside], rng), np.array(which)))
    counts = np.array([len(which) for _, _, which in rows])
    point = np.concatenate([which for _, _, which in rows])
    snapshot = MapSnapshot(
        image=np.arange(n_frames), time_s=np.linspace(0, 20, n_frames), R_cw=R_cw, t_cw=t_cw,
        covariance=np.full((n_frames, 6, 6), np.nan), points=np.array(points),
        points_views=np.bincount(point, minlength=len(points)),
        points_grey=np.zeros(len(points), np.uint8),
        points_descriptor=np.zeros((len(points), 32), np.uint8),
        first_row=np.concatenate([[0], np.cumsum(counts)]),
        pixels=np.concatenate([p for p, _, _ in rows]).astype(np.float32),
        octave=np.zeros(len(point), np.int64),
        descriptor=np.concatenate([d for _, d, _ in rows]), point=point,
        weight=np.ones(len(point)),
    )  # fmt: skip
    return snapshot, centre


def centres(world: VisualMap) -> Array:
    """Return the places of all key frames."""
    return np.asarray(-np.einsum("kji,kj->ki", world.frames["R_cw"], world.frames["t_cw"]))


def off(world: VisualMap, true: Array) -> float:
    """Return the rms error of the path, aligned."""
    moved = umeyama(centres(world), true, with_scale=True).apply(centres(world))
    return float(np.sqrt(np.mean(np.sum((moved - true) ** 2, axis=1))))


def walk(finder: LoopFinder, world: VisualMap, judge: RangeJudgement | None) -> Match | None:
    """Return the first loop that is taken as key frames come."""
    for k in range(world.n_frames):
        found = finder.look(world, k, None if judge is None else lambda _a, _b: judge)
        if found is not None:
            return found
    return None


def test_similarity_of_points() -> None:
    """Found again exactly, there and back; without scale where that is wanted."""
    rng = np.random.default_rng(1)
    points = rng.normal(size=(20, 3))
    found = umeyama(points, DRIFT.apply(points), with_scale=True)
    np.testing.assert_allclose(found.R, DRIFT.R, atol=1e-12)
    assert found.scale == pytest.approx(DRIFT.scale)
    np.testing.assert_allclose(found.inverse().apply(found.apply(points)), points, atol=1e-12)
    np.testing.assert_allclose(
        found.after(found).apply(points), found.apply(found.apply(points)), atol=1e-12
    )
    assert umeyama(points, DRIFT.apply(points), with_scale=False).scale == 1.0
    with pytest.raises(DataError, match="at least 3 pairs"):
        umeyama(points[:2], points[:2], with_scale=True)


def test_distances_in_bits() -> None:
    """The product of signs counts bits."""
    rng = np.random.default_rng(2)
    a, b = (rng.integers(0, 256, (n, 32), dtype=np.uint8) for n in (7, 9))
    np.testing.assert_array_equal(bit_distances(a, b), hamming(a[:, None], b[None]))


def test_words_know_a_place_again() -> None:
    """Of 40 places the right one, clearly; the same descriptors give the same tree."""
    rng = np.random.default_rng(0)
    places = [rng.integers(0, 256, (200, 32), dtype=np.uint8) for _ in range(40)]
    index = PlaceIndex()
    for place in places:
        index.add(noisy(place, rng))
    scores = index.scores(noisy(places[7], rng))
    assert scores.argmax() == 7
    assert scores[7] > 1.4 * np.sort(scores)[-2]
    one, two = (WordTree(np.concatenate(places[:5])).words(places[3]) for _ in range(2))
    np.testing.assert_array_equal(one, two)


def test_a_loop_is_found_and_takes_the_drift_back() -> None:
    """The correction is the drift between both visits; closing cuts the error, joins points."""
    snapshot, true = laps()
    world = world_of(snapshot, CAMERA)
    before = off(world, true)
    finder = LoopFinder(CAMERA)
    match = walk(finder, world, RangeJudgement(0.5, 0.1, 0.08, 60))
    assert match is not None
    assert abs(match.key_frame - match.matched - N_LAP) <= 5
    lag = (match.key_frame - match.matched) / (world.n_frames - 1)
    assert match.correction.scale == pytest.approx(DRIFT.scale**-lag, abs=0.01)
    assert finder.records[-1].is_taken
    assert "ranges agree to 0.10 m" in finder.records[-1].why
    closed = close_loop(world, match, CAMERA)
    assert closed.n_fused > 50
    assert off(world, true) < 0.25 * before
    np.testing.assert_allclose(centres(world)[0], true[0], atol=1e-6)


def test_ranges_and_the_path_refuse_false_loops() -> None:
    """Where walls repeat: ranges contradict, or too much of the path would be taken back."""
    snapshot, _ = laps(turns=0.98, is_repeated=True)
    world = world_of(snapshot, CAMERA)
    alone = LoopFinder(CAMERA, LoopSettings(least_gap=12))
    assert walk(alone, world, None) is None
    assert alone.records
    assert all("% of the path between" in x.why for x in alone.records if "in a row" not in x.why)
    judged = LoopFinder(CAMERA, LoopSettings(least_gap=12))
    assert walk(judged, world, RangeJudgement(0.1, 4.2, 0.08, 60)) is None
    assert judged.records
    assert all("ranges contradict it by 4.20 m" in loop.why for loop in judged.records)
    # Both judges silenced, the same walls do deceive the geometry.
    deaf = LoopSettings(least_gap=12, drift_alone=10.0, drift_with_ranges=10.0)
    assert walk(LoopFinder(CAMERA, deaf), world, RangeJudgement(0.1, 0.1, 0.08, 60)) is not None


def test_a_map_comes_back_from_disk(tmp_path: Path) -> None:
    """Bit for bit, with its camera; a camera is found in it by its corners."""
    snapshot, _ = laps(turns=0.6, all_drift=IDENTITY)
    n = len(snapshot.time_s)
    result = VisualResult(
        name="x", camera=CAMERA, time_s=snapshot.time_s,
        state=np.full(n, FrameState.TRACKED, dtype=np.int64), R_cw=snapshot.R_cw,
        t_cw=snapshot.t_cw, key_frame=np.arange(n), n_tracked=np.zeros(n, np.int64), map=snapshot,
    )  # fmt: skip
    save_map(tmp_path / "map.npz", result)
    saved = load_map(tmp_path / "map.npz")
    assert saved.camera == CAMERA
    assert np.isnan(saved.scale)
    np.testing.assert_array_equal(saved.map.points, snapshot.points)
    world = world_of(saved.map, saved.camera)
    k = n // 2
    rows = world.rows_of(k)
    points = np.flatnonzero(world.points["valid"])
    found = place_camera(
        world.rows["xy"][rows], world.rows["octave"][rows], world.rows["descriptor"][rows],
        world.points["place"][points], world.rows["descriptor"][world.points["row"][points]],
        CAMERA, replace(LoopSettings(), least_inliers=20),
    )  # fmt: skip
    assert found is not None
    np.testing.assert_allclose(found.pose.centre, world.pose(k).centre, atol=0.02)
    (tmp_path / "map.npz").write_bytes(b"PK\x03\x04 cut off")
    with pytest.raises(DataError, match="expected a map that ssm-graph visual wrote"):
        load_map(tmp_path / "map.npz")
