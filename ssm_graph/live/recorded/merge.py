"""Inertial data and recordings of other instruments, on one clock, as a mission folder."""

from __future__ import annotations

import math
import os
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import replace
from fnmatch import fnmatch
from heapq import merge
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from ssm_graph.base.errors import ConfigError, DataError
from ssm_graph.base.frames import BodyAxes
from ssm_graph.base.progress import told
from ssm_graph.io.ardupilot.convert import (
    ArduPilotOptions,
    is_ardupilot,
    logs_of_ardupilot,
)
from ssm_graph.io.columns.convert import logs_of_columns
from ssm_graph.io.columns.map_file import ColumnMap
from ssm_graph.io.columns.sources import ENDINGS
from ssm_graph.io.mission_folder.folder import read_mission
from ssm_graph.io.mission_folder.toml import TOML_NAME
from ssm_graph.io.raw_log.log import RawLog
from ssm_graph.io.tables.files import read_table
from ssm_graph.live.recorded.log import Recorded, read_recorded
from ssm_graph.live.recorded.turns import clock_offset
from ssm_graph.mission.mission import Mission, Reference
from ssm_graph.mission.vehicle import Vehicle
from ssm_graph.sensors.compass import HeadingReading
from ssm_graph.sensors.dvl import Ping
from ssm_graph.sensors.imu import IMU, ImuLog, ImuSample
from ssm_graph.sensors.instrument import read_columns
from ssm_graph.sensors.messages import Message
from ssm_graph.sensors.registry import BY_LOG, BY_MESSAGE

TABLES: Final = (".csv", ".parquet")


class Merged(NamedTuple):
    """A mission that was written, and what was assumed."""

    mission: Mission
    notes: tuple[str, ...]


def merge_recordings(
    logs: Sequence[Path],
    out: Path,
    *,
    vehicle: Vehicle,
    offset_s: float | None = None,
    ardupilot: ArduPilotOptions | None = None,
) -> Merged:
    """Write a mission folder of one file of inertial data and recordings of other instruments.

    Each recording is moved onto the clock of the inertial data by ``offset_s``, s, or by the turns
    that its headings show, where it has any.

    Raises :class:`ConfigError`: not one file of inertial data. Raises :class:`DataError`: a file
    cannot be read, or nothing tells how its clock stands to that of the inertial data.

    Parameters
    ----------
    logs : one table with the columns of ``imu.csv`` or log of ArduPilot, whose depths and fixes
        count, too; the others as :func:`read_recorded` reads.
    out : folder, made if it does not exist.
    vehicle : of which the mission is.
    offset_s : what is to be added to the times of the recordings, s; None to find it.
    ardupilot : water and its surface, of a log of ArduPilot.
    """
    own = [log for log in logs if _is_inertial(log) or is_ardupilot(log)]
    if len(own) != 1:
        raise ConfigError(
            "expected one table with the columns of imu.csv, or one log of ArduPilot, among the "
            f"files, got {len(own)}: {', '.join(map(str, logs))}"
        )
    recordings: dict[Path, Recorded] = {}
    for log in logs:
        if log is own[0]:
            continue
        found = read_recorded(log)
        if found is None:
            raise DataError(f"{log}: neither inertial data nor a recording that is read")
        recordings[log] = found
    if not is_ardupilot(own[0]):
        imu = _inertial(own[0], vehicle)
        return _joined([imu], recordings, out, vehicle=vehicle, offset_s=offset_s)
    has_pings = any(isinstance(m, Ping) for one in recordings.values() for m in one.messages)
    held = logs_of_ardupilot(own[0], vehicle=vehicle, options=ardupilot, with_dvl=not has_pings)
    made = _joined(held.logs, recordings, out, vehicle=vehicle, offset_s=offset_s)
    return Merged(made.mission, (*held.notes, *made.notes))


