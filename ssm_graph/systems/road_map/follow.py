"""Once the lane is known: a localiser over the last pictures; older ones stay as a prior.

Every picture adds a pose; the window is laid on the map anew; the oldest pose is eliminated with
all it saw. What is known along the road grows on bends and fades on straights, as it should.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from ssm_graph.base.errors import DataError
from ssm_graph.base.frozen import Array, FrozenArrays, shaped
from ssm_graph.systems.road_map.drive import Drive, curve_groups, dead_reckoned
from ssm_graph.systems.road_map.maps.index import LineIndex
from ssm_graph.systems.road_map.maps.road_map import LineKind
from ssm_graph.systems.road_map.refinement import Prior, RefinementSettings, refine
from ssm_graph.systems.road_map.window import window_of


@dataclass(frozen=True, slots=True, eq=False)
class Followed(FrozenArrays):
    """The localiser's answer at every picture, from what was seen until then."""

    time_s: Array = shaped("N")
    pose: Array = shaped("N", 3)
    """x, y [m], yaw [rad]"""
    cov: Array = shaped("N", 3, 3)


def follow(
    drive: Drive,
    prior: Prior,
    first_s: float,
    indices: Mapping[LineKind, LineIndex],
    *,
    n_pictures: int = 12,
    n_points: int = 8,
    settings: RefinementSettings | None = None,
) -> Followed:
    """Follow a drive from a known lane on.

    Parameters
    ----------
    prior : of the pose at the first picture, scale and bias; such as the last answer of `locate`.
    first_s : time of that picture.
    n_pictures : of the window.

    Raises :class:`DataError` where there are no pictures from then on.
    """
    groups = [group for group in curve_groups(drive.curves) if group[0] >= first_s - 1e-6]
    if not groups:
        raise DataError(f"{drive.name} curves: expected pictures from {first_s:.3f} s on, got none")
    s = replace(settings or RefinementSettings(), rounds=4)
    poses: Array = np.empty((0, 3))
    rows: list[tuple[float, Array, Array]] = []
    first = 0
    for last, (when, _) in enumerate(groups):
        times = np.array([t for t, _ in groups[first : last + 1]])
        motion = dead_reckoned(np.zeros(3), times, drive.chassis)
        if len(poses) == 0:
            poses = prior.mean[None, :3]
        else:
            step = dead_reckoned(
                poses[-1], times[-2:], drive.chassis, scale=1.0 + prior.mean[3], bias=prior.mean[4]
            )
            poses = np.concatenate([poses, step[1:]])
        window = window_of(drive.curves, groups[first : last + 1], motion, n_points)
        if window is None:
            continue
        found = refine(window, poses, prior, indices, s)
        poses = found.poses
        rows.append((when, poses[-1], found.covs[-1]))
        if len(poses) >= n_pictures and found.next_prior is not None:
            prior, poses, first = found.next_prior, poses[1:], first + 1
    return Followed(
        np.array([row[0] for row in rows]),
        np.array([row[1] for row in rows]),
        np.array([row[2] for row in rows]),
    )
