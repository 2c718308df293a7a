"""What ``ssm-graph convert`` does once its options are read."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Collection, Iterable
from dataclasses import replace
from functools import partial
from pathlib import Path

from rich.console import Console

from ssm_graph.base.errors import ConfigError, DataError
from ssm_graph.cli.terminal import say
from ssm_graph.io.ardupilot.convert import (
    ArduPilotOptions,
    convert_ardupilot,
    is_ardupilot,
)
from ssm_graph.io.blueye.convert import convert_blueye
from ssm_graph.io.columns.convert import convert_columns
from ssm_graph.io.columns.map_file import read_map
from ssm_graph.io.file_kind import check_is_file, is_mcap, kind_of
from ssm_graph.io.mission_folder.folder import write_mission
from ssm_graph.io.mission_folder.vehicle import instrument_notes, read_vehicle
from ssm_graph.io.results.place import check_is_free
from ssm_graph.io.ros.convert import convert_rosbag
from ssm_graph.io.ros.log import is_rosbag
from ssm_graph.io.ros.messages import BeamSign, RosOptions
from ssm_graph.live.recorded.log import Recorded, read_recorded, write_tables
from ssm_graph.live.recorded.merge import (
    Merged,
    merge_columns,
    merge_recordings,
    mission_of_recording,
    not_tables,
)
from ssm_graph.mission.mission import Mission
from ssm_graph.report.terminal.progress import ProgressDisplay
from ssm_graph.sensors.dvl import Ping
from ssm_graph.sensors.messages import Message

ROS_OPTIONS = (
    *("vehicle", "topic", "body", "water_density", "atmosphere", "surface_height"),
    "beams_against",
)
ARDUPILOT_OPTIONS = ("vehicle", "water_density", "surface_height")


def convert(arguments: argparse.Namespace, console: Console, errors: Console) -> bool:
    """Convert and write."""
    write = partial(_write, arguments=arguments, console=console, errors=errors)
    check_is_free(arguments.out, may_overwrite=arguments.overwrite)
    for log in arguments.log:
        check_is_file(log)
        if log.exists() and arguments.out.resolve() == log.resolve():
            raise ConfigError(f"--out: expected another folder than that of LOG: {arguments.out}")
    if arguments.map is not None:
        return _from_tables(arguments, write, console, errors)
    if len(arguments.log) > 1:
        return _merge(arguments, console, errors)
    (log,) = arguments.log
    if arguments.clock_offset is not None:
        raise ConfigError(f"--clock-offset is for several logs, got {log} alone")
    if is_rosbag(log):
        return write(lambda: _from_rosbag(log, arguments))
    if log.is_file() and is_ardupilot(log):
        return write(lambda: _from_ardupilot(log, arguments))
    _refuse_ros_options(log, arguments, but=("vehicle", "beams_against"))
    if not log.exists():
        raise DataError(f"{log}: there is no such file or folder")
    if is_mcap(log):
        _refuse_ros_options(log, arguments)
        return write(lambda: convert_blueye(log))
    with ProgressDisplay(errors) as show:
        show.stage(f"reading {log}")
        recorded = None if log.is_dir() else read_recorded(log)
    if recorded is None:
        raise DataError(f"{log}: {kind_of(log)}")
    if arguments.beams_against:
        recorded = replace(recorded, messages=tuple(map(_turned, recorded.messages)))
    if arguments.vehicle is None:
        return _write_tables(recorded, arguments.out, console)
    vehicle = read_vehicle(arguments.vehicle)
    made = mission_of_recording(log, recorded, arguments.out, vehicle=vehicle)
    return _said(made, arguments, console)


def _refuse_ros_options(
    log: Path, arguments: argparse.Namespace, *, but: Collection[str] = ()
) -> None:
    for name in ROS_OPTIONS:
        if name not in but and getattr(arguments, name) is not None:
            too = name in ARDUPILOT_OPTIONS
            raise ConfigError(
                f"--{name.replace('_', '-')} is for ROS bags{' and logs of ArduPilot' * too}, and "
                f"{log} is none: {kind_of(log)}"
            )


def _merge(arguments: argparse.Namespace, console: Console, errors: Console) -> bool:
    """Write the mission of inertial data and recordings of other instruments."""
    own = ARDUPILOT_OPTIONS if any(map(is_ardupilot, arguments.log)) else ("vehicle",)
    _refuse_ros_options(arguments.log[0], arguments, but=own)
    if arguments.vehicle is None:
        raise ConfigError("several logs: expected  --vehicle FILE  with noise, mounting and place")
    vehicle, offset_s = read_vehicle(arguments.vehicle), arguments.clock_offset
    for log in arguments.log:
        if not log.is_file():
            raise DataError(f"{log}: expected a file, of an IMU or of one instrument")
    with ProgressDisplay(errors) as show:
        show.stage("reading and joining the logs")
        found = merge_recordings(
            arguments.log,
            arguments.out,
            vehicle=vehicle,
            offset_s=offset_s,
            ardupilot=_ardupilot_options(arguments),
        )
    return _said(found, arguments, console)


def _said(found: Merged, arguments: argparse.Namespace, console: Console) -> bool:
    _say_mission(found.mission, arguments, console)
    _say_notes(found.notes, console)
    return True


def _from_ardupilot(log: Path, arguments: argparse.Namespace) -> Mission:
    _refuse_ros_options(log, arguments, but=ARDUPILOT_OPTIONS)
    vehicle = None if arguments.vehicle is None else read_vehicle(arguments.vehicle)
    return convert_ardupilot(log, vehicle=vehicle, options=_ardupilot_options(arguments))


def _ardupilot_options(arguments: argparse.Namespace) -> ArduPilotOptions:
    return ArduPilotOptions(_density(arguments), arguments.surface_height)


def _density(arguments: argparse.Namespace) -> float | None:
    density: float | None = arguments.water_density
    if density is not None and density <= 0.0:
        raise ConfigError(f"--water-density: expected a number above zero, got {density:g}")
    return density


def _vehicle_path(arguments: argparse.Namespace) -> Path | None:
    """Return the file of the vehicle: as an option says, else as the map does."""
    stated: Path | None = arguments.vehicle
    if stated is not None or arguments.map is None:
        return stated
    return read_map(arguments.map).vehicle


def _from_tables(
    arguments: argparse.Namespace,
    write: Callable[[Callable[[], Mission]], bool],
    console: Console,
    errors: Console,
) -> bool:
    """Write the mission of tables of any columns, and of recordings beside them."""
    _refuse_ros_options(arguments.log[0], arguments, but=("vehicle",))
    column_map = read_map(arguments.map)
    path = _vehicle_path(arguments)
    if path is None:
        raise ConfigError(
            f'{arguments.map}: expected vehicle = "vehicle.toml", or  --vehicle FILE, with noise, '
            "mounting and place"
        )
    for log in arguments.log:
        if not log.is_file():
            raise DataError(f"{log}: expected a file with columns")
    vehicle = read_vehicle(path)
    if not_tables(arguments.log, column_map):
        with ProgressDisplay(errors) as show:
            show.stage("reading and joining the logs")
            offset_s, out = arguments.clock_offset, arguments.out
            merged = merge_columns(
                arguments.log, column_map, out, vehicle=vehicle, offset_s=offset_s
            )
        if merged is not None:
            return _said(merged, arguments, console)
    if arguments.clock_offset is not None:
        raise ConfigError("--clock-offset: of tables with a map, time has the key offset_s")
    return write(lambda: convert_columns(arguments.log, column_map, vehicle, name=vehicle.name))


def _write(
    read: Callable[[], Mission],
    *,
    arguments: argparse.Namespace,
    console: Console,
    errors: Console,
) -> bool:
    with ProgressDisplay(errors) as show:
        show.stage(f"reading {', '.join(map(str, arguments.log))}")
        mission = read()
        show.stage("writing the mission")
        write_mission(arguments.out, mission, table_format=arguments.format)
    _say_mission(mission, arguments, console)
    _say_notes(mission.notes, console)
    return True


def _say_mission(mission: Mission, arguments: argparse.Namespace, console: Console) -> None:
    n_fixes = len(mission.gnss.time_s) if mission.gnss is not None else 0
    span_s = mission.imu.time_s[-1] - mission.imu.start_s
    say(
        console,
        f"{arguments.out}: {span_s:.1f} s, {len(mission.imu.time_s)} inertial samples, "
        f"{len(mission.dvl.time_s)} pings, {n_fixes} GNSS fixes",
    )
    path = _vehicle_path(arguments)
    if path is not None:
        _say_notes(instrument_notes(path), console)


def _turned(message: Message) -> Message:
    """Return a ping whose speeds count the other way."""
    if not isinstance(message, Ping):
        return message
    return replace(message, speed=tuple(-speed for speed in message.speed))


def _write_tables(recorded: Recorded, out: Path, console: Console) -> bool:
    written = write_tables(out, recorded.messages)
    rows = ", ".join(f"{name} with {count} rows" for name, count in written.items())
    is_whole = "imu.csv" in written and "dvl.csv" in written
    lacking = (
        "mission.toml beside them makes"
        if is_whole
        else "imu.csv and mission.toml beside them make"
    )
    say(console, f"{out}: {rows}; {lacking} a mission")
    _say_notes(recorded.told, console)
    return True


def _say_notes(notes: Iterable[str], console: Console) -> None:
    for note in notes:
        console.print(
            f"note: {note}", style="yellow", markup=False, highlight=False, soft_wrap=True
        )


def _from_rosbag(log: Path, arguments: argparse.Namespace) -> Mission:
    defaults = RosOptions()
    density, atmosphere = _density(arguments), arguments.atmosphere
    against = bool(arguments.beams_against)
    options = RosOptions(
        body=arguments.body or defaults.body,
        beam_sign=BeamSign.AGAINST if against else BeamSign.ALONG,
        water_density=defaults.water_density if density is None else density,
        atmosphere=defaults.atmosphere if atmosphere is None else atmosphere,
        surface_height=arguments.surface_height,
    )
    topics: dict[str, list[str]] = {}
    for role, name in arguments.topic or ():
        topics.setdefault(role, []).append(name)
    vehicle = None if arguments.vehicle is None else read_vehicle(arguments.vehicle)
    return convert_rosbag(log, vehicle=vehicle, topics=topics, options=options)
