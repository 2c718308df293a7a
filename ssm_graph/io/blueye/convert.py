"""Import of Blueye X3 logs, a small ROV with a Water Linked A50, as missions.

What these logs need before they can be used, all of it measured on logs of 2025:

* Every message carries its arrival time at the surface computer, and topics repeat their last
  value at their own publishing rate; only a changed value is a measurement.
* ``Imu2Tel`` brings a new value about 37 times a second (24 in older logs), at no regular rate:
  its count drifts by a second against any fixed period. Its stamps are therefore smoothed only
  locally, over `CLOCK_WINDOW` values: against the gyro of ``Imu1Tel``, an independent instrument,
  that lowers the residual by 6 to 16 %, and every longer window is worse. A value waits for the
  next message, half a publishing period on average; read as the mean over the interval that ends
  at its stamp, it is late by no more than about 15 ms.
* The DVL's own clock, the running sum of ``delta_time``, is good; its offset to the arrivals is a
  running median. They scatter by +-22 ms about it, the publishing period of that topic.
* The DVL dead-reckons with inertial sensors of its own, without compass or GNSS, and its heading is
  among the sensors of the vehicle's position estimate: a directional gyro of no known origin. A
  reset of its dead reckoning makes the heading jump; pieces are joined by the vehicle's gyros.
* The vehicle's other IMU is screwed to the same vehicle, so that both turn alike; what differs is a
  bias, a scale or a sign of one of them, and the accelerometers tell whose sign it is: at rest a
  specific force points up.
"""

from __future__ import annotations

import math
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

import numpy as np

from ssm_graph.base.errors import DataError
from ssm_graph.base.frames import wrap_to_pi
from ssm_graph.base.frozen import Array
from ssm_graph.base.units import STANDARD_GRAVITY
from ssm_graph.io.blueye import vehicle as x3
from ssm_graph.io.blueye.log import GNSS_SENSOR_ID, BlueyeTables, read_blueye_tables
from ssm_graph.io.mission_folder.assembly import mission_from
from ssm_graph.mission.mission import Mission
from ssm_graph.sensors.compass import HeadingLog
from ssm_graph.sensors.depth import DepthCalibration, DepthLog
from ssm_graph.sensors.dvl import DvlLog
from ssm_graph.sensors.gnss import GnssLog
from ssm_graph.sensors.imu import ImuLog

LABELS: Final = {
    "imu": "Imu2Tel",
    "dvl": "DvlVelocityTel",
    "depth": "DepthTel",
    "gnss": "PositionEstimateTel",
    "heading": "PositionEstimateTel of the DVL",
}
"""What messages call the source of each instrument's readings."""

CLOCK_WINDOW: Final = 5
"""IMU values; odd."""
DVL_CLOCK_WINDOW: Final = 101
"""DVL reports, about 20 s; odd."""
GAP_S: Final = 0.25
"""A longer silence of the IMU is a gap, over which nothing is smoothed."""
JUMP: Final = np.deg2rad(10.0)
"""Between two readings, beyond what the vehicle's gyros turn."""
MOST_JUMPS: Final = 0.02
"""Share of the readings: with more of them it is no gyro."""
FEWEST: Final = 20
MOST_RATE: Final = 4.0 * math.hypot(x3.DVL_HEADING_ERRORS.rate_sigma, x3.NOISE.gyro_bias_sigma)
"""rad/s, between both gyros: one that drifts further is not the one that its sigma is of."""
STEP_S: Final = 2.0
"""Turns over so long are compared; longer than the gaps and the jitter of either."""
FEWEST_STEPS: Final = 10
TURNING: Final = 0.02
"""rad/s rms: slower turns about an axis say nothing of its sign and scale."""
SAME_SCALE: Final = 0.05


