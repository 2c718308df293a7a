"""Check turn rates against the accelerometer: signs, units, biases."""

from __future__ import annotations

from typing import Final

import numpy as np

from ssm_graph.base.earth import EARTH_RATE
from ssm_graph.base.errors import DataError
from ssm_graph.base.frozen import Array
from ssm_graph.io.mission_folder.checks.motion_series import (
    force_direction,
    gravity_direction,
    turned,
    velocities,
)
from ssm_graph.mission.mission import Mission

_FEWEST_PINGS: Final = 30
_OPPOSITE_TILT: Final = -0.85
_TINY_GAIN: Final = 0.04
_SMALLEST_TILT: Final = 0.02
"""rad rms in one window."""
_TILT_STEP_S: Final = 1.0
_TILT_NOISE: Final = 0.1
"""rad, of the tilt by the accelerometer at either end of a mission, waves included."""
_BIAS_SIGMAS: Final = 4.0
_REST_S: Final = 10.0
_REST_FORCE: Final = 0.05
"""m/s^2, scatter of the specific force of a vehicle at rest."""
_REST_RATE: Final = 0.01
"""rad/s, scatter of its turn rates."""
_REST_SPEED: Final = 0.03
"""m/s along the beams"""


def turn_signs(mission: Mission, label: str) -> list[str]:
    """Compare turn rates with the accelerometer: tilting the vehicle tilts the specific force."""
    imu = mission.imu
    half = 0.5 * _TILT_STEP_S
    time_s = np.arange(imu.time_s[0] + 2.0 * half, imu.time_s[-1] - 2.0 * half, 2.0 * half)
    if len(time_s) < _FEWEST_PINGS:
        return []
    # Windows touch: the end of one step is the begin of the next.
    edges = np.append(time_s - half, time_s[-1] + half)
    force = force_direction(mission, edges, half)
    before, after = force[:-1], force[1:]
    turn = turned(mission, time_s, half)
    predicted, seen = -np.cross(turn, 0.5 * (before + after)), after - before
    notes = []
    for axis, motion in enumerate(("pitches", "rolls")):
        notes += _tilt_agrees(seen[:, axis], predicted[:, axis], f"{label}: the vehicle {motion}")
    # What moves the vehicle is in the force as well, and turns with it: only gravity stays behind.
    ping_s, velocity = velocities(mission)
    if len(ping_s) < _FEWEST_PINGS:
        return notes
    gravity = gravity_direction(mission, edges, half, ping_s=ping_s, velocity=velocity)
    before, after = gravity[:-1], gravity[1:]
    drift = (after - before + np.cross(turn, 0.5 * (before + after))).mean(axis=0)
    return notes + _level_bias(mission, drift / (2.0 * half), label)


def _level_bias(mission: Mission, drift: Array, label: str) -> list[str]:
    """Note gyros about the level axes that read far more than the vehicle tilts.

    Parameters
    ----------
    mission : the recorded run.
    drift : (3,) how fast the direction of the specific force leaves the one by the gyros, 1/s;
        that is ``bias x force``.
    label : the table.
    """
    force = np.median(mission.imu.accel_b, axis=0)
    bias = np.cross(force / np.linalg.norm(force), drift)
    noise, span = mission.imu.noise, float(mission.imu.time_s[-1] - mission.imu.start_s)
    spread = (noise.gyro_density / np.sqrt(span), _TILT_NOISE / span)
    size, limit = float(np.linalg.norm(bias)), float(np.hypot(*spread))
    if size < EARTH_RATE + _BIAS_SIGMAS * np.hypot(noise.gyro_bias_sigma, limit):
        return []
    return [
        f"{label}: over the mission the gyros turn by {_deg_per_h(bias)} deg/h about x, y, z more "
        "than the vehicle tilts, far beyond gyro_bias_deg_per_h = "
        f"{_deg_per_h(noise.gyro_bias_sigma)}: that is a bias, and the axis along gravity, which "
        "this does not see, may have one too; take it off or state it"
    ]


def rates_at_rest(mission: Mission, label: str) -> list[str]:
    """Note gyros that turn while the accelerometer and the DVL are still."""
    imu, noise = mission.imu, mission.imu.noise
    spread = np.hypot(noise.gyro_bias_sigma, noise.gyro_density / _REST_S**0.5)
    limit = EARTH_RATE + _BIAS_SIGMAS * float(spread)
    for begin in np.arange(imu.start_s, imu.time_s[-1] - _REST_S, _REST_S):
        now = (imu.time_s > begin) & (imu.time_s <= begin + _REST_S)
        ping = (mission.dvl.ping_s > begin) & (mission.dvl.ping_s <= begin + _REST_S)
        speed = mission.dvl.speed[ping]
        if now.sum() < _FEWEST_PINGS or not np.isfinite(speed).any():
            continue
        is_still = np.max(np.std(imu.accel_b[now], axis=0)) < _REST_FORCE
        is_still &= np.max(np.std(imu.gyro_b[now], axis=0)) < _REST_RATE
        mean = imu.gyro_b[now].mean(axis=0)
        if is_still and np.nanmedian(np.abs(speed)) < _REST_SPEED and np.abs(mean).max() > limit:
            return [
                f"{label}: from {begin:z.1f} s on the vehicle lies still for {_REST_S:g} s by "
                f"accelerometer and DVL, and the gyros read {_deg_per_h(mean)} deg/h about x, y, "
                f"z; gyro_bias_deg_per_h = {_deg_per_h(noise.gyro_bias_sigma)}: a bias, or a "
                "steady turn on the spot"
            ]
    return []


def _tilt_agrees(seen: Array, predicted: Array, subject: str) -> list[str]:
    """Refuse or note a tilt that the accelerometer sees otherwise than the gyros."""
    seen_sq, predicted_sq = float(np.mean(seen**2)), float(np.mean(predicted**2))
    if min(seen_sq, predicted_sq) < _SMALLEST_TILT**2:
        return []
    product = float(np.mean(seen * predicted))
    correlation = product / np.sqrt(seen_sq * predicted_sq)
    text = (
        f"{subject} by the gyros and the other way by the accelerometer (correlation "
        f"{correlation:.2f}); expected one motion; check the signs of the gyros and [frames] body"
    )
    if correlation < _OPPOSITE_TILT:
        raise DataError(text)
    if correlation > -_OPPOSITE_TILT and product / predicted_sq < _TINY_GAIN:
        raise DataError(
            f"{subject} {predicted_sq / product:.0f} times as far by the gyros as by the "
            "accelerometer; expected rad/s; are the turn rates in deg/s?"
        )
    return [text] if correlation < -0.5 else []


def _deg_per_h(rate: Array | float) -> str:
    return ", ".join(f"{x + 0.0:.0f}" for x in np.atleast_1d(np.degrees(rate) * 3600.0))
