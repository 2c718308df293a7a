"""Height between keyframes: what depth readings need that were taken on the way."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from factors.so3 import cross
from ssm_graph.base.earth import LocalFrame
from ssm_graph.base.frozen import Array


class HeightTrack(NamedTuple):
    """The depth sensor at keyframes."""

    height: Array
    """(...) m above the ellipsoid"""
    climb: Array
    """(...) m/s, upwards"""
    up_n: Array
    """(..., 3) local vertical"""
    sensor_n: Array
    """(..., 3) m"""


def height_track(
    frame: LocalFrame, *, R_nb: Array, p_n: Array, v_n: Array, gyro_b: Array, lever_arm_b: Array
) -> HeightTrack:
    """Return the track of a sensor ``lever_arm_b`` off the body origin, leading axes (...)."""
    arm_n = (R_nb @ lever_arm_b[..., None])[..., 0]
    swing_n = (R_nb @ cross(gyro_b, lever_arm_b)[..., None])[..., 0]
    sensor_n = p_n + arm_n
    lat, lon, height = frame.geodetic_from_p_n(np.array([p_n, sensor_n]))
    up_n = frame.up_n_at(lat[0], lon[0])
    return HeightTrack(
        height=height[1],
        climb=((v_n + swing_n) * up_n).sum(axis=-1),
        up_n=up_n,
        sensor_n=sensor_n,
    )


def height_on_the_way(
    begin: HeightTrack, end: HeightTrack, *, elapsed_s: Array, span_s: Array
) -> Array:
    """Return the sensor's height (...) after ``elapsed_s`` of ``span_s`` between two keyframes.

    It follows the cubic through both heights and climbs.
    """
    s = elapsed_s / span_s
    rise = end.height - begin.height
    return np.asarray(
        begin.height
        + rise * s**2 * (3.0 - 2.0 * s)
        + span_s * s * (1.0 - s) * (begin.climb * (1.0 - s) - end.climb * s)
    )


def mean_rises(
    track: HeightTrack, keyframe_s: Array, *, reading_keyframe: NDArray[np.intp], reading_s: Array
) -> Array:
    """Return how much higher the sensor is at each keyframe (K,) than at its readings, m, mean.

    Zero where there are none, and at the first keyframe: what came before it is not known here.

    Parameters
    ----------
    track : of the sensor at K keyframes.
    keyframe_s : (K,) s.
    reading_keyframe : (M,) the first keyframe at or after each reading.
    reading_s : (M,) s.
    """
    between = reading_keyframe > 0
    end, time_s = reading_keyframe[between], reading_s[between]
    end_track = HeightTrack(*(column[end] for column in track))
    on_the_way = height_on_the_way(
        HeightTrack(*(column[end - 1] for column in track)),
        end_track,
        elapsed_s=time_s - keyframe_s[end - 1],
        span_s=keyframe_s[end] - keyframe_s[end - 1],
    )
    total = np.bincount(end, weights=end_track.height - on_the_way, minlength=len(keyframe_s))
    return np.asarray(total / np.maximum(np.bincount(end, minlength=len(keyframe_s)), 1))
