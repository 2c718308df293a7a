"""A Blueye's two IMUs beside each other: what the one that is not used says of the other.

Both are screwed to one vehicle, so that they turn alike; what differs is a bias, a scale or a sign
of one of them, and the accelerometers tell whose sign it is: at rest a specific force points up.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from ssm_graph.base.frozen import Array
from ssm_graph.sensors.imu import ImuLog

STEP_S: Final = 2.0
"""Turns over so long are compared; longer than the gaps and the jitter of either."""
FEWEST_STEPS: Final = 10
TURNING: Final = 0.02
"""rad/s rms: slower turns about an axis say nothing of its sign and scale."""
SAME_SCALE: Final = 0.05


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
