"""A fleet of AUVs over acoustic links: each leads its own set on, and cuts it by ranges to others.

One vehicle speaks in a slot; who hears it gets its set, in few bytes, and by the time of flight a
range. A range is no strip but an annulus, which is not convex: it is cut to a strip along the line
between the centres, with what that leaves out bounded.
"""

from __future__ import annotations

import math
from collections import defaultdict
from dataclasses import dataclass
from typing import Final

import numpy as np

from ssm_graph.base.errors import ConfigError, DataError
from ssm_graph.base.frozen import Array, ReadOnlyArrays
from ssm_graph.filters.rules.ellipsoids import Ellipsoids, Mask, segments, sum_shape
from ssm_graph.filters.rules.set_membership import Sets, led_on, measured
from ssm_graph.systems.sensor_network.motion import planar_image, planar_step

FAR_M: Final = 1e6
"""A bound that cuts nothing."""
CENTER_STEP_M: Final = 0.05
AXIS_STEP_M: Final = 0.02
DEPTH_STEP_M: Final = 0.1
RHO_STEPS: Final = 127
SET_BYTES: Final = 20
"""Node 1, step 4, centre 2 x 3, half-widths 2 x 2, correlation 1, depths 2 x 2."""
_FLOOR: Final = np.array([1e-3, 1e-3, 1e-5])


@dataclass(frozen=True, slots=True)
class FleetSetting:
    """Vehicles, their bounds and their links; a step is a second."""

    n_vehicles: int = 4
    n_steps: int = 600
    speed_m_per_s: float = 1.2
    start_bound_m: float = 2.0
    dvl_bound_m_per_s: float = 0.02
    """Of each component of a velocity in body axes."""
    compass_bound_rad: float = math.radians(2.0)
    turn_bound_rad: float = math.radians(0.02)
    """Of the gyro's turn in a step."""
    depth_bound_m: float = 0.3
    range_bound_m: float = 0.5
    """Of a range, with what both have moved during the time of flight."""
    fix_bound_m: float = 2.5
    fix_every: int = 30
    """Steps between the fixes of those at the surface; 0 for none."""
    n_surfaced: int = 2
    """The first vehicles, which have fixes: two lines of position take two of them."""
    slot: int = 10
    """Steps from packet to packet; the vehicles take turns."""
    loss: float = 0.3
    false_range: float = 1.0
    """By which ranges err more than their bound says: above 1 it is a lie."""
    at_corners: bool = False
    """Whether every error is at one end of its bound or the other, instead of uniform within."""

    def __post_init__(self) -> None:
        if self.n_vehicles < 2 or self.slot < 1 or self.n_steps < 1:
            raise ConfigError("fleet: expected two vehicles, a step and a slot of a step, or more")
        if not 0.0 <= self.loss < 1.0:
            raise ConfigError(f"fleet: loss: expected from 0 to below 1, got {self.loss}")


def range_strip(
    own: Ellipsoids, other: Ellipsoids, low: Array, high: Array
) -> tuple[Array, Array, Array]:
    """Return a strip ``|h.x - value| <= bound`` around the places at a range from another set.

    With u along the line from the other's centre and z = x - y, ``|z| >= u.z`` always, so
    ``u.z <= high``. And ``u.z >= sqrt(low^2 - t^2)`` where t bounds what z has across u, if all of
    z is on the side of u; else there is no lower bound.

    Parameters
    ----------
    own : (...) places of two components of who hears.
    other : (...) places of who speaks.
    low, high : (...) bounds of the level distance, m.

    Returns
    -------
    h (..., 2), value (...) and bound (...), both m.
    """
    line = own.center - other.center
    distance = np.linalg.norm(line, axis=-1)
    u = line / np.maximum(distance, 1e-9)[..., None]
    across = np.stack([-u[..., 1], u[..., 0]], axis=-1)
    t = own.extent(across) + other.extent(across)
    along, reach = own.extent(u), other.extent(u)
    is_ahead = (distance - along - reach > 0.0) & (low > t)
    least = np.where(is_ahead, np.sqrt(np.maximum(low**2 - t**2, 0.0)), -FAR_M)
    at = np.einsum("...i,...i->...", u, other.center)
    first, last = least - reach + at, high + reach + at
    return u, 0.5 * (first + last), 0.5 * (last - first)


