"""Times and the keyframes that they belong to."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ssm_graph.base.frozen import Array

MIN_SPACING_S = 1e-3
"""Times closer than this share a keyframe."""
UNIX_FROM_S, UNIX_UNTIL_S = 1.0e9, 4.1e9
"""September 2001 and the year 2099: times between them are Unix time, others begin near zero."""
GPS_EPOCH_S = 315_964_800.0
"""Unix time of 1980-01-06T00:00:00Z, s."""
WEEK_S = 604_800.0
GPS_AHEAD = (
    (-np.inf, 13.0),
    (1_136_073_600.0, 14.0),  # 2006
    (1_230_768_000.0, 15.0),  # 2009
    (1_341_100_800.0, 16.0),  # July 2012
    (1_435_708_800.0, 17.0),  # July 2015
    (1_483_228_800.0, 18.0),  # 2017
)
"""Unix time from which GPS time is ahead of UTC by as many seconds (IERS Bulletin C); the first is
right from 1999 on."""

Indices = NDArray[np.intp]


def usual_interval(time_s: Array) -> float:
    """Return the median of the intervals between times (N,) that rise, two or more."""
    spacing = np.sort(time_s[1:] - time_s[:-1])  # an eighth of `numpy.median`'s time, where few
    middle = len(spacing) // 2
    return float(0.5 * (spacing[middle] + spacing[len(spacing) - 1 - middle]))


def gps_ahead_s(unix_s: Array | float) -> Array:
    """Return by how much GPS time is ahead of UTC then, s."""
    since, ahead = zip(*GPS_AHEAD, strict=True)
    return np.array(ahead)[np.searchsorted(since, unix_s, side="right") - 1]


def is_inside(time_s: Array, start_s: float, end_s: float) -> NDArray[np.bool_]:
    """Return which times lie in the span, but for rounding."""
    return (time_s > start_s - MIN_SPACING_S) & (time_s < end_s + MIN_SPACING_S)


def nearest(keyframe_s: Array, time_s: Array) -> Indices:
    """Return the index of the keyframe nearest to each time."""
    middle = 0.5 * (keyframe_s[:-1] + keyframe_s[1:])
    return np.searchsorted(middle, time_s)


def last_readings(keyframe_s: Array, time_s: Array) -> tuple[Indices, Indices]:
    """Return the keyframes (M,) with a reading since the keyframe before, and the last one of each.

    Of the first keyframe it is a reading at its own time.
    """
    late_s = keyframe_s + MIN_SPACING_S
    reading = np.searchsorted(time_s, late_s, side="right") - 1
    before = np.searchsorted(time_s, np.append(keyframe_s[0] - MIN_SPACING_S, late_s[:-1]))
    keyframe = np.flatnonzero(reading >= before)
    return keyframe, reading[keyframe]


def left_out(what: str, count: int, start_s: float, end_s: float) -> tuple[str, ...]:
    """Return the note on measurements outside the keyframes, if there are any."""
    if count == 0:
        return ()
    plural = "" if count == 1 else "es" if what.endswith("fix") else "s"
    return (
        f"{count} {what}{plural} outside the smoothed span {start_s:.3f}..{end_s:.3f} s left out",
    )
