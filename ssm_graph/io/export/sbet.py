"""SBET, the smoothed best estimate of trajectory of Applanix, with its accuracy file beside it.

Both are rows of little-endian doubles: 17 of a row in ``.sbet``/``.out``, 10 in ``smrmsg_NAME``.
"""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np

from ssm_graph.base.errors import ConfigError
from ssm_graph.base.frozen import Array
from ssm_graph.base.times import GPS_EPOCH_S, WEEK_S, gps_ahead_s
from ssm_graph.io.export.track import Track

_FROM_S: Final = 1_136_073_600.0
"""Unix time of 2006: an earlier time is a wrong epoch rather than a mission."""


def gps_seconds_of_week(unix_s: Array) -> Array:
    """Return GPS time (N,) within the week of the first, s; later weeks go on counting.

    Raises :class:`ConfigError` before 2006.
    """
    if unix_s[0] < _FROM_S:
        raise ConfigError(
            f"--epoch: expected a time of 2006 or later for GPS time, got Unix time {unix_s[0]:.0f}"
        )
    gps_s = unix_s - GPS_EPOCH_S + gps_ahead_s(unix_s)
    return np.asarray(gps_s - WEEK_S * np.floor(gps_s[0] / WEEK_S))


def write_sbet(track: Track, path: Path) -> None:
    """Write a row of 17 for every row of the track, and ``smrmsg_NAME`` beside it.

    Time of the GPS week; latitude, longitude (rad), height; velocity north, east, down, which a
    wander angle of zero makes of x, y, z; roll, pitch, heading (rad); wander angle 0. Body
    accelerations and rates are not part of a result: they are NaN.
    """
    nothing = np.full((len(track.time_s), 6), np.nan)
    north_east_down = track.velocity_enu[:, [1, 0, 2]] * [1.0, 1.0, -1.0]
    time_s = gps_seconds_of_week(track.unix_s)
    roll, pitch, heading = track.roll_pitch_heading.T
    angles = np.column_stack([roll, pitch, (heading + np.pi) % (2.0 * np.pi) - np.pi])
    place = np.column_stack([time_s, track.lat, track.lon, track.height])
    rows = np.column_stack([place, north_east_down, angles, np.zeros(len(time_s)), nothing])
    path.write_bytes(np.ascontiguousarray(rows, "<f8").tobytes())
    ned = [1, 0, 2]
    sigmas = (track.position_sigma_enu[:, ned], track.velocity_sigma_enu[:, ned])
    arcminutes = np.degrees(track.attitude_sigma) * 60.0
    accuracy = np.column_stack([time_s, *sigmas, arcminutes])
    beside = path.with_name(f"smrmsg_{path.name}")
    beside.write_bytes(np.ascontiguousarray(accuracy, "<f8").tobytes())
