"""GNSS receiver."""

from __future__ import annotations

from dataclasses import dataclass

from ssm_graph.base.frozen import Array, FrozenArrays, Vector, shaped
from ssm_graph.sensors.drift import Drift


@dataclass(frozen=True, slots=True)
class GnssCalibration:
    """What is known of the errors of a GNSS receiver, and what is asked for."""

    time_offset_s: float = 0.0
    """How late its stamps are, s."""
    time_offset_sigma_s: float = 0.0
    """Prior sigma of what is left of that, s; above zero asks for its calibration."""
    lever_arm_sigma: float = 0.0
    """Prior sigma of each component of the lever arm, m; above zero asks for its calibration."""
    drift: Drift = Drift()
    """What fixes are off by slowly, each of east, north and up, m."""


@dataclass(frozen=True, slots=True, eq=False)
class GnssLog(FrozenArrays):
    """Position fixes of a GNSS antenna."""

    time_s: Array = shaped("N")
    """(N,) s, strictly increasing."""
    lat: Array = shaped("N")
    """(N,) rad"""
    lon: Array = shaped("N")
    """(N,) rad"""
    height: Array = shaped("N")
    """(N,) m above the ellipsoid"""
    sigma_enu: Array = shaped("N", 3)
    """(N, 3) m, east, north, up, above zero."""
    lever_arm_b: Array = shaped(3)
    """(3,) body origin to antenna, m."""
    calibration: GnssCalibration = GnssCalibration()
    """Its time offset is taken off ``time_s`` already."""


@dataclass(frozen=True, slots=True)
class Fix:
    """One GNSS fix of the antenna."""

    time_s: float
    lat: float
    """rad"""
    lon: float
    """rad"""
    height: float
    """m above the ellipsoid"""
    sigma_enu: Vector
    """m"""
