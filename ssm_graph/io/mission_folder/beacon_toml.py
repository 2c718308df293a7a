"""Beacons where a mission found them, ready to be put into ``mission.toml``."""

from __future__ import annotations

import numpy as np

from ssm_graph.mission.estimate import Calibration, Determined
from ssm_graph.mission.mission import Mission
from ssm_graph.sensors.acoustic import RangeLog


def beacon_lines(mission: Mission, calibration: Calibration) -> list[str]:
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
