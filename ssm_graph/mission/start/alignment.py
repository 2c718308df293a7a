"""Finding the initial state from the data: levelling, gyrocompassing, fixes and DVL, compass.

Levelling and gyrocompassing are one fit. In axes that do not turn, the specific force that the
vehicle's own velocity does not explain integrates to gravity, and gravity turns with the Earth::

    [C v_b] - int C f_b dt = R_bn int Exp(omega_ie t) g_n dt

with ``C`` the gyros' rotation since the start. The direction of both sides gives roll and pitch,
its turning gives heading, if the gyros sense the Earth.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from ssm_graph.base.earth import EARTH_RATE, normal_gravity
from ssm_graph.base.frames import (
    R_lb_from_roll_pitch_heading,
    roll_pitch_heading_from_R_lb,
    wrap_to_pi,
)
from ssm_graph.base.frozen import Array
from ssm_graph.base.stepwise import Steps, at_once
from ssm_graph.imu.increments import merge_samples_steps
from ssm_graph.mission.mission import InitialState, LocalStart, Mission
from ssm_graph.mission.start.heading import (
    HeadingFit,
    heading_from_compass_steps,
    heading_from_track_steps,
)
from ssm_graph.mission.start.measured import (
    LOCAL,
    MIN_WINDOW_S,
    BodyVelocities,
    StartFixes,
    body_velocities,
    start_fixes,
)
from ssm_graph.mission.usable import require_usable
from ssm_graph.sensors.imu import ImuLog

SAFE_HEADING_SIGMA = math.radians(10.0)
"""Above this, one heading is not safe and several are tried."""
N_HYPOTHESES = 8
CAUTION = 3.0
"""The data that align are used again by the smoother: their sigmas enter its prior this much
larger, so that counting them twice adds little."""
MAX_WINDOW_S = 300.0
LOCAL_HEADING_SIGMA = math.radians(0.1)
"""Of a heading that is zero by definition."""
COMPASS_FLOOR = math.radians(0.5)
"""No gyrocompass heading is trusted further: a bad ping in the window costs that much."""
TURN_BUDGET = math.radians(0.5)
"""The window is as long as the gyros' turn-on bias keeps the accumulated turn below this."""


@dataclass(frozen=True, slots=True)
class Alignment:
    """Initial states to start from; more than one where the heading is not safe."""

    candidates: tuple[InitialState, ...]
    method: str
    """One sentence: how roll, pitch and heading were found, with sigmas."""


def align_steps(mission: Mission) -> Steps[Alignment]:
    """Find the initial state of a mission from its first minutes.

    Raises
    ------
    ConfigError
        If there is no GNSS or USBL fix to give a position.
    DataError
        If no inertial data follow the first fix.
    """
    require_usable(mission)
    mission = replace(mission, imu=mission.imu.calibrated)
    velocities = body_velocities(mission)
    yield 0.03 * len(velocities.time_s)
    fixes = start_fixes(mission, velocities)
    start_s = float(fixes.time_s[0])
    window_s = _window(mission, start_s)
    turned = yield from _integrate_gyros_steps(mission, start_s, window_s, velocities)
    R_lb = _level_and_compass(mission, turned)
    compass = _compass_sigma(mission.imu, turned, mission.frame.lat)
    track = yield from heading_from_track_steps(mission, fixes, R_lb, velocities)
    magnetic = yield from heading_from_compass_steps(mission, start_s, R_lb, window_s=window_s)
    if mission.local is None:
        heading, method = _choose_heading(R_lb, compass, track, magnetic, fixes.source)
    else:
        heading, method = _local_heading(mission.local, R_lb, compass, magnetic)
    level = _level_sigma(mission.imu, turned)
    roll, pitch, _ = roll_pitch_heading_from_R_lb(R_lb)
    starts = [
        _initial_state(mission, fixes, (float(roll), float(pitch), h), level, sigma, velocities)
        for h, sigma in _hypotheses(heading)
    ]
    method += (
        f"; roll and pitch levelled over {turned.time_s[-1]:.0f} s, sigma "
        f"{math.degrees(level):.2f} deg; position from {fixes.source}"
    )
    return Alignment(tuple(starts), method)


align = at_once(align_steps)


