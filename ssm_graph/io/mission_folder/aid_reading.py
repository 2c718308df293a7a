"""Acoustics, compass and times at rest of a mission folder, checked."""

from __future__ import annotations

import numpy as np

from ssm_graph.io.mission_folder.aid_keys import AID_TABLES
from ssm_graph.io.mission_folder.checks.tables import check_positions, refuse_beyond
from ssm_graph.io.mission_folder.instruments import lever_arm_b, radians_wrapped
from ssm_graph.io.mission_folder.keys import LIMITS
from ssm_graph.io.mission_folder.toml import MissionToml
from ssm_graph.io.mission_folder.units import to_si
from ssm_graph.io.tables.settings import Settings
from ssm_graph.io.tables.table import POSITION_SIGMA, Table
from ssm_graph.mission.mission import Aids
from ssm_graph.sensors.acoustic import Beacon, RangeLog, UsblLog
from ssm_graph.sensors.compass import HeadingErrors, HeadingLog
from ssm_graph.sensors.standstill import Standstill

_DEFAULT_STANDSTILL = Standstill(0.0, 1.0)


def read_aids(tables: dict[str, Table], toml: MissionToml) -> tuple[Aids, list[str]]:
    """Return the further aids of a mission, and notes on what is odd about them."""
    notes: list[str] = []
    usbl, ranges, heading = None, None, None
    beacons = tuple(_beacon(settings) for settings in toml.lists["beacon"])
    if "usbl" in tables:
        notes += check_usbl(tables["usbl"])
        usbl = _usbl(tables["usbl"], toml)
    if "ranges" in tables:
        notes += check_ranges(tables["ranges"], toml, beacons)
        ranges = _ranges(tables["ranges"], toml, beacons)
    elif beacons:
        notes.append(f"{toml.file} [[beacon]]: there is no [ranges]; going on without beacons")
    if "heading" in tables:
        notes += check_heading(tables["heading"])
        heading = _heading(tables["heading"], toml["heading"])
    standstills = tuple(_standstill(settings, tables) for settings in toml.lists["standstill"])
    return Aids(usbl, ranges, heading, *standstills), notes


def sections_of_aids(toml: MissionToml) -> tuple[str, ...]:
    """Return the sections of a file that tell of further aids."""
    sections = [f"[{name}]" for name in AID_TABLES if name in toml]
    return (*sections, *(["[[standstill]]"] if toml.lists["standstill"] else []))


def check_usbl(table: Table) -> list[str]:
    """Check ranges of position, sigma and delay."""
    notes = check_positions(table)
    expected = "expected a standard deviation above 0, in metres; delete fixes of unknown quality"
    refuse_beyond(table, POSITION_SIGMA, expected)
    longest = LIMITS["delay_s"][1]
    refuse_beyond(
        table, ["delay_s"], f"expected seconds from 0 to {longest:g}; is it in milliseconds?"
    )
    return notes


def check_ranges(table: Table, toml: MissionToml, beacons: tuple[Beacon, ...]) -> list[str]:
    """Check that the ranges are to beacons that the mission knows, each of them once."""
    numbers = [beacon.number for beacon in beacons]
    for i, settings in enumerate(toml.lists["beacon"]):
        if numbers[i] in numbers[:i]:
            raise settings.fault("number", f"{numbers[i]} is another beacon's already")
    refuse_beyond(table, ["range_m"], "expected metres from 0 to 20000; is it in mm?")
    refuse_beyond(table, ["sigma_m"], "expected a standard deviation above 0, in metres")
    is_known = np.isin(table["beacon"], numbers)
    if not is_known.all():
        known = f"expected one of {', '.join(map(str, numbers))}" if numbers else "there is none"
        raise table.cell_fault(
            int(np.argmin(is_known)),
            "beacon",
            f"{known}; state the beacon's place in {toml.file} under [[beacon]], with "
            "position_sigma_m where it is not known",
        )
    return [
        f"{table.label}: no range is to beacon {number}"
        for number in numbers
        if number not in table["beacon"]
    ]


