"""A vehicle as a live estimator has to know it: from a TOML file, from a mission, into a log."""

from __future__ import annotations

import os
import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w

from ssm_graph.base.errors import ConfigError
from ssm_graph.base.frames import BodyAxes
from ssm_graph.base.frozen import Array
from ssm_graph.io.mission_folder.aid_reading import sections_of_aids
from ssm_graph.io.mission_folder.instruments import (
    current_model,
    depth_calibration,
    dvl_mount,
    gnss_calibration,
    imu_noise,
    initial_state,
    lever_arm_b,
    stated_frame,
)
from ssm_graph.io.mission_folder.keys import FORMAT, SECTIONS
from ssm_graph.io.mission_folder.toml import read_vehicle_toml
from ssm_graph.io.mission_folder.writer import (
    current_settings,
    depth_calibration_settings,
    dvl_settings,
    gnss_calibration_settings,
    imu_settings,
    initial_settings,
    nominal_sigma,
    origin_settings,
    sigma_off_water,
)
from ssm_graph.io.tables.settings import TOML_NAME
from ssm_graph.io.tables.table import Order, TableFormat
from ssm_graph.mission.mission import Mission
from ssm_graph.mission.vehicle import Vehicle
from ssm_graph.sensors.current import CurrentModel
from ssm_graph.sensors.depth import DepthCalibration
from ssm_graph.sensors.gnss import GnssCalibration


def read_vehicle(path: Path | str) -> Vehicle:
    """Read what is known of a vehicle before its first message.

    The file has the keys of ``mission.toml``; ``file`` and ``stamp``, which are about tables, may
    be left out and are not looked at. Messages are in body axes FRD whatever ``[frames]`` says,
    which holds for the lever arms of the file. The navigation frame is at ``[origin]``, else at
    ``[initial]``, else left to the first fix.

    Parameters
    ----------
    path : a TOML file, or a mission folder.

    Raises
    ------
    ConfigError
        For a key that is missing, unknown or out of range, and where neither ``[origin]`` nor
        ``[initial]`` nor a ``[gnss]`` receiver will ever say where on Earth the vehicle is.
    """
    path = Path(path)
    toml = read_vehicle_toml(path / TOML_NAME if path.is_dir() else path)
    frame = stated_frame(toml, "origin") or stated_frame(toml, "initial")
    if frame is None and "gnss" not in toml:
        raise toml.fault_of_no_place()
    return Vehicle(
        name=toml.name,
        imu_noise=imu_noise(toml["imu"]),
        mount=dvl_mount(toml),
        beam_sigma=toml["dvl"].number("beam_noise_m_per_s"),
        water_sigma=toml["dvl"].number("water_noise_m_per_s") or None,
        current=current_model(toml["current"]) if "current" in toml else None,
        depth_lever_arm_b=lever_arm_b(toml, "depth"),
        gnss_lever_arm_b=lever_arm_b(toml, "gnss"),
        depth_sigma=toml["depth"].number("noise_m") if "depth" in toml else None,
        depth_calibration=depth_calibration(toml),
        gnss_calibration=gnss_calibration(toml),
        frame=frame,
        initial=initial_state(toml["initial"]) if "initial" in toml else None,
        further_aids=sections_of_aids(toml),
    )


def vehicle_of(mission: Mission) -> Vehicle:
    """Return the vehicle of a recorded mission; its beam sigma is the median of those recorded.

    The offsets of depth and GNSS are those that are left in the mission's values: none. It has a
    current where there are pings off the water: the default one if the mission states none.
    """
    depth, gnss = mission.depth, mission.gnss
    hears_water = mission.dvl.hears_water
    return Vehicle(
        name=mission.name,
        imu_noise=mission.imu.noise,
        mount=mission.dvl.mount,
        beam_sigma=nominal_sigma(mission.dvl),
        water_sigma=sigma_off_water(mission.dvl) if hears_water else None,
        current=(mission.current or CurrentModel()) if hears_water else None,
        depth_lever_arm_b=np.zeros(3) if depth is None else depth.lever_arm_b,
        gnss_lever_arm_b=np.zeros(3) if gnss is None else gnss.lever_arm_b,
        depth_sigma=None if depth is None else depth.sigma,
        depth_calibration=(
            DepthCalibration() if depth is None else replace(depth.calibration, offset=0.0)
        ),
        gnss_calibration=(
            GnssCalibration() if gnss is None else replace(gnss.calibration, time_offset_s=0.0)
        ),
        frame=mission.frame,
        initial=mission.initial,
        further_aids=mission.aids.sections,
    )