def convert_blueye(log: Path) -> Mission:
    """Read a Blueye X3 log into a mission without initial state or reference.

    Times stay Unix seconds; body and instrument axes are forward-right-down. The vehicle's own
    position estimate is not used. Everything assumed or dropped is in the mission's notes.

    Raises :class:`MissingExtraError`: the packages of the extra ``blueye`` are not installed.
    Raises :class:`DataError`: not a complete MCAP file, topics missing, or values of unknown units
    or axes.

    Parameters
    ----------
    log : MCAP file with the topics of `ssm_graph.io.blueye.log.TOPICS`.
    """
    log = Path(log)
    tables = read_blueye_tables(log)
    imu, imu_notes = _imu(tables)
    dvl, dvl_notes = _dvl(tables, imu)
    heading, heading_notes = dvl_heading(tables.dvl_heading, imu)
    depth = _depth(tables)
    gnss, gnss_notes = _gnss(tables, imu, depth)
    assumed = (
        "Noise, biases, delays, scale and lever arms are those measured on one Blueye X3; DVL "
        f"speeds are taken to be {100.0 * x3.DVL_SCALE_ERROR:.1f} % high, give or take "
        f"{100.0 * x3.DVL_SCALE_SIGMA:g} %; this and both delays are estimated about these values."
    )
    return mission_from(
        [part for part in (imu, dvl, depth, gnss, heading) if part is not None],
        None,
        source=log,
        labels=LABELS,
        notes=(
            *imu_notes,
            *compare_imus(imu, tables.witness),
            *dvl_notes,
            *heading_notes,
            *gnss_notes,
            assumed,
        ),
    )


def _is_new(values: Array) -> Any:
    """Return the mask (N,) of rows that differ from the row before; the first is new."""
    return np.r_[True, np.any(values[1:] != values[:-1], axis=1)]


def _strictly_later(time_s: Array) -> Any:
    """Return the mask (N,) of the times later than all before them."""
    before = np.maximum.accumulate(time_s)[:-1]
    return np.r_[True, time_s[1:] > before]


def smooth_arrivals(time_s: Array, *, window: int = CLOCK_WINDOW) -> Array:
    """Return arrival times (N,) with each replaced by the mean of ``window`` values about it.

    That is a straight line fitted locally to time over count; near gaps and ends the window
    shrinks, so that gaps stay what they are and order is kept.
    """
    from scipy.ndimage import uniform_filter1d

    smooth = time_s - time_s[0]
    edges = [0, *(np.flatnonzero(np.diff(time_s) > GAP_S) + 1), len(time_s)]
    for begin, end in pairwise(edges):
        part = smooth[begin:end].copy()
        for size in range(3, window + 1, 2):
            half = size // 2
            if len(part) >= size:
                mean = uniform_filter1d(part, size)
                smooth[begin + half : end - half] = mean[half : len(part) - half]
    return np.asarray(smooth + time_s[0])


def _imu(tables: BlueyeTables) -> tuple[ImuLog, tuple[str, ...]]:
    """Return the IMU in rad/s and m/s^2 on a smoothed clock, and what was noticed."""
    table = tables.imu[_is_new(tables.imu[:, 1:])]
    table = table[_strictly_later(table[:, 0])]
    accel_unit, unit_name = _accel_unit(table[:, 4:7])
    _check_gyro_unit(table[:, 3], tables.yaw_rate[:, 1])
    time_s = smooth_arrivals(table[:, 0])
    steps = np.diff(time_s)
    jitter_ms = 1e3 * np.std(table[:, 0] - time_s)
    imu = ImuLog(
        start_s=float(time_s[0] - np.median(steps)),
        noise=x3.NOISE,
        time_s=time_s,
        gyro_b=table[:, 1:4] - x3.GYRO_BIAS,
        accel_b=table[:, 4:7] * accel_unit,
    )
    rate = (len(time_s) - 1) / np.sum(steps[steps < GAP_S])
    notes = [
        f"Imu2Tel: {len(table)} new values among {len(tables.imu)} messages, {rate:.1f} per "
        f"second, accelerometer in {unit_name}; stamps are smoothed arrival times, "
        f"{jitter_ms:.1f} ms rms of jitter removed; "
        f"the gyro biases known of the X3, {x3.GYRO_BIAS} rad/s, are taken off."
    ]
    return imu, tuple(notes)


