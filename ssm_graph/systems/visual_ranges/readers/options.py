"""What a reader cannot know of itself and the user may say."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

Vector = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class ReadOptions:
    """Options of :func:`ssm_graph.systems.visual_ranges.readers.source.read_sequence`."""

    camera: Path | None = None
    """Calibration file; None: the one of the recording."""
    ranges: Path | None = None
    """Table of ranges; None: the one of the recording, if there is one."""
    rate_hz: float | None = None
    """Of images that carry no times; None: what the video says."""
    start_s: float | None = None
    """Time of the first image on the clock of the ranges, s; None: as recorded, or 0."""
    sigma_m: float | None = None
    """Of ranges whose row does not say, m."""
    lever_arm_m: Vector | None = None
    """Camera centre to antenna, camera axes, m."""
    range_unit: str = ""
    """m, cm, mm or ft, where the table does not say."""
    time_unit: str = ""
    """Of the ranges' times: s, ms, us or ns, where the table does not say."""
    bayer: str = ""
    """Pattern of raw colour images."""
    camera_number: int = 0
    """Of a recording with several."""
    first: int = 0
    """First image that is used."""
    count: int | None = None
    """Images that are used; None: all."""
