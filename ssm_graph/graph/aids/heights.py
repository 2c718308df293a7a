"""Height between keyframes: what depth readings need that were taken on the way."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

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
    up_n = frame.R_nl_at(p_n)[..., 2]
    sensor_n = p_n + arm_n
    return HeightTrack(
        height=frame.geodetic_from_p_n(sensor_n)[2],
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
