"""What a start is found from: velocities of whole pings, and position fixes."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ssm_graph.base.errors import ConfigError, DataError
from ssm_graph.base.frozen import Array, FrozenArrays, shaped
from ssm_graph.imu.ping_motion import mean_gyro
from ssm_graph.mission.mission import Mission
from ssm_graph.sensors.acoustic import RangeLog, UsblLog
from ssm_graph.sensors.gnss import GnssLog
from ssm_graph.sensors.standstill import HOLDS_S, RestLog, Standstill

PARITY_GATE = 5.0
"""Sigmas of the array's parity above which a ping is not used."""
REST_STEP_S = 1.0
"""Between the velocities of a standstill."""
REACH_S = 3.0
"""How far from a ping its velocity is believed."""


@dataclass(frozen=True, slots=True, eq=False)
class BodyVelocities:
    """Velocity over ground of the body origin at the usable pings, body axes."""

    time_s: Array
    """(N,) s"""
    v_b: Array
    """(N, 3) m/s"""

    def at(self, time_s: Array) -> Array:
        """Return velocities (M, 3) at any times, held at the ends; zero without any ping."""
        if len(self.time_s) == 0:
            return np.zeros((len(time_s), 3))
        return np.stack([np.interp(time_s, self.time_s, axis) for axis in self.v_b.T], axis=-1)

    def covers(self, time_s: float) -> bool:
        """Return whether a ping is near."""
        return bool(np.any(np.abs(self.time_s - time_s) < REACH_S))


def body_velocities(mission: Mission) -> BodyVelocities:
    """Return the velocities of the pings, and zero while the mission stands still."""
    velocities = _of_pings(mission)
    for still in (*mission.aids.all(Standstill), *_told(mission.aids.get(RestLog))):
        velocities = _at_rest(velocities, still)
    return velocities


def _told(log: RestLog | None) -> Iterator[Standstill]:
    """Yield the times in which a vehicle said again and again that it stands still."""
    if log is None or len(log.time_s) == 0:
        return
    parts = np.split(log.time_s, np.flatnonzero(np.diff(log.time_s) > HOLDS_S) + 1)
    for part in parts:
        if len(part) > 1:
            yield Standstill(float(part[0]), float(part[-1]))


def _at_rest(velocities: BodyVelocities, still: Standstill) -> BodyVelocities:
    """Return velocities with those of a standstill in the place of its pings."""
    count = int((still.end_s - still.begin_s) / REST_STEP_S) + 2
    rest_s = np.linspace(still.begin_s, still.end_s, count)
    before = velocities.time_s < still.begin_s
    after = velocities.time_s > still.end_s
    return BodyVelocities(
        np.concatenate([velocities.time_s[before], rest_s, velocities.time_s[after]]),
        np.concatenate([velocities.v_b[before], np.zeros((count, 3)), velocities.v_b[after]]),
    )


def _of_pings(mission: Mission) -> BodyVelocities:
    """Solve pings of agreeing beams, or of three, for the velocity of the body origin.

    Parities are blind to some faults, so what passes here is no more than a start. Pings off the
    water are left out.
    """
    dvl = mission.dvl.of_ground()
    if len(dvl.time_s) == 0:
        return BodyVelocities(dvl.time_s, np.zeros((0, 3)))
    beams_b = dvl.mount.beams_b
    valid = np.isfinite(dvl.speed)
    # Three beams agree with anything: they count only where pings of all beams are rare.
    n_needed = max(3, dvl.mount.n_beams if np.mean(valid.all(axis=1)) > 0.5 else 3)
    contradicts = dvl.mount.parity(dvl.speed, dvl.sigma) >= PARITY_GATE
    usable = np.flatnonzero((valid.sum(axis=1) >= n_needed) & ~contradicts)
    time_s = dvl.valid_s[usable]
    if len(usable) == 0:
        return BodyVelocities(time_s, np.zeros((0, 3)))
    v_b = np.array([np.linalg.lstsq(beams_b[valid[i]], dvl.speed[i, valid[i]])[0] for i in usable])
    gyro_b = mean_gyro(mission.imu, time_s)
    return BodyVelocities(time_s, v_b - np.cross(gyro_b, dvl.mount.lever_arm_b))


