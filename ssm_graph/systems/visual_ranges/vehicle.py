"""What a vehicle under water measures beside camera and ranges: depth, and its dead reckoning."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ssm_graph.base.errors import ConfigError, DataError
from ssm_graph.base.frozen import Array, FrozenArrays, ShortRepr, shaped

DEPTH_SIGMA_M: Final = 0.05
"""Of a pressure sensor, with what waves and trim do to it."""
DEPTH_SHARE: Final = 0.003
"""Of a depth: from pressure by a density of water known to 3 kg/m^3. Where fresh water may have
been read as sea water, 0.03."""
STEP_M: Final = 0.01
"""Standard deviation of what a DVL and a gyro are off by after one second, m: 600 kHz near the
bottom, grades from tactical on; it grows as the root of time."""
TURN_RAD: Final = 1e-3
"""The same of the turn about the vertical and across, rad."""
TILT_RAD: Final = 5e-3
"""Of roll and pitch, the camera's mounting included."""
SCALE_SHARE: Final = 0.003
"""Of a DVL's speed: its own calibration and the sound speed that it assumed."""
LONGEST_GAP_S: Final = 1.0
"""Between two readings, over which is interpolated."""


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Depths(FrozenArrays):
    """Depths of a sensor at the camera."""

    time_s: Array = shaped("N")
    depth_m: Array = shaped("N")
    """Down from any level."""
    sigma_m: float = DEPTH_SIGMA_M
    lever_arm_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """From the camera's centre to the sensor, camera axes."""
    scale_share: float = DEPTH_SHARE
    """Of the depth; counts where depth alone tells the scale."""


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class DeadReckoning(FrozenArrays):
    """Poses of the camera by inertial unit and DVL, as ``ssm-graph smooth`` gives them.

    Only what changes between two times is used, and the vertical.
    """

    time_s: Array = shaped("N")
    position_m: Array = shaped("N", 3)
    """Of the camera, axes whose third is down, m."""
    quaternion: Array = shaped("N", 4)
    """Camera axes to these, x, y, z, w."""
    step_m: float = STEP_M
    turn_rad: float = TURN_RAD
    tilt_rad: float = TILT_RAD
    scale_share: float = SCALE_SHARE
    """Standard deviations; see the constants of this module."""


@dataclass(frozen=True, slots=True)
class Vehicle(ShortRepr):
    """What a vehicle brings; nothing for a camera in the hand."""

    depths: Depths | None = None
    dead_reckoning: DeadReckoning | None = None
    range_scale_share: float = 0.0
    """Standard deviation of the unit of the ranges, a share: of the sound speed; 0 for radio."""

    def __post_init__(self) -> None:
        if not 0.0 <= self.range_scale_share < 0.5:
            raise ConfigError(
                f"sound speed: expected a sigma from 0 to 0.5, a share, got "
                f"{self.range_scale_share}; 0.01 is a guess of 15 m/s"
            )
        for what, log in (("depths", self.depths), ("dead reckoning", self.dead_reckoning)):
            if log is not None and (len(log.time_s) < 2 or np.any(np.diff(log.time_s) <= 0.0)):
                raise DataError(f"{what}: expected two or more times that rise")

    @property
    def scale_share(self) -> float:
        """Standard deviation of the unit of what tells the scale, a share; 0 for nothing."""
        own = self.depths if self.dead_reckoning is None else self.dead_reckoning
        return 0.0 if own is None else own.scale_share

    @property
    def has_aids(self) -> bool:
        """Whether there is anything that bears on the map."""
        return self.depths is not None or self.dead_reckoning is not None


def inside(time_s: Array, at_s: Array) -> tuple[NDArray[np.int64], Array]:
    """Return rows before (M,) and shares (M,) of times between two readings; NaN in gaps, outside.

    Parameters
    ----------
    time_s : (N,) of the readings, rising.
    at_s : (M,)
    """
    row = np.clip(np.searchsorted(time_s, at_s, side="right") - 1, 0, len(time_s) - 2)
    row = row.astype(np.int64)
    span = time_s[row + 1] - time_s[row]
    share = (at_s - time_s[row]) / span
    known = (share >= -1e-9) & (share <= 1.0 + 1e-9) & (span <= LONGEST_GAP_S)
    return row, np.where(known, share, np.nan)
