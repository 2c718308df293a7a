"""Aids beside the DVL: depth, GNSS, acoustic fixes and ranges, a compass, and times at rest.

Each reads the motion at the end of its own lever arm. Gross errors are placed at random: one
reading by itself in acoustics, where an echo is taken for the answer, a few seconds of readings of
a compass that passes iron.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from ssm_graph.base.earth import (
    LocalFrame,
    R_el_from_lat_lon,
    ecef_from_geodetic,
    geodetic_from_ecef,
)
from ssm_graph.base.frozen import Array
from ssm_graph.mission.mission import AidLog, Aids
from ssm_graph.sensors.acoustic import Beacon, RangeLog, UsblLog
from ssm_graph.sensors.compass import HeadingErrors, HeadingLog
from ssm_graph.sensors.depth import DepthLog
from ssm_graph.sensors.gnss import GnssLog
from ssm_graph.sensors.standstill import Standstill
from ssm_graph.simulation import checked
from ssm_graph.simulation.randomness import (
    DriftSettings,
    SlowPart,
    Streams,
    draw_drift,
    gauss_markov,
    with_slow_part,
)
from ssm_graph.simulation.trajectory import Trajectory, stacked

Mask = NDArray[np.bool_]
Point = tuple[float, float, float]
Rng = np.random.Generator


@dataclass(frozen=True, slots=True)
class DepthSettings(checked.Settings):
    """A pressure sensor."""

    rate_hz: float = checked.positive(2.0, hint="try 2 Hz")
    sigma: float = checked.positive(0.05, hint="try 0.05 m")
    """m"""
    lever_arm_b: Point = checked.point((0.2, 0.1, 0.0))
    """Body origin to sensor, body axes, m."""
    offset: float = 0.0
    """Depths are read too large by this much, m."""


@dataclass(frozen=True, slots=True)
class GnssSettings(checked.Settings):
    """A receiver that works at the surface only."""

    rate_hz: float = checked.positive(1.0, hint="try 1 Hz")
    sigma_horizontal: float = checked.positive(0.5, hint="try 0.5 m")
    """Each of east and north, m."""
    sigma_vertical: float = checked.positive(1.0, hint="try 1 m")
    """m"""
    lever_arm_b: Point = checked.point((-0.3, 0.0, -0.6))
    """Body origin to antenna, body axes, m."""
    lever_arm_error_b: Point = checked.point((0.0, 0.0, 0.0))
    """The antenna truly sits this much further on, m."""
    late_s: float = 0.0
    """Stamps are later than the fixes by this much, s."""
    drift: DriftSettings | None = None
    """Of the fixes on top of their noise, each of east, north and up, m."""
    windows: tuple[tuple[float, float], ...] | None = checked.windows(None)
    """Times with fixes, s, each ``[start, end)``; None for whenever the route is at the surface."""
    surface_depth_m: float = 0.5
    """The route is at the surface where its depth, waves left out, is less than this, m."""


@dataclass(frozen=True, slots=True)
class GrossErrors(checked.Settings):
    """How often a reading is grossly wrong, and by how much."""

    rate: float = checked.fraction(0.0)
    """Fraction of the readings."""
    size: tuple[float, float] = checked.sizes((5.0, 50.0))
    """Smallest and largest absolute error, m or rad, drawn uniformly; the sign or direction too."""


@dataclass(frozen=True, slots=True)
class UsblSettings(checked.Settings):
    """Acoustic fixes of a transponder on the vehicle."""

    interval_s: float = checked.positive(5.0, hint="try 5 s")
    sigma_horizontal: float = checked.positive(2.0, hint="try 2 m")
    """Each of east and north, m."""
    sigma_vertical: float = checked.positive(2.0, hint="try 2 m")
    """m"""
    delay_s: float = 1.5
    """How much later than it was valid a fix is stamped, s."""
    lever_arm_b: Point = checked.point((-0.5, 0.0, -0.4))
    """Body origin to transponder, body axes, m."""
    gross: GrossErrors = GrossErrors()


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
class RangingSettings(checked.Settings):
    """Acoustic ranges to beacons, one after the other."""

    beacons: tuple[BeaconSettings, ...]
    interval_s: float = checked.positive(4.0, hint="try 4 s")
    """From one range to the next, whichever beacon it is to."""
    sigma: float = checked.positive(0.3, hint="try 0.3 m")
    """m"""
    lever_arm_b: Point = checked.point((0.4, 0.1, -0.3))
    """Body origin to transducer, body axes, m."""
    gross: GrossErrors = GrossErrors()


@dataclass(frozen=True, slots=True)
class CompassSettings(checked.Settings):
    """A compass; the errors are drawn from what the mission states of them."""

    rate_hz: float = checked.positive(4.0, hint="try 4 Hz")
    sigma: float = checked.positive(math.radians(1.0), hint="try 0.02 rad")
    """rad"""
    declination: float = 0.0
    """rad, taken off what is read"""
    errors: HeadingErrors = HeadingErrors()
    gross: GrossErrors = GrossErrors(size=(0.2, 1.0))
    gross_s: float = checked.positive(3.0, hint="try 3 s")
    """A disturbance lasts so long, s."""


class AidSimulator(Protocol):
    """Settings of one more instrument, and how it reads; a file of its own beside this one."""

    def read(
        self, trajectory: Trajectory, *, end_s: float, streams: Streams, noisy: bool
    ) -> tuple[AidLog, Mask]:
        """Return its log over ``(0, end_s]``, and which readings are grossly wrong."""


@dataclass(frozen=True, slots=True)
class AidSettings:
    """All of them; None or empty is none."""

    usbl: UsblSettings | None = None
    ranging: RangingSettings | None = None
    compass: CompassSettings | None = None
    standstills: tuple[Standstill, ...] = ()
    """What the mission says; whether it is true is up to the route."""
    others: tuple[AidSimulator, ...] = ()


class SimulatedAids(NamedTuple):
    """The readings, and which of them are grossly wrong."""

    logs: Aids
    gross: dict[str, Mask]
    """By section: usbl, ranges, heading ..."""
    heading_errors: Array
    """(6,) of the compass: offset, sine and cosine once, sine and cosine twice, rad; rate, rad/s"""


def aid_logs(
    trajectory: Trajectory, settings: AidSettings, *, end_s: float, streams: Streams, noisy: bool
) -> SimulatedAids:
    """Return the readings over ``(0, end_s]``; without noise, with gross errors as asked for."""
    gross: dict[str, Mask] = {}
    usbl, ranges, heading, errors = None, None, None, np.zeros(6)
    if settings.usbl is not None:
        usbl, gross["usbl"] = _usbl(trajectory, settings.usbl, end_s, streams.usbl, noisy)
    if settings.ranging is not None:
        ranges, gross["ranges"] = _ranges(
            trajectory, settings.ranging, end_s, streams.ranges, noisy
        )
    if settings.compass is not None:
        heading, gross["heading"], errors = _heading(
            trajectory, settings.compass, end_s, streams.heading, noisy
        )
    others = []
    for instrument in settings.others:
        log, is_gross = instrument.read(trajectory, end_s=end_s, streams=streams, noisy=noisy)
        others.append(log)
        gross[log.SECTION.strip("[]")] = is_gross
    logs = Aids(usbl, ranges, heading, *others, *settings.standstills)
    return SimulatedAids(logs, gross, errors)


def regular_times(rate_hz: float, end_s: float) -> Array:
    """Return the times in ``(0, end_s]`` of what happens at a rate."""
    return np.arange(1, math.floor(end_s * rate_hz + 1e-9) + 1) / rate_hz


def _fixes(
    trajectory: Trajectory, time_s: Array, lever_arm_b: Array, error_enu: Array
) -> tuple[Array, Array, Array]:
    """Return latitude, longitude (rad) and height (m) of a point of the body, off by an error."""
    motion = trajectory.at(time_s)
    R_el = R_el_from_lat_lon(motion.lat.value, motion.lon.value)
    error_e = np.einsum("kij,kj->ki", R_el, error_enu)
    return geodetic_from_ecef(stacked(motion.point_e(lever_arm_b)) + error_e)


def _sigma_enu(settings: GnssSettings | UsblSettings) -> Array:
    horizontal = settings.sigma_horizontal
    return np.array([horizontal, horizontal, settings.sigma_vertical])


def depth_log(
    trajectory: Trajectory,
    settings: DepthSettings,
    *,
    end_s: float,
    rng: Rng | None,
    slow: tuple[SlowPart, Rng] | None = None,
) -> DepthLog:
    """Return the depth of the sensor over ``(0, end_s]``; None draws no noise, or no slow one."""
    time_s = regular_times(settings.rate_hz, end_s)
    point_e = trajectory.at(time_s).point_e(np.array(settings.lever_arm_b))
    depth = settings.offset - geodetic_from_ecef(stacked(point_e))[2]
    if rng is not None:
        unit = rng.standard_normal((len(time_s), 1))
        unit = with_slow_part(unit, time_s, *slow) if slow else unit
        depth = depth + settings.sigma * unit[:, 0]
    return DepthLog(
        sigma=settings.sigma, time_s=time_s, depth=depth, lever_arm_b=np.array(settings.lever_arm_b)
    )


def gnss_log(
    trajectory: Trajectory,
    settings: GnssSettings,
    *,
    end_s: float,
    rng: Rng | None,
    drift_rng: Rng | None = None,
    slow: tuple[SlowPart, Rng] | None = None,
) -> GnssLog | None:
    """Return the fixes over ``(0, end_s]``; None if there is not one. No ``rng``, no noise."""
    time_s, sigma_enu = regular_times(settings.rate_hz, end_s), _sigma_enu(settings)
    # Drawn before fixes are chosen: a fix keeps its noise when the windows change.
    unit = np.zeros((len(time_s), 3)) if rng is None else rng.standard_normal((len(time_s), 3))
    if rng is not None and slow is not None:
        unit = with_slow_part(unit, time_s, *slow)
    error_enu = unit * sigma_enu
    if drift_rng is not None and settings.drift is not None:
        error_enu = error_enu + draw_drift(settings.drift, time_s, drift_rng)
    has_fix = _has_fix(trajectory, settings, time_s)
    if not has_fix.any():
        return None
    time_s, error_enu = time_s[has_fix], error_enu[has_fix]
    true_arm_b = np.array(settings.lever_arm_b) + np.array(settings.lever_arm_error_b)
    lat, lon, height = _fixes(trajectory, time_s, true_arm_b, error_enu)
    return GnssLog(
        time_s=time_s + settings.late_s,
        lat=lat,
        lon=lon,
        height=height,
        sigma_enu=np.broadcast_to(sigma_enu, (len(time_s), 3)),
        lever_arm_b=np.array(settings.lever_arm_b),
    )


def _has_fix(trajectory: Trajectory, settings: GnssSettings, time_s: Array) -> np.ndarray:
    if settings.windows is None:
        return np.asarray(trajectory.path_depth(time_s) < settings.surface_depth_m)
    inside = np.zeros(len(time_s), dtype=bool)
    for start_s, end_s in settings.windows:
        inside |= (start_s <= time_s) & (time_s < end_s)
    return inside


def _usbl(
    trajectory: Trajectory, settings: UsblSettings, end_s: float, rng: Rng, noisy: bool
) -> tuple[UsblLog, Mask]:
    time_s, sigma_enu = regular_times(1.0 / settings.interval_s, end_s), _sigma_enu(settings)
    unit, direction = rng.standard_normal((2, len(time_s), 3))
    size, is_gross = gross_errors(settings.gross, len(time_s), rng=rng)
    direction[:, 2] *= 0.3
    off_enu = size[:, None] * direction / np.linalg.norm(direction, axis=1, keepdims=True)
    error_enu = float(noisy) * unit * sigma_enu + off_enu
    lat, lon, height = _fixes(trajectory, time_s, np.array(settings.lever_arm_b), error_enu)
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
    trajectory: Trajectory, settings: RangingSettings, end_s: float, rng: Rng, noisy: bool
) -> tuple[RangeLog, Mask]:
    time_s = regular_times(1.0 / settings.interval_s, end_s)
    turn = np.arange(len(time_s)) % len(settings.beacons)
    frame = LocalFrame(trajectory.lat, trajectory.lon, 0.0)
    true_enu = np.array([beacon.enu for beacon in settings.beacons])
    beacon_e = ecef_from_geodetic(*frame.geodetic_from_p_n(true_enu))
    point_e = stacked(trajectory.at(time_s).point_e(np.array(settings.lever_arm_b)))
    true_m = np.linalg.norm(point_e - beacon_e[turn], axis=1)
    noise = settings.sigma * rng.standard_normal(len(time_s))
    size, is_gross = gross_errors(settings.gross, len(time_s), rng=rng)
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
    trajectory: Trajectory, settings: CompassSettings, end_s: float, rng: Rng, noisy: bool
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
    size, is_gross = gross_errors(settings.gross, n_events, rng=rng)
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


def gross_errors(settings: GrossErrors, count: int, *, rng: Rng) -> tuple[Array, Mask]:
    """Return absolute errors of ``count`` readings, most of them zero, and which have one."""
    is_gross = rng.random(count) < settings.rate
    return np.where(is_gross, rng.uniform(*settings.size, size=count), 0.0), is_gross
