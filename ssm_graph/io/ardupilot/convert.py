"""Logs of ArduPilot as missions: IMU, barometer, GNSS and the movements that a DVL reports.

Facts, and where they come from (ArduPilot, ``LogStructure.h`` of the libraries):

* ``IMU`` is in rad/s and m/s^2, axes forward-right-down; the first instance is taken.
* ``VISO`` is a movement over ``dt`` in axes of the vehicle, already turned by ``VISO_ORIENT``: what
  a DVL sends as ``VISION_POSITION_DELTA``. Divided by ``dt`` it is the mean velocity of an interval
  that ended when it came; here it counts in the middle of it, as three beams along the axes.
* ``VISO_POS_X`` and the next are where the DVL is, ``INS_POS1_X`` where the IMU is, both from the
  centre of the vehicle.
* ``BARO`` has a pressure for each barometer; the one of ``BARO_PRIMARY`` is that of the water on a
  submarine, whose hull has another. ``BARO1_GND_PRESS`` is the pressure at the surface,
  ``BARO_SPEC_GRAV`` the water's density.
* ``GPS`` has heights above the sea; ``GPA`` what the receiver says of its accuracy.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ssm_graph.base.errors import ConfigError, DataError
from ssm_graph.base.frozen import Array
from ssm_graph.base.times import GPS_EPOCH_S, WEEK_S, gps_ahead_s
from ssm_graph.base.units import SEA_WATER, STANDARD_ATMOSPHERE, STANDARD_GRAVITY
from ssm_graph.io.ardupilot.dataflash import Columns, is_dataflash, read_dataflash
from ssm_graph.io.ardupilot.telemetry import is_telemetry, read_telemetry
from ssm_graph.io.instruments.assumed import BEAM_SIGMA, DEPTH_SIGMA, NOISE
from ssm_graph.io.mission_folder.assembly import mission_from
from ssm_graph.io.recording import whole
from ssm_graph.mission.mission import Mission
from ssm_graph.mission.vehicle import GNSS_AT_ORIGIN, Vehicle
from ssm_graph.sensors.depth import DepthLog
from ssm_graph.sensors.dvl import DvlLog, DvlMount
from ssm_graph.sensors.gnss import GnssLog
from ssm_graph.sensors.imu import ImuLog

FIELDS: Final[Mapping[str, tuple[str, ...]]] = {
    "IMU": ("TimeUS", "GyrX", "GyrY", "GyrZ", "AccX", "AccY", "AccZ"),
    "BARO": ("TimeUS", "Press"),
    "BAR2": ("TimeUS", "Press"),
    "GPS": ("TimeUS", "Status", "Lat", "Lng", "Alt", "HDop"),
    "GPA": ("TimeUS", "VAcc", "HAcc"),
    "VISO": ("TimeUS", "dt", "PosDX", "PosDY", "PosDZ", "conf"),
    "PARM": ("Value",),
}
"""Messages that are read, and the numbers that each has to have."""
_DRY_PA: Final = 1000.0
"""A pressure that changes less under way is that of the air."""
_FIX_3D: Final = 3
_UP_SIGMA: Final = 10.0
"""m, of heights above the sea where the geoid is not known."""
_SIGMA_OF_HDOP: Final = 2.5
"""m, of a fix of HDOP 1 whose accuracy is not told."""


@dataclass(frozen=True, slots=True)
class ArduPilotOptions:
    """What a log does not say."""

    water_density: float | None = None
    """kg/m^3; None for BARO_SPEC_GRAV, else sea water."""
    surface_height: float | None = None
    """m, of the water above the ellipsoid; None for that of the fixes, else 0."""


def is_ardupilot(path: Path) -> bool:
    """Return whether a file is a dataflash or a telemetry log, by its first bytes."""
    try:
        with path.open("rb") as stream:
            head = stream.read(16)
    except OSError:
        return False
    return is_dataflash(head) or is_telemetry(head)


class ArduPilotLogs(NamedTuple):
    """What a log holds, on one clock."""

    logs: tuple[Any, ...]
    """Of the IMU, of the DVL if it was asked for, of depth and fixes where there are any"""
    labels: Mapping[str, str]
    """By section, where it stands"""
    notes: tuple[str, ...]


def convert_ardupilot(
    log: Path, *, vehicle: Vehicle | None = None, options: ArduPilotOptions | None = None
) -> Mission:
    """Read a dataflash log (.BIN) or a telemetry log (.tlog) into a mission.

    Times are Unix seconds where the log knows them, else seconds since the start of the vehicle.

    Raises :class:`ConfigError`: nothing says where on Earth, or the vehicle's DVL has beams, which
    no movement has. Raises :class:`DataError`: no IMU or no movements in the log, or what any
    mission is refused for. Raises :class:`MissingExtraError`: a .tlog without pymavlink.

    Parameters
    ----------
    log : the file.
    vehicle : noise, lever arms, place; without it they are assumed, and notes say so.
    options : water and its surface.
    """
    found = logs_of_ardupilot(log, vehicle=vehicle, options=options)
    return mission_from(
        found.logs, vehicle, source=log, labels=found.labels, notes=list(found.notes)
    )


def logs_of_ardupilot(
    log: Path,
    *,
    vehicle: Vehicle | None = None,
    options: ArduPilotOptions | None = None,
    with_dvl: bool = True,
) -> ArduPilotLogs:
    """Return what a log holds; raises and takes what :func:`convert_ardupilot` does.

    ``with_dvl`` is whether its movements are the DVL's: not where a recording of the DVL itself
    lies beside it.
    """
    options = options or ArduPilotOptions()
    messages, notes = _read(log)
    wanted = {"IMU": "inertial data", **({"VISO": "movements of a DVL"} if with_dvl else {})}
    for name, what in wanted.items():
        if name not in messages:
            raise DataError(
                f"{log}: no message {name}, {what}; it has {', '.join(sorted(messages)) or 'none'};"
                " a DVL that sends VISION_POSITION_DELTA makes VISO, with VISO_TYPE = 1; a DVL's "
                "own recording can be given beside it"
            )
    parameters = _parameters(messages.get("PARM", {}))
    offset_s, said = _clock(log, messages)
    notes += said
    imu = _imu(messages["IMU"], offset_s, vehicle)
    dvl = _dvl(log, messages["VISO"], offset_s, vehicle, parameters) if with_dvl else None
    if not with_dvl and "VISO" in messages:
        notes.append("VISO: movements left out, for the DVL's own recording lies beside it.")
    gnss, said = _gnss(messages, offset_s, vehicle)
    notes += said
    depth, said = _depth(messages, offset_s, vehicle, parameters, gnss, options)
    notes += said
    rate = 1.0 / np.median(np.diff(imu.time_s))
    notes.append(f"IMU: {rate:.0f} samples per second, each the mean over the time before it.")
    if vehicle is None:
        notes.append(
            "No --vehicle: the IMU is taken for a consumer MEMS unit (100 deg/h, 0.4 deg/sqrt(h), "
            f"5 mg), velocities for {BEAM_SIGMA} m/s, depths for {DEPTH_SIGMA} m."
        )
    labels = {"imu": "IMU", "dvl": "VISO", "depth": "BARO", "gnss": "GPS"}
    return ArduPilotLogs(
        tuple(one for one in (imu, dvl, depth, gnss) if one is not None),
        {section: f"{log.name}: {name}" for section, name in labels.items()},
        tuple(notes),
    )


def _read(log: Path) -> tuple[dict[str, Columns], list[str]]:
    data = whole(log)
    if is_dataflash(data[:16]):
        found = read_dataflash(data, FIELDS)
        messages, skipped = dict(found.messages), found.n_skipped
        about = f"ArduPilot dataflash log, {found.n_records} records"
    else:
        messages, skipped = read_telemetry(data)
        about = "MAVLink telemetry log; the rates are those of the radio"
    for name, columns in messages.items():
        for field in FIELDS[name]:
            if field not in columns or columns[field].dtype.kind not in "iuf":
                raise DataError(
                    f"{log}: message {name} has no number {field!r}, it has {', '.join(columns)}; "
                    "expected a log of ArduPilot 3.6 or later"
                )
    notes = [about, *([f"{skipped} bytes of no sound record left out"] if skipped else [])]
    return messages, notes


def _parameters(columns: Columns) -> dict[str, float]:
    if not columns:
        return {}
    names = [name.decode("ascii", "replace") for name in columns["Name"].tolist()]
    return dict(zip(names, columns["Value"].astype(float).tolist(), strict=True))


def _first(columns: Columns, instance: int = 0) -> Columns:
    """Return the rows of one instance, where there are several."""
    if "I" not in columns:
        return columns
    mine = columns["I"] == instance
    return {name: values[mine] for name, values in columns.items()}


def _seconds(columns: Columns) -> Array:
    return np.asarray(columns["TimeUS"], np.float64) / 1e6


def _later(time_s: Array) -> NDArray[np.bool_]:
    """Return the times (N,) that are later than all before them."""
    later: NDArray[np.bool_] = np.r_[True, time_s[1:] > np.maximum.accumulate(time_s)[:-1]]
    return later


def _clock(log: Path, messages: Mapping[str, Columns]) -> tuple[float, list[str]]:
    """Return what makes Unix seconds of the log's times, and the note on it."""
    if not messages:
        raise DataError(f"{log}: not one message that is read")
    gps = messages.get("GPS", {})
    if "GWk" not in gps:
        return 0.0, []
    good = (gps["Status"] >= _FIX_3D) & (gps["GWk"] > 0)
    if not good.any():
        return 0.0, ["Times are seconds since the start of the vehicle: no fix tells the date."]
    unix_s = GPS_EPOCH_S + gps["GWk"] * WEEK_S + gps["GMS"] / 1e3
    unix_s -= gps_ahead_s(unix_s)
    offset_s = float(np.median((unix_s - _seconds(gps))[good]))
    return offset_s, [
        f"Times are UTC: {offset_s:.3f} s after the vehicle's own, by its receiver, whose reports "
        "come some 0.1 s late."
    ]


