"""One way into a mission, for files and converters alike: the logs, checked against each other.

No check is chosen by the author of a reader: whoever has logs hands them in here. They have to fit
each other: clocks, positions, gravity, and the motion that they tell of.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from ssm_graph.base.earth import EARTH_RATE, LocalFrame, normal_gravity
from ssm_graph.base.errors import ConfigError, DataError
from ssm_graph.base.frames import BodyAxes
from ssm_graph.base.frozen import Array
from ssm_graph.base.tables import Table, TableFile, table_of
from ssm_graph.base.units import DEG_PER_H
from ssm_graph.io.mission_folder.motion import check_motion
from ssm_graph.io.mission_folder.toml import REFERENCE, TOML_NAME
from ssm_graph.mission.mission import Aids, InitialState, LocalStart, Mission, Reference
from ssm_graph.mission.vehicle import Vehicle
from ssm_graph.sensors.compass import HeadingLog
from ssm_graph.sensors.current import CurrentModel
from ssm_graph.sensors.gnss import GnssLog
from ssm_graph.sensors.registry import BY_LOG, INSTRUMENTS
from ssm_graph.sensors.standstill import Standstill

FARTHEST_M: Final = 100e3
"""From the origin; a longer mission may go 5 m/s times its length."""
_FASTEST: Final = 5.0
_EDGE_S: Final = 1.0
_GRAVITY_SHARE: Final = 0.005
_UNITS: Final = ((1e3, "milliseconds"), (1e6, "microseconds"), (1e9, "nanoseconds"))
_FINDS_NORTH: Final = math.radians(10.0)
"""Gyros whose bias is less than this share of the Earth's turn find a safe heading."""
_OWN_FIELDS = ("imu", "dvl", "depth", "gnss")
"""Sections that are fields of a mission; the others are among its aids."""


class Part(NamedTuple):
    """One instrument of a mission: its log, and the table that it came from."""

    log: Any
    table: Table


def mission_from(
    logs: Iterable[Any],
    vehicle: Vehicle | None,
    *,
    source: Path,
    labels: Mapping[str, str | TableFile],
    notes: Sequence[str] = (),
) -> Mission:
    """Return the mission of logs that were made of messages, checked as a folder's tables are.

    Raises :class:`ConfigError` where neither vehicle nor fixes say where on Earth the mission was.
    Raises :class:`DataError` for readings that cannot be what they are said to be, or that
    contradict each other.

    Parameters
    ----------
    logs : of instruments of the registry, forward-right-down, SI units; IMU and DVL at least; and a
        reference where there is one.
    vehicle : its frame is taken, its current, and its start where it lies within the inertial
        data; None where nothing is known beside the logs.
    source : the recording; the mission has its name.
    labels : by section, what messages call the place that the readings came from; a file of which
        messages name the row as well.
    notes : what the converter noticed, one sentence each; what the checks notice follows.
    """
    parts: dict[str, Part] = {}
    found = list(notes)
    for log in logs:
        one = REFERENCE if isinstance(log, Reference) else BY_LOG[type(log)]
        label, columns = labels[one.section], one.table_of(log)
        table = table_of(label, columns) if isinstance(label, str) else Table(label, columns)
        found += one.check(table, log, BodyAxes.FRD)
        parts[one.section] = Part(one.cleaned(log), table)
    initial, some = _initial_within(parts["imu"].log, vehicle)
    local = None if vehicle is None else vehicle.local
    if local is not None and {"gnss", "usbl"} & set(parts):
        local = None
        found.append("[local] of the vehicle file is not used: the log has fixes.")
    stated = None if vehicle is None or vehicle.local not in (None, local) else vehicle.frame
    frame = first_frame(stated, parts, None)
    if frame is None:
        raise ConfigError(
            f"{source}: nothing says where on Earth the recording was made: it holds no usable "
            "fix; give  --vehicle FILE  with [origin], or [local] for a tank or a pool"
        )
    return assembled(
        source.stem,
        parts,
        frame=frame,
        has_origin=stated is not None,
        local=local,
        initial=initial,
        current=None if vehicle is None else vehicle.current,
        notes=[*found, *some],
    )


def assembled(
    name: str,
    parts: Mapping[str, Part],
    *,
    frame: LocalFrame,
    has_origin: bool,
    standstills: Sequence[Standstill] = (),
    initial: InitialState | None,
    local: LocalStart | None = None,
    current: CurrentModel | None,
    notes: Sequence[str],
) -> Mission:
    """Return the mission of logs that are sound by themselves, checked against each other."""
    logs = {section: part.log for section, part in parts.items()}
    own: dict[str, Any] = {section: logs.get(section) for section in (*_OWN_FIELDS, "reference")}
    aids = [logs.get(one.section) for one in INSTRUMENTS if one.section not in _OWN_FIELDS]
    mission = Mission(
        name=name,
        frame=frame,
        aids=Aids(*aids, *standstills),
        initial=initial,
        local=local,
        current=current,
        **own,
    )
    if local is not None:
        mission, said = _without_north(mission, local)
        notes = [*notes, local.sentence, *said]
    tables = {section: part.table for section, part in parts.items()}
    return replace(mission, notes=(*notes, *_check(mission, tables, has_origin=has_origin)))


