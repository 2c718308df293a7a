"""Settings of the visual part; lengths of the map in units of its median depth."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ssm_graph.base.errors import ConfigError
from ssm_graph.systems.visual_ranges.loop_settings import LoopSettings


@dataclass(frozen=True)
class VisualSettings:
    """How a run follows, maps and adjusts."""

    n_corners: int = 700
    """Corners followed at a time, one a cell of a grid."""
    pixel_sigma: float = 0.3
    """Pixels, of a corner's place in its octave."""
    start_flow_share: float = 0.028
    """Median flow, share of the image's width, below which a start waits (18 pixels of 640)."""
    restart_flow_share: float = 0.125
    """Median flow above which, without success, the reference is renewed."""
    key_translation: float = 0.12
    """Of the median depth, from the last key frame to the next."""
    key_rotation_rad: float = np.deg2rad(12.0)
    key_share: float = 0.7
    """Next key frame when fewer points are left than this share of the last one's."""
    key_least_points: int = 100
    key_interval_s: float = 0.6
    key_least_translation: float = 0.02
    """Of the median depth: standing still makes no key frame."""
    key_least_rotation_rad: float = np.deg2rad(3.0)
    window: int = 16
    """Key frames adjusted together after each new one."""
    held: int = 20
    """Further key frames that see the same points, held."""
    local_steps: int = 5
    global_steps: int = 12
    least_inliers: int = 15
    """Points that a frame's pose needs."""
    parallax_rad: float = np.deg2rad(1.0)
    """Of the rays that make a point."""
    is_deterministic: bool = True
    """Everything in one thread, in order; else mapping runs beside tracking."""
    has_final_adjustment: bool = True
    """Adjust all key frames and points together at the end."""

    loops: LoopSettings = field(default_factory=LoopSettings)
    """When a place is taken for one seen before."""

    def __post_init__(self) -> None:
        if self.n_corners < 100 or self.window < 3:
            raise ConfigError(
                f"visual settings: expected n_corners >= 100 and window >= 3, got "
                f"{self.n_corners} and {self.window}"
            )
        if not self.pixel_sigma > 0.0:
            raise ConfigError(f"pixel_sigma: expected above 0 pixels, got {self.pixel_sigma}")
