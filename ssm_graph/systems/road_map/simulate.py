"""Simulated drives over any map: a route along its lanes, a chassis, a receiver and a camera."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from ssm_graph.base.errors import DataError
from ssm_graph.base.frozen import Array
from ssm_graph.base.units import DEGREE
from ssm_graph.systems.road_map.camera import CameraModel, curves_of, seen
from ssm_graph.systems.road_map.drive import Chassis, Drive, GnssFixes, Poses
from ssm_graph.systems.road_map.maps.index import LineIndex
from ssm_graph.systems.road_map.maps.road_map import LineKind, RoadMap, line_length, resampled

_STEP_M: Final = 0.5
_SMOOTHING_M: Final = 5.0
_WANDER_M: Final = 0.15
"""Largest drift of the vehicle from the middle of its lane."""
_TRIES: Final = 400


@dataclass(frozen=True, slots=True, kw_only=True)
class DriveModel:
    """Everything about a simulated drive but its route."""

    length_m: float = 200.0
    speed: float = 8.0
    """m/s"""
    rate_hz: float = 10.0
    gnss_bias_m: float = 20.0
    """Fixes are off by a constant, uniform within as much along each axis."""
    gnss_sigma_m: float = 1.0
    """And by noise from fix to fix."""
    gnss_yaw_sigma: float = 3.0 * DEGREE
    speed_sigma: float = 0.01
    """Relative, of the speed's scale over the whole drive."""
    speed_noise_m: float = 0.005
    """Of the way in each step."""
    yaw_noise: float = 0.05 * DEGREE
    """rad in each step."""
    gyro_bias: float = 0.0
    """rad/s, standard deviation of a constant."""
    camera: CameraModel = CameraModel()


def random_route(road_map: RoadMap, length_m: float, rng: np.random.Generator) -> Array:
    """Return the middle of lanes that follow each other, (N, 2), so long and drawn at random."""
    starts = sorted(name for name, lane in road_map.lanes.items() if lane.is_road)
    if not starts:
        raise DataError(
            f"{road_map.name}: expected lanes for cars to drive along, got none; give a trajectory"
        )
    for _ in range(_TRIES):
        name, parts, total, passed = str(rng.choice(starts)), [], 0.0, set[str]()
        while total < length_m + 10.0 and name not in passed:
            passed.add(name)
            parts.append(road_map.lanes[name].centre())
            total += line_length(parts[-1])
            following = [
                n
                for n in road_map.lanes[name].successors
                if n in road_map.lanes and road_map.lanes[n].is_road
            ]
            if not following:
                break
            name = str(rng.choice(following))
        if total >= length_m + 10.0:
            route = np.concatenate([parts[0], *(part[1:] for part in parts[1:])])
            first = rng.uniform(0.0, total - length_m - 10.0)
            return cut(route, first, first + length_m + 10.0)
    raise DataError(
        f"{road_map.name}: expected a route of {length_m:.0f} m along its lanes, found none in "
        f"{_TRIES} tries; ask for a shorter one"
    )


def cut(route: Array, first_m: float, last_m: float) -> Array:
    """Return the part of a line (N, 2) between two lengths along it, m."""
    fine = resampled(route, _STEP_M)
    s = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(fine, axis=0).T))])
    return fine[(s >= first_m) & (s <= last_m)]


def driven(route: Array, model: DriveModel, rng: np.random.Generator) -> Poses:
    """Return the poses of a vehicle along a route (N, 2) at steady speed, near its middle."""
    from scipy.ndimage import uniform_filter1d

    fine = resampled(route, _STEP_M)
    n = max(3, int(_SMOOTHING_M / _STEP_M))
    smooth = uniform_filter1d(uniform_filter1d(fine, n, axis=0), n, axis=0)
    s = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(smooth, axis=0).T))])
    d = np.gradient(smooth, s, axis=0)
    normal = np.column_stack([-d[:, 1], d[:, 0]]) / np.hypot(*d.T)[:, None]
    wave, phase = rng.uniform(60.0, 120.0), rng.uniform(0.0, 2.0 * np.pi)
    aside = _WANDER_M * np.sin(2.0 * np.pi * s / wave + phase)
    path = smooth + aside[:, None] * normal
    s = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(path, axis=0).T))])
    end = min(model.length_m, s[-1] - 1.0)
    time_s = np.arange(0.0, end / model.speed, 1.0 / model.rate_hz)
    at = 0.5 + time_s * model.speed
    x, y = (np.interp(at, s, c) for c in path.T)
    ahead = np.column_stack([np.interp(at + 0.5, s, c) for c in path.T])
    behind = np.column_stack([np.interp(at - 0.5, s, c) for c in path.T])
    d = ahead - behind
    return Poses(time_s, np.column_stack([x, y]), np.unwrap(np.arctan2(d[:, 1], d[:, 0])))


