"""Scale factors, misalignments and g-sensitivity of inertial sensors: what is known and asked for.

::

    gyro  = (I + S_g) rate + S_f force + bias
    accel = (I + S_a) force            + bias

``S_g`` and ``S_a`` have scale errors on the diagonal and misalignments beside it, ``S_f`` is what
gyros read of the specific force. What is stated is taken off the readings before anything else, so
that biases, random walks and what a calibration finds are those of what is left.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from ssm_graph.base.frames import MATRIX_PLACES
from ssm_graph.base.frozen import Array, FrozenArrays, optional_shaped
from ssm_graph.base.settings import Key, optional_key
from ssm_graph.base.units import DEG_PER_H, MICRO_G
from ssm_graph.sensors.drift import SECONDS
from ssm_graph.sensors.instrument import Calibrated, compounded

PPM: Final = 1e-6
MRAD: Final = 1e-3
VALUES: Final = (
    "gyro_scale_error",
    "gyro_misalignment",
    "gyro_g_sensitivity",
    "accel_scale_error",
    "accel_misalignment",
)
"""The fields that state what is known."""
DEG_PER_H_PER_G: Final = DEG_PER_H / (1e6 * MICRO_G)
"""rad/s per m/s^2"""


@dataclass(frozen=True, slots=True, eq=False)
class ImuCalibration(FrozenArrays):
    """What is known of the errors of inertial sensors, and what is asked for.

    A prior sigma is that of each component of what is left of the stated value; above zero it asks
    for the calibration. Body axes.
    """

    gyro_scale_error: Array | None = optional_shaped(3)
    """(3,) rates are read ``1 + gyro_scale_error`` too large; None for none, as in the next."""
    gyro_misalignment: Array | None = optional_shaped(6)
    """(6,) rad, xy, xz, yx, yz, zx, zy: what the gyro of the first axis reads of the second."""
    gyro_g_sensitivity: Array | None = optional_shaped(9)
    """(9,) rad/s per m/s^2, row by row: what the gyro of each axis reads of x, y and z."""
    accel_scale_error: Array | None = optional_shaped(3)
    """(3,) forces are read so much too large."""
    accel_misalignment: Array | None = optional_shaped(6)
    """(6,) rad, as those of the gyros."""
    gyro_scale_sigma: float = 0.0
    """1"""
    gyro_misalignment_sigma: float = 0.0
    """rad"""
    gyro_g_sensitivity_sigma: float = 0.0
    """rad/s per m/s^2"""
    accel_scale_sigma: float = 0.0
    """1"""
    accel_misalignment_sigma: float = 0.0
    """rad"""
    time_offset_s: float = 0.0
    """How late stamps are, s: latency and the group delay of the unit's filters."""

    @property
    def is_stated(self) -> bool:
        """Whether any error of the readings is known."""
        values = (getattr(self, name) for name in VALUES)
        return any(value is not None and bool(value.any()) for value in values)

    @property
    def is_asked(self) -> bool:
        """Whether any of it is to be found."""
        return any(getattr(self, f"{name}_sigma") > 0.0 for name in CALIBRATED)

    def exact(self) -> ImuCalibration:
        """Return what is asked for of sensors whose known errors are taken off."""
        none: dict[str, Any] = dict.fromkeys(VALUES)
        return replace(self, **none, time_offset_s=0.0)

    def taken_off(self, gyro_b: Array, accel_b: Array) -> tuple[Array, Array]:
        """Return readings (N, 3) of gyros and accelerometers without what is known."""
        if not self.is_stated:
            return gyro_b, accel_b
        S_g = _matrix(self.gyro_scale_error, self.gyro_misalignment)
        S_a = _matrix(self.accel_scale_error, self.accel_misalignment)
        force = np.linalg.solve(np.eye(3) + S_a, accel_b.T)
        rate = np.linalg.solve(np.eye(3) + S_g, gyro_b.T - _matrix(self.gyro_g_sensitivity) @ force)
        return np.asarray(rate.T), np.asarray(force.T)


def _matrix(*parts: Array | None) -> Array:
    """Return the matrix (3, 3) of some of its numbers, zero where there are none."""
    matrix = np.zeros(9)
    for part in parts:
        if part is not None:
            matrix[MATRIX_PLACES[len(part)]] = part
    return matrix.reshape(3, 3)


