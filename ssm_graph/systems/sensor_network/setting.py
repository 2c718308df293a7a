"""What a network is told: its motion, bounds, graph, code and losses; and settings by name."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import Enum
from pathlib import Path
from typing import Any, Final

import numpy as np

from ssm_graph.base.errors import ConfigError
from ssm_graph.base.frozen import Array, Vector
from ssm_graph.base.settings import read_toml
from ssm_graph.systems.sensor_network.codes import MOST_BITS, require_step

KINDS: Final = ("network", "fleet")
"""Of a study."""
_ABOVE_ZERO: Final = {
    "saturation": 3,
    "motion_bound": 3,
    "position_bound": 1,
    "initial_variance": 1,
    "true_scale": 1,
}
"""What has to be positive and finite, and of how many numbers it is."""
FLOOR_SHARE: Final = 1e-3
"""Of the least bound: the half-width below which no cut makes a set thinner."""
RING: Final = ((1, 2), (1, 4), (2, 1), (2, 3), (3, 2), (3, 4), (4, 3), (4, 1))
"""Edges between four nodes; the patent's own are lost."""


class Share(Enum):
    """What neighbours send each other."""

    NONE = "nothing"
    MEASUREMENTS = "their measurements, which are strips to whoever hears them"
    ELLIPSOIDS = "their sets, which are intersected"


@dataclass(frozen=True, slots=True)
class Setting:
    """A network of nodes that watch one robot; numbers of the patent, or assumed where lost."""

    name: str = "patent"
    edges: tuple[tuple[int, int], ...] = RING
    """(i, j): node j sends to node i; numbers from 1."""
    n_nodes: int = 4
    n_steps: int = 40
    """m of the patent."""
    speed_m: float = 1.0
    """Advance in a step, m [assumed]."""
    turn_amplitude_rad: float = 0.25
    """The robot turns by ``amplitude * cos(rate * k)`` in step k [assumed]."""
    turn_rate_rad: float = 0.15
    saturation: Vector = (20.0, 30.0, 20.0)
    """Largest absolute value of each component: m, m, rad."""
    motion_bound: Vector = (0.3, 0.3, 0.4)
    """Of what is added to each component in a step: m, m, rad."""
    position_bound: float = 1.2
    """Of the noise of each component of a measured position, m."""
    compass_bound: float | None = None
    """Of the noise of a measured heading, rad; None where there is none."""
    initial_variance: float = 2.0
    """P_0 of the patent is so many times the identity."""
    d: float = 0.01
    """Interval of the quantiser, before the key."""
    key: float = 1.0
    """Of the patent: positions are divided by it before they are rounded. It is no encryption."""
    share: Share = Share.NONE
    loss: float = 0.0
    """Share of packets that are lost between nodes."""
    delay: tuple[int, int] = (0, 0)
    """Least and largest delay of packets, steps; each is drawn anew, so that they overtake."""
    bits: int = 32
    """Of an index between nodes; fewer are residues, which the receiver's set completes."""
    true_scale: float = 1.0
    """By which the noise of positions is larger than its bound says: above 1 it is a lie."""

    def __post_init__(self) -> None:
        require_step(self.d)
        if not (math.isfinite(self.key) and self.key > 0.0):
            raise ConfigError(f"[code] key: expected a number above 0, got {self.key}; try 1.0")
        require_step(self.step)
        for name, n in _ABOVE_ZERO.items():
            value = np.asarray(getattr(self, name), dtype=np.float64)
            if value.size != n or not np.all((value > 0.0) & np.isfinite(value)):
                text = f"expected {f'{n} numbers' if n > 1 else 'a number'} above 0"
                raise ConfigError(f"[setting] {name}: {text}, got {getattr(self, name)}")
        if not 1 <= self.bits <= MOST_BITS:
            raise ConfigError(f"[code] bits: expected 1 to {MOST_BITS}, got {self.bits}")
        if self.compass_bound is not None and not 0.0 < self.compass_bound < math.pi:
            raise ConfigError(
                f"[setting] compass_bound: expected between 0 and pi rad, got {self.compass_bound}"
            )
        if not (1 <= self.n_nodes <= 255 and self.n_steps >= 1):
            raise ConfigError(
                f"[setting]: expected 1 to 255 nodes and a step or more, got {self.n_nodes}, "
                f"{self.n_steps}"
            )
        for i, j in self.edges:
            if i == j or not (1 <= i <= self.n_nodes and 1 <= j <= self.n_nodes):
                raise ConfigError(
                    f"[network] edges: expected pairs of two different nodes of 1 to "
                    f"{self.n_nodes}, got ({i}, {j})"
                )
        if not 0.0 <= self.loss < 1.0:
            raise ConfigError(f"[network] loss: expected from 0 to below 1, got {self.loss}")
        if not 0 <= self.delay[0] <= self.delay[1] <= 50:
            raise ConfigError(
                f"[network] delay_steps: expected least and largest from 0 to 50, got {self.delay}"
            )

    @property
    def step(self) -> float:
        """Of the quantiser, m: ``key * d``."""
        return self.key * self.d

    @property
    def floor(self) -> Array:
        """(3,) half-widths below which nothing is told from rounding."""
        angle = self.compass_bound or self.motion_bound[2]
        least = min(self.position_bound, *self.motion_bound[:2])
        return FLOOR_SHARE * np.array([least, least, min(angle, self.motion_bound[2])])

    def hears(self) -> Array:
        """Return (N, N) 1 where node i hears node j."""
        heard = np.zeros((self.n_nodes, self.n_nodes))
        for i, j in self.edges:
            heard[i - 1, j - 1] = 1.0
        return heard

    @property
    def deaf(self) -> tuple[int, ...]:
        """Nodes that hear nobody."""
        return tuple(int(i) + 1 for i in np.flatnonzero(self.hears().sum(axis=1) == 0.0))

    def turn(self, k: int) -> float:
        """Return the turn in step k, rad."""
        return self.turn_amplitude_rad * math.cos(self.turn_rate_rad * k)


PATENT: Final = Setting()
QUIET: Final = replace(PATENT, name="quiet", motion_bound=(0.05, 0.05, 0.02), position_bound=0.3)
COMPASS: Final = replace(QUIET, name="compass", compass_bound=0.1)
SETTINGS: Final = {
    one.name: one
    for one in (
        PATENT,
        QUIET,
        COMPASS,
        replace(COMPASS, name="walls", saturation=(5.0, 4.0, 20.0)),
        replace(COMPASS, name="coarse", d=1.0),
    )
}
"""By name: the patent's noise; less of it; with a compass; where walls clip; in steps of 1 m."""


def read_study(path: Path) -> dict[str, Any]:
    """Return what a study file says; its ``kind`` is ``network`` where it says none."""
    try:
        raw = read_toml(path)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror or error}") from error
    kind = raw.setdefault("kind", "network")
    if kind not in KINDS:
        raise ConfigError(f"{path}: kind: expected one of {', '.join(KINDS)}, got {kind!r}")
    return raw
