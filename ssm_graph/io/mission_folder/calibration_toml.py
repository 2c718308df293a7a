"""What was found of the instruments, ready to be put into ``mission.toml``."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from scipy.spatial.transform import Rotation

from ssm_graph.base.frames import R_FRD, BodyAxes
from ssm_graph.base.frozen import Array
from ssm_graph.mission.estimate import CalibratedValue, Calibration, Determined
from ssm_graph.mission.mission import Mission
from ssm_graph.sensors.acoustic import RangeLog
from ssm_graph.sensors.compass import HeadingLog
from ssm_graph.sensors.dvl import rpy_from_R_bd

CALIBRATION_NAME: Final = "calibration.toml"

Total = Callable[[Mission, Array, BodyAxes], Array]
"""Makes the value of a key of what the mission states and what it is off by."""


@dataclass(frozen=True, slots=True)
class _Key:
    """A key that holds a calibrated value, and the one of its prior sigma."""

    section: str
    name: str
    sigma_name: str
    total: Total


def _mounting(mission: Mission, off: Array, axes: BodyAxes) -> Array:  # noqa: ARG001
    R_bd = mission.dvl.mount.R_bd @ Rotation.from_rotvec(off).as_matrix()
    return np.degrees(rpy_from_R_bd(R_bd))


def _dvl_arm(mission: Mission, off: Array, axes: BodyAxes) -> Array:
    return np.asarray((mission.dvl.mount.lever_arm_b + off) @ R_FRD[axes])


def _gnss_arm(mission: Mission, off: Array, axes: BodyAxes) -> Array:
    assert mission.gnss is not None
    return np.asarray((mission.gnss.lever_arm_b + off) @ R_FRD[axes])


def _added(stated: Callable[[Mission], float | Array]) -> Total:
    return lambda mission, off, axes: np.asarray(stated(mission) + off)  # noqa: ARG005


def _compounded(stated: Callable[[Mission], float | Array]) -> Total:
    return lambda mission, off, axes: np.asarray(  # noqa: ARG005
        (1.0 + stated(mission)) * (1.0 + off) - 1.0
    )


def _depth_offset(mission: Mission) -> float:
    return 0.0 if mission.depth is None else mission.depth.calibration.offset


def _gnss_late(mission: Mission) -> float:
    return 0.0 if mission.gnss is None else mission.gnss.calibration.time_offset_s


def _declination_deg(mission: Mission, off: Array, axes: BodyAxes) -> Array:  # noqa: ARG001
    return np.degrees(mission.aids[HeadingLog].declination - off)


_KEYS: Final[Mapping[str, _Key]] = {
    "dvl_mounting": _Key("dvl", "mounting_rpy_deg", "misalignment_sigma_deg", _mounting),
    "dvl_scale": _Key(
        "dvl", "scale_error", "scale_sigma", _compounded(lambda m: m.dvl.mount.scale_error)
    ),
    "dvl_beam_scale": _Key(
        "dvl",
        "beam_scale_error",
        "beam_scale_sigma",
        _compounded(lambda m: m.dvl.mount.beam_scale_errors),
    ),
    "dvl_lever_arm": _Key("dvl", "lever_arm_m", "lever_arm_sigma_m", _dvl_arm),
    "dvl_time_offset": _Key(
        "dvl", "time_offset_s", "time_offset_sigma_s", _added(lambda m: m.dvl.mount.time_offset_s)
    ),
    "depth_offset": _Key("depth", "offset_m", "offset_sigma_m", _added(_depth_offset)),
    "gnss_lever_arm": _Key("gnss", "lever_arm_m", "lever_arm_sigma_m", _gnss_arm),
    "heading_offset": _Key("heading", "declination_deg", "offset_sigma_deg", _declination_deg),
    "gnss_time_offset": _Key("gnss", "time_offset_s", "time_offset_sigma_s", _added(_gnss_late)),
}


def calibration_toml(
    mission: Mission, calibration: Calibration, *, axes: BodyAxes = BodyAxes.FRD
) -> str:
    """Return the lines of ``mission.toml`` that a calibration changes, with comments.

    What the mission did not determine stays as it is stated, and a comment says so. The prior
    sigmas for going on from here are comments as well: without them the values are exact.

    Parameters
    ----------
    mission : what was calibrated.
    calibration : what was found.
    axes : body axes of the file that the lines are for.
    """
    lines = [
        f"# Calibrated with mission {mission.name!r}. Put these values in the place of the stated",
        "# ones; the sigmas, made keys, let the next mission calibrate on from here.",
    ]
    found: dict[str, list[CalibratedValue]] = {}
    for value in calibration.values:
        found.setdefault(value.variable, []).append(value)
    for section in ("dvl", "depth", "gnss", "heading"):
        keys = {name: key for name, key in _KEYS.items() if key.section == section}
        if not keys.keys() & found.keys():
            continue
        lines += ["", f"[{section}]"]
        for name, key in keys.items():
            if name in found:
                lines += _lines(key, found[name], mission, axes)
    lines += _beacon_lines(mission, calibration)
    return "\n".join(lines) + "\n"


def _lines(key: _Key, values: list[CalibratedValue], mission: Mission, axes: BodyAxes) -> list[str]:
    sigmas = [value.sigma / value.unit for value in values]
    shown = ", ".join(f"{sigma:.2g}" for sigma in sigmas)
    if all(value.determined is Determined.RED for value in values):
        prior = values[0].prior_sigma / values[0].unit
        return [f"# {key.name}: not determined, sigma {shown} of {prior:.2g} before"]
    total = key.total(mission, np.array([value.value for value in values]), axes)
    unsure = [v.label for v in values if v.determined is Determined.RED]
    remark = f"; not determined: {', '.join(unsure)}" if unsure else ""
    return [
        f"{key.name} = {_number(total)}  # sigma {shown}{remark}",
        f"# {key.sigma_name} = {max(sigmas):.2g}",
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
