"""Depth sensor."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from ssm_graph.base.errors import DataError
from ssm_graph.base.frames import BodyAxes
from ssm_graph.base.frozen import Array, FrozenArrays, shaped
from ssm_graph.base.settings import FILE_KEY, LEVER_ARM_KEY, optional_key, sigma_key
from ssm_graph.base.tables import Table
from ssm_graph.sensors.drift import Drift, drift_keys
from ssm_graph.sensors.instrument import Calibrated, Column, Instrument
from ssm_graph.sensors.messages import Message

DEEPEST_M: Final = 12_000.0
"""Depth, positive down; the deepest trench has 10,935 m."""
HIGHEST_M: Final = 6_500.0
"""Above the ellipsoid, where the highest lakes are; depth is minus the height of the sensor."""


@dataclass(frozen=True, slots=True)
class DepthCalibration:
    """What is known of the errors of a depth sensor, and what is asked for."""

    offset: float = 0.0
    """Depths are read too large by so much, m."""
    offset_sigma: float = 0.0
    """Prior sigma of what is left of that, m; above zero asks for its calibration."""
    drift: Drift = Drift()
    """What depths are off by slowly, m: swell, drag on the port, a sensor that warms up."""


@dataclass(frozen=True, slots=True, eq=False)
class DepthLog(FrozenArrays):
    """Depth: minus the ellipsoidal height of the sensor."""

    sigma: float
    """Standard deviation, m."""
    time_s: Array = shaped("N")
    """(N,) s, strictly increasing."""
    depth: Array = shaped("N")
    """(N,) m as read, positive down."""
    lever_arm_b: Array = shaped(3)
    """(3,) body origin to sensor, m."""
    calibration: DepthCalibration = DepthCalibration()

    @property
    def true_depth(self) -> Array:
        """(N,) m, positive down, without the known offset."""
        return np.asarray(self.depth - self.calibration.offset)


@dataclass(frozen=True, slots=True)
class DepthReading(Message):
    """One depth reading."""

    depth: float
    """m as read, positive down: minus the height of the sensor, and its offset."""


_METRES: Final = "the unit is metres"
_DEPTH: Final = Column(
    "depth",
    "depth_m",
    limits=(-HIGHEST_M, DEEPEST_M),
    expected="expected metres, positive down",
    told="depth {:g} m: a wrong unit?",
)
_KEYS: Final = {
    "file": FILE_KEY,
    "noise_m": sigma_key("sigma", 1000.0),
    "lever_arm_m": LEVER_ARM_KEY,
    "offset_m": optional_key("calibration.offset", -1000.0, 1000.0, _METRES),
    "offset_sigma_m": optional_key("calibration.offset_sigma", 0.0, 1000.0, _METRES),
    **drift_keys("drift_sigma_m", "calibration.drift", 1000.0, _METRES),
}


_CALIBRATED: Final = {"depth_offset": Calibrated("offset_m", "offset_sigma_m")}


class _Depth(Instrument):
    """The way of depth sensors: some give pressure, or millimetres."""

    def check(self, table: Table, bare: DepthLog, axes: BodyAxes) -> list[str]:
        depth = table["depth_m"]
        if len(depth) and np.median(np.abs(depth)) > DEEPEST_M:
            raise DataError(
                f"{table.label}: column 'depth_m' has a median of {np.median(depth):.6g}; expected "
                "metres below the ellipsoid; is it a pressure, or in millimetres?"
            )
        return super().check(table, bare, axes)


DEPTH: Final = _Depth(
    "depth", DepthLog, _KEYS, (_DEPTH,), DepthReading, "z", calibrated=_CALIBRATED
)
