"""Writing a mission folder: the inverse of :func:`.reader.read_mission`."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w

from ssm_graph.base.earth import LocalFrame
from ssm_graph.base.errors import DataError
from ssm_graph.base.frames import BodyAxes
from ssm_graph.base.frozen import Array
from ssm_graph.io.mission_folder.aid_writer import aid_settings, aid_tables
from ssm_graph.io.mission_folder.keys import (
    ACCEL,
    ATTITUDE,
    FORMAT,
    GYRO,
    RANGE,
    SPEED,
    SPEED_SIGMA,
    VELOCITY,
    WATER_TRACK,
    Stamp,
)
from ssm_graph.io.mission_folder.units import R_bd_from_rpy, from_si, rpy_from_R_bd
from ssm_graph.io.tables.settings import TOML_NAME
from ssm_graph.io.tables.table import POSITION_SIGMA, TIME, TableFormat, write_table
from ssm_graph.mission.mission import InitialState, Mission, Reference
from ssm_graph.sensors.current import CurrentModel
from ssm_graph.sensors.depth import DepthCalibration
from ssm_graph.sensors.drift import Drift
from ssm_graph.sensors.dvl import DvlLog, DvlMount
from ssm_graph.sensors.gnss import GnssCalibration
from ssm_graph.sensors.imu import ImuNoise

_NOISE_OF_EMPTY_LOG = 0.01


def write_mission(
    folder: Path | str, mission: Mission, *, table_format: TableFormat = TableFormat.CSV
) -> None:
    """Write ``mission`` as a folder that :func:`read_mission` turns into the same values.

    Body axes are FRD and IMU stamps name the interval's end. Every number is written with all its
    digits; angles may differ by rounding. An interrupted write leaves the old mission, or a folder
    without ``mission.toml``, never a mixture.

    Parameters
    ----------
    folder : made if it does not exist; files of the same names are replaced.
    mission : what to write; its notes are not.
    table_format : CSV or Parquet.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    settings = mission_settings(mission, table_format)
    parts = {}
    for section, columns in mission_tables(mission).items():
        path = folder / settings[section]["file"]
        parts[path] = path.with_name(f"{path.stem}.part{path.suffix}")
        write_table(parts[path], columns)
    toml_part = folder / f"{TOML_NAME}.part"
    with toml_part.open("wb") as stream:
        tomli_w.dump(settings, stream)
        stream.flush()
        os.fsync(stream.fileno())
    (folder / TOML_NAME).unlink(missing_ok=True)
    for path, part in parts.items():
        part.replace(path)
    toml_part.replace(folder / TOML_NAME)


def mission_settings(mission: Mission, table_format: TableFormat) -> dict[str, Any]:
    """Return the content of ``mission.toml``."""
    suffix = table_format.value
    settings: dict[str, Any] = {
        "format": FORMAT,
        "name": mission.name,
        "frames": {"body": BodyAxes.FRD.value},
        "origin": origin_settings(mission.frame),
        "imu": imu_settings(mission.imu.noise, suffix),
        "dvl": dvl_settings(mission.dvl.mount, nominal_sigma(mission.dvl), suffix),
    }
    if mission.dvl.is_water.any():
        settings["dvl"]["water_noise_m_per_s"] = sigma_off_water(mission.dvl)
    if mission.current is not None:
        settings["current"] = current_settings(mission.current)
    if mission.depth is not None:
        settings["depth"] = {
            "file": f"depth{suffix}",
            "noise_m": float(mission.depth.sigma),
            "lever_arm_m": mission.depth.lever_arm_b.tolist(),
            **depth_calibration_settings(mission.depth.calibration),
        }
    if mission.gnss is not None:
        settings["gnss"] = {
            "file": f"gnss{suffix}",
            "lever_arm_m": mission.gnss.lever_arm_b.tolist(),
            **gnss_calibration_settings(mission.gnss.calibration),
        }
    settings |= aid_settings(mission.aids, suffix)
    if mission.initial is not None:
        settings["initial"] = initial_settings(mission.initial)
    if mission.reference is not None:
        settings["reference"] = {"file": f"reference{suffix}"}
    return settings