def _imu(columns: Columns, offset_s: float, vehicle: Vehicle | None) -> ImuLog:
    rows = _first(columns)
    time_s = _seconds(rows)
    kept = _later(time_s) if len(time_s) else np.zeros(0, bool)
    if kept.sum() < 2:
        raise DataError(f"IMU: {kept.sum()} samples; expected at least 2")
    time_s = time_s[kept] + offset_s

    def vector(kind: str) -> Array:
        return np.column_stack([np.asarray(rows[f"{kind}{a}"], np.float64) for a in "XYZ"])[kept]

    log = ImuLog(
        start_s=float(time_s[0] - np.median(np.diff(time_s))),
        noise=NOISE if vehicle is None else vehicle.imu_noise,
        time_s=time_s,
        gyro_b=vector("Gyr"),
        accel_b=vector("Acc"),
    )
    return log if vehicle is None else replace(log, calibration=vehicle.imu_calibration)


def _dvl(
    log: Path,
    columns: Columns,
    offset_s: float,
    vehicle: Vehicle | None,
    parameters: Mapping[str, float],
) -> DvlLog:
    arm = [
        parameters.get(f"VISO_POS_{a}", 0.0) - parameters.get(f"INS_POS1_{a}", 0.0) for a in "XYZ"
    ]
    mount = DvlMount(np.eye(3), np.eye(3), np.array(arm)) if vehicle is None else vehicle.mount
    if not (mount.n_beams == 3 and np.allclose(mount.beams_d, np.eye(3))):
        raise ConfigError(
            f"{log}: the log has movements and no beams: expected [dvl] beam_vectors = [[1, 0, 0], "
            f"[0, 1, 0], [0, 0, 1]] of the vehicle, got {mount.n_beams} beams"
        )
    dt = np.asarray(columns["dt"], np.float64)
    time_s = _seconds(columns) - 0.5 * dt + offset_s
    moved = np.column_stack([np.asarray(columns[f"PosD{a}"], np.float64) for a in "XYZ"])
    usable = (dt > 0.0) & (np.asarray(columns["conf"]) > 0.0) & np.isfinite(moved).all(axis=1)
    time_s, speed = time_s[usable], moved[usable] / dt[usable, None]
    kept = _later(time_s) if len(time_s) else np.zeros(0, bool)
    if not kept.any():
        raise DataError(f"{log}: VISO has {len(dt)} movements and none of confidence above 0")
    speed = speed[kept] @ mount.R_bd  # of the vehicle, along the axes of the instrument
    sigma = BEAM_SIGMA if vehicle is None else vehicle.beam_sigma
    return DvlLog(mount=mount, time_s=time_s[kept], speed=speed, sigma=np.full(speed.shape, sigma))


