"""A mission folder: read into one :class:`~ssm_graph.mission.mission.Mission`, and written again.

What a calibration found is written as lines that can be put into ``mission.toml``.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
import tomli_w

from ssm_graph.base.frames import R_FRD, BodyAxes, matrix_to_frd
from ssm_graph.base.frozen import Array
from ssm_graph.base.settings import build, owner_of, written
from ssm_graph.base.tables import Order, Table
from ssm_graph.io.mission_folder.assembly import Part, assembled, first_frame
from ssm_graph.io.mission_folder.toml import (
    FORMAT,
    INITIAL_KEYS,
    LOCAL_KEYS,
    OF_PLACES,
    REFERENCE,
    REQUIRED_SECTIONS,
    TABLES,
    TOML_NAME,
    MissionToml,
    read_mission_toml,
    table_path,
)
from ssm_graph.io.raw_log.kinds import RowKind
from ssm_graph.io.raw_log.waiting import WAITING, left_waiting
from ssm_graph.io.seabed.section import map_settings, with_map, write_map
from ssm_graph.io.tables.append_file import write_through
from ssm_graph.io.tables.files import TableFormat, read_arrival_table, read_table, write_table
from ssm_graph.mission.estimate import CalibratedValue, Calibration, Determined
from ssm_graph.mission.mission import LocalStart, Mission
from ssm_graph.mission.vehicle import Vehicle
from ssm_graph.sensors.acoustic import RangeLog
from ssm_graph.sensors.current import CURRENT_KEYS, CurrentModel
from ssm_graph.sensors.instrument import Calibrated, Instrument
from ssm_graph.sensors.place import PLACE_KEYS
from ssm_graph.sensors.registry import INSTRUMENTS
from ssm_graph.sensors.seabed import TerrainLog
from ssm_graph.sensors.standstill import STANDSTILL_KEYS, Standstill, check_during, standstill

__all__ = ["TableFormat", "read_mission", "write_mission"]

CALIBRATION_NAME: Final = "calibration.toml"


def read_mission(folder: Path | str) -> Mission:
    """Read and check a mission folder.

    Raises :class:`ConfigError` for a key of ``mission.toml`` that is missing, unknown or out of
    range. Raises :class:`DataError` for a table that is damaged, or whose numbers cannot be what
    the format says they are. Raises :class:`MissingExtraError` for a Parquet table where pyarrow is
    not installed.

    Parameters
    ----------
    folder : the folder that holds ``mission.toml`` and the tables it names.

    Returns
    -------
    Mission
        In SI units, radians and body axes forward-right-down; ``notes`` holds, one sentence each,
        what was noticed and is no error.
    """
    toml = read_mission_toml(Path(folder))
    bare = {one.section: toml.bare(one) for one in TABLES if one.section in toml}
    tables, notes = _read_tables(toml, bare)
    notes = [*toml.notes, *notes]
    parts: dict[str, Part] = {}
    for one in TABLES:
        if one.section in tables:
            table, own = tables[one.section], bare[one.section]
            notes += one.check(table, own, toml.body)
            log = one.filled(table, own, toml[one.section], toml.body)
            parts[one.section] = Part(log, table)
    notes += _lists_without_section(toml)
    initial, local = toml.initial(), toml.local()
    stated = toml.frame("origin") if local is None else local.frame
    frame = first_frame(stated, parts, initial)
    if frame is None:
        raise toml.fault_of_no_place()
    mission = assembled(
        toml.name,
        parts,
        frame=frame,
        has_origin=stated is not None,
        local=local,
        standstills=_standstills(toml, parts["imu"].table),
        initial=initial,
        current=build(CurrentModel, toml["current"].given()) if "current" in toml else None,
        notes=notes,
    )
    return with_map(mission, toml["map"], toml.folder) if "map" in toml else mission


def read_log(toml: MissionToml, one: Instrument) -> Any:
    """Read one log of a mission alone; None where it has none; raises as :func:`read_mission`."""
    if one.section not in toml:
        return None
    bare = {one.section: toml.bare(one)}
    table = _read_tables(toml, bare)[0].get(one.section)
    if table is None:
        return None
    return one.filled(table, bare[one.section], toml[one.section], toml.body)


def _read_tables(toml: MissionToml, bare: dict[str, Any]) -> tuple[dict[str, Table], list[str]]:
    tables: dict[str, Table] = {}
    waited, notes = _waited(toml, bare)
    for one in TABLES:
        section = one.section
        if section not in bare:
            continue
        label = toml[section].text("file")
        path = table_path(toml, section)
        if path is None:
            notes.append(f"{label}: there is no such file; going on without [{section}]")
            continue
        spec = one.spec(bare[section])
        if toml.order is Order.TIME:
            table = read_table(path, label, spec)
        else:
            table = read_arrival_table(path, label, spec, waited.get(section, ()))
        notes += table.notes
        if len(table) or section in REQUIRED_SECTIONS:
            tables[section] = table
        else:
            notes.append(f"{label}: the table has no rows; going on without [{section}]")
    return tables, notes


def _waited(
    toml: MissionToml, bare: dict[str, Any]
) -> tuple[dict[str, tuple[str, ...]], list[str]]:
    """Return by section the lines of a live run's log that had no row yet, and a note on them."""
    if toml.order is Order.TIME:
        return {}, []
    live = [one for one in TABLES if one.section in bare and one.message is not None]
    kinds = {RowKind(one, bare[one.section]): one.section for one in live}
    rows: dict[str, tuple[str, ...]] = {}
    for kind, record in left_waiting(toml.folder, kinds):
        rows[kinds[kind]] = (*rows.get(kinds[kind], ()), record.decode())
    counts = ", ".join(f"{len(lines)} of [{section}]" for section, lines in rows.items())
    said = f"{WAITING}: rows that waited for a place in their tables when the log was written last "
    said += "are read from there, at their likelier times"
    return rows, [f"{said}: {counts}"] if rows else []


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
    parts: dict[Path, Path] = {}
    try:
        for section, columns in mission_tables(mission).items():
            path = folder / settings[section]["file"]
            parts[path] = path.with_name(f"{path.stem}.part{path.suffix}")
            write_table(parts[path], columns)
        terrain = mission.aids.get(TerrainLog)
        if terrain is not None:
            write_map(folder, terrain)
        toml_part = write_toml_part(folder, settings)
    except BaseException:  # a full disk, or somebody who would not wait
        for part in (*parts.values(), folder / f"{TOML_NAME}.part"):
            part.unlink(missing_ok=True)
        raise
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
    settings = settings_of(mission, mission.logs, suffix)
    stills = [written(still, STANDSTILL_KEYS) for still in mission.aids.all(Standstill)]
    if stills:
        settings["standstill"] = stills
    terrain = mission.aids.get(TerrainLog)
    if terrain is not None:
        settings["map"] = map_settings(terrain)
    if mission.reference is not None:
        settings["reference"] = {"file": f"reference{suffix}"}
    return settings


