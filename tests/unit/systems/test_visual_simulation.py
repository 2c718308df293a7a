"""Rendered worlds and simulated ranges, judged by geometry that the renderer does not use."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ssm_graph.base.errors import ConfigError, DataError
from ssm_graph.systems.visual_ranges.ranges import Ranges, screened_ranges
from ssm_graph.systems.visual_ranges.render import render
from ssm_graph.systems.visual_ranges.sequence import PathTruth, Sequence
from ssm_graph.systems.visual_ranges.simulate import (
    SMALL_CAMERA,
    ImageFaults,
    Run,
    axes,
    corridor_path,
    room_path,
    simulate,
)
from ssm_graph.systems.visual_ranges.simulated_ranges import RangeFaults, with_simulated_ranges
from ssm_graph.systems.visual_ranges.world import REPEAT_M, corridor, room

TEXEL_M = 0.03


def test_two_views_agree_on_the_points_of_the_walls() -> None:
    """A point's grey is the same from two places; it moves by tens of pixels between them."""
    world, path = room(1, texel_m=TEXEL_M), room_path(1)
    rng = np.random.default_rng(0)
    time = np.array([0.0, 0.8])
    R_wc, p_w = axes(path, time), path.place(time)
    views = [render(world, SMALL_CAMERA, R, p) for R, p in zip(R_wc, p_w, strict=True)]
    wall = max(world.walls[:6], key=lambda one: R_wc[0][:, 2] @ -one.normal_w)
    share = rng.uniform(0.05, 0.95, (4000, 2)) * wall.size_m
    points = wall.corner_w + share[:, :1] * wall.along_w + share[:, 1:] * wall.up_w
    pixels = [SMALL_CAMERA.project((points - p) @ R) for R, p in zip(R_wc, p_w, strict=True)]
    both = SMALL_CAMERA.contains(pixels[0], 2.0) & SMALL_CAMERA.contains(pixels[1], 2.0)
    assert both.sum() > 200
    moved = np.linalg.norm(pixels[0] - pixels[1], axis=1)[both]
    assert np.median(moved) > 10.0
    grey = [
        view[tuple(np.round(at[both][:, ::-1]).astype(int).T)]
        for view, at in zip(views, pixels, strict=True)
    ]
    correlation = np.corrcoef(grey[0], grey[1])[0, 1]
    assert correlation > 0.8
    assert np.corrcoef(grey[0], np.roll(grey[1], 1))[0, 1] < 0.4


def test_compiled_and_numpy_draw_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    """To rounding in single precision, walls near and far, at a slant and in the corners."""
    world, path = corridor(3, texel_m=TEXEL_M), corridor_path(3)
    R_wc, p_w = axes(path, np.array([3.0])), path.place(np.array([3.0]))
    drawn = []
    for chosen in ("1", "0"):
        monkeypatch.setenv("SSM_GRAPH_NUMBA", chosen)
        drawn.append(render(world, SMALL_CAMERA, R_wc[0], p_w[0]))
    assert np.abs(drawn[0] - drawn[1]).max() < 1e-3
    assert drawn[0].std() > 5.0


def test_the_corridor_looks_the_same_again() -> None:
    """One period on, before the same wall: the trap that ranges have to see through."""
    world = corridor(0, texel_m=0.032)  # 400 to a period
    R_wc = np.array([[-1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, -1.0, 0.0]])  # to the wall
    places = [np.array([x, -5.6, 1.3]) for x in (-6.0, -6.0 + REPEAT_M, -2.0)]
    here, again, elsewhere = (render(world, SMALL_CAMERA, R_wc, p) for p in places)
    middle = np.s_[100:140, 140:180]
    assert np.abs(here[middle] - again[middle]).max() < 2.0
    assert np.abs(here[middle] - elsewhere[middle]).mean() > 10.0


def test_ranges_along_a_recorded_path_are_distances_of_their_own_times() -> None:
    """Between the poses of the truth as well, with the lever arm turned along."""
    time = np.arange(0.0, 6.0, 0.1)
    path = room_path(2)
    R_wc, p_w = axes(path, time), path.place(time)
    truth = PathTruth(time + 5.0, p_w, Rotation.from_matrix(R_wc).as_quat())
    none = screened_ranges([], [], [])
    made = Sequence(
        "made", SMALL_CAMERA, time + 5.0, lambda _: np.zeros((240, 320), np.uint8), none
    )
    faults = RangeFaults(sigma_m=1e-9, bias_m=0.0, lever_arm_m=(0.3, 0.0, -0.2))
    anchors = np.array([[3.0, 1.0, 2.0], [-2.0, 2.0, 0.5]])
    found = with_simulated_ranges(replace(made, truth=truth), anchors, 1, faults)
    assert found.lever_arm_m == faults.lever_arm_m
    at = found.ranges.time_s
    assert at.min() >= 5.0
    assert at.max() < 11.1
    antenna = path.place(at - 5.0) + axes(path, at - 5.0) @ np.array(faults.lever_arm_m)
    inside = at < time[-1] + 5.0
    distance = np.linalg.norm(antenna - anchors[found.ranges.anchor], axis=1)
    assert np.abs(distance - found.ranges.range_m)[inside].max() < 2e-3
    with pytest.raises(DataError, match="true path"):
        with_simulated_ranges(made, anchors, 1)


