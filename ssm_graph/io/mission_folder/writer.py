"""Writing a mission folder: the inverse of :func:`.reader.read_mission`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import tomli_w

from ssm_graph.base.frames import BodyAxes
from ssm_graph.base.frozen import Array
from ssm_graph.base.settings import written
from ssm_graph.io.mission_folder.toml import FORMAT, INITIAL_KEYS, REFERENCE, TOML_NAME
from ssm_graph.io.tables.append_file import write_through
from ssm_graph.io.tables.files import TableFormat, write_table
from ssm_graph.mission.mission import Mission
from ssm_graph.mission.vehicle import Vehicle
from ssm_graph.sensors.current import CURRENT_KEYS
from ssm_graph.sensors.place import PLACE_KEYS
from ssm_graph.sensors.registry import INSTRUMENTS
from ssm_graph.sensors.standstill import STANDSTILL_KEYS, Standstill


def write_mission(
    folder: Path | str, mission: Mission, *, table_format: TableFormat = TableFormat.CSV
) -> None:
    """Write ``mission`` as a folder that :func:`read_mission` turns into the same values.

    Body axes are FRD and IMU stamps name the interval's end. Every number is written with all its
    digits; angles may differ by rounding. An interrupted write leaves the old mission, or a folder
    without ``mission.toml``, never a mixture.

    The folder is made if it does not exist; files of the same names are replaced. The mission's
    notes are not written.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    settings = mission_settings(mission, table_format)
    parts = {}
    for section, columns in mission_tables(mission).items():
        path = folder / settings[section]["file"]
        parts[path] = path.with_name(f"{path.stem}.part{path.suffix}")
        write_table(parts[path], columns)
    toml_part = write_toml_part(folder, settings)
    (folder / TOML_NAME).unlink(missing_ok=True)
    for path, part in parts.items():
        part.replace(path)
    toml_part.replace(folder / TOML_NAME)


def write_toml_part(folder: Path, settings: dict[str, Any]) -> Path:
    """Write a ``mission.toml`` under another name, on the disk when this returns."""
    part = folder / f"{TOML_NAME}.part"
    write_through(part, tomli_w.dumps(settings).encode())
    return part


def mission_settings(mission: Mission, table_format: TableFormat) -> dict[str, Any]:
    """Return the content of ``mission.toml``."""
    suffix = table_format.value
    settings: dict[str, Any] = {
        "format": FORMAT,
        "name": mission.name,
        "frames": {"body": BodyAxes.FRD.value},
        "origin": written(mission.frame, PLACE_KEYS),
        **instrument_sections(mission.logs, suffix),
        **common_sections(mission),
    }
    stills = [written(still, STANDSTILL_KEYS) for still in mission.aids.all(Standstill)]
    if stills:
        settings["standstill"] = stills
    if mission.reference is not None:
        settings["reference"] = {"file": f"reference{suffix}"}
    return settings


def common_sections(source: Mission | Vehicle) -> dict[str, Any]:
    """Return the sections of a mission or a vehicle that are of no instrument."""
    sections = {}
    if source.current is not None:
        sections["current"] = written(source.current, CURRENT_KEYS)
    if source.initial is not None:
        sections["initial"] = written(source.initial, INITIAL_KEYS)
    return sections


def instrument_sections(logs: Mapping[type, Any], suffix: str) -> dict[str, Any]:
    """Return the sections that describe instruments; ``suffix`` is that of their tables' names."""
    sections: dict[str, Any] = {}
    for one in INSTRUMENTS:
        if one.log in logs:
            settings = one.settings_of(logs[one.log])
            sections[one.section] = {"file": f"{one.section}{suffix}", **settings}
            sections |= one.lists_of(logs[one.log])
    return sections


def mission_tables(mission: Mission) -> dict[str, dict[str, Array]]:
    """Return the columns of every table."""
    logs = mission.logs
    tables = {one.section: one.table_of(logs[one.log]) for one in INSTRUMENTS if one.log in logs}
    if mission.reference is not None:
        tables["reference"] = REFERENCE.table_of(mission.reference)
    return tables