ACOUSTIC: Final = "USBL"
LOCAL: Final = "the local start at zero"
LOCAL_SIGMA_M: Final = 0.01
"""Of a position that is zero by definition; none, but for numerics."""
MIN_WINDOW_S: Final = 10.0
"""Inertial data that have to follow the first fix, to align with."""
NEAR_S: Final = 60.0
"""An acoustic fix is compared with those so long before and after it, and is preferred to one of
GNSS that is so much later."""
NEAR_AT_THE_SURFACE_S: Final = 5.0
"""A fix of GNSS is compared with those so long before and after it."""
FASTEST_AT_THE_SURFACE: Final = 3.0
"""m/s, of the vehicle meanwhile."""
GATE: Final = 4.0
"""It disagrees with one that is further off than the way swum and so many sigmas."""


@dataclass(frozen=True, slots=True, eq=False)
class StartFixes(FrozenArrays):
    """Fixes of one instrument from the begin of the inertial data on, the first to start from."""

    source: str
    """For people."""
    time_s: Array = shaped("N")
    """(N,) when they were valid, s."""
    position_n: Array = shaped("N", 3)
    """(N, 3) of antenna or transponder, m."""
    sigma_enu: Array = shaped("N", 3)
    """(N, 3) m"""
    lever_arm_b: Array = shaped(3)
    """(3,) body origin to antenna or transponder, m."""

    def where(self, kept: NDArray[np.bool_]) -> StartFixes:
        """Return some of them."""
        return StartFixes(
            self.source,
            self.time_s[kept],
            self.position_n[kept],
            self.sigma_enu[kept],
            self.lever_arm_b,
        )


def start_fixes(mission: Mission, velocities: BodyVelocities) -> StartFixes:
    """Return the fixes of a mission that its start is found from.

    Fixes err grossly now and then: those that disagree with most of the others near them are left
    out here; the smoother judges them again.

    Raises
    ------
    ConfigError
        If the mission has no position fixes.
    DataError
        If no inertial data follow the first fix.
    """
    if mission.local is not None:
        return _at_zero(mission)
    every = _all_fixes(mission)
    usable = [used for fixes in every if (used := _usable(mission, fixes, velocities)) is not None]
    if usable:
        return min(usable, key=lambda used: used.time_s[0] + NEAR_S * (used.source == ACOUSTIC))
    said = " and ".join(
        f"{fixes.source} {fixes.time_s[0]:.3f}..{fixes.time_s[-1]:.3f} s" for fixes in every
    )
    raise DataError(
        f"alignment: expected a position fix at least {MIN_WINDOW_S:.0f} s before the end of the "
        f"inertial data at {mission.imu.time_s[-1]:.3f} s, got fixes of {said}; check the clocks "
        "or add [initial]"
    )


def _at_zero(mission: Mission) -> StartFixes:
    """Return the one "fix" of a local start: zero when the inertial data begin, as deep as told."""
    start_s = mission.imu.start_s
    up, sigma_up = 0.0, LOCAL_SIGMA_M
    if mission.depth is not None and len(mission.depth.time_s):
        first = mission.depth.time_s < mission.depth.time_s[0] + REACH_S
        up = -float(np.median(mission.depth.true_depth[first]))
        sigma_up = max(mission.depth.sigma, 0.1)
    return StartFixes(
        LOCAL,
        np.array([start_s]),
        np.array([[0.0, 0.0, up]]),
        np.array([[LOCAL_SIGMA_M, LOCAL_SIGMA_M, sigma_up]]),
        np.zeros(3),
    )


def _all_fixes(mission: Mission) -> tuple[StartFixes, ...]:
    found = tuple(
        _in_order(mission, source, log)
        for source, log in (("GNSS", mission.gnss), (ACOUSTIC, mission.aids.get(UsblLog)))
        if log is not None and len(log.time_s)
    )
    if found:
        return found
    alone = "" if mission.aids.get(RangeLog) is None else ", and ranges to beacons alone give none"
    raise ConfigError(
        "mission.toml: expected [initial], [gnss] or [usbl], got none of them; without one the "
        f"start is unknown{alone}: add [initial] with position, attitude and their sigmas"
    )


