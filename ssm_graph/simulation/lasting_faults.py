"""Break a finished mission, recorded or simulated, with the faults of :mod:`.faults`."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from ssm_graph.base.earth import R_el_from_lat_lon, ecef_from_geodetic, geodetic_from_ecef
from ssm_graph.base.errors import ConfigError, DataError
from ssm_graph.base.frozen import Array, ShortRepr
from ssm_graph.mission.mission import Aids, Mission, Reference
from ssm_graph.sensors.acoustic import RangeLog, UsblLog
from ssm_graph.sensors.compass import HeadingLog
from ssm_graph.simulation import checked
from ssm_graph.simulation.faults import WHOLE_ARRAY, Fault, FaultShape, Sensor

Mask = NDArray[np.bool_]
Truth = Callable[[Array], Reference]
"""Position, velocity and attitude at any times, s."""
Rng = np.random.Generator

_AIDS: Final = {Sensor.USBL: UsblLog, Sensor.COMPASS: HeadingLog, Sensor.RANGES: RangeLog}
_VALUE: Final = {Sensor.DEPTH: "depth", Sensor.COMPASS: "heading", Sensor.RANGES: "range_m"}


@dataclass(frozen=True, slots=True, eq=False)
class BrokenMission(ShortRepr):
    """A mission with faults, and which of its readings are bad."""

    mission: Mission
    is_bad: Mapping[str, Mask]
    """By the section of the log: (N, B) of ``dvl``; (N,) of ``gnss``, ``depth``, ``imu``,
    ``heading``, ``usbl``, ``ranges``. Sensors without a fault are not in it."""

    def told(self, intact: Mission) -> Mission:
        """Return the mission of the oracle, who is told the bad readings: they are missing.

        Nobody can do without inertial data: his are those of the ``intact`` mission.
        """
        mission = self.mission
        for name, bad in self.is_bad.items():
            sensor = Sensor(name)
            log = log_of(mission, sensor)
            if sensor is Sensor.DVL:
                log = replace(log, speed=np.where(bad, np.nan, log.speed))
            elif sensor is Sensor.IMU:
                log = intact.imu
            else:
                log = None if bad.all() else log.rows(~bad)
            mission = with_log(mission, sensor, log)
        return mission


def with_faults(
    mission: Mission, faults: Sequence[Fault], *, truth: Truth | None = None, seed: int = 0
) -> BrokenMission:
    """Return a mission with faults, in their order: a recorded log, broken on purpose.

    Parameters
    ----------
    mission : left as it is.
    faults : times are those of the mission's stamps.
    truth : where the vehicle is; None for the mission's reference, between whose rows it is
        straight. Only LATE, MOVING_BOTTOM, SLIP, COASTING and FLAT look at it.
    seed : of what NOISE and SPIKES draw.

    Raises
    ------
    ConfigError
        A fault of a sensor or a beam that the mission does not have.
    DataError
        A fault that needs a truth of which the reference knows nothing.
    """
    known = truth or (lambda time_s: _between(mission.reference, time_s))
    broken, is_bad = mission, dict[str, Mask]()
    for i, fault in enumerate(faults):
        rng = np.random.default_rng([seed, *b"faults", i])
        if fault.sensor.is_inertial:
            broken, bad = _break_imu(broken, fault, rng)
        else:
            log = log_of(broken, fault.sensor)
            if log is None:
                raise ConfigError(
                    f"Fault.sensor: expected a sensor of the mission, got {fault.sensor.name}; "
                    "it has none, leave the fault out"
                )
            break_log = _BREAK.get(fault.sensor, _break_scalar)
            log, bad = break_log(log, fault, known, mission, rng)
            broken = with_log(broken, fault.sensor, log)
        name = "imu" if fault.sensor.is_inertial else fault.sensor.value
        is_bad[name] = bad | is_bad.get(name, np.zeros_like(bad))
    return BrokenMission(broken, is_bad)


def log_of(mission: Mission, sensor: Sensor) -> Any:
    """Return the log of a sensor, None if there is none."""
    if sensor in _AIDS:
        return mission.aids.get(_AIDS[sensor])
    return mission.imu if sensor.is_inertial else getattr(mission, sensor.value)


def with_log(mission: Mission, sensor: Sensor, log: Any) -> Mission:
    """Return the mission with another log of a sensor."""
    if sensor in _AIDS:
        others = (aid for aid in mission.aids if not isinstance(aid, _AIDS[sensor]))
        return replace(mission, aids=mission.aids.having(log) if log else Aids(*others))
    return replace(mission, **{"imu" if sensor.is_inertial else sensor.value: log})


def _changed(
    fault: Fault, time_s: Array, reading: Array, sigma: Array, rng: Rng
) -> tuple[Array, Mask]:
    """Return readings (N, n) inside a fault as it makes them, and which of them it touches."""
    every = np.ones(reading.shape, bool)
    if fault.shape is FaultShape.NOISE:
        more = math.sqrt(fault.sizes[0] ** 2 - 1.0) * sigma
        return reading + more * rng.standard_normal(reading.shape), every
    if fault.shape is FaultShape.SPIKES:
        touched = rng.random(reading.shape) < fault.share
        off = sigma * rng.uniform(fault.sizes.min(), fault.sizes.max(), reading.shape)
        return np.where(touched, reading + off, reading), touched
    return fault.changed(time_s, reading), every


def _break_scalar(
    log: Any, fault: Fault, truth: Truth, mission: Mission, rng: Rng
) -> tuple[Any, Mask]:
    """Break depth, compass or ranges: one number a reading."""
    name, rows = _VALUE[fault.sensor], fault.inside(log.time_s)
    value, bad = getattr(log, name).copy(), np.zeros(len(log.time_s), bool)
    if len(rows) == 0:
        return log, bad
    time_s = log.time_s[rows]
    if fault.shape is FaultShape.LATE:
        before, now = truth(time_s - fault.sizes[0]), truth(time_s)
        if fault.sensor is Sensor.DEPTH:
            value[rows] += now.height - before.height
        else:
            value[rows] += before.roll_pitch_heading[:, 2] - now.roll_pitch_heading[:, 2]
        bad[rows] = True
    elif fault.shape is FaultShape.FLAT:
        now = truth(time_s)
        up = mission.frame.p_n_from_geodetic(now.lat, now.lon, now.height)[:, 2]
        value[rows] += now.height - mission.frame.height - up
        bad[rows] = True
    else:
        sigma = np.broadcast_to(log.sigma, value.shape)[rows, None]
        read, touched = _changed(fault, time_s, value[rows, None], sigma, rng)
        value[rows], bad[rows] = read[:, 0], touched[:, 0]
    if fault.sensor is Sensor.COMPASS:
        value[rows] = np.remainder(value[rows], 2.0 * math.pi)
    if fault.sensor is Sensor.RANGES:
        value[rows] = np.maximum(value[rows], 0.0)
    return replace(log, **{name: value}), bad


def _break_place(log: Any, fault: Fault, truth: Truth, _: Mission, rng: Rng) -> tuple[Any, Mask]:
    """Break fixes, of GNSS or acoustic."""
    rows, bad = fault.inside(log.time_s), np.zeros(len(log.time_s), bool)
    if len(rows) == 0:
        return log, bad
    lat, lon, height = log.lat.copy(), log.lon.copy(), log.height.copy()
    p_e = ecef_from_geodetic(lat[rows], lon[rows], height[rows])
    time_s, touched = log.time_s[rows], np.ones(len(rows), bool)
    if fault.shape is FaultShape.LATE:
        valid_s = log.valid_s[rows]
        before, now = truth(valid_s - fault.sizes[0]), truth(valid_s)
        p_e = p_e + _place(before) - _place(now)
    elif fault.shape is FaultShape.STUCK:
        p_e = np.broadcast_to(p_e[:1], p_e.shape)
    elif fault.shape is FaultShape.COASTING:
        first = truth(time_s[:1])
        v_e = R_el_from_lat_lon(first.lat[0], first.lon[0]) @ first.velocity_enu[0]
        p_e = p_e[:1] + (time_s - time_s[0])[:, None] * v_e
    else:
        sigma = log.sigma_enu[rows]
        off_enu, spikes = _changed(fault, time_s, np.zeros(p_e.shape), sigma, rng)
        if fault.shape is FaultShape.SPIKES:  # of whole fixes, in any direction
            touched = spikes[:, 0]
            towards = rng.standard_normal(p_e.shape)
            off_enu = off_enu[:, :1] / sigma[:, :1] * sigma * towards
            off_enu /= np.linalg.norm(towards, axis=1, keepdims=True)
        R_el = R_el_from_lat_lon(lat[rows], lon[rows])
        p_e = p_e + np.einsum("kij,kj->ki", R_el, off_enu)
    rows, p_e = rows[touched], p_e[touched]
    lat[rows], lon[rows], height[rows] = geodetic_from_ecef(p_e)
    bad[rows] = True
    return replace(log, lat=lat, lon=lon, height=height), bad


def _break_dvl(
    log: Any, fault: Fault, truth: Truth, mission: Mission, rng: Rng
) -> tuple[Any, Mask]:
    """Break beams; one that is missing stays so."""
    from scipy.spatial.transform import Rotation

    checked.require_beams("Fault.beams", fault.beams, log.mount.n_beams)
    rows, speed = fault.inside(log.time_s), log.speed.copy()
    beams = fault.beams_of(log.mount.n_beams)
    where, bad = np.ix_(rows, beams), np.zeros(speed.shape, bool)
    if len(rows) == 0:
        return log, bad
    if fault.shape not in WHOLE_ARRAY:
        read, touched = _changed(fault, log.time_s[rows], speed[where], log.sigma[where], rng)
    else:
        valid_s, touched = log.valid_s[rows], np.ones((len(rows), len(beams)), bool)
        beams_b = log.mount.beams_b
        if fault.shape is FaultShape.MOVING_BOTTOM:
            enu = np.broadcast_to(fault.sizes, (len(rows), 3))
            off = -_body_from_enu(truth(valid_s), enu) @ beams_b.T
        else:
            v_b = _instrument_velocity(truth, mission, valid_s)
            if fault.shape is FaultShape.LATE:
                off = _instrument_velocity(truth, mission, valid_s - fault.sizes[0]) - v_b
                off = off @ beams_b.T
            else:
                R_bd = log.mount.R_bd
                slip = R_bd @ Rotation.from_rotvec(fault.sizes).as_matrix() @ R_bd.T
                off = v_b @ (slip - np.eye(3)) @ beams_b.T
        read = speed[where] + off
    speed[where], bad[where] = np.where(np.isnan(speed[where]), np.nan, read), touched
    return replace(log, speed=speed), bad & np.isfinite(speed)


def _break_imu(mission: Mission, fault: Fault, rng: Rng) -> tuple[Mission, Mask]:
    """Break inertial data."""
    log = mission.imu
    rows, bad = fault.inside(log.time_s), np.zeros(len(log.time_s), bool)
    bad[rows] = True
    if len(rows) == 0:
        return mission, bad
    if fault.shape is FaultShape.CLOCK:
        time_s = log.time_s + fault.sizes[0] * bad
        return replace(mission, imu=replace(log, time_s=time_s)), bad
    reading = np.hstack([log.gyro_b, log.accel_b])
    axes = np.array(fault.axes or (0, 1, 2))
    of = {Sensor.GYROS: axes, Sensor.ACCELEROMETERS: 3 + axes, Sensor.IMU: np.arange(6)}
    where = np.ix_(rows, of[fault.sensor])
    step_s = float(np.median(np.diff(log.time_s, prepend=log.start_s)))
    if fault.shape is FaultShape.LATE:
        earlier = np.clip(rows - round(fault.sizes[0] / step_s), 0, len(reading) - 1)
        read = reading[np.ix_(earlier, of[fault.sensor])]
    elif fault.shape is FaultShape.LOW_PASS:
        read = low_passed(reading[where], fault.sizes[0], 1.0 / step_s)
    else:
        density = np.repeat([log.noise.gyro_density, log.noise.accel_density], 3)
        sigma = density[of[fault.sensor]] / math.sqrt(step_s)
        read, _ = _changed(fault, log.time_s[rows], reading[where], sigma, rng)
    reading[where] = read
    return replace(mission, imu=replace(log, gyro_b=reading[:, :3], accel_b=reading[:, 3:])), bad


def low_passed(reading: Array, cutoff_hz: float, rate_hz: float) -> Array:
    """Return readings (N, n) behind a Butterworth filter of two poles, at rest on the first.

    Above 0.45 of the rate there is nothing left to take out: they are returned as they are.
    """
    if cutoff_hz >= 0.45 * rate_hz:
        return reading
    from scipy.signal import butter, sosfilt, sosfilt_zi

    sections = butter(2, cutoff_hz, fs=rate_hz, output="sos")
    rest = sosfilt_zi(sections)[:, :, None] * reading[:1]
    return np.asarray(sosfilt(sections, reading, axis=0, zi=rest)[0])


def _instrument_velocity(truth: Truth, mission: Mission, time_s: Array) -> Array:
    """Return the velocity of the DVL over ground (N, 3), m/s, body axes.

    The turn about the lever arm is that of the gyros; what the Earth's adds is below 0.1 mm/s.
    """
    now, imu = truth(time_s), mission.imu
    omega_b = np.column_stack([np.interp(time_s, imu.time_s, axis) for axis in imu.gyro_b.T])
    turned = np.cross(omega_b, mission.dvl.mount.lever_arm_b)
    return np.asarray(_body_from_enu(now, now.velocity_enu) + turned)


def _body_from_enu(now: Reference, v_enu: Array) -> Array:
    from scipy.spatial.transform import Rotation

    roll, pitch, heading = now.roll_pitch_heading.T
    R_nb = Rotation.from_euler("ZYX", np.column_stack([heading, pitch, roll]))  # of local NED
    return np.asarray(R_nb.inv().apply(v_enu[:, [1, 0, 2]] * [1.0, 1.0, -1.0]))


def _place(now: Reference) -> Array:
    return ecef_from_geodetic(now.lat, now.lon, now.height)


def _between(reference: Reference | None, time_s: Array) -> Reference:
    """Return the reference at any times; at either end it stands still."""
    if reference is None:
        raise DataError(
            "with_faults: expected a mission with a reference, or the truth, for a fault that "
            "depends on the motion; got neither: add [reference], or hand in truth"
        )

    def at(values: Array, what: str) -> Array:
        known = np.isfinite(values)
        if not known.any():
            raise DataError(
                f"with_faults: expected a reference with {what} for a fault that depends on the "
                "motion, got none; hand in truth"
            )
        return np.interp(time_s, reference.time_s[known], values[known])

    def all_at(columns: Array, what: str, *, wraps: bool = False) -> Array:
        known = np.isfinite(columns).all(axis=1)
        if wraps:
            columns = columns.copy()
            columns[known] = np.unwrap(columns[known], axis=0)
        return np.column_stack([at(np.where(known, c, np.nan), what) for c in columns.T])

    return Reference(
        time_s=time_s,
        lat=at(reference.lat, "positions"),
        lon=at(reference.lon, "positions"),
        height=at(reference.height, "heights"),
        velocity_enu=all_at(reference.velocity_enu, "velocities"),
        roll_pitch_heading=all_at(reference.roll_pitch_heading, "attitudes", wraps=True),
    )


_BREAK: Final = {
    Sensor.DVL: _break_dvl,
    Sensor.GNSS: _break_place,
    Sensor.USBL: _break_place,
}
