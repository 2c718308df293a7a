"""A vehicle as a live estimator has to know it: from a TOML file, from a mission, into a log."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ssm_graph.base.errors import ConfigError
from ssm_graph.base.settings import build
from ssm_graph.base.tables import Order
from ssm_graph.io.mission_folder.folder import settings_of, write_toml_part
from ssm_graph.io.mission_folder.toml import SECTIONS, TOML_NAME, read_vehicle_toml
from ssm_graph.io.tables.files import TableFormat
from ssm_graph.mission.mission import Aids, Mission
from ssm_graph.mission.vehicle import GNSS_AT_ORIGIN, Vehicle
from ssm_graph.sensors.current import CurrentModel
from ssm_graph.sensors.depth import DEPTH
from ssm_graph.sensors.dvl import nominal_sigma, sigma_off_water
from ssm_graph.sensors.gnss import GNSS
from ssm_graph.sensors.registry import BY_LOG, INSTRUMENTS
from ssm_graph.sensors.seabed import TerrainLog
from ssm_graph.sensors.standstill import Standstill, standstill


def read_vehicle(path: Path | str) -> Vehicle:
    """Read what is known of a vehicle before its first message.

    The file has the keys of ``mission.toml``; ``file`` and ``stamp``, which are about tables, may
    be left out and are not looked at. Messages are in body axes FRD whatever ``[frames]`` says,
    which holds for the lever arms of the file. The navigation frame is at ``[origin]``, else at
    ``[initial]``, else left to the first fix.

    Raises :class:`ConfigError` for a key that is missing, unknown or out of range, and where
    neither ``[origin]`` nor ``[initial]`` nor a ``[gnss]`` receiver will ever say where on Earth
    the vehicle is.

    Parameters
    ----------
    path : a TOML file, or a mission folder.
    """
    path = Path(path)
    toml = read_vehicle_toml(path / TOML_NAME if path.is_dir() else path)
    local = toml.local()
    frame = toml.frame("origin") or toml.frame("initial") if local is None else local.frame
    if frame is None and "gnss" not in toml:
        raise toml.fault_of_no_place()
    bare = {one.section: toml.bare(one) for one in INSTRUMENTS if one.section in toml}
    imu, dvl = bare.pop("imu"), bare.pop("dvl")
    depth, gnss = bare.pop("depth", None), bare.pop("gnss", GNSS_AT_ORIGIN)
    return Vehicle(
        name=toml.name,
        imu_noise=imu.noise,
        mount=dvl.mount,
        beam_sigma=toml["dvl"].number("beam_noise_m_per_s"),
        water_sigma=toml["dvl"].number("water_noise_m_per_s") or None,
        current=build(CurrentModel, toml["current"].given()) if "current" in toml else None,
        depth=depth,
        gnss=gnss,
        aids=Aids(*bare.values(), *map(standstill, toml.lists["standstill"])),
        frame=frame,
        initial=toml.initial(),
        local=local,
        imu_calibration=imu.calibration,
    )


def instrument_notes(path: Path | str) -> tuple[str, ...]:
    """Return where the figures of the instruments that a vehicle file names are from."""
    path = Path(path)
    return read_vehicle_toml(path / TOML_NAME if path.is_dir() else path).notes


def vehicle_of(mission: Mission) -> Vehicle:
    """Return the vehicle of a recorded mission; its beam sigma is the median of those recorded.

    It has a current where there are pings off the water: the default one if the mission states
    none.
    """
    hears_water = mission.dvl.hears_water
    aids = (
        log if isinstance(log, Standstill) else BY_LOG[type(log)].without_rows(log)
        for log in mission.aids
        if not isinstance(log, TerrainLog)
    )
    return Vehicle(
        name=mission.name,
        imu_noise=mission.imu.noise,
        mount=mission.dvl.mount,
        beam_sigma=nominal_sigma(mission.dvl),
        water_sigma=sigma_off_water(mission.dvl) if hears_water else None,
        current=(mission.current or CurrentModel()) if hears_water else None,
        depth=None if mission.depth is None else DEPTH.without_rows(mission.depth),
        gnss=GNSS_AT_ORIGIN if mission.gnss is None else GNSS.without_rows(mission.gnss),
        aids=Aids(*aids),
        frame=mission.frame,
        initial=mission.initial,
        local=mission.local,
        imu_calibration=mission.imu.calibration,
    )


def write_vehicle(folder: Path | str, vehicle: Vehicle, *, order: Order = Order.ARRIVAL) -> None:
    """Write the ``mission.toml`` of a folder whose tables are written by someone else.

    The tables are called as their sections, ``imu.csv`` (body axes FRD, stamps at the interval's
    end) and so on. The file appears whole or not at all; one that is there is replaced.
    """
    settings = vehicle_settings(vehicle, order=order)
    write_toml_part(Path(folder), settings).replace(Path(folder) / TOML_NAME)


def vehicle_settings(vehicle: Vehicle, *, order: Order = Order.ARRIVAL) -> dict[str, Any]:
    """Return the content of the ``mission.toml`` that :func:`write_vehicle` writes."""
    suffix = TableFormat.CSV.value
    settings = settings_of(vehicle, vehicle.bare_logs, suffix, order=order.value)
    settings["dvl"]["beam_noise_m_per_s"] = float(vehicle.beam_sigma)
    if vehicle.water_sigma is not None:
        settings["dvl"]["water_noise_m_per_s"] = float(vehicle.water_sigma)
    return settings


def check_same_vehicle(folder: Path | str, vehicle: Vehicle) -> None:
    """Raise :class:`ConfigError` unless the log in ``folder`` was begun for just this vehicle."""
    logged = read_vehicle(Path(folder) / TOML_NAME)
    place = _difference(vehicle_settings(logged), vehicle_settings(vehicle))
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