def _gnss(
    messages: Mapping[str, Columns], offset_s: float, vehicle: Vehicle | None
) -> tuple[GnssLog | None, list[str]]:
    if "GPS" not in messages:
        return None, ["No message GPS: nothing says where it begins but [origin] or [initial]."]
    rows = _first(messages["GPS"])
    place = np.column_stack([np.asarray(rows[n], np.float64) for n in ("Lat", "Lng", "Alt")])
    sigma, geoid_m = _accuracy(rows, messages.get("GPA", {}))
    good = (np.asarray(rows["Status"]) >= _FIX_3D) & (np.abs(place[:, :2]) > 0.0).any(axis=1)
    good &= np.isfinite(sigma).all(axis=1)
    time_s = _seconds(rows)[good]
    if not len(time_s):
        return None, [f"GPS: {len(place)} reports and no three-dimensional fix."]
    kept = _later(time_s)
    place, sigma = place[good][kept], sigma[good][kept]
    height = place[:, 2] + geoid_m
    note = (
        f"GPS: {kept.sum()} fixes of {len(good)} reports; heights above the sea"
        + (f", with the geoid at {geoid_m:.1f} m" if geoid_m else " are taken for ellipsoidal ones")
        + "."
    )
    bare = GNSS_AT_ORIGIN if vehicle is None else vehicle.gnss
    return replace(
        bare,
        time_s=time_s[kept] + offset_s,
        lat=np.radians(place[:, 0]),
        lon=np.radians(place[:, 1]),
        height=height,
        sigma_enu=sigma,
    ), [note]


