"""How a vehicle moves in the plane: poses, controls, and where their noise enters.

A pose is (x, y [m], heading [rad]), the heading positive from x to y. Leading axes broadcast.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import final

import numpy as np

from factors.bearing_range import half_turn
from ssm_graph.base.errors import ConfigError
from ssm_graph.base.frozen import Array


class Motion(ABC):
    """A motion with a control that is known but for its noise."""

    labels: tuple[str, ...]
    """(q,) what each component of the noise is, with its unit."""

    @abstractmethod
    def increment(self, control: Array, noise: Array) -> Array:
        """Return how far the pose moves (..., 3), in the axes of the pose before.

        ``control`` (..., c) is what was measured or commanded, ``noise`` (..., q) what comes to it.
        """

    @abstractmethod
    def basis(self, control: Array) -> Array:
        """Return the derivative (..., 3, q) of the increment by the noise, at none."""

    def move(self, pose: Array, control: Array, noise: Array) -> Array:
        """Return the poses (..., 3) after a step."""
        return composed(pose, self.increment(control, noise))

    def slopes(self, pose: Array, control: Array) -> tuple[Array, Array, Array]:
        """Return the pose after a noiseless step, its derivatives by the pose and by the noise."""
        basis = self.basis(control)
        step = self.increment(control, np.zeros((*control.shape[:-1], basis.shape[-1])))
        rotation = turned(pose[..., 2])
        moved = composed(pose, step)
        by_pose = np.broadcast_to(np.eye(3), (*moved.shape[:-1], 3, 3)).copy()
        shift = moved[..., :2] - pose[..., :2]
        by_pose[..., 0, 2], by_pose[..., 1, 2] = -shift[..., 1], shift[..., 0]
        return moved, by_pose, rotation @ basis


def turned(heading: Array) -> Array:
    """Return rotations (..., 3, 3) of an increment from the axes of a pose to those of the map."""
    c, s = np.cos(heading), np.sin(heading)
    rotation = np.zeros((*np.shape(heading), 3, 3))
    rotation[..., 0, 0] = rotation[..., 1, 1] = c
    rotation[..., 0, 1], rotation[..., 1, 0] = -s, s
    rotation[..., 2, 2] = 1.0
    return rotation


def composed(pose: Array, step: Array) -> Array:
    """Return the pose (..., 3) after an increment (..., 3) in its own axes."""
    c, s = np.cos(pose[..., 2]), np.sin(pose[..., 2])
    x = pose[..., 0] + c * step[..., 0] - s * step[..., 1]
    y = pose[..., 1] + s * step[..., 0] + c * step[..., 1]
    return np.stack([x, y, half_turn(pose[..., 2] + step[..., 2])], axis=-1)


def between(pose: Array, other: Array) -> Array:
    """Return the increment (..., 3) that takes a pose to another: the inverse of `composed`."""
    d = other - pose
    c, s = np.cos(pose[..., 2]), np.sin(pose[..., 2])
    along, across = c * d[..., 0] + s * d[..., 1], c * d[..., 1] - s * d[..., 0]
    return np.stack([along, across, half_turn(d[..., 2])], axis=-1)


@final
@dataclass(frozen=True, slots=True)
class Bicycle(Motion):
    """Bailey's vehicle: ``x' = x + d cos(h + g), y' = y + d sin(h + g), h' = h + d sin(g) / B``.

    The control is the distance ``d`` [m] of the step and the steering angle ``g`` [rad], each with
    its noise.

    References
    ----------
    .. [1] T. Bailey, "SLAM Simulations", ACFR, University of Sydney: `vehicle_model.m`.
    """

    wheel_base_m: float = 1.0

    labels = ("distance, m", "steering, rad")

    def __post_init__(self) -> None:
        if not 0.0 < self.wheel_base_m < np.inf:
            raise ConfigError(
                f"wheel_base_m: expected metres above 0, got {self.wheel_base_m}; try 1"
            )

    def increment(self, control: Array, noise: Array) -> Array:  # noqa: D102
        d, g = control[..., 0] + noise[..., 0], control[..., 1] + noise[..., 1]
        c, s = np.cos(g), np.sin(g)
        return np.stack([d * c, d * s, d * s / self.wheel_base_m], axis=-1)

    def basis(self, control: Array) -> Array:  # noqa: D102
        d, g = control[..., 0], control[..., 1]
        c, s, b = np.cos(g), np.sin(g), self.wheel_base_m
        by_distance = np.stack([c, s, s / b], axis=-1)
        by_steering = np.stack([-d * s, d * c, d * c / b], axis=-1)
        return np.stack([by_distance, by_steering], axis=-1)


@final
@dataclass(frozen=True, slots=True)
class Odometry(Motion):
    """Increments from odometry: forward, to the side, turn; last in a control are three scales.

    The control (..., 6) is the increment [m, m, rad] and by what each component of the noise is
    multiplied: a square root of seconds for noise that grows like a random walk.
    """

    labels = ("forward, m/sqrt(s)", "sideways, m/sqrt(s)", "turn, rad/sqrt(s)")

    def increment(self, control: Array, noise: Array) -> Array:  # noqa: D102
        return np.asarray(control[..., :3] + control[..., 3:] * noise)

    def basis(self, control: Array) -> Array:  # noqa: D102
        return np.asarray(control[..., 3:, None] * np.eye(3))


@final
@dataclass(frozen=True, slots=True)
class Increments(Motion):
    """Increments with a covariance each: of graphs, or of several steps put together.

    The control (..., 12) is the increment [m, m, rad] and, row by row, the root (3, 3) by which
    noise of unit size comes to it.
    """

    labels = ("first root", "second root", "third root")

    def increment(self, control: Array, noise: Array) -> Array:  # noqa: D102
        return np.asarray(control[..., :3] + (self.basis(control) @ noise[..., None])[..., 0])

    def basis(self, control: Array) -> Array:  # noqa: D102
        return np.asarray(control[..., 3:].reshape(*control.shape[:-1], 3, 3))


def increments_of(step: Array, cov: Array) -> Array:
    """Return controls (N, 12) of `Increments` from steps (N, 3) and covariances (N, 3, 3)."""
    return np.hstack([step, np.linalg.cholesky(cov).reshape(len(step), 9)])
