"""Is each table, by itself, physically possible?  Wrong units and signs are refused here.

A check raises where the numbers cannot be what their columns say, and returns a note, one sentence,
where they are odd and may yet be right.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final

import numpy as np

from ssm_graph.base.errors import DataError
from ssm_graph.base.frames import BodyAxes, to_frd
from ssm_graph.base.frozen import Array
from ssm_graph.io.mission_folder.checks.dvl import check_dvl
from ssm_graph.io.mission_folder.keys import ACCEL, ATTITUDE, GYRO, LIMITS, VELOCITY
from ssm_graph.io.mission_folder.toml import MissionToml
from ssm_graph.io.tables.table import POSITION_SIGMA, Table
from ssm_graph.sensors.limits import DEEPEST_M, LON_RANGE_DEG

RATE_RANGE_HZ: Final = (5.0, 20000.0)
"""A slower IMU cannot carry a vehicle's motion between pings; a faster one has other units."""
LONGEST_GAP_S: Final = 10.0
NOTED_GAP_S: Final = 0.1
NOTED_JITTER: Final = 0.1
"""Scatter of the steps between samples, of their median; an instrument's own clock has no more."""
FORCE_RANGE: Final = (9.3, 10.3)
"""m/s^2: no bias or scale error of a usable accelerometer leads out of it."""
FASTEST_TURN: Final = 6.0
"""rad/s"""
_HALF_G: Final = 4.9
_REPEATED_SHARE: Final = 0.2
_FORCE_UNITS: Final = (
    (1.0, "g", "multiply them by 9.80665"),
    (1e3, "mg", "multiply them by 0.00980665"),
    (1e6, "ug", "multiply them by 9.80665e-6"),
    (32.174, "ft/s^2", "multiply them by 0.3048"),
    (980.665, "cm/s^2", "divide them by 100"),
    (9806.65, "mm/s^2", "divide them by 1000"),
)
_STEP_UNITS: Final = ((1e3, "milliseconds"), (1e6, "microseconds"), (1e9, "nanoseconds"))


def check_tables(tables: dict[str, Table], toml: MissionToml) -> list[str]:
    """Check every table by itself; return the notes."""
    notes = check_imu(tables["imu"], toml.body)
    notes += check_dvl(tables["dvl"])
    others: dict[str, Callable[[Table], list[str]]] = {
        "depth": check_depth,
        "gnss": check_gnss,
        "reference": check_reference,
    }
    for name, check in others.items():
        if name in tables:
            notes += check(tables[name])
    return notes


def check_imu(table: Table, body: BodyAxes) -> list[str]:
    """Check rate, gaps, units and signs of the inertial sensors."""
    if len(table) < 2:
        got = f"{len(table)} row" if len(table) else "a header and no rows"
        raise DataError(f"{table.label}: the table has {got}; expected at least 2 samples")
    notes = _imu_times(table)
    _specific_force(table)
    _turn_rates(table)
    notes += _gravity_direction(table, body)
    same = np.all(np.diff(table.stack([*GYRO, *ACCEL]), axis=0) == 0.0, axis=1).mean()
    if same > _REPEATED_SHARE:
        notes.append(
            f"{table.label}: {100 * same:.0f} % of the rows repeat all readings of the row before; "
            "a driver that publishes faster than the sensor measures makes such rows"
        )
    return notes


def check_depth(table: Table) -> list[str]:
    """Check the unit of the depth."""
    depth = table["depth_m"]
    if np.median(np.abs(depth)) > DEEPEST_M:
        raise DataError(
            f"{table.label}: column 'depth_m' has a median of {np.median(depth):.6g}; expected "
            "metres below the ellipsoid; is it a pressure, or in millimetres?"
        )
    refuse_beyond(table, ["depth_m"], "expected metres, positive down")
    return []


def check_gnss(table: Table) -> list[str]:
    """Check ranges of position and sigma."""
    notes = check_positions(table)
    expected = "expected a standard deviation above 0, in metres; delete fixes of unknown quality"
    refuse_beyond(table, POSITION_SIGMA, expected)
    return notes


def check_reference(table: Table) -> list[str]:
    """Check ranges of position, velocity and attitude."""
    notes = check_positions(table)
    refuse_beyond(table, VELOCITY, "expected m/s; is it in mm/s?")
    for name in ATTITUDE:
        refuse_beyond(table, [name], f"expected degrees up to {LIMITS[name][1]:g}")
    return notes


