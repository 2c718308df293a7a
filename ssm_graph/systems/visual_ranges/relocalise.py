"""A camera found in a map that it was lost in, or that an earlier run made."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ssm_graph.systems.visual_ranges.camera import Camera
from ssm_graph.systems.visual_ranges.features import Image, corners, descriptors
from ssm_graph.systems.visual_ranges.geometry import Pose
from ssm_graph.systems.visual_ranges.loop_settings import LoopSettings
from ssm_graph.systems.visual_ranges.loops import LoopFinder, place_camera, points_of
from ssm_graph.systems.visual_ranges.visual_map import VisualMap

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

N_CANDIDATES = 5
RECENT = 3
"""The newest key frames are tried whatever their words say."""


class Found(NamedTuple):
    """Where a camera is in the map."""

    pose: Pose
    key_frame: int
    """The most alike"""
    pixel: Array
    """(n, 2) of the points it sees ..."""
    points: Indices
    """(n,) ... these"""


def relocalise(
    world: VisualMap,
    finder: LoopFinder,
    camera: Camera,
    image: Image,
    n_corners: int,
    settings: LoopSettings | None = None,
) -> Found | None:
    """Return the pose of an image in the map; None where it is not recognised."""
    settings = LoopSettings() if settings is None else settings
    pixel = corners(image, n_corners, np.zeros((0, 2)))
    if len(pixel) < settings.least_matches:
        return None
    octave = np.zeros(len(pixel), dtype=np.int64)
    own = descriptors(image, pixel, octave)
    xy = camera.normalise(pixel)
    recent = range(max(world.n_frames - RECENT, 0), world.n_frames)
    tried = dict.fromkeys([*finder.alike(own, N_CANDIDATES), *recent])
    for k in tried:
        points = points_of(world, sorted(finder.group_of(world, k)))
        found = place_camera(
            xy,
            octave,
            own,
            world.points["place"][points],
            world.rows["descriptor"][world.points["row"][points]],
            camera,
            settings,
        )
        if found is not None:
            return Found(found.pose, k, pixel[found.seen], points[found.points])
    return None
