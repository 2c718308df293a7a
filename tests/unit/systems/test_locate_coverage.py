"""Errors of a found lane, judged by the sigmas that come with them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from ssm_graph.base.frozen import Array
from ssm_graph.systems.road_map.hypotheses import apart
from ssm_graph.systems.road_map.locate import locate
from ssm_graph.systems.road_map.maps.road_map import LineKind, Mark, RoadLine, RoadMap
from ssm_graph.systems.road_map.simulate import DriveModel, driven, simulate_drive


def road_with_bends() -> Array:
    """Return the middle of a road, 560 m: straights and bends of 100 m radius either way."""
    pieces = [(120.0, 0.0), (100.0, 0.01), (80.0, 0.0), (120.0, -0.01), (140.0, 0.0)]
    bend = np.concatenate([np.full(int(length), value) for length, value in pieces])
    yaw = np.cumsum(bend)
    return np.column_stack([np.cumsum(np.cos(yaw)), np.cumsum(np.sin(yaw))])


def surveyed(lines: RoadMap, rng: np.random.Generator) -> RoadMap:
    """Return a map as it is surveyed: a point every 4 m, each 3 cm off."""
    kept = [line.points[::4] for line in lines.lines]
    off = [points + rng.normal(0.0, 0.03, points.shape) for points in kept]
    pairs = zip(lines.lines, off, strict=True)
    return replace(lines, lines=tuple(replace(line, points=points) for line, points in pairs))


def three_lanes(centre: Array) -> RoadMap:
    """Return kerbs, a solid and a dashed line along a road."""
    d = np.gradient(centre, axis=0)
    normal = np.column_stack([-d[:, 1], d[:, 0]]) / np.hypot(*d.T)[:, None]
    lines = (
        RoadLine("left", LineKind.BOUNDARY, centre + 5.5 * normal),
        RoadLine("right", LineKind.BOUNDARY, centre - 6.0 * normal),
        RoadLine("solid", LineKind.LANE_LINE, centre + 1.75 * normal, Mark.SOLID),
        RoadLine("dashed", LineKind.LANE_LINE, centre - 1.75 * normal, Mark.DASHED),
    )
    return RoadMap("bends", lines, {})


@pytest.mark.slow
def test_sigmas_cover_errors_where_bends_change() -> None:
    """At 25 m/s and in short logs: chi-square over the drives, and sigmas that are of use.

    The kinks of a map are errors, the same in all pictures: they say nothing of the place along.
    """
    centre = road_with_bends()
    road = three_lanes(centre)
    road_map = surveyed(road, np.random.default_rng(7))
    rows = []
    for seed in range(16):
        is_short = seed % 2 == 1
        model = DriveModel(length_m=80.0) if is_short else DriveModel(length_m=330.0, speed=25.0)
        rng = np.random.default_rng([5, seed])
        begin = int(rng.uniform(60.0, 400.0) if is_short else rng.uniform(0.0, 200.0))
        truth = driven(centre[begin:], model, rng)
        found = locate(simulate_drive("bends", truth, road, model, rng), road_map, seed=seed)
        off = apart(truth.at(found.track.time_s[-1:])[0], found.pose)
        rows.append([*off, *found.sigmas])
    errors, sigmas = np.hsplit(np.array(rows), 2)
    most = chi2.ppf(0.999, len(rows))
    squares = np.square(errors / sigmas).sum(axis=0)
    assert np.all(squares < most), f"across, along, yaw: {squares}, expected below {most:.1f}"
    across, along, _ = np.median(sigmas, axis=0)
    assert across < 0.05
    assert along < 3.0
