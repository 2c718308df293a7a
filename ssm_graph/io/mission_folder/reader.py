"""Reading a mission folder into one frozen :class:`~ssm_graph.mission.mission.Mission`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ssm_graph.base.settings import build
from ssm_graph.base.tables import Order, Table
from ssm_graph.io.mission_folder.assembly import Part, assembled, first_frame
from ssm_graph.io.mission_folder.toml import (
    REQUIRED_SECTIONS,
    TABLES,
    MissionToml,
    read_mission_toml,
    table_path,
)
from ssm_graph.io.mission_folder.writer import write_mission
from ssm_graph.io.tables.files import TableFormat, read_arrival_table, read_table
from ssm_graph.mission.mission import Mission
from ssm_graph.sensors.current import CurrentModel
from ssm_graph.sensors.instrument import Instrument
from ssm_graph.sensors.standstill import Standstill, check_during, standstill

__all__ = ["TableFormat", "read_mission", "write_mission"]


def read_mission(folder: Path | str) -> Mission:
    """Read and check a mission folder.

    Parameters
    ----------
    folder : the folder that holds ``mission.toml`` and the tables it names.

    Returns
    -------
    Mission
        In SI units, radians and body axes forward-right-down; ``notes`` holds, one sentence each,
        what was noticed and is no error.

    Raises
    ------
    ConfigError
        For a key of ``mission.toml`` that is missing, unknown or out of range.
    DataError
        For a table that is damaged, or whose numbers cannot be what the format says they are.
    MissingExtraError
        For a Parquet table where pyarrow is not installed.
    """
    toml = read_mission_toml(Path(folder))
    bare = {one.section: toml.bare(one) for one in TABLES if one.section in toml}
    tables, notes = _read_tables(toml, bare)
    parts: dict[str, Part] = {}
    for one in TABLES:
        if one.section in tables:
            table, settings = tables[one.section], toml[one.section]
            log, some = one.read(table, bare[one.section], settings, axes=toml.body)
            parts[one.section] = Part(log, table)
            notes += some
    notes += _lists_without_section(toml)
    initial = toml.initial()
    frame = first_frame(toml.frame("origin"), parts, initial)
    if frame is None:
        raise toml.fault_of_no_place()
    return assembled(
        toml.name,
        parts,
        frame=frame,
        has_origin="origin" in toml,
        standstills=_standstills(toml, parts["imu"].table),
        initial=initial,
        current=build(CurrentModel, toml["current"].given()) if "current" in toml else None,
        notes=notes,
    )


def _read_tables(toml: MissionToml, bare: dict[str, Any]) -> tuple[dict[str, Table], list[str]]:
    tables: dict[str, Table] = {}
    notes: list[str] = []
    read = read_table if toml.order is Order.TIME else read_arrival_table
    for one in TABLES:
        section = one.section
        if section not in toml:
            continue
        label = toml[section].text("file")
        path = table_path(toml, section)
        if path is None:
            notes.append(f"{label}: there is no such file; going on without [{section}]")
            continue
        table = read(path, label, one.spec(bare[section]))
        notes += table.notes
        if len(table) or section in REQUIRED_SECTIONS:
            tables[section] = table
        else:
            notes.append(f"{label}: the table has no rows; going on without [{section}]")
    return tables, notes


def _lists_without_section(toml: MissionToml) -> list[str]:
    """Note the beacons of ranges that there are none of."""

    def is_idle(one: Instrument, name: str) -> bool:
        return bool(toml.lists[name]) and one.section not in toml

    return [
        f"{toml.file} [[{name}]]: there is no [{one.section}]; going on without {name}s"
        for one in TABLES
        for name in one.lists
        if is_idle(one, name)
    ]


def _standstills(toml: MissionToml, imu: Table) -> list[Standstill]:
    first_s, last_s = float(imu.time_s[0]), float(imu.time_s[-1])
    found = []
    for settings in toml.lists["standstill"]:
        still = standstill(settings)
        check_during(still, settings, first_s=first_s, last_s=last_s, label=imu.label)
        found.append(still)
    return found
