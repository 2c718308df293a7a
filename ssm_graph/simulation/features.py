"""A sonar that finds points of the seabed again; off unless it is asked for."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ssm_graph.base.earth import LocalFrame, ecef_from_geodetic
from ssm_graph.base.frozen import Array
from ssm_graph.sensors.dvl import R_bd_from_rpy
from ssm_graph.sensors.features import FeatureLog
from ssm_graph.simulation import checked
from ssm_graph.simulation.aids import GrossErrors, Mask, Point, gross_errors, regular_times
from ssm_graph.simulation.randomness import Streams
from ssm_graph.simulation.trajectory import Trajectory, stacked


@dataclass(frozen=True, slots=True)
class FeatureSettings(checked.Settings):
    """A sonar that looks ahead and the points that it may see."""

    places: tuple[Point, ...]
    """East, north and up of each from the start of the mission at the surface, m; from number 1."""
    interval_s: float = checked.positive(1.0, hint="try 1 s")
    """From one look to the next; a look finds all that is in view."""
    reach_m: float = checked.positive(40.0, hint="try 40 m")
    half_width: float = checked.positive(math.radians(65.0), hint="try 1.1 rad")
    """It sees so far to both sides of its axis, rad."""
    range_sigma: float = checked.positive(0.05, hint="try 0.05 m")
    """m"""
    angle_sigma: float = checked.positive(math.radians(1.0), hint="try 0.02 rad")
    """Across and upwards, rad."""
    mounting_rpy: Point = checked.point((0.0, -math.radians(20.0), 0.0))
    """rad; it looks down by this pitch."""
    lever_arm_b: Point = checked.point((0.8, 0.0, 0.1))
    """Body origin to instrument, body axes, m."""
    gross: GrossErrors = GrossErrors(size=(2.0, 20.0))
    """Another point taken for this one: it lies so far from it, m."""

    def read(
        self, trajectory: Trajectory, *, end_s: float, streams: Streams, noisy: bool
    ) -> tuple[FeatureLog, Mask]:
        """Return the sightings over ``(0, end_s]``, and which are of another point."""
        rng = streams.of("features")
        time_s = regular_times(1.0 / self.interval_s, end_s)
        look, point = np.divmod(np.arange(len(time_s) * len(self.places)), len(self.places))
        noise, towards = rng.standard_normal((2, len(look), 3))
        size, is_gross = gross_errors(self.gross, len(look), rng=rng)
        towards *= (size / np.linalg.norm(towards, axis=1))[:, None]
        true_s = self._sights(trajectory, time_s, np.zeros((len(look), 3)))
        seen_s = self._sights(trajectory, time_s, towards)
        bearing = np.arctan2(true_s[:, 1], true_s[:, 0])
        away = np.linalg.norm(true_s, axis=1)
        in_view = (away < self.reach_m) & (np.abs(bearing) < self.half_width)
        off = float(noisy) * noise * [self.range_sigma, self.angle_sigma, self.angle_sigma]
        range_m = np.maximum(np.linalg.norm(seen_s, axis=1) + off[:, 0], 1e-2)
        along = _turned(seen_s, off[:, 1:])[in_view]
        log = FeatureLog(
            range_sigma=self.range_sigma,
            angle_sigma=self.angle_sigma,
            mounting_rpy=np.array(self.mounting_rpy),
            time_s=time_s[look[in_view]],
            feature=1.0 + point[in_view],
            range_m=range_m[in_view],
            bearing=np.arctan2(along[:, 1], along[:, 0]),
            elevation=np.arctan2(-along[:, 2], np.hypot(along[:, 0], along[:, 1])),
            lever_arm_b=np.array(self.lever_arm_b),
        )
        return log, is_gross[in_view]

    def _sights(self, trajectory: Trajectory, time_s: Array, off_enu: Array) -> Array:
        """Return the points in the instrument's axes, look by look, each off by so much (N, 3)."""
        frame = LocalFrame(trajectory.lat, trajectory.lon, 0.0)
        place_n = np.tile(np.array(self.places), (len(time_s), 1)) + off_enu
        place_e = ecef_from_geodetic(*frame.geodetic_from_p_n(place_n))
        at, count = trajectory.at(time_s), len(self.places)
        origin_e = stacked(at.point_e(np.array(self.lever_arm_b)))
        ends = [stacked(at.point_e(np.array(self.lever_arm_b) + axis)) for axis in np.eye(3)]
        axes_e = np.repeat(np.stack([end - origin_e for end in ends], axis=1), count, axis=0)
        sight_b = np.einsum("nij,nj->ni", axes_e, place_e - np.repeat(origin_e, count, axis=0))
        return np.asarray(sight_b @ R_bd_from_rpy(np.array(self.mounting_rpy)))


def _turned(sight_s: Array, by: Array) -> Array:
    """Return sights (N, 3) turned to starboard and upwards by small angles (N, 2), of length 1."""
    along = sight_s / np.linalg.norm(sight_s, axis=1, keepdims=True)
    bearing = np.arctan2(along[:, 1], along[:, 0])
    starboard = np.column_stack([-np.sin(bearing), np.cos(bearing), np.zeros(len(bearing))])
    turned = along + np.tan(by[:, :1]) * starboard
    turned += np.tan(by[:, 1:]) * np.cross(starboard, along)
    return np.asarray(turned / np.linalg.norm(turned, axis=1, keepdims=True))