def simulate_drive(
    name: str,
    truth: Poses,
    road_map: RoadMap | dict[LineKind, LineIndex],
    model: DriveModel,
    rng: np.random.Generator,
) -> Drive:
    """Return what a vehicle records on its way; the map is the true one."""
    indices = road_map if isinstance(road_map, dict) else indices_of(road_map)
    every = max(1, round(1.0 / (model.camera.rate_hz * np.median(np.diff(truth.time_s)))))
    pictures = range(0, len(truth.time_s), every)
    poses = np.column_stack([truth.x_y, truth.yaw])
    rows = [seen(poses[k], indices, model.camera, rng) for k in pictures]
    curves = curves_of([float(truth.time_s[k]) for k in pictures], rows)
    return Drive(
        name,
        _gnss(truth, model, rng),
        _chassis(truth, model, rng),
        curves,
        truth,
        gnss_bias_m=model.gnss_bias_m,
    )


def indices_of(road_map: RoadMap) -> dict[LineKind, LineIndex]:
    """Return an index for each kind of line that the map has."""
    found = {kind: road_map.of_kind(kind) for kind in LineKind}
    return {kind: LineIndex(lines) for kind, lines in found.items() if lines}


def _gnss(truth: Poses, model: DriveModel, rng: np.random.Generator) -> GnssFixes:
    time_s = np.arange(truth.time_s[0], truth.time_s[-1], 1.0)
    at = truth.at(time_s)
    bias = rng.uniform(-model.gnss_bias_m, model.gnss_bias_m, 2)
    x_y = at[:, :2] + bias + rng.normal(0.0, model.gnss_sigma_m, (len(time_s), 2))
    yaw = at[:, 2] + rng.normal(0.0, model.gnss_yaw_sigma, len(time_s))
    # Of a uniform distribution, and of the noise on it.
    sigma = np.hypot(model.gnss_bias_m / np.sqrt(3.0), model.gnss_sigma_m)
    return GnssFixes(time_s, x_y, np.full(len(time_s), sigma), yaw)


def _chassis(truth: Poses, model: DriveModel, rng: np.random.Generator) -> Chassis:
    dt = np.diff(truth.time_s)
    way = np.hypot(*np.diff(truth.x_y, axis=0).T)
    turn = np.diff(np.unwrap(truth.yaw))
    scale = 1.0 + rng.normal(0.0, model.speed_sigma)
    bias = rng.normal(0.0, model.gyro_bias) if model.gyro_bias > 0.0 else 0.0
    # A rate that is integrated by the trapezoidal rule gives the turn of each step.
    speed = np.gradient(np.concatenate([[0.0], np.cumsum(way)]), truth.time_s)
    rate = np.gradient(np.concatenate([[0.0], np.cumsum(turn)]), truth.time_s)
    speed = scale * speed + rng.normal(0.0, model.speed_noise_m / dt[0], len(speed))
    rate = rate + bias + rng.normal(0.0, model.yaw_noise / dt[0], len(rate))
    return Chassis(truth.time_s, speed, rate)


def damaged(
    road_map: RoadMap, rng: np.random.Generator, *, missing: float, shifted: float, by_m: float
) -> RoadMap:
    """Return the map with shares of its boundaries missing and others shifted sideways, m."""
    lines = []
    for line in road_map.lines:
        draw = rng.random()
        if line.kind is LineKind.BOUNDARY and draw < missing:
            continue
        if line.kind is LineKind.BOUNDARY and draw < missing + shifted:
            d = line.points[-1] - line.points[0]
            normal = np.array([-d[1], d[0]]) / max(float(np.hypot(*d)), 1e-9)
            line = replace(line, points=line.points + rng.choice([-by_m, by_m]) * normal)
        lines.append(line)
    return replace(road_map, lines=tuple(lines))


def mirrored(road_map: RoadMap) -> RoadMap:
    """Return the map with north and south exchanged: traffic keeps to the other side."""
    turn = np.array([1.0, -1.0])
    lanes = {
        name: replace(lane, left=lane.right * turn, right=lane.left * turn)
        for name, lane in road_map.lanes.items()
    }
    lines = tuple(replace(line, points=line.points * turn) for line in road_map.lines)
    return replace(road_map, lines=lines, lanes=lanes, projection=None)
