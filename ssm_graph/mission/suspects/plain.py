"""What needs no motion to be seen: gravity, the array's parity, and heights beside depths."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import permutations
from typing import Final

import numpy as np

from ssm_graph.base.times import is_inside
from ssm_graph.mission.fault import DetectedFault, Treatment
from ssm_graph.mission.mission import Mission
from ssm_graph.sensors.imu import FORCE_RANGE, FORCE_UNITS

GRAVITY: Final = 9.80665
"""m/s^2"""
OFF_PARITY: Final = 4.0
"""Median of the parity in sigmas, above which the beams cannot be as stated."""
PARITY_SHARE: Final = 0.3
"""Another order has to make it so much smaller."""
ATMOSPHERE_M: Final = (9.7, 10.5)
"""What a pressure of 1 atm is of fresh or salt water, at any weather."""
INDEPENDENT: Final = 4
"""Errors of heights change slowly: never count on more of them."""
SIGMAS: Final = 6.0
LEAST_M: Final = 3.0


def fault_of(mission: Mission, sensor: str, what: str, remedy: str, sigmas: float) -> DetectedFault:
    """Return a suspect of a whole mission; see :class:`DetectedFault` for the words."""
    imu = mission.imu
    return DetectedFault(
        *(sensor, what, imu.start_s, float(imu.time_s[-1]), sigmas**2, 1, Treatment.SAID),
        remedy=remedy,
    )


def of_gravity(mission: Mission) -> Iterator[DetectedFault]:
    """Yield accelerometers whose readings cannot hold gravity, by unit or axes."""
    force = mission.imu.accel_b
    size, down = float(np.median(np.linalg.norm(force, axis=1))), float(np.median(force[:, 2]))
    off = np.abs(size - GRAVITY) / mission.imu.noise.accel_bias_sigma
    if not FORCE_RANGE[0] <= size <= FORCE_RANGE[1]:
        unit = next((u for s, u, _ in FORCE_UNITS if abs(size / s - 1.0) < 0.06), "")
        yield fault_of(
            *(mission, "accelerometers"),
            f"read {size:.4g} where gravity is {GRAVITY:.2f} m/s^2{f': {unit}' if unit else ''}",
            f"multiply the accelerometer columns in the table of [imu] by {GRAVITY / size:.4g}",
            off,
        )
    elif down > 0.5 * GRAVITY:
        yield fault_of(
            *(mission, "IMU", f"gravity reads {down:+.2f} m/s^2 along z: z points up"),
            '[frames] body = "FLU", or change the signs of y and z',
            off,
        )


def of_heights(mission: Mission) -> Iterator[DetectedFault]:
    """Yield depths that lie off the heights of fixes, or of the start, by a constant."""
    depth, gnss, initial = mission.depth, mission.gnss, mission.initial
    if depth is None or len(depth.time_s) == 0 or depth.calibration.offset_sigma > LEAST_M / SIGMAS:
        return
    arm = -depth.lever_arm_b[2]
    if gnss is not None and len(gnss.time_s) > 0:
        time_s, height, sigma = gnss.valid_s, gnss.height, gnss.sigma_enu[:, 2]
        arm, whose = arm + gnss.lever_arm_b[2], "fixes"
    elif initial is not None:
        time_s, height = np.array([initial.time_s]), np.array([initial.height])
        sigma, whose = initial.position_sigma_enu[2:], "the start"
    else:
        return
    used = is_inside(time_s, float(depth.time_s[0]) - 1.0, float(depth.time_s[-1]))
    if not used.any():
        return
    off = np.interp(time_s[used], depth.time_s, depth.true_depth) + height[used] + arm
    sigma_off = float(np.median(sigma[used])) / np.sqrt(min(INDEPENDENT, used.sum()))
    median = float(np.median(off))
    if abs(median) < max(LEAST_M, SIGMAS * sigma_off):
        return
    is_air = ATMOSPHERE_M[0] <= median <= ATMOSPHERE_M[1]
    why = ": the pressure of the atmosphere is in them" if is_air else ", or these are no heights"
    yield fault_of(
        *(mission, "depth", f"depths are {median:.1f} m more than the heights of {whose} say{why}"),
        f"[depth] offset_m = {depth.calibration.offset + median:.2f}"
        + ("" if is_air else ", or heights above the ellipsoid in [gnss] and [initial]"),
        median / sigma_off,
    )


def order_by_parity(mission: Mission) -> tuple[tuple[int, ...], float] | None:
    """Return an order of the beams, from 0, that the array's parity fits, and sigmas it mends.

    None where the stated order fits, or none does.
    """
    dvl = mission.dvl.of_ground()
    whole = np.isfinite(dvl.speed).all(axis=1)
    if dvl.mount.n_beams != 4 or whole.sum() < 12:
        return None
    speed, sigma = dvl.speed[whole], dvl.sigma[whole]
    off = {
        order: float(np.median(dvl.mount.parity(speed[:, list(order)], sigma[:, list(order)])))
        for order in permutations(range(4))
    }
    stated = off[tuple(range(4))]
    best = min(off, key=lambda order: off[order])
    if stated < OFF_PARITY or off[best] > PARITY_SHARE * stated:
        return None
    return best, stated


def reordered(mission: Mission, order: tuple[int, ...]) -> Mission:
    """Return the mission with its beam speeds in another order."""
    dvl, columns = mission.dvl, list(order)
    return replace(
        mission, dvl=replace(dvl, speed=dvl.speed[:, columns], sigma=dvl.sigma[:, columns])
    )
