"""Suspects in words: who, by how much, from what it follows, and the line that mends it."""

from __future__ import annotations

import math
from itertools import permutations, product
from typing import Any, Final

import numpy as np

from ssm_graph.base.frozen import Array
from ssm_graph.mission.fault import DetectedFault, Treatment
from ssm_graph.mission.mission import Mission
from ssm_graph.mission.suspects.families import AXES, DEPTH_UNITS, UNITS
from ssm_graph.mission.suspects.search import Found
from ssm_graph.sensors.dvl import DvlMount, rpy_from_R_bd
from ssm_graph.sensors.imu_calibration import MOST_LATE_S

SAYS: Final = 10.0
"""Gain of a part that is named as evidence."""
SAME_UNIT: Final = 0.03
LEAP_SECONDS: Final = {
    18.0: "GPS time where UTC was expected",
    -18.0: "UTC where GPS time was expected",
    37.0: "TAI where UTC was expected",
    -37.0: "UTC where TAI was expected",
    19.0: "TAI where GPS time was expected",
    -19.0: "GPS time where TAI was expected",
}
SENSORS: Final = {
    "DVL clock": "DVL",
    "GNSS clock": "GNSS",
    "depth clock": "depth",
    "compass clock": "compass",
    "IMU clock": "IMU",
    "speed": "DVL",
    "Janus angle": "DVL",
    "DVL axes": "DVL",
    "depth scale": "depth",
    "fix axes": "GNSS",
}
"""By family; all others are gyros."""
SECTIONS: Final = {"depth": "[depth]", "compass": "[heading]", "IMU": "[imu]", "GNSS": "[gnss]"}


def sensor_of(found: Found) -> str:
    """Return what people call the instrument."""
    return SENSORS.get(found.family.name, "gyros")


def said(found: Found, mission: Mission, order: tuple[int, ...] | None = None) -> DetectedFault:
    """Return a suspect in words; ``order`` is that of the beams that it was found with."""
    what, remedy = _words(found, mission, order)
    names = {
        "accelerometers": "accelerometers, gyros and DVL",
        "fixes": "fixes and track",
        "depth": "depths and vertical speed",
        "compass": "compass and gyros",
    }
    from_what = [names[name] for name, gain in found.by_part.items() if gain > SAYS]
    begin_s, end_s = _stretch(found, mission)
    return DetectedFault(
        sensor=sensor_of(found),
        what=f"{what} (then {'; '.join(from_what)} agree)" if from_what else what,
        begin_s=begin_s,
        end_s=end_s,
        chi_sq=2.0 * found.gain,
        dof=1,
        treatment=Treatment.SAID,
        rivals=tuple(
            f"{sensor_of(rival)}, {_words(rival, mission, order)[0]}" for rival in found.rivals
        ),
        remedy=remedy,
        late_s=found.value if found.family.clocks and not found.is_set else None,
    )


def _stretch(found: Found, mission: Mission) -> tuple[float, float]:
    begin_s, end_s = mission.imu.start_s, float(mission.imu.time_s[-1])
    delay = found.delay
    if delay is None or not found.is_set:
        return begin_s, end_s
    is_before = abs(delay.before_s) > abs(delay.after_s)
    return (begin_s, delay.switch_s) if is_before else (delay.switch_s, end_s)


def _words(found: Found, mission: Mission, order: tuple[int, ...] | None) -> tuple[str, str]:
    name, value = found.family.name, found.value
    if name.endswith("clock"):
        return _of_clock(found, mission)
    if name.startswith("gyro"):
        return _of_gyros(name, value)
    if name == "speed":
        return _of_speed(value, mission.dvl.mount)
    if name == "Janus angle":
        degrees = math.degrees(value)
        return f"a Janus angle of {degrees:.1f} deg fits", f"[dvl] beam_janus_deg = {degrees:.1f}"
    if name == "DVL axes":
        return _of_axes(AXES[int(value)], mission.dvl.mount, order)
    if name == "depth scale":
        unit = _unit(value, DEPTH_UNITS)
        is_unit = f": they are in {unit}" if unit else ""
        return (
            f"depths are {1.0 / value:.4g} times what the DVL says{is_unit}",
            f"multiply depth_m in the table of [depth] by {value:.4g}",
        )
    return (
        "longitude and latitude have changed places",
        "exchange the columns lat_deg and lon_deg in the table of [gnss]",
    )


def _unit(value: float, units: dict[float, str]) -> str:
    return next((unit for size, unit in units.items() if abs(value / size - 1.0) < SAME_UNIT), "")


