"""The heading of a Blueye's DVL as a directional gyro: no known origin, but a gyro of its own.

The A50 dead-reckons with inertial sensors that are not the vehicle's, and without compass or GNSS.
A reset of its dead reckoning makes the heading jump; pieces are joined by the vehicle's gyros.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from ssm_graph.base.frames import wrap_to_pi
from ssm_graph.base.frozen import Array
from ssm_graph.io.blueye.vehicle import (
    DVL_HEADING_DELAY_S,
    DVL_HEADING_ERRORS,
    DVL_HEADING_SCALE,
    DVL_HEADING_SIGMA,
    NOISE,
)
from ssm_graph.io.blueye.witness import turned
from ssm_graph.sensors.compass import HeadingLog
from ssm_graph.sensors.imu import ImuLog

JUMP: Final = np.deg2rad(10.0)
"""Between two readings, beyond what the vehicle's gyros turn."""
MOST_JUMPS: Final = 0.02
"""Share of the readings: with more of them it is no gyro."""
FEWEST: Final = 20
MOST_RATE: Final = 4.0 * math.hypot(DVL_HEADING_ERRORS.rate_sigma, NOISE.gyro_bias_sigma)
"""rad/s, between both gyros: one that drifts further is not the one that its sigma is of."""


def dvl_heading(readings: Array, imu: ImuLog) -> tuple[HeadingLog | None, tuple[str, ...]]:
    """Return the DVL's heading, if the log has one that turns as the vehicle does, and notes.

    Parameters
    ----------
    readings : (N, 2) arrival time, s, and heading, rad, repeats included.
    imu : forward-right-down; its turns about z say where the readings jump.
    """
    new = readings[1:][np.diff(readings[:, 1]) != 0.0]  # the first is of unknown age
    time_s = new[:, 0] - DVL_HEADING_DELAY_S
    inside = (time_s >= imu.time_s[0]) & (time_s <= imu.time_s[-1])
    inside &= np.r_[True, np.diff(time_s) > 0.0][: len(time_s)]
    new, time_s = new[inside], time_s[inside]
    if len(new) < FEWEST:
        return None, ()
    turn = np.diff(turned(imu.time_s, imu.gyro_b, time_s)[:, 2])
    beyond = wrap_to_pi(np.diff(new[:, 1]) - DVL_HEADING_SCALE * turn)
    jumps = np.abs(beyond) > JUMP
    if np.mean(jumps) > MOST_JUMPS:
        return None, (
            f"The DVL's heading is left out: {int(jumps.sum())} of {len(new)} readings jump by "
            f"more than {np.rad2deg(JUMP):.0f} degrees from what the gyros turn.",
        )
    away = np.cumsum(np.where(jumps, 0.0, beyond) / DVL_HEADING_SCALE)
    rate = float(np.polyfit(time_s[1:] - time_s[0], away, 1)[0])
    if abs(rate) > MOST_RATE:
        return None, (
            f"The DVL's heading is left out: it drifts by {_deg_per_h(rate):.0f} deg/h against the "
            f"gyros, and {_deg_per_h(MOST_RATE):.0f} were expected at most.",
        )
    heading = new[0, 1] + np.concatenate([[0.0], np.cumsum(turn) + away])
    log = HeadingLog(
        sigma=DVL_HEADING_SIGMA,
        time_s=time_s,
        heading=np.remainder(heading, 2.0 * np.pi),
        errors=DVL_HEADING_ERRORS,
    )
    note = (
        f"The DVL's own heading, {len(new)} readings {DVL_HEADING_DELAY_S} s late, is used as a "
        f"directional gyro: it turns {DVL_HEADING_SCALE} of what the vehicle turns, from an origin "
        f"of its own; {int(jumps.sum())} jumps of its dead reckoning bridged by the gyros."
    )
    return log, (note,)


def _deg_per_h(rate: float) -> float:
    return 3600.0 * math.degrees(rate)