def _window(mission: Mission, start_s: float) -> float:
    """Return how long to align for, s: as long as the gyros keep their attitude."""
    budget = TURN_BUDGET / mission.imu.noise.gyro_bias_sigma
    longest = float(mission.imu.time_s[-1]) - start_s
    return float(min(max(budget, MIN_WINDOW_S), MAX_WINDOW_S, longest))


class _Turned(NamedTuple):
    """Inertial data of the window in the body axes of its start (``C`` turns into these)."""

    time_s: Array
    """(N,) s since the start, at pings"""
    velocity: Array
    """(N, 3) ``C v_b``, m/s"""
    force: Array
    """(N, 3) ``int C f_b dt`` since the start, m/s"""


def _integrate_gyros_steps(
    mission: Mission, start_s: float, window_s: float, velocities: BodyVelocities
) -> Steps[_Turned]:
    pings = velocities.time_s[
        (velocities.time_s > start_s) & (velocities.time_s < start_s + window_s)
    ]
    if len(pings) < 3:
        pings = start_s + np.linspace(0.0, window_s, max(int(window_s), 3) + 1)[1:]
    keyframe_s = np.concatenate([[start_s], pings])
    merged = yield from merge_samples_steps(mission.imu, keyframe_s, rate_hz=20.0)
    v_b = velocities.at(pings)
    C, force = np.eye(3), np.zeros(3)
    rows = []
    for k in range(len(pings)):
        for i in range(merged.first[k], merged.first[k + 1]):
            half = Rotation.from_rotvec(0.5 * merged.gyro_b[i] * merged.dt[i]).as_matrix()
            force = force + C @ half @ merged.accel_b[i] * merged.dt[i]
            C = C @ half @ half
        rows.append((C @ v_b[k], force))
        yield 0.2
    velocity, integral = (np.array(column) for column in zip(*rows, strict=True))
    return _Turned(pings - start_s, velocity, integral)


def _level_and_compass(mission: Mission, turned: _Turned) -> Array:
    """Return the rotation body to local level at the start that explains the velocities best."""
    frame = mission.frame
    omega, t = frame.omega_ie_n, turned.time_s[:, None]
    g_n = np.array([0.0, 0.0, -float(normal_gravity(frame.lat, frame.height))])
    # int Exp(omega t) g dt to second order in the Earth's turn, 1e-7 of it over the window
    first, second = np.cross(omega, g_n), np.cross(omega, np.cross(omega, g_n))
    expected = g_n * t + first * t**2 / 2.0 + second * t**3 / 6.0
    gain = turned.velocity - turned.force
    elapsed = t[1:] - t[0]
    R_lb = np.eye(3)
    # Seen from axes that do not turn, a velocity over ground gains -omega x v besides; that needs
    # the attitude, roughly.
    for _ in range(2):
        coriolis = np.cross(R_lb.T @ omega, turned.velocity)
        step = 0.5 * (coriolis[1:] + coriolis[:-1]) * np.diff(t, axis=0)
        seen = gain[1:] - gain[0] + np.cumsum(step, axis=0)
        # Every row counts alike once divided by its length of time.
        fitted, _ = Rotation.align_vectors(
            (expected[1:] - expected[0]) / elapsed, seen / elapsed, weights=elapsed[:, 0]
        )
        R_lb = np.asarray(fitted.as_matrix())
    return R_lb


def _rate_sigma(imu: ImuLog) -> float:
    """Return the sigma of what lasts in the gyros under gravity, rad/s."""
    return math.hypot(imu.noise.gyro_bias_sigma, 9.8 * imu.calibration.gyro_g_sensitivity_sigma)


def _compass_sigma(imu: ImuLog, turned: _Turned, lat: float) -> float:
    """Return the standard deviation of a gyrocompass heading, rad."""
    window_s = turned.time_s[-1]
    rate = math.hypot(_rate_sigma(imu), imu.noise.gyro_density / math.sqrt(window_s))
    # A velocity error of a few mm/s against the sideways gain g omega cos(lat) T^2 / 2.
    gain = 0.5 * 9.8 * window_s**2
    sigma = math.hypot(rate, 2.0 * _VELOCITY_SIGMA / gain) / (EARTH_RATE * math.cos(lat))
    return max(sigma, COMPASS_FLOOR)


_VELOCITY_SIGMA = 0.02