def check_heading(table: Table) -> list[str]:
    """Check the unit of headings."""
    refuse_beyond(table, ["heading_deg"], "expected degrees up to 360, clockwise from north")
    if np.all(np.abs(table["heading_deg"]) <= 2.0 * np.pi):
        return [
            f"{table.label}: all headings lie within 6.3 degrees of north; if they are in radians, "
            "multiply them by 180/pi"
        ]
    return []


def _usbl(table: Table, toml: MissionToml) -> UsblLog:
    delay_s = table.stack(["delay_s"])[:, 0]
    return UsblLog(
        time_s=table.time_s,
        delay_s=np.where(np.isnan(delay_s), 0.0, delay_s),
        lat=np.radians(table["lat_deg"]),
        lon=radians_wrapped(table["lon_deg"]),
        height=table["height_m"],
        sigma_enu=table.stack(POSITION_SIGMA),
        lever_arm_b=lever_arm_b(toml, "usbl"),
    )


def _beacon(settings: Settings) -> Beacon:
    number = settings.number("number")
    if number % 1.0:
        raise settings.fault("number", f"expected a whole number, got {number:g}")
    is_doubted = "position_sigma_m" in settings
    return Beacon(
        number=int(number),
        lat=to_si("lat_deg", settings.number("lat_deg")),
        lon=float(radians_wrapped(settings.number("lon_deg"))),
        height=settings.number("height_m"),
        position_sigma_enu=settings.array("position_sigma_m") if is_doubted else np.zeros(3),
    )


def _ranges(table: Table, toml: MissionToml, beacons: tuple[Beacon, ...]) -> RangeLog:
    sigma = table.stack(["sigma_m"])[:, 0]
    return RangeLog(
        beacons=beacons,
        time_s=table.time_s,
        beacon=table["beacon"],
        range_m=table["range_m"],
        sigma=np.where(np.isnan(sigma), toml["ranges"].number("noise_m"), sigma),
        lever_arm_b=lever_arm_b(toml, "ranges"),
    )


def _heading(table: Table, settings: Settings) -> HeadingLog:
    given = {
        field: to_si(key, settings.number(key))
        for field, key in (
            ("offset_sigma", "offset_sigma_deg"),
            ("rate_sigma", "rate_sigma_deg_per_h"),
            ("walk_sigma", "walk_sigma_deg"),
            ("correlation_s", "correlation_s"),
            ("one_cycle_sigma", "one_cycle_sigma_deg"),
            ("two_cycle_sigma", "two_cycle_sigma_deg"),
        )
        if key in settings
    }
    if "correlation_s" in settings and not given.get("walk_sigma"):
        raise settings.fault(
            "correlation_s", "expected with a walk_sigma_deg above 0, got none; 1 is usual"
        )
    return HeadingLog(
        sigma=to_si("noise_deg", settings.number("noise_deg")),
        time_s=table.time_s,
        heading=np.radians(table["heading_deg"]),
        declination=to_si("declination_deg", settings.number("declination_deg")),
        errors=HeadingErrors(**given),
    )


def _standstill(settings: Settings, tables: dict[str, Table]) -> Standstill:
    begin_s, end_s = settings.number("begin_s"), settings.number("end_s")
    first_s, last_s = (float(tables["imu"].time_s[i]) for i in (0, -1))
    if not begin_s < end_s:
        raise settings.fault("end_s", f"expected a time after {begin_s:z.3f} s, got {end_s:z.3f} s")
    if end_s < first_s or begin_s > last_s:
        raise settings.fault(
            "begin_s",
            f"{begin_s:z.3f} to {end_s:z.3f} s lies outside {tables['imu'].label}, "
            f"{first_s:z.3f} to {last_s:z.3f} s; give times on the clock of the tables",
        )
    sigma = settings.number("sigma_m_per_s")
    return Standstill(begin_s, end_s, sigma or _DEFAULT_STANDSTILL.sigma)
