"""Reading a mission folder into one frozen :class:`~ssm_graph.data.Mission`."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from ssm_graph.data import (
    Array,
    DepthLog,
    DvlLog,
    DvlMount,
    GnssLog,
    ImuLog,
    ImuNoise,
    InitialState,
    Mission,
    Reference,
)
from ssm_graph.earth import LocalFrame
from ssm_graph.errors import ConfigError
from ssm_graph.frames import wrap_to_pi
from ssm_graph.io.mission_checks import check_tables
from ssm_graph.io.mission_cross_checks import check_mission
from ssm_graph.io.mission_keys import (
    ACCEL,
    ATTITUDE,
    GYRO,
    POSITION_SIGMA,
    RANGE,
    SPEED,
    SPEED_SIGMA,
    TABLES,
    TOML_NAME,
    VELOCITY,
    Settings,
)
from ssm_graph.io.mission_toml import MissionToml, read_mission_toml, table_path
from ssm_graph.io.mission_units import (
    R_bd_from_rpy,
    beams_from_angles,
    interval_ends,
    to_frd,
    to_si,
)
from ssm_graph.io.mission_writer import write_mission
from ssm_graph.io.tables import Table, TableFormat, read_table

__all__ = ["TableFormat", "read_mission", "write_mission"]

_UNIT_TOLERANCE = 1e-3
_FLATTEST_GEOMETRY = 0.01


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
    mission = Mission(
        name=toml.name,
        frame=_frame(toml, tables),
        imu=_imu(tables["imu"], toml),
        dvl=_dvl(tables["dvl"], toml),
        depth=_depth(tables["depth"], toml) if "depth" in tables else None,
        gnss=_gnss(tables["gnss"], toml) if "gnss" in tables else None,
        initial=_initial(toml["initial"]) if "initial" in toml else None,
        reference=_reference(tables["reference"]) if "reference" in tables else None,
    )
    notes += check_mission(mission, tables, toml)
    return replace(mission, notes=tuple(notes))


def _read_tables(toml: MissionToml) -> tuple[dict[str, Table], list[str]]:
    tables: dict[str, Table] = {}
    notes: list[str] = []
    for section, spec in TABLES.items():
        if section not in toml:
            continue
        label = toml[section].text("file")
        path = table_path(toml, section)
        if path is None:
            notes.append(f"{label}: there is no such file; going on without [{section}]")
            continue
        table = read_table(path, label, spec)
        notes += table.notes
        if len(table) or section in ("imu", "dvl"):
            tables[section] = table
        else:
            notes.append(f"{label}: the table has no rows; going on without [{section}]")
    return tables, notes


def _frame(toml: MissionToml, tables: dict[str, Table]) -> LocalFrame:
    if "origin" in toml:
        place = [toml["origin"].number(key) for key in ("lat_deg", "lon_deg", "height_m")]
    elif "gnss" in tables:
        place = [float(tables["gnss"][key][0]) for key in ("lat_deg", "lon_deg", "height_m")]
    elif "initial" in toml:
        place = [toml["initial"].number(key) for key in ("lat_deg", "lon_deg", "height_m")]
    else:
        raise ConfigError(
            f"{TOML_NAME} [origin]: nothing says where on Earth the mission was; add [origin] with "
            "lat_deg, lon_deg and height_m, or a [gnss] table, or [initial]"
        )
    lat, lon, height = place
    return LocalFrame(float(np.radians(lat)), float(_radians_wrapped(lon)), height)


def _imu(table: Table, toml: MissionToml) -> ImuLog:
    settings = toml["imu"]
    start_s, ends = interval_ends(table.time_s, toml.stamp)
    return ImuLog(
        start_s=start_s,
        noise=ImuNoise(
            gyro_density=_si(settings, "gyro_random_walk_deg_per_sqrt_h"),
            accel_density=_si(settings, "accel_random_walk_ug_per_sqrt_hz"),
            gyro_bias_sigma=_si(settings, "gyro_bias_deg_per_h"),
            accel_bias_sigma=_si(settings, "accel_bias_ug"),
            gyro_bias_density=_si(settings, "gyro_bias_walk_deg_per_h_per_sqrt_h"),
            accel_bias_density=_si(settings, "accel_bias_walk_ug_per_sqrt_h"),
        ),
        time_s=ends,
        gyro_b=to_frd(table.stack(GYRO), toml.body),
        accel_b=to_frd(table.stack(ACCEL), toml.body),
    )


def _dvl(table: Table, toml: MissionToml) -> DvlLog:
    settings = toml["dvl"]
    sigma = table.stack(SPEED_SIGMA)
    return DvlLog(
        mount=DvlMount(
            beams_d=_beams(settings),
            R_bd=R_bd_from_rpy(np.radians(settings.array("mounting_rpy_deg"))),
            lever_arm_b=to_frd(settings.array("lever_arm_m"), toml.body),
            misalignment_sigma=_si(settings, "misalignment_sigma_deg"),
            scale_sigma=settings.number("scale_sigma"),
            time_offset_s=settings.number("time_offset_s"),
            time_offset_sigma_s=settings.number("time_offset_sigma_s"),
        ),
        time_s=table.time_s,
        speed=table.stack(SPEED),
        sigma=np.where(np.isnan(sigma), settings.number("beam_noise_m_per_s"), sigma),
        range_m=table.stack(RANGE) if any(name in table for name in RANGE) else None,
    )


def _beams(settings: Settings) -> Array:
    if "beam_vectors" not in settings:
        azimuth = np.radians(settings.array("beam_azimuth_deg"))
        beams = beams_from_angles(azimuth, float(np.radians(settings.number("beam_janus_deg"))))
    else:
        beams = settings.array("beam_vectors")
        length = np.linalg.norm(beams, axis=1)
        for row in np.flatnonzero(np.abs(length - 1.0) > _UNIT_TOLERANCE):
            raise settings.fault(
                "beam_vectors",
                f"expected unit vectors, got length {length[row]:.6g} for beam {row + 1}",
            )
        beams = beams / length[:, None]
    if np.linalg.svd(beams, compute_uv=False)[-1] < _FLATTEST_GEOMETRY:
        key = "beam_vectors" if "beam_vectors" in settings else "beam_azimuth_deg"
        raise settings.fault(
            key,
            "the beams lie in one plane and cannot measure a velocity; expected four different "
            "directions around the vertical",
        )
    return beams


def _depth(table: Table, toml: MissionToml) -> DepthLog:
    return DepthLog(
        sigma=toml["depth"].number("noise_m"),
        time_s=table.time_s,
        depth=table["depth_m"],
        lever_arm_b=to_frd(toml["depth"].array("lever_arm_m"), toml.body),
    )


def _gnss(table: Table, toml: MissionToml) -> GnssLog:
    return GnssLog(
        time_s=table.time_s,
        lat=np.radians(table["lat_deg"]),
        lon=_radians_wrapped(table["lon_deg"]),
        height=table["height_m"],
        sigma_enu=table.stack(POSITION_SIGMA),
        lever_arm_b=to_frd(toml["gnss"].array("lever_arm_m"), toml.body),
    )


def _initial(settings: Settings) -> InitialState:
    return InitialState(
        time_s=settings.number("time_s"),
        lat=_si(settings, "lat_deg"),
        lon=float(_radians_wrapped(settings.number("lon_deg"))),
        height=settings.number("height_m"),
        roll=_si(settings, "roll_deg"),
        pitch=_si(settings, "pitch_deg"),
        heading=_si(settings, "heading_deg"),
        velocity_enu=settings.array("vel_enu_m_per_s"),
        position_sigma_enu=settings.array("position_sigma_m"),
        velocity_sigma_enu=settings.array("velocity_sigma_m_per_s"),
        attitude_sigma=np.radians(settings.array("attitude_sigma_deg")),
    )


def _reference(table: Table) -> Reference:
    return Reference(
        time_s=table.time_s,
        lat=np.radians(table["lat_deg"]),
        lon=_radians_wrapped(table["lon_deg"]),
        height=table["height_m"],
        velocity_enu=table.stack(VELOCITY),
        roll_pitch_heading=np.radians(table.stack(ATTITUDE)),
    )


def _si(settings: Settings, key: str) -> float:
    return to_si(key, settings.number(key))


def _radians_wrapped(lon_deg: Array | float) -> Array:
    """Return a longitude in [-pi, pi], unchanged in all its digits where it lies there already."""
    lon = np.radians(lon_deg)
    return np.asarray(np.where(np.abs(lon) > np.pi, wrap_to_pi(lon), lon))