def _level_sigma(imu: ImuLog, turned: _Turned) -> float:
    window_s, noise = turned.time_s[-1], imu.noise
    parts = (
        noise.accel_bias_sigma / 9.8,
        imu.calibration.accel_misalignment_sigma,
        0.5 * _rate_sigma(imu) * window_s,
        2.0 * _VELOCITY_SIGMA / (9.8 * window_s),
        noise.gyro_density * math.sqrt(window_s),
    )
    return math.hypot(*parts)


def _choose_heading(
    R_lb: Array, compass: float, track: HeadingFit, magnetic: HeadingFit, fixes: str
) -> tuple[HeadingFit, str]:
    """Return the heading of smallest sigma and a sentence that says where it is from."""
    if compass <= min(track.sigma, magnetic.sigma):
        fit = HeadingFit(float(roll_pitch_heading_from_R_lb(R_lb)[2]), compass)
        source = "gyrocompassing"
    elif track.sigma <= magnetic.sigma:
        fit, source = track, f"{fixes} against DVL displacement"
    else:
        fit, source = magnetic, "the compass"
    if fit.sigma > SAFE_HEADING_SIGMA:
        sigma = f"{math.degrees(fit.sigma):.0f} deg" if fit.sigma < math.pi else "unbounded"
        return fit, (
            f"heading hardly observable from {source} (sigma {sigma}): {N_HYPOTHESES} hypotheses "
            "tried"
        )
    return fit, (
        f"heading {math.degrees(fit.heading) % 360.0:.2f} deg from {source}, sigma "
        f"{math.degrees(fit.sigma):.2f} deg"
    )


def _local_heading(
    local: LocalStart, R_lb: Array, compass: float, magnetic: HeadingFit
) -> tuple[HeadingFit, str]:
    """Return the heading of a start without a place: stated, found, or zero by definition."""
    if local.is_heading_known:
        fit = HeadingFit(local.heading, local.heading_sigma / CAUTION)
        return fit, f"heading {math.degrees(local.heading) % 360.0:.2f} deg as [local] states"
    if min(compass, magnetic.sigma) <= SAFE_HEADING_SIGMA:
        none = HeadingFit(0.0, math.inf)
        return _choose_heading(R_lb, compass, none, magnetic, LOCAL)
    return HeadingFit(0.0, LOCAL_HEADING_SIGMA), (
        "heading not known: zero is where the vehicle looked at the start, which need not be north"
    )


def _hypotheses(fit: HeadingFit) -> list[tuple[float, float]]:
    """Return headings to start from with the sigma of each."""
    if fit.sigma <= SAFE_HEADING_SIGMA:
        return [(fit.heading, CAUTION * fit.sigma)]
    step = 2.0 * math.pi / N_HYPOTHESES
    return [
        (float(wrap_to_pi(fit.heading + i * step)), CAUTION * SAFE_HEADING_SIGMA)
        for i in range(N_HYPOTHESES)
    ]


def _initial_state(
    mission: Mission,
    fixes: StartFixes,
    roll_pitch_heading: tuple[float, float, float],
    level_sigma: float,
    heading_sigma: float,
    velocities: BodyVelocities,
) -> InitialState:
    frame, antenna_n = mission.frame, fixes.position_n[0]
    start_s = float(fixes.time_s[0])
    R_lb = R_lb_from_roll_pitch_heading(*roll_pitch_heading)
    lat, lon, height = frame.geodetic_from_p_n(
        antenna_n - frame.R_nl_at(antenna_n) @ R_lb @ fixes.lever_arm_b
    )
    speed = float(np.linalg.norm(velocities.at(np.array([start_s]))))
    across = speed * min(heading_sigma, 2.0)
    velocity_sigma = max(0.1, across) if velocities.covers(start_s) else 1.0
    level = max(CAUTION * level_sigma, math.radians(0.05))
    roll, pitch, heading = roll_pitch_heading
    return InitialState(
        time_s=start_s,
        lat=float(lat),
        lon=float(lon),
        height=float(height),
        roll=roll,
        pitch=pitch,
        heading=heading % (2.0 * math.pi),
        velocity_enu=R_lb @ velocities.at(np.array([start_s]))[0],
        position_sigma_enu=CAUTION * fixes.sigma_enu[0],
        velocity_sigma_enu=np.full(3, velocity_sigma),
        attitude_sigma=np.array([level, level, heading_sigma]),
    )
