"""Check that the parts of a mission fit each other: clocks, positions, gravity."""

from __future__ import annotations

from typing import Final

import numpy as np

from ssm_graph.base.earth import normal_gravity
from ssm_graph.base.errors import ConfigError, DataError
from ssm_graph.base.frozen import Array
from ssm_graph.base.tables import Table
from ssm_graph.io.mission_folder.motion import check_motion
from ssm_graph.io.mission_folder.toml import TOML_NAME
from ssm_graph.mission.mission import Mission

FARTHEST_M: Final = 100e3
"""From the origin; a longer mission may go 5 m/s times its length."""
_FASTEST: Final = 5.0
_EDGE_S: Final = 1.0
_GRAVITY_SHARE: Final = 0.005
_UNITS: Final = ((1e3, "milliseconds"), (1e6, "microseconds"), (1e9, "nanoseconds"))


def check_mission(mission: Mission, tables: dict[str, Table], *, has_origin: bool) -> list[str]:
    """Check the parts of a mission against each other; return the notes.

    Parameters
    ----------
    mission : its instruments are sound by themselves.
    tables : by section, where their readings came from.
    has_origin : whether the frame was stated, not taken from the first position.
    """
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
        if name == "imu" or len(table) == 0:
            continue
        time_s = table.time_s
        if "delay_s" in table:
            time_s = time_s - np.nan_to_num(table["delay_s"])
        first, last = float(time_s[0]), float(time_s[-1])
        inside = (time_s >= start - _EDGE_S) & (time_s <= end + _EDGE_S)
        ratio = (last - first) / (end - start)
        if not inside.any() or (ratio > 20.0 and inside.mean() < 0.5):
            raise DataError(
                f"{table.label}: the times run from {first:z.3f} to {last:z.3f} s, those of "
                f"{tables['imu'].label} from {start:z.3f} to {end:z.3f} s; expected one clock in "
                f"seconds; {_clock_hint(ratio, first, start)}"
            )
        outside = int(np.sum(~inside))
        if outside:
            notes.append(
                f"{table.label}: {outside} of {len(table)} rows lie outside the time of the IMU"
            )
    return notes


def _clock_hint(ratio: float, first: float, start: float) -> str:
    for size, unit in _UNITS:
        if 0.3 < ratio / size < 3.0:
            return f"are these in {unit}?"
        if 0.3 < ratio * size < 3.0:
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