def settings_of(
    source: Mission | Vehicle, logs: Mapping[type, Any], suffix: str, **more: str
) -> dict[str, Any]:
    """Return what a ``mission.toml`` says of a mission or vehicle and its instruments.

    ``suffix`` is that of the names of their tables; ``more`` are keys above all sections.
    """
    settings: dict[str, Any] = {"format": FORMAT, "name": source.name, **more}
    settings["frames"] = {"body": BodyAxes.FRD.value}
    if source.local is not None:
        settings["local"] = _local_settings(source.local)
    elif source.frame is not None:
        settings["origin"] = written(source.frame, PLACE_KEYS)
    for one in INSTRUMENTS:
        if source.local is not None and one.section in OF_PLACES:
            continue  # a receiver that a vehicle may have, where there is nothing to receive
        if one.log in logs:
            keys = one.settings_of(logs[one.log])
            settings[one.section] = {"file": f"{one.section}{suffix}", **keys}
            settings |= one.lists_of(logs[one.log])
    if source.current is not None:
        settings["current"] = written(source.current, CURRENT_KEYS)
    if source.initial is not None:
        settings["initial"] = written(source.initial, INITIAL_KEYS)
    return settings


def _local_settings(local: LocalStart) -> dict[str, Any]:
    """Return ``[local]``; a heading that is not known is no number."""
    keys = LOCAL_KEYS if local.is_heading_known else {"lat_deg": LOCAL_KEYS["lat_deg"]}
    return written(local, keys)


