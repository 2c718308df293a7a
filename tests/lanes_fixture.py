"""Sensors that lie for long: recorded missions and what the live estimator says of them."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ssm_graph.base.frames import R_lb_from_roll_pitch_heading
from ssm_graph.base.frozen import Array
from ssm_graph.io.mission_folder.vehicle import vehicle_of
from ssm_graph.io.raw_log.rows import messages_of
from ssm_graph.live.estimator import ONLINE, FixedLagSmoother, IntegrityConfig
from ssm_graph.mission.mission import Mission
from ssm_graph.mission.navigation import Health, Navigation
from ssm_graph.sensors.imu import ImuSample
from ssm_graph.simulation import (
    DvlSettings,
    GnssSettings,
    Grade,
    SimulatedMission,
    scenario_config,
    simulate,
)

EARTH_M = 6.37e6
Lie = Callable[[SimulatedMission, float, float], Mission]


def survey(
    grade: Grade, seed: int, *, duration_s: float, realistic: bool = False
) -> SimulatedMission:
    """Return survey lines with fixes all the time, as near the surface."""
    return simulate(
        scenario_config(
            "survey",
            duration_s=duration_s,
            seed=seed,
            grade=grade,
            dvl=DvlSettings(rate_hz=2.0),
            gnss=GnssSettings(windows=((0.0, duration_s),)),
            realistic=realistic,
        )
    )


def _beams(off: Callable[[SimulatedMission], Array]) -> Lie:
    """Return a lie that adds (N, B) m/s to the beams from a time to another."""

    def lie(sim: SimulatedMission, begin_s: float, end_s: float) -> Mission:
        dvl = sim.mission.dvl
        here = (dvl.time_s >= begin_s) & (dvl.time_s < end_s)
        speed = dvl.speed + here[:, None] * off(sim)
        return replace(sim.mission, dvl=replace(dvl, speed=speed))

    return lie


def _moving(velocity_enu: tuple[float, float, float]) -> Lie:
    """Return the lie of a bottom that moves."""

    def off(sim: SimulatedMission) -> Array:
        dvl = sim.mission.dvl
        R_lb = R_lb_from_roll_pitch_heading(*sim.truth_at(dvl.time_s).roll_pitch_heading.T)
        return np.asarray((velocity_enu @ R_lb) @ dvl.mount.beams_b.T)

    return _beams(off)


def _slipped(sim: SimulatedMission) -> Array:
    """Return what a mounting that turns by 5 degrees about the vertical makes of the speeds."""
    beams_b, a = sim.mission.dvl.mount.beams_b, math.radians(5.0)
    R = np.array([[math.cos(a), -math.sin(a), 0.0], [math.sin(a), math.cos(a), 0.0], [0, 0, 1.0]])
    v_b = sim.true_speed @ np.linalg.pinv(beams_b).T
    return np.asarray(v_b @ R.T @ beams_b.T - sim.true_speed)


def _fixes(off: Callable[[Array, float], tuple[Array, Array]]) -> Lie:
    """Return a lie that moves fixes by metres east and north of their times since its begin."""

    def lie(sim: SimulatedMission, begin_s: float, end_s: float) -> Mission:
        gnss = sim.mission.gnss
        assert gnss is not None
        here = (gnss.time_s >= begin_s) & (gnss.time_s < end_s)
        east, north = off(gnss.time_s, begin_s)
        lat = gnss.lat + here * north / EARTH_M
        lon = gnss.lon + here * east / (EARTH_M * math.cos(gnss.lat[0]))
        return replace(sim.mission, gnss=replace(gnss, lat=lat, lon=lon))

    return lie


def _frozen_fixes(sim: SimulatedMission, begin_s: float, end_s: float) -> Mission:
    gnss = sim.mission.gnss
    assert gnss is not None
    here = (gnss.time_s >= begin_s) & (gnss.time_s < end_s)
    first = int(np.argmax(here))
    columns = {n: np.where(here, getattr(gnss, n)[first], getattr(gnss, n)) for n in ("lat", "lon")}
    return replace(sim.mission, gnss=replace(gnss, **columns))


def _depths(off: Callable[[Array, Array], Array]) -> Lie:
    """Return a lie that makes depths of depths and the times since its begin."""

    def lie(sim: SimulatedMission, begin_s: float, end_s: float) -> Mission:
        log = sim.mission.depth
        assert log is not None
        here = (log.time_s >= begin_s) & (log.time_s < end_s)
        depth = log.depth.copy()
        depth[here] = off(depth[here], log.time_s[here] - begin_s)
        return replace(sim.mission, depth=replace(log, depth=depth))

    return lie


def _stuck_gyro(sim: SimulatedMission, begin_s: float, end_s: float) -> Mission:
    imu = sim.mission.imu
    gyro_b = imu.gyro_b.copy()
    gyro_b[(imu.time_s >= begin_s) & (imu.time_s < end_s), 2] = 0.0
    return replace(sim.mission, imu=replace(imu, gyro_b=gyro_b))


FOREVER = math.inf
LIES: dict[str, tuple[Lie, float, str]] = {
    "mounting slips by 5 deg": (_beams(_slipped), FOREVER, "DVL"),
    "bottom drifts 5 cm/s": (_moving((0.05, 0.0, 0.0)), FOREVER, "DVL"),
    "GNSS 3 m off": (_fixes(lambda t, _: (3.0 + 0.0 * t, 0.0 * t)), 60.0, "GNSS"),
    "GNSS pulled 5 cm/s": (_fixes(lambda t, s: (0.0 * t, 0.05 * (t - s))), FOREVER, "GNSS"),
    "depth drifts 2 cm/s": (_depths(lambda d, s: d + 0.02 * s), FOREVER, "depth"),
    "gyro z stuck at 0": (_stuck_gyro, 20.0, "inertial"),
    "two opposite beams": (
        _beams(lambda sim: np.array([0.05, 0.0, -0.05, 0.0]) + 0.0 * sim.true_speed),
        FOREVER,
        "DVL",
    ),
    "false bottom 0.2 m/s": (_moving((0.12, 0.16, 0.0)), 60.0, "DVL"),
    "depth frozen": (_depths(lambda d, _: np.full(len(d), d[0])), FOREVER, "depth"),
    "GNSS frozen": (_frozen_fixes, FOREVER, "GNSS"),
    "DVL scale jumps 3 %": (_beams(lambda sim: 0.03 * sim.true_speed), FOREVER, "DVL"),
    "water track unmarked": (_moving((0.18, -0.24, 0.0)), FOREVER, "DVL"),
}
"""What lies, how long, and who it is."""


class Look(NamedTuple):
    """The answer at a time and what it is off."""

    navigation: Navigation
    off_sigmas: float
    """Of position and velocity along east, north, up, the largest in its sigmas"""
    off_m: float
    """Horizontal"""
    off_up_m: float

    @property
    def is_good(self) -> bool:
        """Whether it says that it may be used."""
        return self.navigation.health is Health.GOOD


def looks(
    mission: Mission,
    sim: SimulatedMission,
    *,
    smoother: FixedLagSmoother | None = None,
    integrity: IntegrityConfig | None = None,
    begin_s: float = -math.inf,
    end_s: float = math.inf,
) -> tuple[list[Look], FixedLagSmoother]:
    """Return what the estimator says once a second of the messages from a time to another."""
    running = smoother or FixedLagSmoother(vehicle_of(mission), ONLINE, integrity=integrity)
    found, next_s = [], 1.0
    for message in messages_of(mission):
        if not begin_s < message.time_s <= end_s:
            continue
        running.push(message)
        if isinstance(message, ImuSample) and message.time_s >= next_s:
            next_s = math.floor(message.time_s) + 1.0
            navigation = running.newest()
            if navigation is not None:
                found.append(_look(navigation, sim))
    return found, running


def _look(navigation: Navigation, sim: SimulatedMission) -> Look:
    truth = sim.truth_at(np.array([navigation.time_s]))
    off = np.array(
        [
            (navigation.lon - truth.lon[0]) * EARTH_M * math.cos(navigation.lat),
            (navigation.lat - truth.lat[0]) * EARTH_M,
            navigation.height - truth.height[0],
        ]
    )
    in_sigmas = np.concatenate(
        [
            off / navigation.position_sigma_enu,
            (navigation.velocity_enu - truth.velocity_enu[0]) / navigation.velocity_sigma_enu,
        ]
    )
    worst = float(np.abs(in_sigmas).max())
    return Look(navigation, worst, float(np.hypot(*off[:2])), abs(float(off[2])))


def longest_good_lie(found: list[Look]) -> int:
    """Return how many looks in a row were GOOD and beyond five sigmas."""
    longest = run = 0
    for look in found:
        run = run + 1 if look.is_good and look.off_sigmas > 5.0 else 0
        longest = max(longest, run)
    return longest
