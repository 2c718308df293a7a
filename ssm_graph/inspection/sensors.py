"""What each sensor of a mission says at a first look: sizes that show a unit, an axis, a lock."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from ssm_graph.base.earth import normal_gravity
from ssm_graph.base.frozen import Array
from ssm_graph.inspection.timing import Timing, timing_of
from ssm_graph.mission.mission import Mission
from ssm_graph.sensors.acoustic import RangeLog, UsblLog
from ssm_graph.sensors.compass import HeadingLog
from ssm_graph.sensors.depth import DepthLog
from ssm_graph.sensors.dvl import DvlLog
from ssm_graph.sensors.frozen import frozen_runs
from ssm_graph.sensors.gnss import GnssLog
from ssm_graph.sensors.imu import ImuLog, frozen_axes

Curves = dict[str, Array]
"""Values (N,) by name with its unit, for the picture."""


@dataclass(frozen=True, slots=True, eq=False)
class SensorFound:
    """One sensor: how regular it is, what it reads, what is odd."""

    name: str
    timing: Timing
    facts: tuple[str, ...]
    """What it reads, with units."""
    oddities: tuple[str, ...]
    """What a person should look at."""
    time_s: Array
    curves: Curves


def sensors_of(mission: Mission) -> Iterator[SensorFound]:
    """Yield what every sensor of a mission says."""
    for kind, log in mission.logs.items():
        if not hasattr(log, "time_s"):
            continue
        time_s = np.asarray(log.time_s)
        look = _LOOKS.get(kind, _plain) if len(time_s) else _nothing
        facts, oddities, curves = look(log, mission)
        timing = timing_of(time_s)
        name = _NAMES.get(kind, kind.__name__.removesuffix("Log"))
        yield SensorFound(
            name, timing, facts, (*oddities, *_of_timing(timing)), time_s, dict(curves)
        )


Found = tuple[tuple[str, ...], tuple[str, ...], Curves]


def _of_timing(timing: Timing) -> Iterator[str]:
    if timing.n_gaps:
        longest = max(length for _, length in timing.gaps)
        begin = next(begin for begin, length in timing.gaps if length == longest)
        yield (
            f"{timing.n_gaps} gap{'s' * (timing.n_gaps > 1)}, {timing.in_gaps_s:.1f} s in all; the "
            f"longest {longest:.2f} s from {begin:.1f} s on"
        )
    if timing.n_repeats or timing.n_back:
        yield f"{timing.n_repeats} times stand twice, {timing.n_back} go back"


def _imu(log: ImuLog, mission: Mission) -> Found:
    force = np.linalg.norm(log.accel_b, axis=1)
    rate = np.degrees(np.linalg.norm(log.gyro_b, axis=1))
    gravity = float(normal_gravity(mission.frame.lat, mission.frame.height))
    mean_b = log.accel_b.mean(axis=0)
    down = "xyz"[int(np.argmax(np.abs(mean_b)))]
    facts = (
        f"specific force {np.median(force):.3f} m/s² (gravity here {gravity:.3f}), mean along x, "
        f"y, z {mean_b[0]:.2f}, {mean_b[1]:.2f}, {mean_b[2]:.2f}",
        f"turn rate {np.median(rate):.2f} deg/s in the median, {rate.max():.1f} at most",
    )
    oddities = [
        f"{'gyro' if axis.is_gyro else 'accelerometer'} {'xyz'[axis.axis]} repeats one reading "
        f"from {axis.begin_s:.1f} to {axis.end_s:.1f} s"
        for axis in frozen_axes(log)[:3]
    ]
    if down != "z" or mean_b[2] > 0.0:
        oddities.append(
            f"gravity lies along {down}, expected -z of forward-right-down: is [frames] body right?"
        )
    return facts, tuple(oddities), {"specific force, m/s²": force, "turn rate, deg/s": rate}


def _dvl(log: DvlLog, _: Mission) -> Found:
    known: NDArray[np.bool_] = np.isfinite(log.speed)
    counts = known.sum(axis=1)
    n_beams = log.mount.n_beams
    every = 100.0 * np.mean(counts == n_beams)
    shares = ", ".join(f"{100.0 * column.mean():.0f}" for column in known.T)
    facts = [
        f"{n_beams} beams, speeds known in {shares} % of the pings, all of them in {every:.0f} %",
        f"beam speeds up to {np.nanmax(np.abs(log.speed)):.2f} m/s" if known.any() else "no speed",
        f"stated noise {1e3 * np.nanmedian(log.sigma):.1f} mm/s in the median",
    ]
    if log.is_water.any():
        facts.append(f"{100.0 * log.is_water.mean():.0f} % of the pings are off the water")
    curves: Curves = {"beams with a speed": counts.astype(float)}
    if log.range_m is not None and np.isfinite(log.range_m).any():
        shortest = np.min(np.where(np.isfinite(log.range_m), log.range_m, np.inf), axis=1)
        facts.append(f"ranges {np.nanmin(log.range_m):.1f} to {np.nanmax(log.range_m):.1f} m")
        curves["shortest range, m"] = np.where(np.isfinite(shortest), shortest, np.nan)
    fastest = np.nanmax(np.abs(np.where(known, log.speed, 0.0)), axis=1)
    return tuple(facts), (), {"fastest beam, m/s": fastest, **curves}


def _depth(log: DepthLog, _: Mission) -> Found:
    runs = frozen_runs(log.time_s, log.depth[:, None], least_s=10.0, least_count=10)
    oddities = [
        f"repeats {log.depth[begin]:.3f} m from {log.time_s[begin]:.1f} to {log.time_s[end]:.1f} s"
        for begin, end in runs[:3]
    ]
    facts = (f"{log.depth.min():.2f} to {log.depth.max():.2f} m",)
    return facts, tuple(oddities), {"depth, m": log.depth}


def _gnss(log: GnssLog, mission: Mission) -> Found:
    enu = mission.frame.p_n_from_geodetic(log.lat, log.lon, log.height)
    extent = np.ptp(enu, axis=0)
    sigma = np.median(np.asarray(log.sigma_enu), axis=0)
    facts = (
        f"within {extent[0]:.0f} m east and {extent[1]:.0f} m north, heights "
        f"{log.height.min():.1f} to {log.height.max():.1f} m",
        f"stated sigma {sigma[0]:.2f}, {sigma[1]:.2f}, {sigma[2]:.2f} m east, north, up",
    )
    off = np.hypot(enu[:, 0] - enu[0, 0], enu[:, 1] - enu[0, 1])
    return facts, (), {"from the first fix, m": off}


def _heading(log: HeadingLog, _: Mission) -> Found:
    degrees = np.degrees(log.heading) % 360.0
    return (f"stated sigma {np.degrees(log.sigma):.2f} deg",), (), {"heading, deg": degrees}


def _usbl(log: UsblLog, _: Mission) -> Found:
    return (f"{len(log.time_s)} acoustic fixes",), (), {}


def _ranges(log: RangeLog, _: Mission) -> Found:
    return (f"ranges to {len(np.unique(log.beacon))} beacons",), (), {"range, m": log.range_m}


def _nothing(_log: Any, _: Mission) -> Found:
    return ("no rows",), (), {}


def _plain(_log: Any, _: Mission) -> Found:
    return (), (), {}


_LOOKS: Final[dict[type, Callable[[Any, Mission], Found]]] = {
    ImuLog: _imu,
    DvlLog: _dvl,
    DepthLog: _depth,
    GnssLog: _gnss,
    HeadingLog: _heading,
    UsblLog: _usbl,
    RangeLog: _ranges,
}
_NAMES: Final = {
    ImuLog: "IMU",
    DvlLog: "DVL",
    DepthLog: "depth",
    GnssLog: "GNSS",
    HeadingLog: "compass",
    UsblLog: "USBL",
    RangeLog: "ranges",
}
