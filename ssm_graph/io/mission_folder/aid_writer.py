"""Writing acoustics, compass and times at rest: the inverse of :mod:`.aid_reading`."""

from __future__ import annotations

from typing import Any

import numpy as np

from ssm_graph.base.frozen import Array
from ssm_graph.io.mission_folder.units import from_si
from ssm_graph.io.tables.table import POSITION_SIGMA, TIME
from ssm_graph.mission.mission import Aids
from ssm_graph.sensors.acoustic import Beacon, RangeLog, UsblLog
from ssm_graph.sensors.compass import HeadingLog
from ssm_graph.sensors.standstill import Standstill


def aid_settings(aids: Aids, suffix: str) -> dict[str, Any]:
    """Return the sections of ``mission.toml``; ``suffix`` is the ending of the tables' names."""
    settings: dict[str, Any] = {}
    if aids.get(UsblLog):
        settings["usbl"] = {
            "file": f"usbl{suffix}",
            "lever_arm_m": aids[UsblLog].lever_arm_b.tolist(),
        }
    if aids.get(RangeLog):
        settings["ranges"] = {
            "file": f"ranges{suffix}",
            "noise_m": _nominal_sigma(aids[RangeLog]),
            "lever_arm_m": aids[RangeLog].lever_arm_b.tolist(),
        }
        settings["beacon"] = [_beacon(beacon) for beacon in aids[RangeLog].beacons]
    if aids.get(HeadingLog):
        settings["heading"] = {"file": f"heading{suffix}", **_heading(aids[HeadingLog])}
    if aids.all(Standstill):
        settings["standstill"] = [
            {
                "begin_s": float(still.begin_s),
                "end_s": float(still.end_s),
                "sigma_m_per_s": float(still.sigma),
            }
            for still in aids.all(Standstill)
        ]
    return settings


def aid_tables(aids: Aids) -> dict[str, dict[str, Array]]:
    """Return the columns of the tables that there are."""
    tables = {}
    if aids.get(UsblLog):
        log = aids[UsblLog]
        tables["usbl"] = {
            TIME: log.time_s,
            "lat_deg": np.degrees(log.lat),
            "lon_deg": np.degrees(log.lon),
            "height_m": log.height,
            **{name: log.sigma_enu[:, i] for i, name in enumerate(POSITION_SIGMA)},
            "delay_s": log.delay_s,
        }
    if aids.get(RangeLog):
        tables["ranges"] = _range_table(aids[RangeLog])
    if aids.get(HeadingLog):
        read = np.degrees(aids[HeadingLog].heading)
        tables["heading"] = {TIME: aids[HeadingLog].time_s, "heading_deg": read}
    return tables


def _nominal_sigma(log: RangeLog) -> float:
    """Return the standard deviation that stands for those of all ranges, m."""
    return float(np.median(log.sigma)) if log.sigma.size else 1.0


def _range_table(log: RangeLog) -> dict[str, Array]:
    columns = {TIME: log.time_s, "beacon": log.beacon, "range_m": log.range_m}
    if np.any(log.sigma != _nominal_sigma(log)):
        columns["sigma_m"] = log.sigma
    return columns


def _beacon(beacon: Beacon) -> dict[str, Any]:
    settings: dict[str, Any] = {
        "number": beacon.number,
        "lat_deg": from_si("lat_deg", beacon.lat),
        "lon_deg": from_si("lon_deg", beacon.lon),
        "height_m": float(beacon.height),
    }
    if not beacon.is_known:
        settings["position_sigma_m"] = beacon.position_sigma_enu.tolist()
    return settings


def _heading(log: HeadingLog) -> dict[str, float]:
    errors = log.errors
    optional = {
        "declination_deg": log.declination,
        "offset_sigma_deg": errors.offset_sigma,
        "rate_sigma_deg_per_h": errors.rate_sigma,
        "walk_sigma_deg": errors.walk_sigma,
        "correlation_s": errors.correlation_s if errors.walk_sigma else 0.0,
        "one_cycle_sigma_deg": errors.one_cycle_sigma,
        "two_cycle_sigma_deg": errors.two_cycle_sigma,
    }
    given = {key: value for key, value in optional.items() if value}
    return {key: from_si(key, value) for key, value in {"noise_deg": log.sigma, **given}.items()}
