"""What may be wrong with a mission's clocks, units and axes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from ssm_graph.base.frozen import Array


@dataclass(frozen=True)
class Delay:
    """How late the stamps of an instrument are; what differs from a switch on was set there."""

    before_s: float = 0.0
    after_s: float = 0.0
    switch_s: float = -np.inf

    def at(self, time_s: Array) -> Array:
        """Return the delay at stamps (n,)."""
        return np.where(time_s < self.switch_s, self.before_s, self.after_s)

    def later(self, by_s: float) -> Delay:
        """Return a delay that is longer throughout."""
        return Delay(self.before_s + by_s, self.after_s + by_s, self.switch_s)


ON_TIME: Final = Delay()


@dataclass(frozen=True)
class Hypothesis:
    """What is wrong with the logs; by default nothing."""

    gyro: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """Readings about x, y, z are to be multiplied by these."""
    velocity: tuple[float, ...] = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
    """(9,) matrix, row by row, that leads the velocities of the DVL to the true ones, body axes."""
    dvl: Delay = ON_TIME
    gnss: Delay = ON_TIME
    depth: Delay = ON_TIME
    compass: Delay = ON_TIME
    depth_scale: float = 1.0
    """Depths are to be multiplied by this."""
    is_swapped: bool = False
    """Whether longitudes and latitudes of the fixes have changed places."""
    jump_s: float = -np.inf
    """Before this, fixes are off by a constant."""


NOTHING: Final = Hypothesis()


def with_delays(base: Hypothesis, delays: Mapping[str, Delay]) -> Hypothesis:
    """Return a hypothesis with other delays, by their names."""
    changes: dict[str, Any] = dict(delays)
    return replace(base, **changes)