def _accel_unit(accel: Array) -> tuple[float, str]:
    """Return the factor to m/s^2 and the unit's name; x forward, y right, z down is checked."""
    size = float(np.median(np.linalg.norm(accel, axis=1)))
    if np.median(accel[:, 2]) > -0.5 * size:
        raise DataError(
            "Imu2Tel: expected specific force near -1 g along z (forward-right-down axes), "
            f"got a median of {np.median(accel, axis=0).round(3).tolist()}"
        )
    for unit, name in ((STANDARD_GRAVITY, "g"), (1.0, "m/s^2")):
        if 0.9 < size * unit / STANDARD_GRAVITY < 1.1:
            return unit, name
    raise DataError(f"Imu2Tel: expected |f| near 1 g or 9.8 m/s^2, got a median of {size:.4g}")


def _check_gyro_unit(gyro_z: Array, yaw_rate: Array) -> None:
    """Refuse gyros that turn at another scale than the vehicle's own yaw rate in rad/s."""
    spread = np.std(yaw_rate) if len(yaw_rate) else 0.0
    if spread < 0.02:  # hardly a turn: nothing to compare
        return
    ratio = float(np.std(gyro_z) / spread)
    if not 0.5 < ratio < 2.0:
        raise DataError(
            "Imu2Tel: expected gyros in rad/s, but they turn "
            f"{ratio:.3g} times as fast as the vehicle's yaw rate (57.3 would be deg/s)"
        )


def _dvl(tables: BlueyeTables, imu: ImuLog) -> tuple[DvlLog, tuple[str, ...]]:
    """Return new reports with beam speeds on the instrument's own clock."""
    from scipy.ndimage import median_filter

    table = tables.dvl[_is_new(tables.dvl[:, 1:])]
    clock = 1e-3 * np.r_[0.0, np.cumsum(table[1:, 1])]
    time_s = clock + median_filter(table[:, 0] - clock, DVL_CLOCK_WINDOW, mode="reflect")
    jitter_ms = 1e3 * np.std(table[1:, 0] - time_s[1:])  # the first is a repeat of unknown age
    during = (time_s - x3.DVL_DELAY_S >= imu.start_s) & (time_s <= imu.time_s[-1])
    kept = during & _strictly_later(time_s)
    table, time_s = table[kept], time_s[kept]
    if len(table) < 2:
        raise DataError("DvlVelocityTel: fewer than two new reports while the IMU ran")
    speed, valid, ranges = np.split(table[:, 4:-3], 3, axis=1)
    water_track = table[:, 2] > 0.0
    is_one_number = np.ptp(speed, axis=1, keepdims=True) == 0.0
    speed = np.where((valid > 0.0) & ~is_one_number, speed, np.nan)
    _check_lock(speed, is_one_number, valid)
    log = DvlLog(
        mount=x3.dvl_mount(),
        time_s=time_s,
        speed=speed,
        sigma=np.full(speed.shape, x3.BEAM_SIGMA),
        range_m=np.where(ranges > 0.0, ranges, np.nan),
        water_track=water_track.astype(float) if water_track.any() else None,
    )
    note = (
        f"DvlVelocityTel: {len(table)} new reports among {len(tables.dvl)} messages, stamped by "
        f"the sum of delta_time (arrivals scatter by {jitter_ms:.1f} ms rms), {x3.DVL_DELAY_S} s "
        f"late; {int(np.isnan(speed).sum())} beams without lock, {int(water_track.sum())} "
        f"reports off the water, {int(is_one_number.sum())} with one number in all four "
        f"beams left out, {int(np.sum(table[:, 3] != 0.0))} with a fault status "
        "kept for their beams."
    )
    return log, (note,)


def _check_lock(speed: Array, is_one_number: Array, valid: Array) -> None:
    """Refuse a log whose beams (N, 4) say nothing, and say why."""
    if np.isfinite(speed).any():
        return
    why = "no beam is flagged valid: was there bottom lock at all?"
    if is_one_number.mean() > 0.5:
        why = (
            "four beams hold the same number: the driver writes one value into all of them; "
            "export the transducers' velocities"
        )
    raise DataError(
        f"DvlVelocityTel: expected beam speeds, got none in {len(speed)} reports "
        f"({int(np.sum(valid > 0.0))} beams flagged valid); {why}"
    )