def _imu_times(table: Table) -> list[str]:
    steps = np.diff(table.time_s)
    median = float(np.median(steps))
    lowest, highest = RATE_RANGE_HZ
    if not 0.99 * lowest <= 1.0 / median <= highest:
        units = [unit for size, unit in _STEP_UNITS if 5.0 <= size / median <= 5000.0]
        hint = f"are the times in {units[0]}" if units else "are the times not in seconds"
        hint += ", or was the log thinned out?" if 1.0 / median < lowest else "?"
        raise DataError(
            f"{table.label}: the rows are {median:.6g} s apart, {1.0 / median:.6g} Hz; expected "
            f"{lowest:g} to {highest:g} Hz; {hint}"
        )
    row = int(np.argmax(steps))
    if steps[row] > LONGEST_GAP_S:
        raise table.fault(
            row + 1,
            f"no samples for {steps[row]:z.3f} s after {table.time_s[row]:z.3f} s; expected no gap "
            f"longer than {LONGEST_GAP_S:g} s; split the mission there",
        )
    gaps = steps > max(NOTED_GAP_S, 5.0 * median)
    notes = []
    jitter = float(np.std(steps[~gaps])) / median
    if jitter > NOTED_JITTER:
        notes.append(
            f"{table.label}: the steps in time scatter by {100.0 * jitter:.0f} % of their median, "
            f"{median:z.4f} s: times of arrival, not the sensor's own; each reading counts for the "
            "step before it"
        )
    if gaps.any():
        notes.append(
            f"{table.label}: {gaps.sum()} gaps in time, the longest {steps[row]:z.3f} s after "
            f"{table.time_s[row]:z.3f} s; each is bridged by the mean of the readings on both "
            "sides, with larger process noise"
        )
    return notes


def _specific_force(table: Table) -> None:
    force = table.stack(ACCEL)
    median = float(np.median(_length(force)))
    low, high = FORCE_RANGE
    if not low <= median <= high:
        found = [(u, todo) for size, u, todo in _FORCE_UNITS if abs(median / size - 1.0) < 0.06]
        if found:
            hint = f"the readings are in {found[0][0]}: {found[0][1]}"
        elif median < 2.0:
            hint = "was gravity taken out? the specific force with gravity is needed"
        else:
            hint = "check unit and scale of the accelerometer"
        raise DataError(
            f"{table.label}: the accelerometer's readings have a median length of {median:.6g}; "
            f"expected about 9.8 m/s^2; {hint}"
        )
    refuse_beyond(table, ACCEL, "expected m/s^2; delete this row")


def _turn_rates(table: Table) -> None:
    rate = float(np.percentile(_length(table.stack(GYRO)), 99.0))
    if rate > FASTEST_TURN:
        raise DataError(
            f"{table.label}: 1 % of the turn rates exceed {rate:.4g}; expected rad/s, up to "
            f"{FASTEST_TURN:g} for a vehicle; the readings are in deg/s: multiply them by pi/180"
        )
    refuse_beyond(table, GYRO, "expected rad/s; delete this row")


def _gravity_direction(table: Table, body: BodyAxes) -> list[str]:
    force = np.median(to_frd(table.stack(ACCEL), body), axis=0)
    vertical = float(np.median(table[ACCEL[2]]))
    want = "-9.8" if body is BodyAxes.FRD else "+9.8"
    place = f"{table.label}: column {ACCEL[2]!r} has a median of {vertical:+.2f}"
    if force[2] > _HALF_G:
        other = (
            "[frames] body is really FLU or RFU"
            if body is BodyAxes.FRD
            else "[frames] body is really FRD"
        )
        raise DataError(
            f"{place}; expected about {want} in {body.value} axes; the accelerometer's signs are "
            f"reversed, or {other}"
        )
    if force[2] > -_HALF_G:
        return [
            f"{place}, where {want} was expected of a level vehicle in {body.value} axes; gravity "
            "lies along another axis: does the vehicle lie on its side, or are columns swapped?"
        ]
    return []


def check_positions(table: Table) -> list[str]:
    """Check the ranges of positions, and whether they are codes or radians."""
    lat, lon = table["lat_deg"], table["lon_deg"]
    nowhere = (lat == 0.0) & (lon == 0.0)
    if nowhere.any():
        raise table.fault(
            int(np.argmax(nowhere)),
            "latitude and longitude are exactly 0; receivers write that when they have no fix: "
            "delete such rows",
        )
    swapped = np.all(np.abs(lon) <= 90.0) and np.all(np.abs(lat) <= 360.0)
    hint = "latitude and longitude seem swapped" if swapped else "is it an integer coding?"
    refuse_beyond(table, ["lat_deg"], f"expected degrees from -90 to 90; {hint}")
    refuse_beyond(table, ["lon_deg"], "expected degrees from {:g} to {:g}".format(*LON_RANGE_DEG))
    refuse_beyond(table, ["height_m"], "expected metres, up; is it in mm?")
    if np.all(np.abs(lat) <= 0.5 * np.pi) and np.all(np.abs(lon) <= np.pi):
        return [
            f"{table.label}: all positions lie within 3.2 degrees of 0 N, 0 E; if they are in "
            "radians, multiply them by 180/pi"
        ]
    return []


def refuse_beyond(table: Table, names: Sequence[str], expected: str) -> None:
    """Raise for the first value outside its limits; NaN and missing columns pass."""
    for name in names:
        if name in table:
            low, high = LIMITS[name]
            bad = (table[name] < low) | (table[name] > high)
            if bad.any():
                raise table.cell_fault(int(np.argmax(bad)), name, expected)


def _length(vectors: Array) -> Array:
    """Return lengths (N,); numbers beyond any sensor are cut so that squares stay finite."""
    return np.asarray(np.linalg.norm(np.clip(vectors, -1e100, 1e100), axis=1))
