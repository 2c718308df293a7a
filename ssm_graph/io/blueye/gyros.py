"""Gyros beside the one that is used: the vehicle's other IMU, and the heading of its DVL.

Both IMUs are screwed to one vehicle, so that they turn alike; what differs is a bias, a scale or a
sign of one of them, and the accelerometers tell whose sign it is: at rest a specific force points
up. The A50 dead-reckons with inertial sensors of its own, without compass or GNSS: its heading is a
directional gyro of no known origin. A reset of its dead reckoning makes the heading jump; pieces
are joined by the vehicle's gyros.
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
from ssm_graph.sensors.compass import HeadingLog
from ssm_graph.sensors.imu import ImuLog

JUMP: Final = np.deg2rad(10.0)
"""Between two readings, beyond what the vehicle's gyros turn."""
MOST_JUMPS: Final = 0.02
"""Share of the readings: with more of them it is no gyro."""
FEWEST: Final = 20
MOST_RATE: Final = 4.0 * math.hypot(DVL_HEADING_ERRORS.rate_sigma, NOISE.gyro_bias_sigma)
"""rad/s, between both gyros: one that drifts further is not the one that its sigma is of."""
STEP_S: Final = 2.0
"""Turns over so long are compared; longer than the gaps and the jitter of either."""
FEWEST_STEPS: Final = 10
TURNING: Final = 0.02
"""rad/s rms: slower turns about an axis say nothing of its sign and scale."""
SAME_SCALE: Final = 0.05


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


def compare_imus(imu: ImuLog, witness: Array) -> tuple[str, ...]:
    """Return one sentence each on what the other IMU tells.

    Parameters
    ----------
    imu : the one that is used, forward-right-down, rad/s and m/s^2.
    witness : (N, 7) arrival time, gyro and accelerometer of the other, in the log's units.
    """
    if len(witness) < 2:
        return ()
    begin = max(imu.start_s, float(witness[0, 0])) + STEP_S
    edges = np.arange(begin, min(float(imu.time_s[-1]), float(witness[-1, 0])) - STEP_S, STEP_S)
    if len(edges) <= FEWEST_STEPS:
        return ()
    used = np.diff(turned(imu.time_s, imu.gyro_b, edges), axis=0) / STEP_S
    other = np.diff(turned(witness[:, 0], witness[:, 1:4], edges), axis=0) / STEP_S
    offset = np.median(other - used, axis=0)
    is_up = float(np.median(witness[:, 6])) < 0.0
    text = ", ".join(f"{x + 0.0:.4f}" for x in offset)
    first = (
        "Imu1Tel is not used, only compared: its gyros read "
        f"({text}) rad/s more than those of Imu2Tel"
        + ("" if is_up else ", and its accelerometer has the opposite sign (+1 g at rest)")
        + "."
    )
    return (first, *_doubts(used - np.median(used, axis=0), other - np.median(other, axis=0)))


def turned(time_s: Array, rate: Array, at_s: Array) -> Array:
    """Return the integral (M, 3) of rates (N, 3) that hold since the time before, rad."""
    angle = np.cumsum(rate[1:] * np.diff(time_s)[:, None], axis=0)
    return np.column_stack([np.interp(at_s, time_s[1:], column) for column in angle.T])


def _doubts(used: Array, other: Array) -> tuple[str, ...]:
    """Compare turn rates (N, 3) less their biases, axis by axis."""
    notes = []
    for axis, name in enumerate("xyz"):
        x, y = used[:, axis], other[:, axis]
        if min(np.std(x), np.std(y)) < TURNING:
            continue
        scale = float(np.std(y) / np.std(x) * np.sign(np.mean(x * y)))
        if abs(scale - 1.0) > SAME_SCALE:
            notes.append(
                f"About {name} the gyros of Imu1Tel turn {scale:.2f} times as far as those of "
                "Imu2Tel, where 1 was expected: sign, unit or axes of one of them are wrong."
            )
    return tuple(notes)