def _accuracy(rows: Columns, accuracies: Columns) -> tuple[Array, float]:
    """Return sigmas east, north, up (N, 3) of reports, m, and the height of the geoid, m."""
    n_rows = len(rows["Lat"])
    source: Mapping[str, Any] = rows
    geoid_m = 0.0
    if accuracies:
        mine = _first(accuracies)
        if len(mine["TimeUS"]):
            at = np.clip(np.searchsorted(mine["TimeUS"], rows["TimeUS"]), 0, len(mine["VAcc"]) - 1)
            source = {name: values[at] for name, values in mine.items()}
            if "Und" in mine:
                geoid_m = float(np.median(mine["Und"]))
    hdop = np.asarray(rows["HDop"], np.float64) * _SIGMA_OF_HDOP
    told = np.asarray(source["HAcc"], np.float64) if "HAcc" in source else np.zeros(n_rows)
    up = np.asarray(source["VAcc"], np.float64) if "VAcc" in source else np.zeros(n_rows)
    flat = np.where(told > 0.0, told / np.sqrt(2.0), hdop)
    up = np.where(up > 0.0, up, 2.0 * flat)
    up = up if geoid_m else np.maximum(up, _UP_SIGMA)
    return np.column_stack([flat, flat, up]), geoid_m


def _depth(
    messages: Mapping[str, Columns],
    offset_s: float,
    vehicle: Vehicle | None,
    parameters: Mapping[str, float],
    gnss: GnssLog | None,
    options: ArduPilotOptions,
) -> tuple[DepthLog | None, list[str]]:
    """Return depths of the barometer that is in the water; None where none is, or none is known."""
    if vehicle is not None and vehicle.depth is None:
        return None, []
    bare = None if vehicle is None else vehicle.depth
    candidates = [
        (number, _first(messages[name], instance))
        for number, name, instance in ((1, "BARO", 0), (2, "BARO", 1), (2, "BAR2", 0))
        if name in messages
    ]
    candidates = [(number, rows) for number, rows in candidates if len(rows["Press"])]
    if not candidates:
        return None, []
    primary = int(parameters.get("BARO_PRIMARY", -1)) + 1
    number, rows = max(candidates, key=lambda one: (one[0] == primary, np.ptp(one[1]["Press"])))
    pressure = np.asarray(rows["Press"], np.float64)
    if np.ptp(pressure) < _DRY_PA:
        return None, [
            f"BARO: pressures change by {np.ptp(pressure):.0f} Pa: air; no depth is taken."
        ]
    density = options.water_density or 1000.0 * parameters.get("BARO_SPEC_GRAV", SEA_WATER / 1e3)
    surface_pa = parameters.get(f"BARO{number}_GND_PRESS", STANDARD_ATMOSPHERE)
    surface_m = options.surface_height
    if surface_m is None:
        surface_m = 0.0 if gnss is None else float(np.median(gnss.height))
    time_s = _seconds(rows)
    kept = _later(time_s)
    empty = np.zeros(0)
    log = bare or DepthLog(DEPTH_SIGMA, time_s=empty, depth=empty, lever_arm_b=np.zeros(3))
    depth = (pressure - surface_pa) / (density * STANDARD_GRAVITY) - surface_m
    note = (
        f"BARO: barometer {number}, {surface_pa:.0f} Pa at the surface, {density:.0f} kg/m^3; the "
        f"surface is taken to be {surface_m:.2f} m above the ellipsoid."
    )
    return replace(log, time_s=time_s[kept] + offset_s, depth=depth[kept]), [note]