def mission_tables(mission: Mission) -> dict[str, dict[str, Array]]:
    """Return the columns of every table."""
    imu, depth, gnss = mission.imu, mission.depth, mission.gnss
    tables = {
        "imu": {TIME: imu.time_s, **_split(GYRO, imu.gyro_b), **_split(ACCEL, imu.accel_b)},
        "dvl": _dvl_table(mission.dvl),
    }
    if depth is not None:
        read = depth.depth + depth.calibration.offset
        tables["depth"] = {TIME: depth.time_s, "depth_m": read}
    if gnss is not None:
        tables["gnss"] = {
            TIME: gnss.time_s + gnss.calibration.time_offset_s,
            "lat_deg": np.degrees(gnss.lat),
            "lon_deg": np.degrees(gnss.lon),
            "height_m": gnss.height,
            **_split(POSITION_SIGMA, gnss.sigma_enu),
        }
    tables |= aid_tables(mission.aids)
    if mission.reference is not None:
        tables["reference"] = _reference_table(mission.reference)
    return tables


def origin_settings(frame: LocalFrame) -> dict[str, Any]:
    """Return the content of ``[origin]``."""
    return {**_scaled(lat_deg=frame.lat, lon_deg=frame.lon), "height_m": float(frame.height)}


def imu_settings(noise: ImuNoise, suffix: str) -> dict[str, Any]:
    """Return the content of ``[imu]``; ``suffix`` is the ending of the table's name."""
    return {
        "file": f"imu{suffix}",
        "stamp": Stamp.END.value,
        **_scaled(
            gyro_random_walk_deg_per_sqrt_h=noise.gyro_density,
            accel_random_walk_ug_per_sqrt_hz=noise.accel_density,
            gyro_bias_deg_per_h=noise.gyro_bias_sigma,
            accel_bias_ug=noise.accel_bias_sigma,
            gyro_bias_walk_deg_per_h_per_sqrt_h=noise.gyro_bias_density,
            accel_bias_walk_ug_per_sqrt_h=noise.accel_bias_density,
        ),
    }


def dvl_settings(mount: DvlMount, beam_sigma: float, suffix: str) -> dict[str, Any]:
    """Return the content of ``[dvl]``; raise where the mounting is no rotation."""
    rpy = rpy_from_R_bd(mount.R_bd)
    if not np.allclose(R_bd_from_rpy(rpy), mount.R_bd, rtol=0.0, atol=1e-9):
        raise DataError(f"DvlMount.R_bd: expected a rotation matrix, got {mount.R_bd.tolist()}")
    optional = {
        "misalignment_sigma_deg": from_si("misalignment_sigma_deg", mount.misalignment_sigma),
        "scale_sigma": float(mount.scale_sigma),
        "time_offset_s": float(mount.time_offset_s),
        "time_offset_sigma_s": float(mount.time_offset_sigma_s),
        "scale_error": float(mount.scale_error),
        "scale_walk_per_sqrt_h": from_si("scale_walk_per_sqrt_h", mount.scale_walk_density),
        "beam_scale_error": mount.beam_scale_errors.tolist()
        if mount.beam_scale_errors.any()
        else 0,
        "beam_scale_sigma": float(mount.beam_scale_sigma),
        "lever_arm_sigma_m": float(mount.lever_arm_sigma),
        **_drift_settings("drift_sigma_m_per_s", mount.drift),
    }
    return {
        "file": f"dvl{suffix}",
        "beam_vectors": mount.beams_d.tolist(),
        "beam_noise_m_per_s": beam_sigma,
        "lever_arm_m": mount.lever_arm_b.tolist(),
        "mounting_rpy_deg": _degrees(rpy),
        **{key: value for key, value in optional.items() if value},
    }


def depth_calibration_settings(calibration: DepthCalibration) -> dict[str, float]:
    """Return the keys of ``[depth]`` that tell of its errors; none for an exact sensor."""
    return _given(offset_m=calibration.offset, offset_sigma_m=calibration.offset_sigma)