def mission_tables(mission: Mission) -> dict[str, dict[str, Array]]:
    """Return the columns of every table."""
    logs = mission.logs
    tables = {one.section: one.table_of(logs[one.log]) for one in INSTRUMENTS if one.log in logs}
    if mission.reference is not None:
        tables["reference"] = REFERENCE.table_of(mission.reference)
    return tables


def calibration_toml(
    mission: Mission, calibration: Calibration, *, axes: BodyAxes = BodyAxes.FRD
) -> str:
    """Return the lines of ``mission.toml`` that a calibration changes, with comments.

    What the mission did not determine stays as it is stated, and a comment says so. The prior
    sigmas for going on from here are comments as well: without them the values are exact.

    ``axes`` are the body axes of the file that the lines are for.
    """
    lines = [
        f"# Calibrated with mission {mission.name!r}. Put these values in the place of the stated",
        "# ones; the sigmas, made keys, let the next mission calibrate on from here.",
    ]
    found: dict[str, list[CalibratedValue]] = {}
    for value in calibration.values:
        found.setdefault(value.variable, []).append(value)
    for one in INSTRUMENTS:
        names = [name for name in one.calibrated if name in found]
        lines += ["", f"[{one.section}]"] if names else []
        for name in names:
            lines += _lines(one, one.calibrated[name], found[name], mission, axes)
    lines += _beacon_lines(mission, calibration)
    return "\n".join(lines) + "\n"


def _lines(
    one: Instrument,
    calibrated: Calibrated,
    values: list[CalibratedValue],
    mission: Mission,
    axes: BodyAxes,
) -> list[str]:
    sigmas = [value.sigma / value.unit for value in values]
    shown = ", ".join(f"{sigma:.2g}" for sigma in sigmas)
    if all(value.determined is Determined.RED for value in values):
        prior = values[0].prior_sigma / values[0].unit
        return [f"# {calibrated.key}: not determined, sigma {shown} of {prior:.2g} before"]
    log, key = mission.logs[one.log], one.keys[calibrated.key]
    stated = getattr(*owner_of(log, key.field)) if key.field else None
    off = np.array([value.value for value in values])
    total = calibrated.total(log, 0.0 if stated is None else stated, off)
    total = total @ R_FRD[axes] if key.is_body else total
    total = matrix_to_frd(total, axes) if key.is_body_matrix else total
    unsure = [v.label for v in values if v.determined is Determined.RED]
    remark = f"; not determined: {', '.join(unsure)}" if unsure else ""
    return [
        f"{calibrated.key} = {_number(total / key.unit)}  # sigma {shown}{remark}",
        f"# {calibrated.sigma_key} = {max(sigmas):.2g}",
    ]


def _number(total: Array) -> str:
    """Return a number, or a list of several, with the digits that a calibration can have."""
    digits: list[Any] = [float(f"{x:.7g}") + 0.0 for x in total]
    return str(digits[0] if len(digits) == 1 else digits)


def _beacon_lines(mission: Mission, calibration: Calibration) -> list[str]:
    """Return a section ``[[beacon]]`` for each whose place was estimated."""
    ranges, lines = mission.aids.get(RangeLog), []
    for beacon in ranges.beacons if ranges is not None else ():
        found = [v for v in calibration.values if v.variable == f"beacon_{beacon.number}"]
        if not found:
            continue
        frame = mission.frame
        stated_n = frame.p_n_from_geodetic(beacon.lat, beacon.lon, beacon.height)
        off_enu = np.array([value.value for value in found])
        lat, lon, height = frame.geodetic_from_p_n(stated_n + frame.R_nl_at(stated_n) @ off_enu)
        sigmas = ", ".join(f"{value.sigma:.2g}" for value in found)
        unsure = [value.label for value in found if value.determined is Determined.RED]
        remark = [f"# not determined: {', '.join(unsure)}"] if unsure else []
        lines += [
            "",
            "[[beacon]]",
            *remark,
            f"number = {beacon.number}",
            f"lat_deg = {np.degrees(lat):.9f}",
            f"lon_deg = {np.degrees(lon):.9f}",
            f"height_m = {height:.3f}",
            f"# position_sigma_m = [{sigmas}]",
        ]
    return lines