def merge_columns(
    files: Sequence[Path],
    column_map: ColumnMap,
    out: Path,
    *,
    vehicle: Vehicle,
    offset_s: float | None = None,
) -> Merged | None:
    """Write a mission folder of tables of any columns and recordings of other instruments.

    A recording is a file that no section of the map names, of a maker's format. Without any this
    returns None and writes nothing: the tables are all there is.

    Raises :class:`ConfigError` and :class:`DataError` as :func:`merge_recordings` and
    :func:`logs_of_columns` do, and for a map with a reference.

    Parameters
    ----------
    files : the tables and the recordings.
    column_map : what the columns of the tables are.
    out, vehicle, offset_s : as of :func:`merge_recordings`.
    """
    found = {file: read_recorded(file) for file in not_tables(files, column_map)}
    recordings = {file: one for file, one in found.items() if one is not None}
    if not recordings:
        return None
    tables = [file for file in files if file not in recordings]
    mapped = logs_of_columns(tables, column_map, vehicle)
    if any(isinstance(log, Reference) for log in mapped.logs):
        raise ConfigError(
            f"{column_map.path.name} [reference]: not beside recordings: convert without it, and "
            "put the table and its section of mission.toml into the folder"
        )
    made = _joined(mapped.logs, recordings, out, vehicle=vehicle, offset_s=offset_s)
    return Merged(made.mission, (*mapped.notes, *made.notes))


def not_tables(files: Sequence[Path], column_map: ColumnMap) -> list[Path]:
    """Return the files beside the tables of a map that may be recordings.

    No section names them; of a map with a DVL they have the ending of no table either.
    """
    has_dvl = "dvl" in {section.name for section in column_map.sections}
    patterns = [section.file for section in column_map.sections if section.file]
    return [
        file
        for file in files
        if not any(fnmatch(file.name, pattern) for pattern in patterns)
        and not (has_dvl and file.suffix.lower() in ENDINGS)
    ]


def _joined(
    logs: Sequence[Any],
    recordings: Mapping[Path, Recorded],
    out: Path,
    *,
    vehicle: Vehicle,
    offset_s: float | None,
) -> Merged:
    """Write the mission of logs, the IMU's among them, and recordings moved onto its clock."""
    imu = next(log for log in logs if isinstance(log, ImuLog))
    notes: list[str] = []
    streams = [list(BY_LOG[type(log)].messages_of(log)) for log in logs]
    has = {BY_LOG[type(log)].section for log in logs}
    known = {BY_LOG[kind].section for kind in vehicle.bare_logs} - has
    for log, found in recordings.items():
        shift_s, said = _shift(log, found.messages, imu, offset_s)
        notes += [*(f"{log.name}: {note}" for note in found.told), said]
        notes += [
            f"{log.name}: [{name}] left out: the vehicle has one, of which the other log tells."
            for name in sorted(has & {BY_MESSAGE[type(one)].section for one in found.messages})
        ]
        for stream in _on_clock(found.messages, shift_s, known):
            kept = _beside(stream, streams[len(logs) :])
            streams.append(kept)
            if len(kept) < len(stream):
                notes.append(
                    f"{log.name}: {len(stream) - len(kept)} of {len(stream)} rows of "
                    f"[{BY_MESSAGE[type(stream[0])].section}] left out: the vehicle has one, of "
                    "which a recording given before tells at that time."
                )
    mission = _written(streams, out, vehicle)
    return Merged(mission, (*notes, *mission.notes))


def _beside(stream: list[Message], others: Sequence[list[Message]]) -> list[Message]:
    """Return messages of one instrument without those amid others of its kind."""
    kind = type(stream[0])
    alike = (one for one in others if one and isinstance(one[0], kind))
    spans = [(one[0].time_s, one[-1].time_s) for one in alike]
    return [m for m in stream if not any(begin <= m.time_s <= end for begin, end in spans)]


def mission_of_recording(log: Path, found: Recorded, out: Path, *, vehicle: Vehicle) -> Merged:
    """Write a mission folder of one recording that holds inertial data as well.

    Raises :class:`ConfigError` where it does not.
    """
    if not any(isinstance(message, ImuSample) for message in found.messages):
        raise ConfigError(
            f"{log}: --vehicle makes a mission of a recording with inertial data, and this has "
            "none: give that of an IMU, a table or a log of ArduPilot, beside it"
        )
    known = {BY_LOG[kind].section for kind in vehicle.bare_logs}
    mission = _written(_on_clock(found.messages, 0.0, known), out, vehicle)
    return Merged(mission, (*found.told, *mission.notes))


