"""The point estimate beside the set: an extended Kalman filter whose noise is that of the bounds.

A set has no most probable point. This filter has one, and what it says is moved into the set.
"""

from __future__ import annotations

import numpy as np

from ssm_graph.base.frozen import Array
from ssm_graph.base.units import wrapped
from ssm_graph.systems.sensor_network.codes import Indices
from ssm_graph.systems.sensor_network.motion import planar_step
from ssm_graph.systems.sensor_network.setting import Setting


class PointNodes:
    """All nodes of R runs: ``center`` (R, N, 3) and ``covariance`` (R, N, 3, 3)."""

    def __init__(self, setting: Setting, *, center: Array, is_corner: bool) -> None:
        """Start from the centres with P_0 / 3.

        Parameters
        ----------
        is_corner : noise is at the corners of its box (variance b^2), not uniform (b^2 / 3).
        """
        self.setting, self.center = setting, center.copy()
        share = 1.0 if is_corner else 1.0 / 3.0
        self.covariance = np.broadcast_to(
            setting.initial_variance / 3.0 * np.eye(3), (*center.shape, 3)
        )
        self.Q = np.diag(share * np.square(setting.motion_bound))
        angle = setting.compass_bound or 1.0
        position = share * setting.position_bound**2 + setting.step**2 / 12.0
        self.R = np.array([position, position, share * angle**2])

    def go_on_with(self, runs: Indices) -> None:
        """Lead some of the runs on, in the places of all."""
        self.center, self.covariance = self.center[runs], self.covariance[runs]

    def step(self, advance: Array, turn: Array, values: Array) -> None:
        """Predict, and use what came in time: values (R, N, senders, 3), NaN for none."""
        levels = np.asarray(self.setting.saturation)
        d = np.broadcast_to(advance, (*self.center.shape[:2], 2))
        theta = self.center[..., 2]
        F = np.broadcast_to(np.eye(3), self.covariance.shape).copy()
        F[..., 0, 2] = -np.sin(theta) * d[..., 0] - np.cos(theta) * d[..., 1]
        F[..., 1, 2] = np.cos(theta) * d[..., 0] - np.sin(theta) * d[..., 1]
        self.center = np.clip(planar_step(self.center, advance, turn), -levels, levels)
        P = F @ self.covariance @ np.swapaxes(F, -1, -2) + self.Q
        for sender in range(values.shape[2]):
            for axis in range(3):
                z = values[:, :, sender, axis]
                known = np.isfinite(z)
                if not known.any():
                    continue
                innovation = z - self.center[..., axis]
                if axis == 2:
                    innovation = wrapped(innovation)
                gain = P[..., axis] / (P[..., axis, axis] + self.R[axis])[..., None]
                move = np.where(known[..., None], gain * innovation[..., None], 0.0)
                self.center = self.center + move
                less = gain[..., :, None] * P[..., axis, None, :]
                P = np.where(known[..., None, None], P - less, P)
        self.covariance = P
