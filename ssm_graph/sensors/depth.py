"""Depth sensor."""

from __future__ import annotations

from dataclasses import dataclass

from ssm_graph.base.frozen import Array, FrozenArrays, shaped


@dataclass(frozen=True, slots=True)
class DepthCalibration:
    """What is known of the errors of a depth sensor, and what is asked for."""

    offset: float = 0.0
    """Depths are read too large by so much, m."""
    offset_sigma: float = 0.0
    """Prior sigma of what is left of that, m; above zero asks for its calibration."""


@dataclass(frozen=True, slots=True, eq=False)
class DepthLog(FrozenArrays):
    """Depth: minus the ellipsoidal height of the sensor."""

    sigma: float
    """Standard deviation, m."""
    time_s: Array = shaped("N")
    """(N,) s, strictly increasing."""
    depth: Array = shaped("N")
    """(N,) m, positive down."""
    lever_arm_b: Array = shaped(3)
    """(3,) body origin to sensor, m."""
    calibration: DepthCalibration = DepthCalibration()
    """Its offset is taken off ``depth`` already."""


@dataclass(frozen=True, slots=True)
class DepthReading:
    """One depth reading."""

    time_s: float
    depth: float
    """m, positive down: minus the height of the sensor; its offset is not yet taken off."""
