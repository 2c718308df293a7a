"""Patches, and whole runs through a small rendered room: tracked, the same twice, found again."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from ssm_graph.systems.visual_ranges import tracking
from ssm_graph.systems.visual_ranges.accuracy import accuracy
from ssm_graph.systems.visual_ranges.features import corners
from ssm_graph.systems.visual_ranges.geometry import Pose
from ssm_graph.systems.visual_ranges.patches import align, align_numpy
from ssm_graph.systems.visual_ranges.result import FrameState, VisualResult
from ssm_graph.systems.visual_ranges.sequence import Sequence
from ssm_graph.systems.visual_ranges.settings import VisualSettings
from ssm_graph.systems.visual_ranges.simulate import SMALL_CAMERA, Run, simulate
from ssm_graph.systems.visual_ranges.system import run
from ssm_graph.systems.visual_ranges.tracking import Tracker, Tracks
from ssm_graph.systems.visual_ranges.visual_map import VisualMap

Array = NDArray[np.float64]
SETTINGS = VisualSettings(n_corners=250)


@cache
def room() -> Sequence:
    """Return 4 s through a room, 320 x 240, rendered once."""
    made = simulate(Run("room", seed=3, duration_s=4.0, camera=SMALL_CAMERA, n_anchors=0)).sequence
    images = np.stack([made.images(i) for i in range(len(made.time_s))])
    return replace(made, images=lambda i: images[i])


@cache
def followed(*, is_deterministic: bool = True, again: int = 0) -> VisualResult:
    """Return a run of it; ``again`` makes another."""
    del again
    return run(room(), replace(SETTINGS, is_deterministic=is_deterministic))


def covered(sequence: Sequence, begin_s: float, end_s: float) -> Sequence:
    """Return a sequence whose lens is black for a while."""
    black = (sequence.time_s >= begin_s) & (sequence.time_s < end_s)

    def image(i: int) -> NDArray[np.uint8]:
        seen = sequence.images(i)
        return np.zeros_like(seen) if black[i] else seen

    return replace(sequence, images=image)


def test_every_frame_is_tracked_to_a_centimetre() -> None:
    """From the first image on, those before the start found afterwards."""
    result = followed()
    found = accuracy(room(), result)
    assert found is not None
    assert (result.state == FrameState.TRACKED).all()
    assert found.similar_m < 0.01


def test_the_same_twice_bit_for_bit() -> None:
    """In one thread nothing depends on time."""
    first, second = followed(), followed(again=1)
    for name in ("R_cw", "t_cw", "state", "key_frame", "n_tracked"):
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name))
    for name in ("points", "pixels", "weight", "covariance"):
        np.testing.assert_array_equal(getattr(first.map, name), getattr(second.map, name))


@pytest.mark.slow
def test_mapping_beside_tracking() -> None:
    """Whatever the mapping takes, every frame is tracked and the path as good."""
    result = followed(is_deterministic=False)
    found = accuracy(room(), result)
    assert found is not None
    assert (result.state == FrameState.TRACKED).all()
    assert found.similar_m < 0.015


def test_a_loop_that_is_closed_meanwhile_is_followed(monkeypatch: pytest.MonkeyPatch) -> None:
    """The map doubles while an image is tracked: the next pose is that in the doubled map."""
    rng = np.random.default_rng(0)
    places = rng.uniform([-1.0, -0.7, 2.0], [1.0, 0.7, 4.0], (120, 3))
    still, black = Pose(np.eye(3), np.zeros(3)), np.zeros((240, 320), np.uint8)
    world = VisualMap()
    world.add_frame(0, 0.0, still, black)
    pixel = SMALL_CAMERA.project(places)
    track = world.new_tracks(120)
    world.add_rows(
        0, track, pixel=pixel, xy=SMALL_CAMERA.normalise(pixel), octave=np.zeros(120, np.int64),
        descriptor=np.zeros((120, 32), np.uint8),
    )  # fmt: skip
    world.add_points(track, places)
    tracker = Tracker(SMALL_CAMERA, world, SETTINGS)
    tracker.start(black, Tracks(track, pixel), still, 0)
    step = np.array([0.02, 0.01, -0.03])
    for n in (1, 2, 3):

        def seen(*_: object, n: int = n) -> tuple[Array, NDArray[np.bool_]]:
            if n == 2:
                world.points["place"][:] *= 2.0
                world.frames["grown"][:] *= 2.0
            return SMALL_CAMERA.project(places + n * step), np.ones(120, dtype=bool)

        monkeypatch.setattr(tracking, "flow", seen)
        assert tracker.follow(black).pose is not None
        np.testing.assert_allclose(
            tracker.relative.t_cw, n * step * (2.0 if n == 3 else 1.0), atol=1e-6
        )
        assert tracker.unit == (2.0 if n == 3 else 1.0)


@pytest.mark.slow
def test_a_covered_lens_is_survived() -> None:
    """The map is kept, the camera found again in it, and the path before and after is one."""
    sequence = covered(room(), 2.0, 2.5)
    result = run(sequence, SETTINGS)
    found = accuracy(sequence, result)
    assert found is not None
    black = (sequence.time_s >= 2.0) & (sequence.time_s < 2.5)
    assert (result.state[black] == FrameState.LOST).all()
    assert np.isnan(result.t_cw[black]).all()
    assert (result.state[~black] == FrameState.TRACKED).all()
    assert any("lost" in text for text in result.events)
    assert found.similar_m < 0.015


def test_patches_in_loops_and_numpy_are_one() -> None:
    """The same places and the same likeness; most are found, and where they are."""
    first, image = room().images(0), room().images(1)
    pixels = corners(first, 200, np.zeros((0, 2)))
    rng = np.random.default_rng(0)
    n = len(pixels)
    affine = np.eye(2) + rng.normal(0.0, 0.03, (n, 2, 2))
    given = ([first], np.zeros(n, dtype=np.int64), pixels, affine)
    for to, guess in ((image, pixels), (first, pixels + rng.normal(0.0, 0.7, (n, 2)))):
        one, other = align(*given, to, guess), align_numpy(*given, to, guess)
        np.testing.assert_allclose(one.likeness, other.likeness, atol=1e-9)
        on = one.likeness > 0.8
        np.testing.assert_allclose(one.pixels[on], other.pixels[on], atol=1e-9)
        assert on.mean() > 0.2
    plain = align([first], given[1], pixels, np.broadcast_to(np.eye(2), (n, 2, 2)), first, guess)
    good = plain.likeness > 0.9
    assert good.mean() > 0.8
    assert np.abs(plain.pixels[good] - pixels[good]).max() < 0.05


def test_corners_are_apart_and_spare_what_is_there() -> None:
    """A fresh corner keeps its distance from those that are followed."""
    image = room().images(0)
    first = corners(image, 200, np.zeros((0, 2)))
    kept = first[::3]
    fresh = corners(image, 200, kept)
    away = np.linalg.norm(fresh[:, None] - kept[None], axis=2)
    assert len(fresh) > 20
    assert away.min() > 5.0
    among = np.linalg.norm(first[:, None] - first[None], axis=2) + 1e3 * np.eye(len(first))
    assert among.min() > 5.0