def _written(streams: Sequence[Sequence[Message]], out: Path, vehicle: Vehicle) -> Mission:
    """Write a mission folder, whole or not at all, and return what is in it."""
    part = out.with_name(f".{out.name}.part-{os.getpid()}")
    ordered = merge(*streams, key=lambda message: message.time_s)
    try:
        with RawLog(part, vehicle) as raw:
            for message in told(ordered, sum(map(len, streams))):
                raw.append(message)
        mission = read_mission(part)
        out.mkdir(parents=True, exist_ok=True)
        (out / TOML_NAME).unlink(missing_ok=True)
        for file in sorted(part.iterdir(), key=lambda file: file.name == TOML_NAME):
            file.replace(out / file.name)
        return mission
    finally:
        shutil.rmtree(part, ignore_errors=True)


def _is_inertial(log: Path) -> bool:
    if log.suffix not in TABLES or not log.is_file():
        return False
    with log.open("rb") as stream:
        head = stream.readline()
    return log.suffix == ".parquet" or b"gyro_x_rad_per_s" in head


def _inertial(log: Path, vehicle: Vehicle) -> ImuLog:
    """Return the samples of a table, in axes forward-right-down as a vehicle's messages are."""
    bare = vehicle.bare_logs[ImuLog]
    table = read_table(log, log.name, IMU.spec(bare))
    IMU.check(table, bare, BodyAxes.FRD)
    start_s = float(table.time_s[0] - np.median(np.diff(table.time_s)))
    readings = read_columns(table, IMU.columns, BodyAxes.FRD)
    found: ImuLog = replace(bare, start_s=start_s, time_s=table.time_s, **readings)
    return found


def _shift(
    log: Path, messages: Sequence[Message], imu: ImuLog, stated_s: float | None
) -> tuple[float, str]:
    """Return what is to be added to the times of a recording, s, and how that was found."""
    if stated_s is not None:
        return stated_s, f"{log.name}: {stated_s:+g} s as stated, onto the clock of the IMU."
    turns = [one for one in messages if isinstance(one, HeadingReading)]
    if len(turns) > 1:
        time_s = np.array([one.time_s for one in turns])
        try:
            found = clock_offset(imu, time_s, np.array([one.heading for one in turns]))
        except DataError as error:
            raise DataError(f"{log}: {error}") from None
        return found.seconds, (
            f"{log.name}: {found.seconds:+.3f} s onto the clock of the IMU, to "
            f"{found.sigma_s:.3f} s, by {found.overlap_s:.0f} s of turns alike to "
            f"{found.correlation:.3f}; what is left of it is estimated where the vehicle states "
            "time_offset_sigma_s."
        )
    first_s, last_s = messages[0].time_s, messages[-1].time_s
    if first_s < imu.time_s[-1] and last_s > imu.start_s:
        return 0.0, f"{log.name}: it shows no turns; its times are taken for those of the IMU."
    raise DataError(
        f"{log}: its times, {first_s:.3f} to {last_s:.3f} s, are not those of the IMU, "
        f"{imu.start_s:.3f} to {imu.time_s[-1]:.3f} s, and it has no headings whose turns would "
        "tell how far they are apart; state  --clock-offset SECONDS"
    )


def _on_clock(messages: Sequence[Message], shift_s: float, known: set[str]) -> list[list[Message]]:
    """Return the messages of each instrument that the vehicle has, moved."""
    found: dict[type[Message], list[Message]] = {}
    for message in messages:
        if BY_MESSAGE[type(message)].section in known and math.isfinite(message.time_s):
            moved = replace(message, time_s=message.time_s + shift_s)
            found.setdefault(type(message), []).append(moved)
    return list(found.values())
