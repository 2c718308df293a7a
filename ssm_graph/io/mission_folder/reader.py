"""Reading a mission folder into one frozen :class:`~ssm_graph.mission.mission.Mission`."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from ssm_graph.base.earth import LocalFrame
from ssm_graph.base.frames import to_frd
from ssm_graph.io.mission_folder.aid_reading import read_aids
from ssm_graph.io.mission_folder.arrival_tables import read_arrival_table
from ssm_graph.io.mission_folder.checks.cross import check_mission
from ssm_graph.io.mission_folder.checks.tables import check_tables
from ssm_graph.io.mission_folder.instruments import (
    current_model,
    depth_calibration,
    dvl_mount,
    frame_at,
    gnss_calibration,
    imu_noise,
    initial_state,
    lever_arm_b,
    radians_wrapped,
    stated_frame,
)
from ssm_graph.io.mission_folder.keys import (
    ACCEL,
    ATTITUDE,
    GYRO,
    RANGE,
    SPEED,
    SPEED_SIGMA,
    TABLES,
    VELOCITY,
    WATER_TRACK,
)
from ssm_graph.io.mission_folder.toml import MissionToml, read_mission_toml, table_path
from ssm_graph.io.mission_folder.units import interval_ends
from ssm_graph.io.mission_folder.writer import write_mission
from ssm_graph.io.tables.table import (
    POSITION,
    POSITION_SIGMA,
    Order,
    Table,
    TableFormat,
    read_table,
)
from ssm_graph.mission.mission import Mission, Reference
from ssm_graph.sensors.depth import DepthLog
from ssm_graph.sensors.dvl import DvlLog, counted_sigma
from ssm_graph.sensors.gnss import GnssLog
from ssm_graph.sensors.imu import ImuLog

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
    tables, notes = _read_tables(toml)
    notes += check_tables(tables, toml)
    aids, notes_of_aids = read_aids(tables, toml)
    notes += notes_of_aids
    mission = Mission(
        name=toml.name,
        frame=_frame(toml, tables),
        imu=_imu(tables["imu"], toml),
        dvl=_dvl(tables["dvl"], toml),
        depth=_depth(tables["depth"], toml) if "depth" in tables else None,
        gnss=_gnss(tables["gnss"], toml) if "gnss" in tables else None,
        aids=aids,
        initial=initial_state(toml["initial"]) if "initial" in toml else None,
        reference=_reference(tables["reference"]) if "reference" in tables else None,
        current=current_model(toml["current"]) if "current" in toml else None,
    )
    notes += check_mission(mission, tables, toml)
    return replace(mission, notes=tuple(notes))


def _read_tables(toml: MissionToml) -> tuple[dict[str, Table], list[str]]:
    tables: dict[str, Table] = {}
    notes: list[str] = []
    read = read_table if toml.order is Order.TIME else read_arrival_table
    for section, spec in TABLES.items():
        if section not in toml:
            continue
        label = toml[section].text("file")
        path = table_path(toml, section)
        if path is None:
            notes.append(f"{label}: there is no such file; going on without [{section}]")
            continue
        table = read(path, label, spec)
        notes += table.notes
        if len(table) or section in ("imu", "dvl"):
            tables[section] = table
        else:
            notes.append(f"{label}: the table has no rows; going on without [{section}]")
    return tables, notes


def _frame(toml: MissionToml, tables: dict[str, Table]) -> LocalFrame:
    frames = (
        stated_frame(toml, "origin"),
        _frame_of_first(tables, "gnss"),
        stated_frame(toml, "initial"),
        _frame_of_first(tables, "usbl"),
    )
    found = next((frame for frame in frames if frame is not None), None)
    if found is None:
        raise toml.fault_of_no_place()
    return found


def _frame_of_first(tables: dict[str, Table], section: str) -> LocalFrame | None:
    """Return the frame at the first position of a table."""
    if section not in tables:
        return None
    return frame_at(*(float(tables[section][key][0]) for key in POSITION))


def _imu(table: Table, toml: MissionToml) -> ImuLog:
    start_s, ends = interval_ends(table.time_s, toml.stamp)
    return ImuLog(
        start_s=start_s,
        noise=imu_noise(toml["imu"]),
        time_s=ends,
        gyro_b=to_frd(table.stack(GYRO), toml.body),
        accel_b=to_frd(table.stack(ACCEL), toml.body),
    )


def _dvl(table: Table, toml: MissionToml) -> DvlLog:
    settings = toml["dvl"]
    water = np.nan_to_num(table.stack([WATER_TRACK])[:, 0])
    return DvlLog(
        mount=dvl_mount(toml),
        time_s=table.time_s,
        speed=table.stack(SPEED),
        sigma=counted_sigma(
            table.stack(SPEED_SIGMA),
            water > 0.0,
            ground_sigma=settings.number("beam_noise_m_per_s"),
            water_sigma=settings.number("water_noise_m_per_s"),
        ),
        range_m=table.stack(RANGE) if any(name in table for name in RANGE) else None,
        water_track=water if water.any() else None,
    )


def _depth(table: Table, toml: MissionToml) -> DepthLog:
    calibration = depth_calibration(toml)
    return DepthLog(
        sigma=toml["depth"].number("noise_m"),
        time_s=table.time_s,
        depth=table["depth_m"] - calibration.offset,
        lever_arm_b=lever_arm_b(toml, "depth"),
        calibration=calibration,
    )


def _gnss(table: Table, toml: MissionToml) -> GnssLog:
    calibration = gnss_calibration(toml)
    return GnssLog(
        time_s=table.time_s - calibration.time_offset_s,
        lat=np.radians(table["lat_deg"]),
        lon=radians_wrapped(table["lon_deg"]),
        height=table["height_m"],
        sigma_enu=table.stack(POSITION_SIGMA),
        lever_arm_b=lever_arm_b(toml, "gnss"),
        calibration=calibration,
    )


def _reference(table: Table) -> Reference:
    return Reference(
        time_s=table.time_s,
        lat=np.radians(table["lat_deg"]),
        lon=radians_wrapped(table["lon_deg"]),
        height=table["height_m"],
        velocity_enu=table.stack(VELOCITY),
        roll_pitch_heading=np.radians(table.stack(ATTITUDE)),
    )