def gnss_calibration_settings(calibration: GnssCalibration) -> dict[str, float]:
    """Return the keys of ``[gnss]`` that tell of its errors; none for an exact receiver."""
    return _given(
        lever_arm_sigma_m=calibration.lever_arm_sigma,
        time_offset_s=calibration.time_offset_s,
        time_offset_sigma_s=calibration.time_offset_sigma_s,
        **_drift_settings("drift_sigma_m", calibration.drift),
    )


def _drift_settings(sigma_key: str, drift: Drift) -> dict[str, float]:
    if drift.sigma == 0.0:
        return {}
    return {
        sigma_key: float(drift.sigma),
        "drift_correlation_s": float(drift.correlation_s),
        "drift_white_share": float(drift.white_share),
    }


def _given(**values: float) -> dict[str, float]:
    return {key: float(value) for key, value in values.items() if value}


def current_settings(model: CurrentModel) -> dict[str, float]:
    """Return the section ``[current]``."""
    return {
        "sigma_m_per_s": float(model.sigma),
        "correlation_s": float(model.correlation_s),
        "vertical_sigma_m_per_s": float(model.vertical_sigma),
    }


def nominal_sigma(dvl: DvlLog) -> float:
    """Return the standard deviation that stands for those of all beams off the ground, m/s."""
    sigma = dvl.sigma[~dvl.is_water] if (~dvl.is_water).any() else dvl.sigma
    return float(np.median(sigma)) if sigma.size else _NOISE_OF_EMPTY_LOG


def sigma_off_water(dvl: DvlLog) -> float:
    """Return the standard deviation that stands for those of all beams off the water, m/s."""
    return float(np.median(dvl.sigma[dvl.is_water]))


def _dvl_table(dvl: DvlLog) -> dict[str, Array]:
    columns = {TIME: dvl.time_s, **_split(SPEED, dvl.speed)}
    nominal = np.full(dvl.sigma.shape, nominal_sigma(dvl))
    if dvl.is_water.any():
        nominal[dvl.is_water] = sigma_off_water(dvl)
    if np.any(dvl.sigma != nominal):
        columns |= _split(SPEED_SIGMA, dvl.sigma)
    if dvl.range_m is not None:
        columns |= _split(RANGE, dvl.range_m)
    if dvl.water_track is not None:
        columns[WATER_TRACK] = dvl.water_track
    return columns


def initial_settings(initial: InitialState) -> dict[str, Any]:
    """Return the content of ``[initial]``."""
    return {
        "time_s": float(initial.time_s),
        **_scaled(lat_deg=initial.lat, lon_deg=initial.lon),
        "height_m": float(initial.height),
        "vel_enu_m_per_s": initial.velocity_enu.tolist(),
        **_scaled(roll_deg=initial.roll, pitch_deg=initial.pitch, heading_deg=initial.heading),
        "position_sigma_m": initial.position_sigma_enu.tolist(),
        "velocity_sigma_m_per_s": initial.velocity_sigma_enu.tolist(),
        "attitude_sigma_deg": _degrees(initial.attitude_sigma),
    }


def _reference_table(reference: Reference) -> dict[str, Array]:
    columns = {
        TIME: reference.time_s,
        "lat_deg": np.degrees(reference.lat),
        "lon_deg": np.degrees(reference.lon),
        "height_m": reference.height,
    }
    if np.isfinite(reference.velocity_enu).any():
        columns |= _split(VELOCITY, reference.velocity_enu)
    if np.isfinite(reference.roll_pitch_heading).any():
        columns |= _split(ATTITUDE, np.degrees(reference.roll_pitch_heading))
    return columns


def _scaled(**values: float) -> dict[str, float]:
    return {key: from_si(key, float(value)) for key, value in values.items()}


def _degrees(angles: Array) -> list[float]:
    return [from_si("roll_deg", float(angle)) for angle in angles]


def _split(names: tuple[str, ...], values: Array) -> dict[str, Array]:
    return {name: values[:, index] for index, name in enumerate(names)}
