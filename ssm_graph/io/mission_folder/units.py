"""Units and axes of the mission folder; the rest of the package knows SI, radians and FRD only."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Final

import numpy as np

from ssm_graph.base.frames import rotation_zyx
from ssm_graph.base.frozen import Array
from ssm_graph.io.mission_folder.keys import Stamp

MICRO_G: Final = 9.80665e-6
"""m/s^2"""

SI: Final[Mapping[str, float]] = {
    "gyro_random_walk_deg_per_sqrt_h": math.radians(1.0) / 60.0,
    "accel_random_walk_ug_per_sqrt_hz": MICRO_G,
    "gyro_bias_deg_per_h": math.radians(1.0) / 3600.0,
    "accel_bias_ug": MICRO_G,
    "gyro_bias_walk_deg_per_h_per_sqrt_h": math.radians(1.0) / 3600.0 / 60.0,
    "accel_bias_walk_ug_per_sqrt_h": MICRO_G / 60.0,
    "lat_deg": math.radians(1.0),
    "lon_deg": math.radians(1.0),
    "roll_deg": math.radians(1.0),
    "pitch_deg": math.radians(1.0),
    "heading_deg": math.radians(1.0),
    "misalignment_sigma_deg": math.radians(1.0),
    "noise_deg": math.radians(1.0),
    "declination_deg": math.radians(1.0),
    "offset_sigma_deg": math.radians(1.0),
    "rate_sigma_deg_per_h": math.radians(1.0) / 3600.0,
    "walk_sigma_deg": math.radians(1.0),
    "one_cycle_sigma_deg": math.radians(1.0),
    "two_cycle_sigma_deg": math.radians(1.0),
    "scale_walk_per_sqrt_h": 1.0 / 60.0,
}
"""One unit of a key in SI units; keys that are not listed are in SI units already."""


def to_si(key: str, value: float) -> float:
    """Return ``value`` of the TOML key ``key`` in SI units and radians."""
    return value * SI.get(key, 1.0)


def from_si(key: str, value: float) -> float:
    """Return the shortest decimal that :func:`to_si` turns into ``value``, or the nearest one."""
    exact = value / SI.get(key, 1.0) + 0.0  # no minus zero in a file for people
    for digits in range(1, 17):
        short = float(f"{exact:.{digits}g}")
        if to_si(key, short) == value:
            return short
    return exact


def interval_ends(time_s: Array, stamp: Stamp) -> tuple[float, Array]:
    """Return the begin of the first averaging interval and the end of each, (N,).

    Intervals touch each other; the one that a stamp leaves open is given the median length.
    """
    median = float(np.median(np.diff(time_s)))
    if stamp is Stamp.END:
        return float(time_s[0]) - median, time_s
    if stamp is Stamp.START:
        return float(time_s[0]), np.append(time_s[1:], time_s[-1] + median)
    middles = time_s[:-1] + 0.5 * np.diff(time_s)
    return float(time_s[0]) - 0.5 * median, np.append(middles, time_s[-1] + 0.5 * median)


def beams_from_angles(azimuth: Array, janus: float) -> Array:
    """Return unit beam directions (N, 3) in instrument axes, radians.

    ``janus`` is counted from the vertical (instrument z), ``azimuth`` from x towards y.
    """
    down = np.full_like(azimuth, np.cos(janus))
    return np.stack([np.cos(azimuth) * np.sin(janus), np.sin(azimuth) * np.sin(janus), down], -1)


def R_bd_from_rpy(roll_pitch_yaw: Array) -> Array:
    """Return the mounting ``Rz(yaw) Ry(pitch) Rx(roll)``, (3, 3), instrument to body, radians."""
    roll, pitch, yaw = roll_pitch_yaw
    return rotation_zyx(yaw, pitch, roll)


def rpy_from_R_bd(R_bd: Array) -> Array:
    """Return roll, pitch, yaw (3,) of a mounting, radians; yaw is 0 where the pitch is vertical."""
    horizontal = math.hypot(R_bd[0, 0], R_bd[1, 0])
    pitch = math.atan2(-R_bd[2, 0], horizontal)
    if horizontal < 1e-9:
        return np.array([math.atan2(math.copysign(1.0, pitch) * R_bd[0, 1], R_bd[1, 1]), pitch, 0])
    return np.array([math.atan2(R_bd[2, 1], R_bd[2, 2]), pitch, math.atan2(R_bd[1, 0], R_bd[0, 0])])