def packed_set(node: int, step: int, place: Ellipsoids, depth: tuple[float, float]) -> bytes:
    """Return a place (2,), (2, 2) and an interval of depths as `SET_BYTES` bytes that hold both.

    What rounds the centre is added to the shape, half-widths are rounded up, and the shape is made
    larger until it holds the true one: ``P~ - P`` positive semidefinite.
    """
    center = np.rint(place.center / CENTER_STEP_M).astype(int)
    half = 0.5 * CENTER_STEP_M * np.eye(2)
    P = sum_shape(np.concatenate([place.shape[None], segments(half)]))
    sigma = np.sqrt(np.diag(P))
    rho = round(float(P[0, 1] / (sigma[0] * sigma[1])) * RHO_STEPS)
    rho = int(np.clip(rho, 1 - RHO_STEPS, RHO_STEPS - 1))
    axes = np.ceil(sigma / AXIS_STEP_M).astype(int)
    while np.linalg.eigvalsh(_shape(axes, rho) - P)[0] < 0.0:
        axes = np.maximum(axes + 1, np.ceil(1.02 * axes).astype(int))
    # Nothing is above the water.
    low, high = (max(depth[0], 0.0), max(depth[1], 0.0))
    top, bottom = math.floor(low / DEPTH_STEP_M), math.ceil(high / DEPTH_STEP_M)
    if np.any(np.abs(center) >= 2**23) or np.any(axes >= 2**16) or not top <= bottom < 2**16:
        raise DataError(
            f"packet of vehicle {node + 1}, step {step}: its set does not fit {SET_BYTES} bytes: "
            f"centre {place.center}, half-widths {sigma}, depths {depth}"
        )
    return b"".join(
        [
            node.to_bytes(1, "big"),
            step.to_bytes(4, "big"),
            *(int(x).to_bytes(3, "big", signed=True) for x in center),
            *(int(x).to_bytes(2, "big") for x in axes),
            rho.to_bytes(1, "big", signed=True),
            top.to_bytes(2, "big"),
            bottom.to_bytes(2, "big"),
        ]
    )


def unpacked_set(packet: bytes) -> tuple[int, int, Ellipsoids, tuple[float, float]]:
    """Return node, step, place and depths of :func:`packed_set`."""
    if len(packet) != SET_BYTES:
        raise DataError(f"packet: expected {SET_BYTES} bytes, got {len(packet)}")
    center = [int.from_bytes(packet[i : i + 3], "big", signed=True) for i in (5, 8)]
    axes = np.array([int.from_bytes(packet[i : i + 2], "big") for i in (11, 13)])
    rho = int.from_bytes(packet[15:16], "big", signed=True)
    low, high = (int.from_bytes(packet[i : i + 2], "big") * DEPTH_STEP_M for i in (16, 18))
    place = Ellipsoids(np.array(center) * CENTER_STEP_M, _shape(axes, rho))
    return packet[0], int.from_bytes(packet[1:5], "big"), place, (low, high)


def _shape(axes: Array, rho: int) -> Array:
    s, r = axes * AXIS_STEP_M, rho / RHO_STEPS
    return np.array([[s[0] ** 2, r * s[0] * s[1]], [r * s[0] * s[1], s[1] ** 2]])


@dataclass(frozen=True, slots=True, eq=False)
class FleetTrial(ReadOnlyArrays):
    """What came of K steps of N vehicles."""

    truth: Array
    """(K, N, 3) m, m, rad"""
    center: Array
    """(K, N, 3) of the ellipsoids"""
    shape: Array
    """(K, N, 3, 3)"""
    low: Array
    """(K, N, 3) of the boxes"""
    high: Array
    """(K, N, 3)"""
    excess: Array
    """(K, N) of the truth, at most 1 inside"""
    n_heard: int
    n_unsent: int
    """Packets that a set was too wide or too far away for"""
    alarms: tuple[tuple[int, int, str], ...]
    """Step, vehicle (from 1) and what missed its set"""

    @property
    def half_widths(self) -> Array:
        """(K, N, 3) of the boxes: m, m, rad."""
        return 0.5 * (self.high - self.low)


def run_fleet(setting: FleetSetting, *, seed: int = 0, hears: bool = True) -> FleetTrial:
    """Run a fleet whose errors stay within their bounds; ``hears`` or each by itself."""
    fleet = _Fleet(setting, seed)
    rows: dict[str, list[Array]] = defaultdict(list)
    for k in range(1, setting.n_steps + 1):
        fleet.step(k, hears=hears)
        rows["truth"].append(fleet.state.copy())
        rows["center"].append(fleet.sets.ellipsoid.center)
        rows["shape"].append(fleet.sets.ellipsoid.shape)
        rows["low"].append(fleet.sets.low)
        rows["high"].append(fleet.sets.high)
        rows["excess"].append(fleet.sets.excess(fleet.state))
    arrays = {name: np.array(values) for name, values in rows.items()}
    return FleetTrial(
        **arrays, n_heard=fleet.n_heard, n_unsent=fleet.n_unsent, alarms=tuple(fleet.alarms)
    )


