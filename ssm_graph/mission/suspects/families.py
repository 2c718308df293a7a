"""What is tried: clocks, scales, units and axes, each as a family of hypotheses."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from itertools import product
from typing import Final

import numpy as np

from ssm_graph.base.frozen import Array
from ssm_graph.mission.mission import Mission
from ssm_graph.mission.suspects.hypothesis import Hypothesis, with_delays
from ssm_graph.mission.suspects.search import Family
from ssm_graph.sensors.dvl import DvlMount

NEAR_S: Final = tuple(round(0.1 * i, 1) for i in range(-20, 21))
FAR_S: Final = tuple(0.5 * i for i in range(-80, 81))
SET_S: Final = tuple(
    sign * size
    for size in (0.5, 1.0, 2.0, 3.0, 5.0, 10.0, 17.0, 18.0, 19.0, 37.0)
    for sign in (1, -1)
)
"""Delays of a clock that is set: whole seconds, leap seconds (18 between GPS time and UTC, 37
between UTC and TAI) and their neighbours."""
BOUND: Final = 4.0
"""A calibration takes care of so many of its prior sigmas."""
DVL_LEAST_S: Final = 0.1
FIX_LEAST_S: Final = 0.3
DEPTH_LEAST_S: Final = 0.2
GYRO_LEAST: Final = 0.05
SPEED_LEAST: Final = 0.1
DEPTH_LEAST: Final = 0.1
JANUS_LEAST: Final = math.radians(2.0)
NEAR_SCALES: Final = (0.8, 0.9, 0.95, 1.05, 1.1, 1.2)
GYRO_SCALES: Final = (
    *(-1.0, math.pi / 180.0, 0.3, 0.4, 0.5, 0.6, 0.667, 0.75, 1.333, 1.5, 1.667, 2.0, 2.5, 3.3),
    180.0 / math.pi,
)
UNITS: Final = {
    0.001: "mm",
    0.01: "cm",
    0.3048: "feet",
    0.514444: "knots",
    0.44704: "miles per hour",
    1.0 / 3.6: "km/h",
}
DEPTH_UNITS: Final = {
    0.001: "millimetres",
    0.01: "centimetres or millibar",
    0.1: "kPa",
    0.3048: "feet",
    0.6895: "psi",
    1.8288: "fathoms",
    10.0: "bar",
    1000.0: "kilometres",
    -1.0: "metres of height, not of depth",
    9.95e-5: "pascal",
}
ALL_SCALES: Final = (*UNITS, *(1.0 / unit for unit in UNITS), 0.5, 0.7, 1.5, 0.1, 10.0)


def _matrix(matrix: Array) -> tuple[float, ...]:
    return tuple(np.asarray(matrix, float).ravel().tolist())


def _composed(base: Hypothesis, matrix: Array) -> Hypothesis:
    return replace(base, velocity=_matrix(matrix @ np.reshape(base.velocity, (3, 3))))


def signed_axes() -> list[Array]:
    """Return the matrices (3, 3) that exchange or turn round level axes, or up; 0 changes none."""
    turned = [np.eye(2), np.array([[0.0, -1.0], [1.0, 0.0]])]
    found = []
    for up, side, quarter in product((1.0, -1.0), (1.0, -1.0), range(4)):
        level = np.linalg.matrix_power(turned[1], quarter) @ np.diag([1.0, side])
        matrix = np.zeros((3, 3))
        matrix[:2, :2], matrix[2, 2] = level, up
        found.append(matrix)
    return found


AXES: Final = signed_axes()


def janus_of(mount: DvlMount) -> float | None:
    """Return the angle of all beams from the instrument's vertical, rad; None if they differ."""
    if mount.n_beams < 3:
        return None
    angles = np.arccos(np.clip(mount.beams_d[:, 2] / np.linalg.norm(mount.beams_d, axis=1), -1, 1))
    is_janus = np.ptp(angles) < math.radians(1.0) and 0.1 < angles.mean() < 1.0
    return float(angles.mean()) if is_janus else None


