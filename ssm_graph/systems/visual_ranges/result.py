"""What a run gives: poses of all frames, the map, and what happened, in map units."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ssm_graph.base.frozen import ReadOnlyArrays
from ssm_graph.systems.visual_ranges.camera import Camera

Array = NDArray[np.float64]
Indices = NDArray[np.int64]


class FrameState(IntEnum):
    """What a frame's pose rests on."""

    WAITING = 0
    """Before the map was started, without a pose."""
    TRACKED = 1
    LOST = 2
    """Without a pose."""


class FrameNow(NamedTuple):
    """The pose of an image as it was first given out."""

    time_s: float
    R_cw: Array
    """(3, 3)"""
    t_cw: Array
    """(3,) map units"""
    scale: float
    """Metres a map unit as known then; NaN before"""


@dataclass(frozen=True, repr=False)
class MapSnapshot(ReadOnlyArrays):
    """Key frames, points and observations as they stood at the end (or when saved).

    Observations are rows of one table; those of key frame ``k`` are
    ``first_row[k]:first_row[k + 1]``. ``point`` is -1 where a key point has no place yet.
    """

    image: Indices
    """(K,) index of each key frame's image in the sequence."""
    time_s: Array
    """(K,)"""
    R_cw: Array
    """(K, 3, 3) map to camera: ``x_c = R_cw X + t_cw``"""
    t_cw: Array
    """(K, 3) map units"""
    covariance: Array
    """(K, 6, 6) of the left perturbation (translation, rotation) of T_cw, map units and rad; NaN
    where unknown."""
    points: Array
    """(P, 3) map units"""
    points_views: Indices
    """(P,) key frames that see each point; 0: culled."""
    points_grey: NDArray[np.uint8]
    """(P,)"""
    points_descriptor: NDArray[np.uint8]
    """(P, 32) ORB"""
    first_row: Indices
    """(K + 1,)"""
    pixels: NDArray[np.float32]
    """(rows, 2) as detected, distorted"""
    octave: NDArray[np.int64]
    """(rows,) each a factor 1.2"""
    descriptor: NDArray[np.uint8]
    """(rows, 32) ORB"""
    point: Indices
    """(rows,) point seen, or -1"""
    weight: Array
    """(rows,) similarity weight of each reprojection at the last adjustment; NaN without point."""


@dataclass(frozen=True, repr=False)
class VisualResult(ReadOnlyArrays):
    """Answer of a run, in map units; metres are ``scale`` times that where it is known."""

    name: str
    camera: Camera
    time_s: Array
    """(N,) of all images"""
    state: NDArray[np.int64]
    """(N,) :class:`FrameState`"""
    R_cw: Array
    """(N, 3, 3) map to camera; NaN without a pose"""
    t_cw: Array
    """(N, 3) map units; NaN without a pose"""
    key_frame: Indices
    """(N,) key frame that each frame hangs on, -1 without a pose."""
    n_tracked: Indices
    """(N,) map points seen in each image"""
    map: MapSnapshot
    ranging: Any = None
    """Scale, anchors, weights of all ranges; None when there were no ranges."""
    loops: tuple[Any, ...] = ()
    """Loops taken and refused, with why."""
    events: tuple[str, ...] = ()
    """What happened, in words with times: started, lost, found again."""
    timing_s: Mapping[str, Array] = field(default_factory=dict)
    """Seconds of every call of each part."""

    @property
    def position(self) -> Array:
        """Camera places (N, 3) in the map, map units; NaN without a pose."""
        return np.asarray(-np.einsum("nji,nj->ni", self.R_cw, self.t_cw))