def _of_clock(found: Found, mission: Mission) -> tuple[str, str]:
    sensor, delay = sensor_of(found), found.delay
    sign = -1.0 if sensor == "IMU" else 1.0
    section = SECTIONS.get(sensor, "[dvl]")
    if delay is None or not found.is_set:
        late_s = sign * found.value
        leap_s, why = _leap(late_s, found.sigma)
        what = f"{_late(late_s)} (sigma {found.sigma:.1g} s){why}"
        stated: dict[str, Any] = {"DVL": mission.dvl.mount, "IMU": mission.imu.calibration}
        if mission.gnss is not None:
            stated["GNSS"] = mission.gnss.calibration
        total_s = leap_s + stated[sensor].time_offset_s if sensor in stated else 0.0
        if sensor not in stated or (sensor == "IMU" and abs(total_s) > MOST_LATE_S):
            return what, f"take {leap_s:.2f} s off time_s in the table of {section}"
        return what, f"{section} time_offset_s = {total_s:.2f}"
    is_before = abs(delay.before_s) > abs(delay.after_s)
    late_s = sign * (delay.before_s if is_before else delay.after_s)
    leap_s, why = _leap(late_s, found.sigma)
    rows = f"before {delay.switch_s:.0f} s" if is_before else f"from {delay.switch_s:.0f} s on"
    change = sign * (delay.after_s - delay.before_s)
    return (
        f"{_late(late_s)} {rows}, where the clock was set by {change:+.1f} s{why}",
        f"take {leap_s:.1f} s off time_s of the rows {rows} in the table of {section}",
    )


def _late(late_s: float) -> str:
    return f"stamps {abs(late_s):.2f} s {'late' if late_s > 0.0 else 'early'}"


def _leap(late_s: float, sigma: float) -> tuple[float, str]:
    """Return a delay, or the leap seconds that it must be, and what these mean."""
    reach = max(0.3, min(4.0 * sigma, 0.7))
    for leap_s, what in LEAP_SECONDS.items():
        if abs(leap_s - late_s) < reach:
            return leap_s, f": {what}"
    return late_s, ""


def _of_gyros(name: str, value: float) -> tuple[str, str]:
    axis = name.removeprefix("gyros").removeprefix("gyro ")
    about = f" about {axis}" if axis else ""
    columns = f"gyro_{axis}_rad_per_s" if axis else "the gyro columns"
    remedy = f"multiply {columns} in the table of [imu] by {value:.4g}"
    if abs(value * 180.0 / math.pi - 1.0) < SAME_UNIT:
        return f"read degrees{about}, {1.0 / value:.1f} times the turn in radians", remedy
    if value < 0.0:
        return f"turn the wrong way{about}, {1.0 / value:.2f} times the turn", remedy
    return f"read {1.0 / value:.2f} of the turn{about}", remedy


def _of_speed(value: float, mount: DvlMount) -> tuple[str, str]:
    unit = _unit(value, UNITS)
    is_unit = f": they are in {unit}{'/s' if unit in ('mm', 'cm', 'feet') else ''}" if unit else ""
    what = f"speeds are {1.0 / value:.4g} times those of the other sensors{is_unit}"
    scale = (1.0 + mount.scale_error) / value - 1.0
    if unit or abs(scale) >= 0.5:
        return what, f"multiply the beam speeds in the table of [dvl] by {value:.4g}"
    return what, f"[dvl] scale_error = {scale:.3f}"


def _of_axes(M: Array, mount: DvlMount, order: tuple[int, ...] | None) -> tuple[str, str]:
    if np.linalg.det(M) > 0.0 and order is None:
        roll, pitch, yaw = np.degrees(rpy_from_R_bd(mount.R_bd @ M)) + 0.0
        turned = np.degrees(math.acos(np.clip(0.5 * (np.trace(M) - 1.0), -1.0, 1.0)))
        return (
            f"a mounting turned by {turned:.0f} deg fits",
            f"[dvl] mounting_rpy_deg = [{roll:.4g}, {pitch:.4g}, {yaw:.4g}]",
        )
    if np.allclose(M, -np.eye(3)) and order is None:
        return (
            "all beam speeds have the wrong sign",
            "change the sign of the beam speeds in the table of [dvl]",
        )
    return said_order(*(order_of(mount, M, order) or (order or (), 1.0)))


def said_order(order: tuple[int, ...], sign: float) -> tuple[str, str]:
    """Return the words for beams in another order, from 0, with a sign."""
    numbers = ", ".join(str(beam + 1) for beam in order)
    other = " with the other sign" if sign < 0.0 else ""
    return (
        f"the beams fit in another order{other}",
        f"as beams 1 to {len(order)} in the table of [dvl], write its columns {numbers}{other}",
    )


def order_of(
    mount: DvlMount, M: Array, order: tuple[int, ...] | None
) -> tuple[tuple[int, ...], float] | None:
    """Return the order and sign of the beams that change velocities by ``M`` (3, 3) in their axes.

    ``order`` is the one that the velocities were solved with; None if none of them does.
    """
    inverse = np.linalg.pinv(mount.beams_d)
    solved = order or tuple(range(mount.n_beams))
    speeds = np.zeros((mount.n_beams, 3))
    speeds[list(solved)] = mount.beams_d
    for one, sign in product(permutations(range(mount.n_beams)), (1.0, -1.0)):
        if np.allclose(sign * inverse @ speeds[list(one)], M, atol=0.05):
            return one, sign
    return None
