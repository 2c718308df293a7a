"""Heading at the start from a compass, where the mission has one."""

from __future__ import annotations

import math

import numpy as np

from ssm_graph.base.frames import wrap_to_pi
from ssm_graph.base.frozen import Array
from ssm_graph.mission.mission import Mission
from ssm_graph.mission.start.track_heading import HeadingFit, gyro_attitudes
from ssm_graph.sensors.compass import HeadingLog

NONE = HeadingFit(0.0, math.inf)
UNKNOWN_OFFSET = math.radians(90.0)
"""A compass that may be off by so much, a directional gyro, says nothing of the start."""


def heading_from_compass(
    mission: Mission, start_s: float, R_lb: Array, *, window_s: float
) -> HeadingFit:
    """Return the median of what the readings of a window say, each led back to its begin.

    The median keeps disturbances out that are shorter than half the window. Its sigma is that of
    one reading with all the errors that the mission states of the compass, as if none averaged out.

    Parameters
    ----------
    mission : with or without a compass.
    start_s : begin of the window, s.
    R_lb : (3, 3) body to local level at the start; its heading is what is sought, so any will do.
    window_s : as long as the gyros keep the heading.
    """
    log = mission.aids.get(HeadingLog)
    if log is None or log.errors.offset_sigma >= UNKNOWN_OFFSET:
        return NONE
    used = (log.time_s > start_s) & (log.time_s <= start_s + window_s)
    if not used.any():
        return NONE
    attitudes = gyro_attitudes(mission, np.concatenate([[start_s], log.time_s[used]]), R_lb)
    assumed = np.arctan2(attitudes[:, 0, 0], attitudes[:, 1, 0])
    off = log.heading[used] + log.declination - assumed[1:]
    middle = math.atan2(float(np.mean(np.sin(off))), float(np.mean(np.cos(off))))
    off = middle + wrap_to_pi(off - middle)
    errors = log.errors
    sigma = math.hypot(
        log.sigma,
        errors.offset_sigma,
        errors.walk_sigma,
        errors.one_cycle_sigma,
        errors.two_cycle_sigma,
    )
    return HeadingFit(float(wrap_to_pi(assumed[0] + float(np.median(off)))), sigma)