def _depth(tables: BlueyeTables) -> DepthLog:
    """Return new depths; the surface they count from is taken as height zero."""
    table = tables.depth[_is_new(tables.depth[:, 1:])]
    table = table[_strictly_later(table[:, 0])]
    return DepthLog(
        sigma=x3.DEPTH_SIGMA,
        time_s=table[:, 0],
        depth=table[:, 1],
        lever_arm_b=np.zeros(3),
        calibration=DepthCalibration(drift=x3.DEPTH_DRIFT),
    )


def _gnss(tables: BlueyeTables, imu: ImuLog, depth: DepthLog) -> tuple[GnssLog, tuple[str, ...]]:
    """Return new fixes at the time they were taken, heights from the depth sensor."""
    table = tables.gnss
    if len(table) == 0:
        raise DataError(f"PositionEstimateTel: no valid fix of sensor {GNSS_SENSOR_ID} (GNSS)")
    table = table[_is_new(table[:, 1:3])]
    time_s = table[:, 0] - x3.GNSS_DELAY_S  # when the fixes were true
    during = (time_s >= imu.start_s) & (time_s <= imu.time_s[-1]) & _strictly_later(time_s)
    good = (table[:, 3] <= x3.GNSS_SIGMA_LIMIT) & (table[:, 3] > 0.0)
    n_new, n_bad = len(table), int(np.sum(during & ~good))
    table, time_s = table[during & good], time_s[during & good]
    if len(table) == 0:
        raise DataError(
            f"PositionEstimateTel: none of {n_new} fixes is good to {x3.GNSS_SIGMA_LIMIT} m"
        )
    sigma = table[:, 3]
    height = -np.interp(time_s, depth.time_s, depth.depth) - x3.GNSS_LEVER_ARM[2]
    log = GnssLog(
        time_s=table[:, 0],
        lat=np.deg2rad(table[:, 1]),
        lon=np.deg2rad(table[:, 2]),
        height=height,
        sigma_enu=np.column_stack([sigma, sigma, np.full_like(sigma, x3.GNSS_UP_SIGMA)]),
        lever_arm_b=np.array(x3.GNSS_LEVER_ARM),
        calibration=x3.gnss_calibration(),
    )
    silent = np.flatnonzero(np.diff(time_s) > 5.0)
    gaps = [
        f"{a - imu.start_s:.0f}-{b - imu.start_s:.0f} s"
        for a, b in zip(time_s[silent], time_s[silent + 1], strict=True)
    ]
    fixes = (
        f"GNSS: {len(table)} new fixes kept of {n_new}, {n_bad} with sigma above "
        f"{x3.GNSS_SIGMA_LIMIT} m dropped; stamps {x3.GNSS_DELAY_S} s late; "
        f"longer silences: {', '.join(gaps) or 'none'}."
    )
    heights = (
        "The log has no GNSS height: height zero is the surface from which depth counts, and fixes "
        f"carry the antenna's height by depth with a sigma of {x3.GNSS_UP_SIGMA:.0f} m up."
    )
    return log, (fixes, heights)