def _without_north(mission: Mission, local: LocalStart) -> tuple[Mission, list[str]]:
    """Return a mission whose gyros count as the turn of the Earth where its direction is unknown.

    Gyros that find north by themselves, and a compass, tell it.
    """
    turn = EARTH_RATE * math.cos(local.lat)
    sigma = mission.imu.noise.gyro_bias_sigma
    if local.is_heading_known or mission.aids.get(HeadingLog) is not None:
        return mission, []
    if sigma < _FINDS_NORTH * turn or sigma >= 2.0 * turn:
        return mission, []
    noise = replace(mission.imu.noise, gyro_bias_sigma=2.0 * turn)
    said = (
        f"the turn of the Earth, of unknown direction, counts as a gyro bias of "
        f"{2.0 * turn / DEG_PER_H:.0f} deg/h"
    )
    return replace(mission, imu=replace(mission.imu, noise=noise)), [said]


def first_frame(
    origin: LocalFrame | None, parts: Mapping[str, Part], initial: InitialState | None
) -> LocalFrame | None:
    """Return the frame at the origin, else the first fix, the initial state, the first USBL fix."""
    frames = (
        origin,
        _frame_of_first(parts, "gnss"),
        None if initial is None else LocalFrame(initial.lat, initial.lon, initial.height),
        _frame_of_first(parts, "usbl"),
    )
    return next((frame for frame in frames if frame is not None), None)


def _frame_of_first(parts: Mapping[str, Part], section: str) -> LocalFrame | None:
    if section not in parts:
        return None
    log: GnssLog = parts[section].log
    return LocalFrame(float(log.lat[0]), float(log.lon[0]), float(log.height[0]))


def _initial_within(imu: Any, vehicle: Vehicle | None) -> tuple[InitialState | None, list[str]]:
    """Return the start of a vehicle file where it lies within the inertial data, else a note."""
    if vehicle is None or vehicle.initial is None:
        return None, []
    step_s = float(np.median(np.diff(imu.time_s)))  # stamps of sums and dates are rounded
    if imu.start_s - step_s <= vehicle.initial.time_s <= imu.time_s[-1]:
        return vehicle.initial, []
    return None, [
        f"[initial] of the vehicle file is for {vehicle.initial.time_s:.3f} s, outside the "
        "recording, and not used."
    ]


def _check(mission: Mission, tables: dict[str, Table], *, has_origin: bool) -> list[str]:
    """Check the parts of a mission against each other; return the notes.

    ``tables`` by section are where the readings of its instruments, sound by themselves, came from;
    ``has_origin`` says that the frame was stated, not taken from the first position.
    """
    mission = replace(mission, imu=mission.imu.calibrated)
    notes = _times(mission, tables)
    _initial_time(mission, tables["imu"].label)
    _initial_position(mission, has_origin=has_origin)
    for name in ("gnss", "usbl", "reference"):
        if name in tables:
            _table_position(mission, tables[name], has_origin=has_origin)
    notes += _current(mission)
    notes += _gravity(mission, tables["imu"].label)
    return notes + check_motion(mission, {name: table.label for name, table in tables.items()})


def _times(mission: Mission, tables: dict[str, Table]) -> list[str]:
    notes = []
    start, end = mission.imu.start_s, float(mission.imu.time_s[-1])
    for name, table in tables.items():
        time_s = table.time_s
        if name == "imu" or len(time_s) == 0:
            continue
        time_s = time_s - np.nan_to_num(table.columns.get("delay_s", 0.0))
        first, last = float(time_s[0]), float(time_s[-1])
        inside = (time_s >= start - _EDGE_S) & (time_s <= end + _EDGE_S)
        ratio = (last - first) / (end - start)
        # A log of the whole day may lie around a dive; one of so many times its length is in ms.
        is_in_units = any(_is_about(ratio, size) for size, _ in _UNITS)
        if not inside.any() or (is_in_units and inside.mean() < 0.5):
            raise DataError(
                f"{table.label}: the times run from {first:z.3f} to {last:z.3f} s, those of "
                f"{tables['imu'].label} from {start:z.3f} to {end:z.3f} s; expected one clock in "
                f"seconds; {_clock_hint(ratio, first, start)}"
            )
        outside = int(np.sum(~inside))
        if outside:
            notes.append(
                f"{table.label}: {outside} of {len(time_s)} rows lie outside the time of the IMU"
            )
    return notes