_PPM_HINT: Final = "the unit is ppm, millionths: 1 % is 10000"
_MRAD_HINT: Final = "the unit is milliradians: 1 degree is 17.45"
_G_HINT: Final = "the unit is deg/h per g"
MOST_LATE_S: Final = 1.0
"""s; filters of a unit are ten times as fast, and what is later belongs to another clock."""


def calibration_keys(owner: str) -> dict[str, Key]:
    """Return the keys of the calibration; ``owner`` is the field that has it."""
    matrix: dict[str, Any] = {"is_body_matrix": True}
    keys = {
        "time_offset_s": optional_key(f"{owner}.time_offset_s", -MOST_LATE_S, MOST_LATE_S, SECONDS)
    }
    for sensor in ("gyro", "accel"):
        scale, misalignment = f"{owner}.{sensor}_scale", f"{owner}.{sensor}_misalignment"
        keys |= {
            f"{sensor}_scale_error_ppm": optional_key(
                f"{scale}_error", -9e5, 9e6, _PPM_HINT, unit=PPM, shape=(3,), **matrix
            ),
            f"{sensor}_scale_sigma_ppm": optional_key(
                f"{scale}_sigma", 0.0, 1e6, _PPM_HINT, unit=PPM
            ),
            f"{sensor}_misalignment_mrad": optional_key(
                misalignment, -500.0, 500.0, _MRAD_HINT, unit=MRAD, shape=(6,), **matrix
            ),
            f"{sensor}_misalignment_sigma_mrad": optional_key(
                f"{misalignment}_sigma", 0.0, 500.0, _MRAD_HINT, unit=MRAD
            ),
        }
    by_force = f"{owner}.gyro_g_sensitivity"
    return keys | {
        "gyro_g_sensitivity_deg_per_h_per_g": optional_key(
            by_force, -1e5, 1e5, _G_HINT, unit=DEG_PER_H_PER_G, shape=(9,), **matrix
        ),
        "gyro_g_sensitivity_sigma_deg_per_h_per_g": optional_key(
            f"{by_force}_sigma", 0.0, 1e5, _G_HINT, unit=DEG_PER_H_PER_G
        ),
    }


def _further(sensor: str) -> Callable[[Any, float | Array, Array], Array]:
    """Return how a matrix of errors that are found goes on top of a stated one.

    Of ``(I + S) (I + off)`` products of two misalignments, parts in a million, are left out.
    """

    def total(log: Any, stated: float | Array | None, off: Array) -> Array:
        scale = getattr(log.calibration, f"{sensor}_scale_error")
        row = np.array(MATRIX_PLACES[len(off)]) // 3
        own = 1.0 if scale is None else 1.0 + scale[row]
        return np.asarray((0.0 if stated is None else stated) + own * off)

    return total


CALIBRATED: Final = {
    "gyro_scale": Calibrated("gyro_scale_error_ppm", "gyro_scale_sigma_ppm", compounded),
    "gyro_misalignment": Calibrated(
        "gyro_misalignment_mrad", "gyro_misalignment_sigma_mrad", _further("gyro")
    ),
    "gyro_g_sensitivity": Calibrated(
        "gyro_g_sensitivity_deg_per_h_per_g",
        "gyro_g_sensitivity_sigma_deg_per_h_per_g",
        _further("gyro"),
    ),
    "accel_scale": Calibrated("accel_scale_error_ppm", "accel_scale_sigma_ppm", compounded),
    "accel_misalignment": Calibrated(
        "accel_misalignment_mrad", "accel_misalignment_sigma_mrad", _further("accel")
    ),
}
"""By the names of the variables."""
LABELS: Final = {3: ("x", "y", "z"), 6: ("xy", "xz", "yx", "yz", "zx", "zy")} | {
    9: tuple(a + b for a in "xyz" for b in "xyz")
}
"""Of so many numbers of a matrix."""
UNITS: Final = {
    "gyro_scale": ("ppm", PPM),
    "gyro_misalignment": ("mrad", MRAD),
    "gyro_g_sensitivity": ("deg_per_h_per_g", DEG_PER_H_PER_G),
    "accel_scale": ("ppm", PPM),
    "accel_misalignment": ("mrad", MRAD),
}
"""By the names of the variables: what they are shown in, and one of it in SI."""
