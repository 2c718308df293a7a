"""One way into a mission, for files and converters alike: the logs, checked against each other.

No check is chosen by the author of a reader: whoever has logs hands them in here.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

from ssm_graph.base.earth import LocalFrame
from ssm_graph.base.frames import BodyAxes
from ssm_graph.base.tables import Table, table_of
from ssm_graph.io.mission_folder.checks import check_mission
from ssm_graph.mission.mission import Aids, InitialState, Mission
from ssm_graph.mission.vehicle import Vehicle
from ssm_graph.sensors.current import CurrentModel
from ssm_graph.sensors.gnss import GnssLog
from ssm_graph.sensors.registry import BY_LOG, INSTRUMENTS
from ssm_graph.sensors.standstill import Standstill

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
    name: str,
    labels: Mapping[str, str],
    frame: LocalFrame,
    notes: Sequence[str] = (),
) -> Mission:
    """Return the mission of logs that were made of messages, checked as a folder's tables are.

    Parameters
    ----------
    logs : of instruments of the registry, forward-right-down, SI units; IMU and DVL at least.
    vehicle : its start is taken where it lies within the inertial data, and its current; None
        where nothing is known beside the logs.
    name : of the mission.
    labels : by section, what messages call the place that the readings came from.
    frame : the navigation frame.
    notes : what the converter noticed, one sentence each; what the checks notice follows.

    Raises
    ------
    DataError
        For readings that cannot be what they are said to be, or that contradict each other.
    """
    parts: dict[str, Part] = {}
    found = list(notes)
    for log in logs:
        one = BY_LOG[type(log)]
        table = table_of(labels[one.section], one.table_of(log))
        found += one.check(table, log, BodyAxes.FRD)
        parts[one.section] = Part(one.cleaned(log), table)
    initial, some = _initial_within(parts["imu"].log, vehicle)
    return assembled(
        name,
        parts,
        frame=frame,
        has_origin=vehicle is not None and vehicle.frame is not None,
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
        current=current,
        **own,
    )
    tables = {section: part.table for section, part in parts.items()}
    return replace(mission, notes=(*notes, *check_mission(mission, tables, has_origin=has_origin)))


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
    if imu.start_s <= vehicle.initial.time_s <= imu.time_s[-1]:
        return vehicle.initial, []
    return None, [
        f"[initial] of the vehicle file is for {vehicle.initial.time_s:.3f} s, outside the "
        "recording, and not used."
    ]
