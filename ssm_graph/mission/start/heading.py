"""Heading at the start, from a compass, or from fixes against DVL and gyros."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from ssm_graph.base.frames import wrap_to_pi
from ssm_graph.base.frozen import Array
from ssm_graph.base.stepwise import Steps
from ssm_graph.imu.increments import merge_samples_steps
from ssm_graph.mission.mission import Mission
from ssm_graph.mission.start.measured import BodyVelocities, StartFixes
from ssm_graph.sensors.compass import HeadingLog

SILENCE_S = 5.0
"""A gap between pings that ends the dead reckoning."""
INDEPENDENT_FIXES = 4
"""Errors of GNSS change slowly: never count on more independent fixes than this."""


class HeadingFit(NamedTuple):
    """A heading at the start with its standard deviation, rad."""

    heading: float
    sigma: float


def heading_from_track_steps(
    mission: Mission, fixes: StartFixes, R_lb: Array, velocities: BodyVelocities
) -> Steps[HeadingFit]:
    """Turn the dead-reckoned track onto that of the fixes, over the stretch that fixes it best.

    Parameters
    ----------
    mission : whose inertial data and pings are used.
    fixes : from the first of which the track begins.
    R_lb : (3, 3) body to local level at the start; its heading is what is sought, so any will do.
    velocities : of the body at the pings.
    """
    track = yield from _dead_reckon_steps(mission, fixes, R_lb, velocities)
    time_s, track_l, antenna_l, turned = track
    used = fixes.where(fixes.time_s <= time_s[-1])
    fix_n = used.position_n
    if len(fix_n) < 3:
        return HeadingFit(0.0, math.inf)
    fix_l = (fix_n @ mission.frame.R_nl_at(fix_n[0]))[:, :2]
    seen_l = np.stack(
        [np.interp(used.time_s, time_s, axis) for axis in (track_l + antenna_l)[:, :2].T], axis=-1
    )
    noise = float(np.sqrt(np.mean(used.sigma_enu[:, :2] ** 2)))
    by_bias = mission.imu.noise.gyro_bias_sigma * (used.time_s - time_s[0])
    by_scale = mission.imu.calibration.gyro_scale_sigma * np.interp(used.time_s, time_s, turned)
    drift = 0.5 * np.hypot(by_bias, by_scale)
    fits = [
        _fit(seen_l[:n], fix_l[:n], noise=noise, drift=float(drift[n - 1]))
        for n in np.unique(np.geomspace(3, len(fix_l), 20).astype(int))
    ]
    turn, sigma = min(fits, key=lambda fit: fit.sigma)
    # The fit turns from the level axes assumed to the true ones, anticlockwise.
    assumed = math.atan2(R_lb[0, 0], R_lb[1, 0])
    return HeadingFit(assumed - turn, sigma)


def _fit(seen: Array, fixed: Array, *, noise: float, drift: float) -> HeadingFit:
    """Return the anticlockwise turn of ``seen`` (N, 2) onto ``fixed`` (N, 2)."""
    a, b = seen - seen.mean(axis=0), fixed - fixed.mean(axis=0)
    turn = math.atan2(float(np.sum(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])), float(np.sum(a * b)))
    spread = math.sqrt(float(np.mean(np.sum(a**2, axis=1))))
    independent = min(len(a), INDEPENDENT_FIXES)
    sigma = noise / max(spread * math.sqrt(independent), 1e-9)
    return HeadingFit(turn, math.hypot(sigma, drift))


class _Track(NamedTuple):
    """A dead-reckoned way in the level axes assumed."""

    time_s: Array
    """(N,)"""
    position_l: Array
    """(N, 3) m"""
    antenna_l: Array
    """(N, 3) m, body origin to antenna"""
    turned: Array
    """(N,) rad, the most that the heading has been away from its first value until then"""


def _dead_reckon_steps(
    mission: Mission, fixes: StartFixes, R_lb: Array, velocities: BodyVelocities
) -> Steps[_Track]:
    start_s = float(fixes.time_s[0])
    end_s = min(float(fixes.time_s[-1]), float(mission.imu.time_s[-1]))
    pings = velocities.time_s[(velocities.time_s > start_s) & (velocities.time_s < end_s)]
    silent = np.flatnonzero(np.diff(pings, prepend=start_s) > SILENCE_S)
    pings = pings[: silent[0]] if len(silent) else pings
    time_s = np.concatenate([[start_s], pings])
    if len(time_s) < 2:
        return _Track(time_s, np.zeros((1, 3)), (R_lb @ fixes.lever_arm_b)[None, :], np.zeros(1))
    R = yield from gyro_attitudes_steps(mission, time_s, R_lb)
    v_l = np.einsum("kij,kj->ki", R, velocities.at(time_s))
    step = 0.5 * (v_l[1:] + v_l[:-1]) * np.diff(time_s)[:, None]
    track = np.concatenate([np.zeros((1, 3)), np.cumsum(step, axis=0)])
    heading = np.unwrap(np.arctan2(R[:, 0, 0], R[:, 1, 0]))
    turned = np.maximum.accumulate(np.abs(heading - heading[0]))
    return _Track(time_s, track, R @ fixes.lever_arm_b, turned)


def gyro_attitudes_steps(mission: Mission, time_s: Array, R_lb: Array) -> Steps[Array]:
    """Return attitudes (N, 3, 3) at the times, by the gyros alone."""
    merged = yield from merge_samples_steps(mission.imu, time_s, rate_hz=20.0)
    # Against the turn of the Earth, which a MEMS gyro does not notice but a better one does.
    earth_l = mission.frame.omega_ie_n
    attitudes = [R_lb]
    for k in range(len(time_s) - 1):
        R = attitudes[-1]
        for i in range(merged.first[k], merged.first[k + 1]):
            rate_b = merged.gyro_b[i] - R.T @ earth_l
            R = R @ Rotation.from_rotvec(rate_b * merged.dt[i]).as_matrix()
        attitudes.append(R)
        yield 0.15
    return np.array(attitudes)


NONE = HeadingFit(0.0, math.inf)
UNKNOWN_OFFSET = math.radians(90.0)
"""A compass that may be off by so much, a directional gyro, says nothing of the start."""


def heading_from_compass_steps(
    mission: Mission, start_s: float, R_lb: Array, *, window_s: float
) -> Steps[HeadingFit]:
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
    time_s = np.concatenate([[start_s], log.time_s[used]])
    attitudes = yield from gyro_attitudes_steps(mission, time_s, R_lb)
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