def dvl_heading(readings: Array, imu: ImuLog) -> tuple[HeadingLog | None, tuple[str, ...]]:
    """Return the DVL's heading, if the log has one that turns as the vehicle does, and notes.

    Parameters
    ----------
    readings : (N, 2) arrival time, s, and heading, rad, repeats included.
    imu : forward-right-down; its turns about z say where the readings jump.
    """
    new = readings[1:][np.diff(readings[:, 1]) != 0.0]  # the first is of unknown age
    time_s = new[:, 0] - x3.DVL_HEADING_DELAY_S
    inside = (time_s >= imu.time_s[0]) & (time_s <= imu.time_s[-1])
    inside &= np.r_[True, np.diff(time_s) > 0.0][: len(time_s)]
    new, time_s = new[inside], time_s[inside]
    if len(new) < FEWEST:
        return None, ()
    turn = np.diff(turned(imu.time_s, imu.gyro_b, time_s)[:, 2])
    beyond = wrap_to_pi(np.diff(new[:, 1]) - x3.DVL_HEADING_SCALE * turn)
    jumps = np.abs(beyond) > JUMP
    if np.mean(jumps) > MOST_JUMPS:
        return None, (
            f"The DVL's heading is left out: {int(jumps.sum())} of {len(new)} readings jump by "
            f"more than {np.rad2deg(JUMP):.0f} degrees from what the gyros turn.",
        )
    away = np.cumsum(np.where(jumps, 0.0, beyond) / x3.DVL_HEADING_SCALE)
    rate = float(np.polyfit(time_s[1:] - time_s[0], away, 1)[0])
    if abs(rate) > MOST_RATE:
        return None, (
            f"The DVL's heading is left out: it drifts by {_deg_per_h(rate):.0f} deg/h against the "
            f"gyros, and {_deg_per_h(MOST_RATE):.0f} were expected at most.",
        )
    heading = new[0, 1] + np.concatenate([[0.0], np.cumsum(turn) + away])
    log = HeadingLog(
        sigma=x3.DVL_HEADING_SIGMA,
        time_s=time_s,
        heading=np.remainder(heading, 2.0 * np.pi),
        errors=x3.DVL_HEADING_ERRORS,
    )
    note = (
        f"The DVL's own heading, {len(new)} readings {x3.DVL_HEADING_DELAY_S} s late, is used as a "
        f"directional gyro: it turns {x3.DVL_HEADING_SCALE} of what the vehicle turns, from an "
        f"origin of its own; {int(jumps.sum())} jumps of its dead reckoning bridged by the gyros."
    )
    return log, (note,)


def _deg_per_h(rate: float) -> float:
    return 3600.0 * math.degrees(rate)


def compare_imus(imu: ImuLog, witness: Array) -> tuple[str, ...]:
    """Return one sentence each on what the other IMU tells.

    Parameters
    ----------
    imu : the one that is used, forward-right-down, rad/s and m/s^2.
    witness : (N, 7) arrival time, gyro and accelerometer of the other, in the log's units.
    """
    if len(witness) < 2:
        return ()
    begin = max(imu.start_s, float(witness[0, 0])) + STEP_S
    edges = np.arange(begin, min(float(imu.time_s[-1]), float(witness[-1, 0])) - STEP_S, STEP_S)
    if len(edges) <= FEWEST_STEPS:
        return ()
    used = np.diff(turned(imu.time_s, imu.gyro_b, edges), axis=0) / STEP_S
    other = np.diff(turned(witness[:, 0], witness[:, 1:4], edges), axis=0) / STEP_S
    offset = np.median(other - used, axis=0)
    is_up = float(np.median(witness[:, 6])) < 0.0
    text = ", ".join(f"{x + 0.0:.4f}" for x in offset)
    first = (
        "Imu1Tel is not used, only compared: its gyros read "
        f"({text}) rad/s more than those of Imu2Tel"
        + ("" if is_up else ", and its accelerometer has the opposite sign (+1 g at rest)")
        + "."
    )
    return (first, *_doubts(used - np.median(used, axis=0), other - np.median(other, axis=0)))


def turned(time_s: Array, rate: Array, at_s: Array) -> Array:
    """Return the integral (M, 3) of rates (N, 3) that hold since the time before, rad."""
    angle = np.cumsum(rate[1:] * np.diff(time_s)[:, None], axis=0)
    return np.column_stack([np.interp(at_s, time_s[1:], column) for column in angle.T])


def _doubts(used: Array, other: Array) -> tuple[str, ...]:
    """Compare turn rates (N, 3) less their biases, axis by axis."""
    notes = []
    for axis, name in enumerate("xyz"):
        x, y = used[:, axis], other[:, axis]
        if min(np.std(x), np.std(y)) < TURNING:
            continue
        scale = float(np.std(y) / np.std(x) * np.sign(np.mean(x * y)))
        if abs(scale - 1.0) > SAME_SCALE:
            notes.append(
                f"About {name} the gyros of Imu1Tel turn {scale:.2f} times as far as those of "
                "Imu2Tel, where 1 was expected: sign, unit or axes of one of them are wrong."
            )
    return tuple(notes)
