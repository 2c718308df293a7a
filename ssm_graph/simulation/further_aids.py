"""Acoustic fixes and ranges, a compass, and times at rest; off unless they are asked for.

Gross errors are placed at random: one reading by itself in acoustics, where an echo is taken for
the answer, a few seconds of readings of a compass that passes iron.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ssm_graph.base.earth import (
    LocalFrame,
    R_el_from_lat_lon,
    ecef_from_geodetic,
    geodetic_from_ecef,
)
from ssm_graph.base.frozen import Array
from ssm_graph.mission.mission import Aids
from ssm_graph.sensors.acoustic import Beacon, RangeLog, UsblLog
from ssm_graph.sensors.compass import HeadingErrors, HeadingLog
from ssm_graph.sensors.standstill import Standstill
from ssm_graph.simulation._checks import require, require_fraction, require_positive
from ssm_graph.simulation.aids import Point, regular_times, require_point
from ssm_graph.simulation.drifts import gauss_markov
from ssm_graph.simulation.streams import Streams
from ssm_graph.simulation.trajectory import Trajectory, stacked

Mask = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class GrossErrors:
    """How often a reading is grossly wrong, and by how much."""

    rate: float = 0.0
    """Fraction of the readings."""
    size: tuple[float, float] = (5.0, 50.0)
    """Smallest and largest absolute error, m or rad, drawn uniformly; the sign or direction too."""

    def __post_init__(self) -> None:
        require_fraction("GrossErrors.rate", self.rate)
        low, high = self.size
        require(
            0.0 <= low <= high < math.inf,
            "GrossErrors.size",
            expected="0 <= low <= high",
            got=self.size,
            hint="sizes are absolute values, the sign is drawn",
        )


@dataclass(frozen=True, slots=True)
class UsblSettings:
    """Acoustic fixes of a transponder on the vehicle."""

    interval_s: float = 5.0
    sigma_horizontal: float = 2.0
    """Each of east and north, m."""
    sigma_vertical: float = 2.0
    """m"""
    delay_s: float = 1.5
    """How much later than it was valid a fix is stamped, s."""
    lever_arm_b: Point = (-0.5, 0.0, -0.4)
    """Body origin to transponder, body axes, m."""
    gross: GrossErrors = GrossErrors()

    def __post_init__(self) -> None:
        require_positive("UsblSettings.interval_s", self.interval_s, hint="try 5 s")
        require_positive("UsblSettings.sigma_horizontal", self.sigma_horizontal, hint="try 2 m")
        require_positive("UsblSettings.sigma_vertical", self.sigma_vertical, hint="try 2 m")
        require_point("UsblSettings.lever_arm_b", self.lever_arm_b)


@dataclass(frozen=True, slots=True)
class BeaconSettings:
    """A beacon, by its true place from the start of the mission at the surface."""

    number: int
    enu: Point
    """East, north and up, m."""
    stated_off: Point = (0.0, 0.0, 0.0)
    """The mission states it this much further east, north and up, m."""
    position_sigma: Point = (0.0, 0.0, 0.0)
    """Prior sigmas that the mission states, m; zero calls its place exact."""


@dataclass(frozen=True, slots=True)
class RangingSettings:
    """Acoustic ranges to beacons, one after the other."""

    beacons: tuple[BeaconSettings, ...]
    interval_s: float = 4.0
    """From one range to the next, whichever beacon it is to."""
    sigma: float = 0.3
    """m"""
    lever_arm_b: Point = (0.4, 0.1, -0.3)
    """Body origin to transducer, body axes, m."""
    gross: GrossErrors = GrossErrors()

    def __post_init__(self) -> None:
        require_positive("RangingSettings.interval_s", self.interval_s, hint="try 4 s")
        require_positive("RangingSettings.sigma", self.sigma, hint="try 0.3 m")
        require_point("RangingSettings.lever_arm_b", self.lever_arm_b)


@dataclass(frozen=True, slots=True)
class CompassSettings:
    """A compass; the errors are drawn from what the mission states of them."""

    rate_hz: float = 4.0
    sigma: float = math.radians(1.0)
    """rad"""
    declination: float = 0.0
    """rad, taken off what is read"""
    errors: HeadingErrors = HeadingErrors()
    gross: GrossErrors = GrossErrors(size=(0.2, 1.0))
    gross_s: float = 3.0
    """A disturbance lasts so long, s."""

    def __post_init__(self) -> None:
        require_positive("CompassSettings.rate_hz", self.rate_hz, hint="try 4 Hz")
        require_positive("CompassSettings.sigma", self.sigma, hint="try 0.02 rad")
        require_positive("CompassSettings.gross_s", self.gross_s, hint="try 3 s")


@dataclass(frozen=True, slots=True)
class AidSettings:
    """All of them; None or empty is none."""

    usbl: UsblSettings | None = None
    ranging: RangingSettings | None = None
    compass: CompassSettings | None = None
    standstills: tuple[Standstill, ...] = ()
    """What the mission says; whether it is true is up to the route."""


class SimulatedAids(NamedTuple):
    """The readings, and which of them are grossly wrong."""

    logs: Aids
    gross: dict[str, Mask]
    """By section: usbl, ranges, heading"""
    heading_errors: Array
    """(6,) of the compass: offset, sine and cosine once, sine and cosine twice, rad; rate, rad/s"""


def aid_logs(
    trajectory: Trajectory, settings: AidSettings, *, end_s: float, streams: Streams, noisy: bool
) -> SimulatedAids:
    """Return the readings over ``(0, end_s]``; without noise, with gross errors as asked for."""
    gross: dict[str, Mask] = {}
    usbl, ranges, heading, errors = None, None, None, np.zeros(6)
    if settings.usbl is not None:
        usbl, gross["usbl"] = _usbl(
            trajectory, settings.usbl, end_s=end_s, rng=streams.usbl, noisy=noisy
        )
    if settings.ranging is not None:
        ranges, gross["ranges"] = _ranges(
            trajectory, settings.ranging, end_s=end_s, rng=streams.ranges, noisy=noisy
        )
    if settings.compass is not None:
        heading, gross["heading"], errors = _heading(
            trajectory, settings.compass, end_s=end_s, rng=streams.heading, noisy=noisy
        )
    return SimulatedAids(Aids(usbl, ranges, heading, *settings.standstills), gross, errors)


def _usbl(
    trajectory: Trajectory,
    settings: UsblSettings,
    *,
    end_s: float,
    rng: np.random.Generator,
    noisy: bool,
) -> tuple[UsblLog, Mask]:
    time_s = regular_times(1.0 / settings.interval_s, end_s)
    horizontal, vertical = settings.sigma_horizontal, settings.sigma_vertical
    sigma_enu = np.array([horizontal, horizontal, vertical])
    unit, direction = rng.standard_normal((2, len(time_s), 3))
    size, is_gross = _gross(settings.gross, len(time_s), rng=rng)
    direction[:, 2] *= 0.3
    off_enu = size[:, None] * direction / np.linalg.norm(direction, axis=1, keepdims=True)
    motion = trajectory.at(time_s)
    R_el = R_el_from_lat_lon(motion.lat.value, motion.lon.value)
    error_enu = float(noisy) * unit * sigma_enu + off_enu
    point_e = stacked(motion.point_e(np.array(settings.lever_arm_b)))
    lat, lon, height = geodetic_from_ecef(point_e + np.einsum("kij,kj->ki", R_el, error_enu))
    log = UsblLog(
        time_s=time_s + settings.delay_s,
        delay_s=np.full(len(time_s), settings.delay_s),
        lat=lat,
        lon=lon,
        height=height,
        sigma_enu=np.broadcast_to(sigma_enu, (len(time_s), 3)),
        lever_arm_b=np.array(settings.lever_arm_b),
    )
    return log, is_gross


def _ranges(
    trajectory: Trajectory,
    settings: RangingSettings,
    *,
    end_s: float,
    rng: np.random.Generator,
    noisy: bool,
) -> tuple[RangeLog, Mask]:
    time_s = regular_times(1.0 / settings.interval_s, end_s)
    turn = np.arange(len(time_s)) % len(settings.beacons)
    frame = LocalFrame(trajectory.lat, trajectory.lon, 0.0)
    true_enu = np.array([beacon.enu for beacon in settings.beacons])
    beacon_e = ecef_from_geodetic(*frame.geodetic_from_p_n(true_enu))
    point_e = stacked(trajectory.at(time_s).point_e(np.array(settings.lever_arm_b)))
    true_m = np.linalg.norm(point_e - beacon_e[turn], axis=1)
    noise = settings.sigma * rng.standard_normal(len(time_s))
    size, is_gross = _gross(settings.gross, len(time_s), rng=rng)
    # An echo comes later than the answer; an answer to someone else may come at any time.
    sign = np.where(rng.random(len(time_s)) < 0.8, 1.0, -1.0)
    range_m = np.maximum(true_m + float(noisy) * noise + sign * size, 0.0)
    log = RangeLog(
        beacons=tuple(_beacon(beacon, frame) for beacon in settings.beacons),
        time_s=time_s,
        beacon=np.array([beacon.number for beacon in settings.beacons])[turn],
        range_m=range_m,
        sigma=np.full(len(time_s), settings.sigma),
        lever_arm_b=np.array(settings.lever_arm_b),
        nominal_sigma=settings.sigma,
    )
    return log, is_gross


def _beacon(settings: BeaconSettings, frame: LocalFrame) -> Beacon:
    stated = np.array(settings.enu) + np.array(settings.stated_off)
    lat, lon, height = frame.geodetic_from_p_n(stated)
    return Beacon(
        settings.number, float(lat), float(lon), float(height), np.array(settings.position_sigma)
    )


def _heading(
    trajectory: Trajectory,
    settings: CompassSettings,
    *,
    end_s: float,
    rng: np.random.Generator,
    noisy: bool,
) -> tuple[HeadingLog, Mask, Array]:
    time_s = regular_times(settings.rate_hz, end_s)
    errors = settings.errors
    once, twice = errors.one_cycle_sigma, errors.two_cycle_sigma
    drawn = rng.standard_normal(5) * np.array([errors.offset_sigma, once, once, twice, twice])
    steps, noise = rng.standard_normal((2, len(time_s)))
    drawn, psi = float(noisy) * drawn, trajectory.truth(time_s).roll_pitch_heading[:, 2]
    read = psi + drawn @ [
        np.ones_like(psi),
        *(f(n * psi) for n in (1, 2) for f in (np.sin, np.cos)),
    ]
    if noisy:
        walk = gauss_markov(steps[:, None], time_s, errors.correlation_s)[:, 0]
        read = read + settings.sigma * noise + errors.walk_sigma * walk
    n_events = math.ceil(len(time_s) / (settings.gross_s * settings.rate_hz))
    event = (time_s / settings.gross_s).astype(int) % n_events
    size, is_gross = _gross(settings.gross, n_events, rng=rng)
    sign = rng.choice([-1.0, 1.0], size=n_events)
    rate = float(noisy) * errors.rate_sigma * rng.standard_normal()
    read = read + (sign * size)[event] + rate * (time_s - time_s[0]) - settings.declination
    log = HeadingLog(
        sigma=settings.sigma,
        time_s=time_s,
        heading=np.remainder(read, 2.0 * np.pi),
        declination=settings.declination,
        errors=errors,
    )
    return log, is_gross[event], np.append(drawn, rate)


def _gross(settings: GrossErrors, count: int, *, rng: np.random.Generator) -> tuple[Array, Mask]:
    """Return absolute errors of ``count`` readings, most of them zero, and which have one."""
    is_gross = rng.random(count) < settings.rate
    return np.where(is_gross, rng.uniform(*settings.size, size=count), 0.0), is_gross
