"""What is summed up over a block of some seconds, from ping to ping."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ssm_graph.base.frozen import Array
from ssm_graph.filters.rules.ellipsoids import Ellipsoids


class BlockRow(NamedTuple):
    """What is left of a block; the order is that of the track's fields."""

    way: Array
    bound: Array
    turn: float
    angle: float
    end_s: float
    speed: float
    closing: float
    tilt: float


def worst_sigma(covariance: Array) -> float:
    """Return the sigma of a vector (3,) along its worst direction."""
    return math.sqrt(float(np.linalg.eigvalsh(covariance)[-1]))


class Block:
    """Sums over a block: from ping to ping by inertial data, bent so that both ends fit."""

    def __init__(self, velocity: Array) -> None:
        self.velocity = self.last = velocity
        self.first: Array | None = None
        self.latest: Array | None = None
        self.way, self.gain, self.gain_to_ping = np.zeros(3), np.zeros(3), np.zeros(3)
        self.covariance, self.earliest = np.zeros((3, 3)), np.zeros((3, 3))
        self._pull: Array | None = None
        self.since_first_s = 0.0
        self.span_s = self.path = self.climbed = self.changed = self.curved = self.turned = 0.0
        self.unseen = self.open_s = self.closing = self.bent = 0.0

    def step(self, gain: Array, dt: float) -> Array:
        """Add an interval of so much gain (3,) of velocity and return its way (3,)."""
        middle = self.velocity + 0.5 * gain
        self.velocity = self.velocity + gain
        self.way, self.gain = self.way + middle * dt, self.gain + gain
        self.path += float(np.linalg.norm(middle)) * dt
        self.climbed += abs(float(middle[2])) * dt
        self.changed += float(np.linalg.norm(gain))
        if self._pull is not None:  # what the acceleration changes by bends the way within a step
            self.curved += 0.125 * float(np.linalg.norm(gain - self._pull * dt)) * dt
        self._pull = gain / dt
        self.span_s, self.open_s = self.span_s + dt, self.open_s + dt
        return np.asarray(middle * dt)

    def close(self, velocity: Array, covariance: Array, force: float) -> Array:
        """Bend the way since the last ping to the velocity of this one; return the correction.

        ``force`` bounds the error of the acceleration, m/s^2: between two known velocities it
        takes the way at most ``force T^2 / 4`` aside.
        """
        bend = 0.5 * (velocity - self.velocity) * self.open_s
        self.way = self.way + bend
        self.covariance += covariance * self.open_s**2
        self.bent += 0.25 * force * self.open_s**2
        self.closing = max(self.closing, float(np.linalg.norm(bend)))
        if self.first is None:
            self.first, self.earliest, self.gain = velocity, covariance, np.zeros(3)
            self.since_first_s = self.span_s
        self.gain_to_ping = self.gain
        self.latest, self.last, self.velocity, self.open_s = covariance, velocity, velocity, 0.0
        return np.asarray(bend)

    def leave_open(self, velocities: Ellipsoids) -> None:
        """Bound what is not known since the last ping, by the set of velocities."""
        if self.open_s > 0.0:
            off = np.max(np.abs(self.velocity - velocities.center) + velocities.half_widths)
            self.unseen = float(off) * self.open_s