def clock_families(mission: Mission) -> Iterator[Family]:
    """Yield the clocks."""

    def of(name: str, *clocks: str, least: float, part: str, sigma_s: float = 0.0) -> Family:
        def make(base: Hypothesis, late_s: float) -> Hypothesis:
            return with_delays(base, {c: getattr(base, c).later(late_s) for c in clocks})

        cared = BOUND * sigma_s
        return Family(name, make, NEAR_S, FAR_S, least, cared=cared, clocks=clocks, part=part)

    dvl_s = mission.dvl.mount.time_offset_sigma_s
    yield of("DVL clock", "dvl", least=DVL_LEAST_S, part="accelerometers", sigma_s=dvl_s)
    if mission.gnss is not None:
        gnss_s = mission.gnss.calibration.time_offset_sigma_s
        yield of("GNSS clock", "gnss", least=FIX_LEAST_S, part="fixes", sigma_s=gnss_s)
    yield of("depth clock", "depth", least=DEPTH_LEAST_S, part="depth")
    yield of("compass clock", "compass", least=DEPTH_LEAST_S, part="compass")
    every = ("dvl", "gnss", "depth", "compass")
    yield of("IMU clock", *every, least=DVL_LEAST_S, part="accelerometers")


def scale_families(mission: Mission) -> Iterator[Family]:
    """Yield scales and axes of gyros, speeds, depths and fixes."""
    for name, axes in (("gyros", (0, 1, 2)), ("gyro x", (0,)), ("gyro y", (1,)), ("gyro z", (2,))):

        def turn(base: Hypothesis, by: float, axes: tuple[int, ...] = axes) -> Hypothesis:
            x, y, z = (g * by if i in axes else g for i, g in enumerate(base.gyro))
            return replace(base, gyro=(x, y, z))

        far = GYRO_SCALES if len(axes) == 3 else (-1.0,)
        yield Family(
            *(name, turn, NEAR_SCALES, far, GYRO_LEAST),
            null=1.0,
            cared=BOUND * mission.imu.calibration.gyro_scale_sigma,
            only_poor=len(axes) == 1,
            part="accelerometers",
        )
    mount = mission.dvl.mount
    yield Family(
        "speed",
        lambda base, by: _composed(base, by * np.eye(3)),
        *(NEAR_SCALES, ALL_SCALES, SPEED_LEAST),
        null=1.0,
        cared=BOUND * mount.scale_sigma,
    )
    stated = janus_of(mount)
    if stated is not None:

        def janus(base: Hypothesis, angle: float, stated: float = stated) -> Hypothesis:
            level = math.sin(stated) / math.sin(angle)
            return _composed(base, np.diag([level, level, math.cos(stated) / math.cos(angle)]))

        angles = tuple(math.radians(a) for a in (10, 15, 18, 20, 22, 22.5, 25, 27, 30, 35, 40, 45))
        near = tuple(angle for angle in angles if abs(angle - stated) < 0.2)
        yield Family("Janus angle", janus, near, angles, JANUS_LEAST, null=stated)
    yield Family(
        "DVL axes",
        lambda base, k: _composed(base, mount.R_bd @ AXES[int(k)] @ mount.R_bd.T),
        *((), tuple(range(1, len(AXES))), 0.5),
        is_discrete=True,
    )
    yield Family(
        "depth scale",
        lambda base, by: replace(base, depth_scale=base.depth_scale * by),
        *(NEAR_SCALES, tuple(DEPTH_UNITS), DEPTH_LEAST),
        null=1.0,
    )
    if mission.gnss is not None and np.all(np.abs(mission.gnss.lon) < 0.5 * math.pi):
        yield Family(
            "fix axes",
            lambda base, k: replace(base, is_swapped=base.is_swapped or k > 0.5),
            *((), (1.0,), 0.5),
            is_discrete=True,
        )