class _Fleet:
    def __init__(self, setting: FleetSetting, seed: int) -> None:
        self.own, self.rng = setting, np.random.default_rng([seed, *b"fleet"])
        n, angle = setting.n_vehicles, 2.0 * math.pi / setting.n_vehicles
        ring = np.arange(n) * angle
        center = np.column_stack([150.0 * np.cos(ring), 150.0 * np.sin(ring), ring + 0.7])
        half = np.array([setting.start_bound_m, setting.start_bound_m, setting.compass_bound_rad])
        self.sets = Sets.of_box(center, np.broadcast_to(half, center.shape), _FLOOR)
        self.state = center + half * self._draw(center.shape)
        self.depth = 20.0 + 10.0 * self.rng.random(n)
        self.n_heard = self.n_unsent = 0
        self.alarms: list[tuple[int, int, str]] = []

    def _draw(self, shape: tuple[int, ...]) -> Array:
        errors = self.rng.uniform(-1.0, 1.0, shape)
        return np.sign(errors) if self.own.at_corners else errors

    def step(self, k: int, *, hears: bool) -> None:
        """Move all vehicles by a second and let them use what they know of it."""
        own, n = self.own, self.own.n_vehicles
        turn = 0.05 * np.cos(0.02 * k + np.arange(n))
        moved = np.column_stack([np.full(n, own.speed_m_per_s), np.zeros(n)])
        self.state = planar_step(self.state, moved, turn)
        read = moved + own.dvl_bound_m_per_s * self._draw((n, 2))
        turned = turn + own.turn_bound_rad * self._draw((n,))
        noise = np.array([0.0, 0.0, own.turn_bound_rad])
        bound = (own.dvl_bound_m_per_s, own.dvl_bound_m_per_s)
        image = planar_image(self.sets, read, turned, noise, advance_bound=bound)
        self.sets = led_on(self.sets, image)
        compass = self.state[:, 2] + own.compass_bound_rad * self._draw((n,))
        self._cut(k, np.eye(3)[2], compass, own.compass_bound_rad, "compass")
        if own.fix_every and k % own.fix_every == 0:
            fix = self.state[:, :2] + own.fix_bound_m * self._draw((n, 2))
            fix[own.n_surfaced :] = np.nan
            for axis in (0, 1):
                self._cut(k, np.eye(3)[axis], fix[:, axis], own.fix_bound_m, "fix")
        if k % own.slot == 0:
            self._speak(k, (k // own.slot) % n, hears=hears)

    def _cut(self, k: int, h: Array, value: Array, bound: Array | float, what: str) -> None:
        self.sets, missed = measured(self.sets, h, value, bound)
        self.alarms += [(k, int(i) + 1, what) for i in np.flatnonzero(missed)]

    def _speak(self, k: int, speaker: int, *, hears: bool) -> None:
        own, n = self.own, self.own.n_vehicles
        read = self.depth + own.depth_bound_m * self._draw((n,))
        low, high = read - own.depth_bound_m, read + own.depth_bound_m
        place = self.sets.ellipsoid[speaker].projected([0, 1])
        offset = self.state[:, :2] - self.state[speaker, :2]
        true = np.sqrt(np.sum(offset**2, axis=1) + (self.depth - self.depth[speaker]) ** 2)
        ranges = true + own.false_range * own.range_bound_m * self._draw((n,))
        heard: Mask = (self.rng.random(n) >= own.loss) & (np.arange(n) != speaker)
        if not hears:
            return
        try:
            packet = packed_set(speaker, k, place, (float(low[speaker]), float(high[speaker])))
        except DataError:  # who knows that little of itself has nothing to say
            self.n_unsent += 1
            return
        self.n_heard += int(heard.sum())
        _, _, other, (top, bottom) = unpacked_set(packet)
        apart = np.maximum(high - top, bottom - low)
        least = np.maximum(np.maximum(low - bottom, top - high), 0.0)
        near = np.sqrt(np.maximum((ranges - own.range_bound_m) ** 2 - apart**2, 0.0))
        far = np.sqrt(np.maximum((ranges + own.range_bound_m) ** 2 - least**2, 0.0))
        places = self.sets.ellipsoid.projected([0, 1])
        h, value, bound = range_strip(places, other, near, far)
        row = np.concatenate([h, np.zeros((n, 1))], axis=1)
        self._cut(k, row, np.where(heard, value, np.nan), bound, f"range to vehicle {speaker + 1}")
