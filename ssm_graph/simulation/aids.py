"""Depth sensor and surface GNSS, each at the end of its own lever arm."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ssm_graph.base.earth import R_el_from_lat_lon, geodetic_from_ecef
from ssm_graph.base.frozen import Array
from ssm_graph.sensors.depth import DepthLog
from ssm_graph.sensors.gnss import GnssLog
from ssm_graph.simulation._checks import require, require_positive, require_window
from ssm_graph.simulation.drifts import DriftSettings, draw_drift
from ssm_graph.simulation.trajectory import Trajectory, stacked

Point = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class DepthSettings:
    """A pressure sensor."""

    rate_hz: float = 2.0
    sigma: float = 0.05
    """m"""
    lever_arm_b: Point = (0.2, 0.1, 0.0)
    """Body origin to sensor, body axes, m."""
    offset: float = 0.0
    """Depths are read too large by this much, m."""

    def __post_init__(self) -> None:
        require_positive("DepthSettings.rate_hz", self.rate_hz, hint="try 2 Hz")
        require_positive("DepthSettings.sigma", self.sigma, hint="try 0.05 m")
        require_point("DepthSettings.lever_arm_b", self.lever_arm_b)


@dataclass(frozen=True, slots=True)
class GnssSettings:
    """A receiver that works at the surface only."""

    rate_hz: float = 1.0
    sigma_horizontal: float = 0.5
    """Each of east and north, m."""
    sigma_vertical: float = 1.0
    """m"""
    lever_arm_b: Point = (-0.3, 0.0, -0.6)
    """Body origin to antenna, body axes, m."""
    lever_arm_error_b: Point = (0.0, 0.0, 0.0)
    """The antenna truly sits this much further on, m."""
    late_s: float = 0.0
    """Stamps are later than the fixes by this much, s."""
    drift: DriftSettings | None = None
    """Of the fixes on top of their noise, each of east, north and up, m."""
    windows: tuple[tuple[float, float], ...] | None = None
    """Times with fixes, s, each ``[start, end)``; None for whenever the route is at the surface."""
    surface_depth_m: float = 0.5
    """The route is at the surface where its depth, waves left out, is less than this, m."""

    def __post_init__(self) -> None:
        require_positive("GnssSettings.rate_hz", self.rate_hz, hint="try 1 Hz")
        require_positive("GnssSettings.sigma_horizontal", self.sigma_horizontal, hint="try 0.5 m")
        require_positive("GnssSettings.sigma_vertical", self.sigma_vertical, hint="try 1 m")
        require_point("GnssSettings.lever_arm_b", self.lever_arm_b)
        require_point("GnssSettings.lever_arm_error_b", self.lever_arm_error_b)
        for window in self.windows or ():
            require_window("GnssSettings.windows", *window)


def require_point(where: str, point: Point) -> None:
    """Raise :class:`ConfigError` for a point that is not three finite numbers."""
    require(
        len(point) == 3 and all(math.isfinite(c) for c in point),
        where,
        expected="three finite numbers, m",
        got=point,
        hint="body axes are forward, right, down",
    )


def depth_log(
    trajectory: Trajectory,
    settings: DepthSettings,
    *,
    end_s: float,
    rng: np.random.Generator | None,
) -> DepthLog:
    """Return the depth of the sensor over ``(0, end_s]``; None draws no noise."""
    time_s = regular_times(settings.rate_hz, end_s)
    point_e = trajectory.at(time_s).point_e(np.array(settings.lever_arm_b))
    depth = settings.offset - geodetic_from_ecef(stacked(point_e))[2]
    if rng is not None:
        depth = depth + settings.sigma * rng.standard_normal(len(time_s))
    return DepthLog(
        sigma=settings.sigma,
        time_s=time_s,
        depth=depth,
        lever_arm_b=np.array(settings.lever_arm_b),
    )


def gnss_log(
    trajectory: Trajectory,
    settings: GnssSettings,
    *,
    end_s: float,
    rng: np.random.Generator | None,
    drift_rng: np.random.Generator | None = None,
) -> GnssLog | None:
    """Return the fixes over ``(0, end_s]``; None if there is not one. No ``rng``, no noise."""
    time_s = regular_times(settings.rate_hz, end_s)
    sigma_enu = np.array(
        [settings.sigma_horizontal, settings.sigma_horizontal, settings.sigma_vertical]
    )
    # Drawn before fixes are chosen: a fix keeps its noise when the windows change.
    unit = np.zeros((len(time_s), 3)) if rng is None else rng.standard_normal((len(time_s), 3))
    noise_l = unit * sigma_enu
    if drift_rng is not None and settings.drift is not None:
        noise_l = noise_l + draw_drift(settings.drift, time_s, drift_rng)
    has_fix = _has_fix(trajectory, settings, time_s)
    if not has_fix.any():
        return None
    time_s, noise_l = time_s[has_fix], noise_l[has_fix]
    motion = trajectory.at(time_s)
    R_el = R_el_from_lat_lon(motion.lat.value, motion.lon.value)
    true_arm_b = np.array(settings.lever_arm_b) + np.array(settings.lever_arm_error_b)
    antenna_e = stacked(motion.point_e(true_arm_b))
    noise_e = np.einsum("kij,kj->ki", R_el, noise_l)
    lat, lon, height = geodetic_from_ecef(antenna_e + noise_e)
    return GnssLog(
        time_s=time_s + settings.late_s,
        lat=lat,
        lon=lon,
        height=height,
        sigma_enu=np.broadcast_to(sigma_enu, (len(time_s), 3)),
        lever_arm_b=np.array(settings.lever_arm_b),
    )


def _has_fix(trajectory: Trajectory, settings: GnssSettings, time_s: Array) -> np.ndarray:
    if settings.windows is None:
        return np.asarray(trajectory.path_depth(time_s) < settings.surface_depth_m)
    inside = np.zeros(len(time_s), dtype=bool)
    for start_s, end_s in settings.windows:
        inside |= (start_s <= time_s) & (time_s < end_s)
    return inside


def regular_times(rate_hz: float, end_s: float) -> Array:
    """Return the times in ``(0, end_s]`` of what happens at a rate."""
    return np.arange(1, math.floor(end_s * rate_hz + 1e-9) + 1) / rate_hz
