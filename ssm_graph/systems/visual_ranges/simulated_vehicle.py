"""Depth and dead reckoning of a simulated vehicle that carries the camera, with their errors.

Nothing of it is shared with the estimator: increments of the true path in the camera's axes, wrong
by scale and noise, are added up along an attitude that wanders.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.spatial.transform import Rotation

from ssm_graph.base.frozen import Array
from ssm_graph.systems.visual_ranges.vehicle import DeadReckoning, Depths, Vehicle

TO_DOWN: Final = np.diag([1.0, -1.0, -1.0])
"""World axes, whose third is up, to axes whose third is down."""
TILT_S: Final = 30.0
"""Time over which errors of roll and pitch change."""


@dataclass(frozen=True, slots=True)
class VehicleFaults:
    """What the vehicle measures, and how wrong."""

    rate_hz: float = 10.0
    has_depth: bool = True
    has_dead_reckoning: bool = True
    depth_sigma_m: float = 0.03
    step_m: float = 0.008
    """Random walk of the place, m after one second, each axis."""
    scale_share: float = 0.003
    """Standard deviation of the DVL's scale, constant in a run."""
    turn_rad: float = 5e-4
    """Random walk of the heading, rad after one second."""
    tilt_rad: float = 3e-3
    """Standard deviation of roll and pitch."""


def simulated_vehicle(
    asked: VehicleFaults, time_s: Array, R_wc: Array, p_w: Array, seed: int, share: float
) -> Vehicle:
    """Return what is measured along a true path, at times (n,) with poses (n, 3, 3), (n, 3).

    ``share``: standard deviation of the unit of the ranges, as told to the estimator.
    """
    rng = np.random.default_rng((seed, 16))
    n, step_s = len(time_s), np.diff(time_s)
    depth = -p_w[:, 2] + asked.depth_sigma_m * rng.standard_normal(n)
    heading = np.cumsum(
        np.concatenate([[0.0], asked.turn_rad * np.sqrt(step_s) * rng.standard_normal(n - 1)])
    )
    tilt = np.zeros((n, 2))
    tilt[0] = asked.tilt_rad * rng.standard_normal(2)
    for k in range(1, n):
        kept = np.exp(-step_s[k - 1] / TILT_S)
        fresh = np.sqrt(1.0 - kept**2) * asked.tilt_rad * rng.standard_normal(2)
        tilt[k] = kept * tilt[k - 1] + fresh
    wrong = Rotation.from_rotvec(np.column_stack([tilt, heading])).as_matrix()
    R_nc = wrong @ TO_DOWN @ R_wc
    scale = 1.0 + asked.scale_share * rng.standard_normal()
    way_c = np.einsum("nji,nj->ni", R_wc[:-1], np.diff(p_w, axis=0)) * scale
    way_c += asked.step_m * np.sqrt(step_s)[:, None] * rng.standard_normal((n - 1, 3))
    way = np.cumsum(np.einsum("nij,nj->ni", R_nc[:-1], way_c), axis=0)
    position = np.vstack([np.zeros(3), way])
    return Vehicle(
        Depths(time_s, depth) if asked.has_depth else None,
        DeadReckoning(time_s, position, Rotation.from_matrix(R_nc).as_quat())
        if asked.has_dead_reckoning
        else None,
        share,
    )
