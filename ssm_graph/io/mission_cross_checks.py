"""Do the parts of a mission fit each other: clocks, positions, and the sign of down?"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

import numpy as np

from ssm_graph.data import Array, DepthLog, Mission
from ssm_graph.earth import normal_gravity
from ssm_graph.errors import ConfigError, DataError
from ssm_graph.io.mission_keys import TOML_NAME
from ssm_graph.io.mission_toml import MissionToml
from ssm_graph.io.tables import Table

FARTHEST_M: Final = 100e3
"""From the origin; a longer mission may go 5 m/s times its length."""
_FASTEST: Final = 5.0
_EDGE_S: Final = 1.0
_GRAVITY_SHARE: Final = 0.005
_UPWARD_M: Final = 2.0
_WINDOW_S: Final = 2.0
_FEWEST_PINGS: Final = 30
_CONTRADICTION: Final = 0.3
_UNITS: Final = ((1e3, "milliseconds"), (1e6, "microseconds"), (1e9, "nanoseconds"))


def check_mission(mission: Mission, tables: dict[str, Table], toml: MissionToml) -> list[str]:
    """Check the parts of a mission against each other; return the notes."""
    notes = _times(mission, tables)
    _initial_time(mission, tables["imu"].label)
    _initial_position(mission, toml)
    for name in ("gnss", "reference"):
        if name in tables:
            _table_position(mission, tables[name], has_origin="origin" in toml)
    notes += _gravity(mission, tables["imu"].label)
    if mission.depth is not None:
        notes += _depth_sign(mission, mission.depth, tables["depth"].label)
        notes += _vertical_speed(mission, mission.depth, tables)
    notes += _beams_agree(mission, tables["dvl"].label)
    return notes


def _times(mission: Mission, tables: dict[str, Table]) -> list[str]:
    notes = []
    start, end = mission.imu.start_s, float(mission.imu.time_s[-1])
    for name, table in tables.items():
        if name == "imu" or len(table) == 0:
            continue
        first, last = float(table.time_s[0]), float(table.time_s[-1])
        inside = (table.time_s >= start - _EDGE_S) & (table.time_s <= end + _EDGE_S)
        ratio = (last - first) / (end - start)
        if not inside.any() or (ratio > 20.0 and inside.mean() < 0.5):
            raise DataError(
                f"{table.label}: the times run from {first:.3f} to {last:.3f} s, those of "
                f"{tables['imu'].label} from {start:.3f} to {end:.3f} s; expected one clock in "
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
    if initial is not None and not start - step <= initial.time_s <= end:
        raise ConfigError(
            f"{TOML_NAME} [initial] time_s: expected a time between {start:.3f} and {end:.3f} s, "
            f"the span of {label}, got {initial.time_s:.3f} s; give the time of the stated "
            "position on the clock of the tables"
        )


def _initial_position(mission: Mission, toml: MissionToml) -> None:
    initial = mission.initial
    if initial is None:
        return
    distance = _distance(mission, np.array([initial.lat]), np.array([initial.lon]))[0]
    if distance > _limit(mission):
        origin = "[origin]" if "origin" in toml else "the first GNSS fix"
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


def _gravity(mission: Mission, label: str) -> list[str]:
    force = float(np.median(np.linalg.norm(mission.imu.accel_b, axis=1)))
    gravity = float(normal_gravity(mission.frame.lat, mission.frame.height))
    share = force / gravity - 1.0
    if abs(share) < _GRAVITY_SHARE:
        return []
    return [
        f"{label}: the median specific force is {force:.3f} m/s^2, {100 * abs(share):.1f} % "
        f"{'above' if share > 0 else 'below'} gravity there ({gravity:.3f}); accel_bias_ug should "
        "cover that"
    ]


def _known_heights(mission: Mission) -> Iterator[float]:
    if mission.gnss is not None:
        yield from mission.gnss.height
    if mission.reference is not None:
        yield from mission.reference.height
    if mission.initial is not None:
        yield mission.initial.height
    yield mission.frame.height


def _depth_sign(mission: Mission, depth: DepthLog, label: str) -> list[str]:
    """Refuse heights given as depths; note a depth that counts from the wrong surface."""
    median = float(np.median(depth.depth))
    if median < -_UPWARD_M and max(_known_heights(mission)) < -0.5 * median:
        raise DataError(
            f"{label}: column 'depth_m' has a median of {median:.2f} m, and no known height is "
            f"near {-median:.2f} m; expected depth, positive down; change its sign"
        )
    gnss = mission.gnss
    if gnss is None:
        return []
    both = (gnss.time_s >= depth.time_s[0]) & (gnss.time_s <= depth.time_s[-1])
    if not both.any():
        return []
    total = gnss.height[both] + np.interp(gnss.time_s[both], depth.time_s, depth.depth)
    offset, sigma = float(np.median(total)), float(np.median(gnss.sigma_enu[both, 2]))
    if abs(offset) < max(5.0, 3.0 * sigma):
        return []
    return [
        f"{label}: depth and GNSS height do not cancel, their sum is {offset:.1f} m; depth is minus "
        "the height above the ellipsoid, not the distance to the surface"
    ]


def _vertical_speed(mission: Mission, depth: DepthLog, tables: dict[str, Table]) -> list[str]:
    """Compare the DVL's downward speed with the change of depth, down being against the force."""
    dvl, imu = mission.dvl, mission.imu
    half = 0.5 * max(_WINDOW_S, 2.0 * float(np.median(np.diff(depth.time_s, prepend=-np.inf))))
    begin = max(imu.time_s[0], depth.time_s[0]) + half
    end = min(imu.time_s[-1], depth.time_s[-1]) - half
    used = np.isfinite(dvl.speed).all(axis=1) & (dvl.time_s > begin) & (dvl.time_s < end)
    if not np.isfinite(half) or used.sum() < _FEWEST_PINGS:
        return []
    time_s = dvl.time_s[used]
    v_b = dvl.speed[used] @ np.linalg.pinv(dvl.mount.beams_b).T
    sums = np.cumsum(imu.accel_b * np.diff(imu.time_s, prepend=imu.start_s)[:, None], axis=0)
    force = np.column_stack([_difference(time_s, half, imu.time_s, axis) for axis in sums.T])
    down_b = -force / np.maximum(np.linalg.norm(force, axis=1, keepdims=True), 1e-9)
    speed = np.sum(down_b * v_b, axis=1)
    rate = _difference(time_s, half, depth.time_s, depth.depth) / (2.0 * half)
    if min(np.std(speed), np.std(rate)) < 0.05:
        return []
    correlation = float(np.corrcoef(speed, rate)[0, 1])
    if correlation < -0.8:
        raise DataError(
            f"{tables['dvl'].label}: the DVL's downward speed is opposite to the change of "
            f"{tables['depth'].label} (correlation {correlation:.2f}); expected beam speeds that "
            "are positive when the instrument moves along the beam, and depth positive down; "
            "change the sign of one of them, or correct mounting_rpy_deg"
        )
    ratio = float(np.std(rate) / np.std(speed))
    if correlation > 0.9 and not 0.7 < ratio < 1.5:
        return [
            f"{tables['depth'].label}: the depth changes {ratio:.2f} times as fast as the DVL goes "
            "down; check the unit of the beam speeds and beam_janus_deg"
        ]
    return []


def _difference(time_s: Array, half: float, known_s: Array, values: Array) -> Array:
    """Return ``values(time_s + half) - values(time_s - half)``."""
    later = np.interp(time_s + half, known_s, values)
    return np.asarray(later - np.interp(time_s - half, known_s, values))


def _beams_agree(mission: Mission, label: str) -> list[str]:
    """Four beams measure three components: what is left over must be small."""
    speed = mission.dvl.speed[np.isfinite(mission.dvl.speed).all(axis=1)]
    if len(speed) < _FEWEST_PINGS:
        return []
    left_over = np.linalg.svd(mission.dvl.mount.beams_d)[0][:, 3]
    error = float(np.median(np.abs(speed @ left_over)))
    typical = float(np.median(np.linalg.norm(speed, axis=1)))
    if error < max(_CONTRADICTION * typical, 10.0 * float(np.median(mission.dvl.sigma))):
        return []
    return [
        f"{label}: the four beams contradict each other by {error:.2f} m/s in half of the pings, at "
        f"typical speeds of {typical:.2f} m/s; check the order of the beams in beam_azimuth_deg"
    ]