def _in_order(mission: Mission, source: str, log: GnssLog | UsblLog) -> StartFixes:
    time_s = log.valid_s
    order = np.argsort(time_s, kind="stable")
    position_n = mission.frame.p_n_from_geodetic(log.lat, log.lon, log.height)
    return StartFixes(
        source, time_s[order], position_n[order], log.sigma_enu[order], log.lever_arm_b
    )


def _usable(mission: Mission, fixes: StartFixes, velocities: BodyVelocities) -> StartFixes | None:
    """Return the fixes to start from; None if there are none, or the first is too late."""
    imu = mission.imu
    used = fixes.where((fixes.time_s >= imu.start_s) & (fixes.time_s <= imu.time_s[-1]))
    if fixes.source == ACOUSTIC:
        used = used.where(_agreeing(used, velocities))
    else:
        used = used.where(_agreeing_at_the_surface(used))
    is_early = len(used.time_s) > 0 and used.time_s[0] <= imu.time_s[-1] - MIN_WINDOW_S
    return used if is_early else None


def _agreeing(fixes: StartFixes, velocities: BodyVelocities) -> NDArray[np.bool_]:
    """Return which fixes (N,) agree with at least half of those near them."""
    if len(velocities.time_s) == 0:
        return np.ones(len(fixes.time_s), bool)
    swum = _swum(fixes.time_s, velocities)
    sigma_sq = np.sum(fixes.sigma_enu**2, axis=1)
    agrees = np.ones(len(fixes.time_s), bool)
    for i, time_s in enumerate(fixes.time_s):
        near = np.abs(fixes.time_s - time_s) <= NEAR_S
        near[i] = False
        if not near.any():
            continue
        apart = np.linalg.norm(fixes.position_n[near] - fixes.position_n[i], axis=1)
        turned = 2.0 * float(np.linalg.norm(fixes.lever_arm_b))
        sigma = np.sqrt(sigma_sq[near] + sigma_sq[i])
        fits = apart <= np.abs(swum[near] - swum[i]) + turned + GATE * sigma
        agrees[i] = np.count_nonzero(fits) >= math.ceil(np.count_nonzero(near) / 2)
    return agrees


def _agreeing_at_the_surface(fixes: StartFixes) -> NDArray[np.bool_]:
    """Return which fixes (N,) of GNSS agree with at least half of those near them.

    At the surface the bottom may be out of reach, so that no speed is known.
    """
    time_s, sigma_sq = fixes.time_s, np.sum(fixes.sigma_enu**2, axis=1)
    begin = np.searchsorted(time_s, time_s - NEAR_AT_THE_SURFACE_S)
    end = np.searchsorted(time_s, time_s + NEAR_AT_THE_SURFACE_S, side="right")
    turned, agrees = 2.0 * float(np.linalg.norm(fixes.lever_arm_b)), np.ones(len(time_s), bool)
    for i, near in enumerate(map(slice, begin, end)):
        apart = np.linalg.norm(fixes.position_n[near] - fixes.position_n[i], axis=1)
        way = FASTEST_AT_THE_SURFACE * np.abs(time_s[near] - time_s[i])
        fits = apart <= way + turned + GATE * np.sqrt(sigma_sq[near] + sigma_sq[i])
        agrees[i] = 2 * (np.count_nonzero(fits) - 1) >= len(fits) - 1
    # Of two that disagree either may be right: then the first one stays.
    return agrees if agrees.any() else np.ones(len(agrees), bool)


def _swum(time_s: Array, velocities: BodyVelocities) -> Array:
    """Return the length of the way up to each time (N,), m."""
    grid = np.union1d(time_s, velocities.time_s)
    speed = np.linalg.norm(velocities.at(grid), axis=1)
    way = np.concatenate([[0.0], np.cumsum(0.5 * (speed[1:] + speed[:-1]) * np.diff(grid))])
    return np.asarray(np.interp(time_s, grid, way))