def write_vehicle(folder: Path | str, vehicle: Vehicle, *, order: Order = Order.ARRIVAL) -> None:
    """Write the ``mission.toml`` of a folder whose tables are written by someone else.

    The tables are ``imu.csv`` (body axes FRD, stamps at the interval's end), ``dvl.csv``,
    ``gnss.csv`` and, where the vehicle has a depth sensor, ``depth.csv``. The file appears whole
    or not at all; one that is there is replaced.
    """
    path = Path(folder) / TOML_NAME
    part = path.with_name(f"{TOML_NAME}.part")
    with part.open("wb") as stream:
        tomli_w.dump(vehicle_settings(vehicle, order=order), stream)
        stream.flush()
        os.fsync(stream.fileno())
    part.replace(path)


def vehicle_settings(vehicle: Vehicle, *, order: Order = Order.ARRIVAL) -> dict[str, Any]:
    """Return the content of the ``mission.toml`` that :func:`write_vehicle` writes."""
    suffix = TableFormat.CSV.value
    settings: dict[str, Any] = {
        "format": FORMAT,
        "name": vehicle.name,
        "order": order.value,
        "frames": {"body": BodyAxes.FRD.value},
    }
    if vehicle.frame is not None:
        settings["origin"] = origin_settings(vehicle.frame)
    settings["imu"] = imu_settings(vehicle.imu_noise, suffix)
    settings["dvl"] = dvl_settings(vehicle.mount, float(vehicle.beam_sigma), suffix)
    if vehicle.water_sigma is not None:
        settings["dvl"]["water_noise_m_per_s"] = float(vehicle.water_sigma)
    if vehicle.current is not None:
        settings["current"] = current_settings(vehicle.current)
    if vehicle.depth_sigma is not None:
        settings["depth"] = {
            "file": f"depth{suffix}",
            "noise_m": float(vehicle.depth_sigma),
            "lever_arm_m": _listed(vehicle.depth_lever_arm_b),
            **depth_calibration_settings(vehicle.depth_calibration),
        }
    settings["gnss"] = {
        "file": f"gnss{suffix}",
        "lever_arm_m": _listed(vehicle.gnss_lever_arm_b),
        **gnss_calibration_settings(vehicle.gnss_calibration),
    }
    if vehicle.initial is not None:
        settings["initial"] = initial_settings(vehicle.initial)
    return settings


def check_same_vehicle(folder: Path | str, vehicle: Vehicle) -> None:
    """Raise :class:`ConfigError` unless the log in ``folder`` was begun for just this vehicle."""
    path = Path(folder) / TOML_NAME
    read_vehicle_toml(path)
    found = tomllib.loads(path.read_text(encoding="utf-8-sig"))
    place = _difference(found, vehicle_settings(vehicle))
    if place is not None:
        raise ConfigError(
            f"{TOML_NAME} {place}: the log in {str(folder)!r} was begun with another value; "
            f"expected that of the vehicle {vehicle.name!r}; begin a new log in another folder"
        )


def _difference(found: Any, wanted: Any, place: str = "") -> str | None:
    """Return the name of the first key that differs by more than rounding."""
    if isinstance(found, dict) and isinstance(wanted, dict):
        for key in {**wanted, **found}:
            inner = f"{place} {key}" if place else f"[{key}]" if key in SECTIONS else key
            if (different := _difference(found.get(key), wanted.get(key), inner)) is not None:
                return different
        return None
    try:
        is_same = np.allclose(found, wanted, rtol=1e-9, atol=1e-12)
    except (TypeError, ValueError):  # texts, missing keys, lists of other lengths
        is_same = found == wanted
    return None if is_same else place


def _listed(lever_arm: Array) -> list[float]:
    return [float(x) + 0.0 for x in lever_arm]  # no minus zero in a file for people
