"""What each sensor of a mission says at a first look: sizes that show a unit, an axis, a lock."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from ssm_graph.base.earth import LocalFrame, normal_gravity
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
from ssm_graph.sensors.messages import Message, field_names
from ssm_graph.sensors.place import PositionMessage
from ssm_graph.sensors.registry import INSTRUMENTS

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
        if hasattr(log, "time_s"):
            yield _found(kind, log, mission.frame)


def sensors_in(messages: Sequence[Message]) -> Iterator[SensorFound]:
    """Yield what every sensor of a recording says, which has no mission around it."""
    of: dict[type[Message], list[Message]] = {}
    for message in messages:
        of.setdefault(type(message), []).append(message)
    first = next((one for one in messages if isinstance(one, PositionMessage)), None)
    place = (0.25 * np.pi, 0.0, 0.0) if first is None else (first.lat, first.lon, first.height)
    for instrument in INSTRUMENTS:
        if instrument.message in of:
            yield _found(instrument.log, _rows(of[instrument.message]), LocalFrame(*place))


def _rows(messages: Sequence[Message]) -> SimpleNamespace:
    """Return the readings of one instrument by the names that its log has for them too."""
    fields = {
        name: [getattr(message, name) for message in messages]
        for name in field_names(type(messages[0]))
    }
    whole = {name: of for name, of in fields.items() if all(one is not None for one in of)}
    return SimpleNamespace(**{name: np.array(of) for name, of in whole.items()})


def _found(kind: type, log: Any, frame: LocalFrame) -> SensorFound:
    time_s = np.asarray(log.time_s)
    look = _LOOKS.get(kind, _plain) if len(time_s) else _nothing
    facts, oddities, curves = look(log, frame)
    timing = timing_of(time_s)
    name = _NAMES.get(kind, kind.__name__.removesuffix("Log"))
    return SensorFound(name, timing, facts, (*oddities, *_of_timing(timing)), time_s, dict(curves))


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


def _imu(log: Any, frame: LocalFrame) -> Found:
    force = np.linalg.norm(log.accel_b, axis=1)
    rate = np.degrees(np.linalg.norm(log.gyro_b, axis=1))
    gravity = float(normal_gravity(frame.lat, frame.height))
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


def _dvl(log: Any, _: LocalFrame) -> Found:
    known: NDArray[np.bool_] = np.isfinite(log.speed)
    counts = known.sum(axis=1)
    n_beams = known.shape[1]
    every = 100.0 * np.mean(counts == n_beams)
    shares = ", ".join(f"{100.0 * column.mean():.0f}" for column in known.T)
    facts = [
        f"{n_beams} beams, speeds known in {shares} % of the pings, all of them in {every:.0f} %",
        f"beam speeds up to {np.nanmax(np.abs(log.speed)):.2f} m/s" if known.any() else "no speed",
    ]
    sigma = getattr(log, "sigma", np.nan)
    if np.isfinite(sigma).any():
        facts.append(f"stated noise {1e3 * np.nanmedian(sigma):.1f} mm/s in the median")
    if log.is_water.any():
        facts.append(f"{100.0 * log.is_water.mean():.0f} % of the pings are off the water")
    curves: Curves = {"beams with a speed": counts.astype(float)}
    range_m = getattr(log, "range_m", None)
    if range_m is not None and np.isfinite(range_m).any():
        shortest = np.min(np.where(np.isfinite(range_m), range_m, np.inf), axis=1)
        facts.append(f"ranges {np.nanmin(range_m):.1f} to {np.nanmax(range_m):.1f} m")
        curves["shortest range, m"] = np.where(np.isfinite(shortest), shortest, np.nan)
    fastest = np.nanmax(np.abs(np.where(known, log.speed, 0.0)), axis=1)
    return tuple(facts), (), {"fastest beam, m/s": fastest, **curves}


def _depth(log: Any, _: LocalFrame) -> Found:
    runs = frozen_runs(log.time_s, log.depth[:, None], least_s=10.0, least_count=10)
    oddities = [
        f"repeats {log.depth[begin]:.3f} m from {log.time_s[begin]:.1f} to {log.time_s[end]:.1f} s"
        for begin, end in runs[:3]
    ]
    facts = (f"{log.depth.min():z.2f} to {log.depth.max():z.2f} m",)
    return facts, tuple(oddities), {"depth, m": log.depth}


def _gnss(log: Any, frame: LocalFrame) -> Found:
    enu = frame.p_n_from_geodetic(log.lat, log.lon, log.height)
    extent = np.ptp(enu, axis=0)
    sigma = np.median(np.asarray(log.sigma_enu), axis=0)
    facts = (
        f"within {extent[0]:.0f} m east and {extent[1]:.0f} m north, heights "
        f"{log.height.min():z.1f} to {log.height.max():z.1f} m",
        f"stated sigma {sigma[0]:.2f}, {sigma[1]:.2f}, {sigma[2]:.2f} m east, north, up",
    )
    off = np.hypot(enu[:, 0] - enu[0, 0], enu[:, 1] - enu[0, 1])
    return facts, (), {"from the first fix, m": off}


def _heading(log: Any, _: LocalFrame) -> Found:
    turned = np.degrees(np.abs(np.diff(np.unwrap(log.heading))).sum())
    facts = [f"turns by {turned:.0f} deg in all"]
    if hasattr(log, "sigma"):
        facts.append(f"stated sigma {np.degrees(log.sigma):.2f} deg")
    return tuple(facts), (), {"heading, deg": np.degrees(log.heading) % 360.0}


def _usbl(log: Any, _: LocalFrame) -> Found:
    return (f"{len(log.time_s)} acoustic fixes",), (), {}


def _ranges(log: Any, _: LocalFrame) -> Found:
    return (f"ranges to {len(np.unique(log.beacon))} beacons",), (), {"range, m": log.range_m}


def _nothing(_log: Any, _: LocalFrame) -> Found:
    return ("no rows",), (), {}


def _plain(_log: Any, _: LocalFrame) -> Found:
    return (), (), {}


_LOOKS: Final[dict[type, Callable[[Any, LocalFrame], Found]]] = {
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
