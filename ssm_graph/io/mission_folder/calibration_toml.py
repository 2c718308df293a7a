"""What was found of the instruments, ready to be put into ``mission.toml``."""

from __future__ import annotations

from typing import Any, Final

import numpy as np

from ssm_graph.base.frames import R_FRD, BodyAxes
from ssm_graph.base.frozen import Array
from ssm_graph.base.settings import owner_of
from ssm_graph.mission.estimate import CalibratedValue, Calibration, Determined
from ssm_graph.mission.mission import Mission
from ssm_graph.sensors.acoustic import RangeLog
from ssm_graph.sensors.instrument import Calibrated, Instrument
from ssm_graph.sensors.registry import INSTRUMENTS

CALIBRATION_NAME: Final = "calibration.toml"


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