def test_walls_in_the_way_lengthen_ranges() -> None:
    """Clean ranges are the distance, bias and noise; the others are longer by 0.3 m and more."""
    faults = RangeFaults(nlos_share=0.2, lever_arm_m=(0.1, 0.0, -0.2), clock_s=0.03)
    run = Run("room", 3, 30.0, n_anchors=2, texel_m=TEXEL_M, ranges=faults)
    done = simulate(run)
    ranges, anchors = done.sequence.ranges, done.sequence.anchor_truth_m
    assert anchors is not None
    path, time = room_path(3), ranges.time_s - 0.03
    antenna = path.place(time) + axes(path, time) @ np.array(faults.lever_arm_m)
    over = ranges.range_m - np.linalg.norm(antenna - anchors[ranges.anchor], axis=1) - 0.05
    clean = over[~done.is_nlos]
    assert abs(float(clean.mean())) < 4.0 * 0.08 / np.sqrt(len(clean))
    assert float(clean.std()) == pytest.approx(0.08, rel=0.15)
    assert 0.2 <= done.is_nlos.mean() < 0.5
    assert float(over[done.is_nlos].min()) > 0.3 - 4.0 * 0.08
    blocked = room(3, texel_m=0.2).is_blocked(antenna, anchors[ranges.anchor])
    assert blocked.any()
    assert done.is_nlos[blocked].all()


def test_images_are_black_while_covered_and_the_same_again() -> None:
    """An image is a function of the run and its index alone."""
    run = Run(
        duration_s=1.0,
        camera=SMALL_CAMERA,
        texel_m=TEXEL_M,
        images=ImageFaults(covered_s=(0.4, 0.6)),
    )
    images = simulate(run).sequence.images
    assert images(9).mean() < 5.0 < 50.0 < images(0).mean()
    np.testing.assert_array_equal(images(3), simulate(run).sequence.images(3))
    with pytest.raises(ConfigError, match="did you mean 'room'"):
        Run("rom")


def test_bad_readings_are_dropped_and_told() -> None:
    """Each kind with its count and its first line."""
    ranges = screened_ranges(
        [1.0, 0.5, np.nan, 2.0, 3.0, 3.0, 4.0, 5.0],
        ["a", "b", "a", "a", "a", "a", "b", "b"],
        [4.0, 5.0, 6.0, -1.0, 7.0, 7.1, 9e3, np.nan],
        lines=[*range(2, 10)],
        source="uwb.csv",
        known={"b": (1.0, 2.0, 3.0)},
    )
    assert ranges.names == ("b", "a")
    assert ranges.time_s.tolist() == [0.5, 1.0, 3.0]
    assert ranges.is_known.tolist() == [True, False]
    told = " ".join(ranges.notes)
    for part in ("without a time, dropped (first: line 4)", "at or below zero", "beyond 500 m",
                 "(first: line 7)", "without a range", "1 readings out of order"):  # fmt: skip
        assert part in told
    assert len(ranges.of("a")) == 2
    with pytest.raises(DataError, match="screened_ranges"):
        Ranges(
            np.array([1.0]), np.array([0]), np.array([-1.0]), np.ones(1), ("a",), np.ones((1, 3))
        )


@pytest.mark.parametrize(
    "wrong",
    [
        {"nlos_share": 2.0},
        {"nlos_share": np.nan},
        {"lost_share": -0.1},
        {"sigma_m": -1.0},
        {"clock_s": np.inf},
        {"silent_s": (5.0, 1.0)},
    ],
)
def test_faults_of_ranges_that_cannot_be_are_refused(wrong: dict[str, Any]) -> None:
    """Before anything is written with them."""
    with pytest.raises(ConfigError, match="expected"):
        RangeFaults(**wrong)


def test_other_options_that_cannot_be_are_refused() -> None:
    """A lens covered backwards, a run without end, a lever arm that is no place."""
    with pytest.raises(ConfigError, match="covered_s: expected from and to"):
        ImageFaults(covered_s=(5.0, 1.0))
    with pytest.raises(ConfigError, match="expected numbers above zero"):
        Run("room", duration_s=np.inf)
    sequence = simulate(Run("room", 0, 1.0, texel_m=0.05)).sequence
    for sigma_m in (-1.0, np.nan):
        with pytest.raises(ConfigError, match="lever_arm_sigma_m: expected 0"):
            replace(sequence, lever_arm_sigma_m=sigma_m)
    with pytest.raises(ConfigError, match="lever_arm_m: expected three finite numbers"):
        replace(sequence, lever_arm_m=(np.nan, 0.0, 0.0))