def _is_about(ratio: float, size: float) -> bool:
    return 0.3 < ratio / size < 3.0


def _clock_hint(ratio: float, first: float, start: float) -> str:
    for size, unit in _UNITS:
        if _is_about(ratio, size):
            return f"are these in {unit}?"
        if _is_about(ratio * size, 1.0):
            return f"are those of the IMU in {unit}?"
    if max(abs(first), abs(start)) > 1e8 > min(abs(first), abs(start)):
        return "one counts from 1970 or 1980 and the other from its own start: shift one of them"
    return "shift one of them"


def _initial_time(mission: Mission, label: str) -> None:
    imu, initial = mission.imu, mission.initial
    step = float(np.median(np.diff(imu.time_s)))
    start, end = imu.start_s, float(imu.time_s[-1])
    if initial is not None and not start - 2.0 * step <= initial.time_s <= end:
        raise ConfigError(
            f"{TOML_NAME} [initial] time_s: expected a time between {start:z.3f} and {end:z.3f} s, "
            f"the span of {label}, got {initial.time_s:z.3f} s; give the time of the stated "
            "position on the clock of the tables"
        )


def _initial_position(mission: Mission, *, has_origin: bool) -> None:
    initial = mission.initial
    if initial is None:
        return
    distance = _distance(mission, np.array([initial.lat]), np.array([initial.lon]))[0]
    if distance > _limit(mission):
        origin = "[origin]" if has_origin else "the first GNSS fix"
        raise ConfigError(
            f"{TOML_NAME} [initial] lat_deg, lon_deg: the position is {distance / 1e3:.0f} km from "
            f"{origin}; expected less than {_limit(mission) / 1e3:.0f} km; "
            + _position_hint(mission, initial.lat, initial.lon)
        )


def _table_position(mission: Mission, table: Table, *, has_origin: bool) -> None:
    lat, lon = np.radians(table["lat_deg"]), np.radians(table["lon_deg"])
    far = _distance(mission, lat, lon) > _limit(mission)
    if not far.any():
        return
    row = int(np.argmax(far))
    distance = _distance(mission, lat, lon)[row] / 1e3
    origin = "the mission's origin" if has_origin else "the first GNSS fix or [initial]"
    hint = _position_hint(mission, lat[row], lon[row])
    if far.mean() > 0.5 and not has_origin:
        hint = "most rows are: is that first position wrong?"
    raise table.fault(
        row,
        f"the position {table['lat_deg'][row]:.6g}, {table['lon_deg'][row]:.6g} degrees is "
        f"{distance:.0f} km from {origin}; expected less than {_limit(mission) / 1e3:.0f} km; "
        f"{hint}",
    )


def _position_hint(mission: Mission, lat: float, lon: float) -> str:
    """Name the slip that would explain a position far from the origin."""
    slips = {
        "latitude and longitude seem swapped": (lon, lat),
        "the position seems to be in radians": (np.degrees(lat), np.degrees(lon)),
        "the longitude seems to have the wrong sign": (lat, -lon),
        "the latitude seems to have the wrong sign": (-lat, lon),
    }
    for text, (slip_lat, slip_lon) in slips.items():
        if abs(slip_lat) <= 0.5 * np.pi:
            distance = _distance(mission, np.array([slip_lat]), np.array([slip_lon]))[0]
            if distance < FARTHEST_M:
                return text
    return "correct or delete it"


def _distance(mission: Mission, lat: Array, lon: Array) -> Array:
    p_n = mission.frame.p_n_from_geodetic(lat, lon, mission.frame.height)
    return np.asarray(np.linalg.norm(p_n, axis=-1))


def _limit(mission: Mission) -> float:
    return max(FARTHEST_M, _FASTEST * float(mission.imu.time_s[-1] - mission.imu.start_s))


def _current(mission: Mission) -> list[str]:
    """Note a current that nothing measures."""
    if mission.current is None or mission.dvl.water_track is not None:
        return []
    return [
        f"{TOML_NAME} [current]: no ping is off the water, so the section changes nothing; a 1 in "
        f"column 'water_track' of the DVL's table marks such a ping"
    ]


def _gravity(mission: Mission, label: str) -> list[str]:
    force = float(np.median(np.linalg.norm(mission.imu.accel_b, axis=1)))
    gravity = float(normal_gravity(mission.frame.lat, mission.frame.height))
    share = force / gravity - 1.0
    if abs(share) < _GRAVITY_SHARE:
        return []
    return [
        f"{label}: the median specific force is {force:z.3f} m/s^2, {100 * abs(share):.1f} % "
        f"{'above' if share > 0 else 'below'} gravity there ({gravity:z.3f}); accel_bias_ug should "
        "cover that"
    ]
