"""What a run works on: a camera, its images one by one, ranges, and the true path where known."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ssm_graph.base.errors import ConfigError
from ssm_graph.base.frozen import Array, FrozenArrays, ShortRepr, shaped
from ssm_graph.systems.visual_ranges.vehicle import Vehicle

if TYPE_CHECKING:
    from ssm_graph.systems.visual_ranges.camera import Camera
    from ssm_graph.systems.visual_ranges.ranges import Ranges

Image = NDArray[np.uint8]
"""Grey image (H, W)."""
ImageOf = Callable[[int], Image]
"""The image of an index; one that cannot be decoded comes back black, as a covered lens would."""


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class PathTruth(FrozenArrays):
    """The true path of the camera in some world frame."""

    time_s: Array = shaped("N")
    position_m: Array = shaped("N", 3)
    """The camera's centre, m."""
    quaternion: Array = shaped("N", 4)
    """Camera axes (x right, y down, z ahead) to world axes, in TUM's order x, y, z, w."""


@dataclass(frozen=True, slots=True, eq=False)
class Sequence(ShortRepr):
    """One recording; images are read when they are asked for."""

    name: str
    camera: Camera
    time_s: Array
    """Time of each image, s, strictly increasing (K,), on the clock of the ranges."""
    images: ImageOf = field(repr=False)
    """Image of an index 0 .. K-1, grey (H, W) of the camera's size."""
    ranges: Ranges
    """May be of length 0: the map then stays without scale."""
    lever_arm_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """From the camera's centre to the antenna, camera axes, m."""
    truth: PathTruth | None = None
    anchor_truth_m: Array | None = None
    """True places of the anchors in the world frame of ``truth`` (J, 3), m, NaN where unknown."""
    notes: tuple[str, ...] = ()
    """What the reader found and did, one sentence each, with file and line where there is one."""
    vehicle: Vehicle = Vehicle()
    """Depth and dead reckoning of what carries the camera."""
    lever_arm_sigma_m: float = 0.0
    """Standard deviation of each number of the lever arm; above 0 it is found with the rest."""

    def __post_init__(self) -> None:
        if not np.isfinite(self.lever_arm_m).all():
            raise ConfigError(
                f"lever_arm_m: expected three finite numbers, got {self.lever_arm_m}; "
                "where it was not measured, state 0 0 0 and lever_arm_sigma_m"
            )
        if not 0.0 <= self.lever_arm_sigma_m < np.inf:
            raise ConfigError(
                "lever_arm_sigma_m: expected 0 (exact) or more, got "
                f"{self.lever_arm_sigma_m:g}; try 0.05"
            )

    def __len__(self) -> int:
        return len(self.time_s)

    @property
    def duration_s(self) -> float:
        """From the first image to the last, s."""
        return float(self.time_s[-1] - self.time_s[0]) if len(self.time_s) else 0.0
