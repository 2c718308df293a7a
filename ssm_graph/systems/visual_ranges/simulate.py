"""A simulated run: a path through a world of walls, its images, and ranges with all their faults.

Nothing of it is shared with the estimator: the path is a closed form, ranges are distances from the
antenna's true place at their own times, walls in the way make them longer.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ssm_graph.base.errors import ConfigError, nearest_hint
from ssm_graph.base.frozen import Array, ShortRepr
from ssm_graph.systems.visual_ranges.camera import Camera
from ssm_graph.systems.visual_ranges.ranges import at_the_anchor
from ssm_graph.systems.visual_ranges.render import Image, Water, render
from ssm_graph.systems.visual_ranges.sequence import PathTruth, Sequence
from ssm_graph.systems.visual_ranges.simulated_ranges import (
    RangeFaults,
    check_span,
    simulated_ranges,
)
from ssm_graph.systems.visual_ranges.simulated_vehicle import VehicleFaults, simulated_vehicle
from ssm_graph.systems.visual_ranges.vehicle import Vehicle
from ssm_graph.systems.visual_ranges.world import RING_M, Picture, World, bottom, corridor, room

CAMERA: Final = Camera(640, 480, 460.0, 460.0, 319.5, 239.5)
SMALL_CAMERA: Final = Camera(320, 240, 230.0, 230.0, 159.5, 119.5)
"""A quarter of the pixels, the same view: for tests."""
CORNER_M: Final = 1.0
"""Radius of the corridor path's corners."""
ANCHORS: Final = {
    "room": ((3.7, 1.6, 2.2), (-3.7, -2.0, 2.5), (-1.0, 2.8, 0.4)),
    "corridor": ((-2.0, 7.0, 2.3), (10.0, -7.0, 0.5), (-11.9, -3.0, 1.5)),
    "bottom": ((9.0, -7.0, 1.8), (-10.0, 6.0, 1.6), (1.0, 8.5, 1.9)),
}
"""Places in the world, m; as many as are asked for."""
Places = Callable[[Array], Array]


@dataclass(frozen=True, slots=True)
class ImageFaults:
    """What is wrong with images."""

    noise: float = 2.0
    """Standard deviation, grey levels."""
    gain_drift: float = 0.05
    """Amplitude of the exposure's slow change."""
    covered_s: tuple[float, float] = (0.0, 0.0)
    """The lens is black from, to."""
    dropped_share: float = 0.0

    def __post_init__(self) -> None:
        check_span("covered_s", self.covered_s)


@dataclass(frozen=True, slots=True)
class Run:
    """What to simulate."""

    world: str = "room"
    """``room``, ``corridor`` or ``bottom``"""
    seed: int = 0
    duration_s: float = 60.0
    rate_hz: float = 20.0
    """Of images."""
    n_anchors: int = 1
    camera: Camera = CAMERA
    texel_m: float = 0.006
    """Fineness of the walls' pictures; a coarser one is made sooner."""
    ranges: RangeFaults = RangeFaults()
    images: ImageFaults = ImageFaults()
    water: Water | None = None
    vehicle: VehicleFaults | None = None
    """What carries the camera; None: a hand."""
    range_scale_share: float = 0.0
    """Standard deviation of the sound speed, a share, as told to the estimator."""

    def __post_init__(self) -> None:
        if self.world not in ANCHORS:
            raise ConfigError(f"world {self.world!r}: {nearest_hint(self.world, ANCHORS)}")
        if not 0 <= self.n_anchors <= len(ANCHORS[self.world]):
            raise ConfigError(f"anchors: expected 0 to 3, got {self.n_anchors}; try 1")
        if self.camera.model != "pinhole":
            raise ConfigError(
                f"camera model {self.camera.model!r}: the renderer's lens is without distortion; "
                "try pinhole"
            )
        if not all(0.0 < x < np.inf for x in (self.duration_s, self.rate_hz, self.ranges.rate_hz)):
            raise ConfigError("duration and rates: expected numbers above zero; try 60 s at 20 Hz")


@dataclass(frozen=True, slots=True, eq=False)
class Simulated(ShortRepr):
    """A run and all that is true of it."""

    sequence: Sequence
    is_nlos: NDArray[np.bool_]
    """(M,) of its ranges"""
    bias_m: Array
    """(M,) true bias of its ranges"""


def simulate(run: Run) -> Simulated:
    """Return a run; its images are rendered when they are asked for."""
    make_world, make_path = WORLDS[run.world]
    world, path = make_world(run.seed, texel_m=run.texel_m), make_path(run.seed)
    rng = np.random.default_rng((run.seed, 3))
    time_s = np.arange(int(run.duration_s * run.rate_hz) + 1) / run.rate_hz
    time_s = time_s[(rng.uniform(size=len(time_s)) >= run.images.dropped_share)]
    anchors = np.array(ANCHORS[run.world][: run.n_anchors], dtype=float).reshape(-1, 3)

    def antenna(time: Array) -> Array:
        turned = axes(path, time) @ np.array(run.ranges.lever_arm_m)
        return np.asarray(path.place(time) + turned)

    ranges, is_nlos, bias = simulated_ranges(
        run.ranges, antenna, anchors, (0.0, run.duration_s), run.seed, world.is_blocked
    )
    if run.ranges.sound_speed_m_per_s and len(ranges):
        ranges, order = at_the_anchor(ranges, run.ranges.assumed_sound_speed_m_per_s)
        is_nlos, bias = is_nlos[order], bias[order]
    R_wc, p_w = axes(path, time_s), path.place(time_s)
    vehicle = Vehicle(range_scale_share=run.range_scale_share)
    if run.vehicle is not None:
        when = np.arange(int(run.duration_s * run.vehicle.rate_hz) + 2) / run.vehicle.rate_hz
        vehicle = simulated_vehicle(
            run.vehicle, when, axes(path, when), path.place(when), run.seed, run.range_scale_share
        )

    def image(index: int) -> Image:
        return _image(run, world, float(time_s[index]), R_wc[index], p_w[index])

    sequence = Sequence(
        name=f"{run.world}-{run.seed}",
        camera=run.camera,
        time_s=time_s,
        images=image,
        ranges=ranges,
        lever_arm_m=run.ranges.lever_arm_m,
        truth=PathTruth(time_s, p_w, _quaternions(R_wc)),
        anchor_truth_m=anchors,
        vehicle=vehicle,
    )
    return Simulated(sequence, is_nlos, bias)


def under_water(
    seed: int,
    duration_s: float = 60.0,
    *,
    vehicle: VehicleFaults | None = VehicleFaults(),  # noqa: B008
) -> Run:
    """Return a vehicle over the bottom: murky water, snow, acoustic ranges once a second.

    The sound speed is 1485 m/s, ranges are computed with 1500, known to 1 %.
    """
    ranges = RangeFaults(rate_hz=1.0, sigma_m=0.1, sound_speed_m_per_s=1485.0)
    return Run(
        "bottom", seed, duration_s, 10.0, texel_m=0.012, ranges=ranges,
        water=Water(0.15, 60.0, 40), vehicle=vehicle, range_scale_share=0.01,
    )  # fmt: skip


@dataclass(frozen=True, slots=True)
class Path:
    """A motion in the world: where the camera is, and what it looks at."""

    place: Places
    """(n,) s to (n, 3) m"""
    heading: Callable[[Array], Array]
    """(n,) s to yaw and pitch (n, 2), rad; yaw anticlockwise from x, pitch up."""


def axes(path: Path, time_s: Array) -> Array:
    """Return camera axes (n, 3, 3) in the world: columns are right, down, ahead."""
    yaw, pitch = path.heading(time_s).T
    ahead = np.stack([np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), np.sin(pitch)], 1)
    right = np.stack([np.sin(yaw), -np.cos(yaw), np.zeros_like(yaw)], 1)
    return np.stack([right, np.cross(ahead, right), ahead], 2)


def room_path(seed: int) -> Path:
    """Return a walk about the room at 0.6 m/s, looking about."""
    rng = np.random.default_rng((seed, 4))
    a, b, c, d, e = rng.uniform(0.0, 2.0 * np.pi, 5)
    turn = rng.choice((-1.0, 1.0)) * 2.0 * np.pi / 40.0

    def place(t: Array) -> Array:
        x = 2.1 * np.sin(2.0 * np.pi * t / 20.0 + a)
        y = 1.6 * np.sin(2.0 * np.pi * t / 14.3 + b)
        return np.stack([x, y, 1.45 + 0.35 * np.sin(2.0 * np.pi * t / 11.0 + c)], 1)

    def heading(t: Array) -> Array:
        yaw = d + turn * t + 0.35 * np.sin(2.0 * np.pi * t / 9.0 + e)
        return np.stack([yaw, -0.05 + 0.12 * np.sin(2.0 * np.pi * t / 7.0 + b)], 1)

    return Path(place, heading)


def bottom_path(seed: int) -> Path:
    """Return a survey 2 to 4 m above the bottom at up to 0.9 m/s, looking down ahead."""
    rng = np.random.default_rng((seed, 17))
    a, b, c, d, e = rng.uniform(0.0, 2.0 * np.pi, 5)

    def place(t: Array) -> Array:
        x = 7.0 * np.sin(2.0 * np.pi * t / 60.0 + a)
        y = 4.5 * np.sin(2.0 * np.pi * t / 41.0 + b)
        return np.stack([x, y, 3.0 + 0.6 * np.sin(2.0 * np.pi * t / 19.0 + c)], 1)

    def heading(t: Array) -> Array:
        yaw = d + 0.6 * np.sin(2.0 * np.pi * t / 37.0 + e)
        return np.stack([yaw, -1.0 + 0.07 * np.sin(2.0 * np.pi * t / 7.0 + b)], 1)

    return Path(place, heading)


def corridor_path(seed: int) -> Path:
    """Return a walk round the ring at 1.3 m/s, swaying, looking ahead: 82 m in 63 s."""
    rng = np.random.default_rng((seed, 5))
    a, b, c = rng.uniform(0.0, 2.0 * np.pi, 3)
    first, sense = rng.uniform(0.0, 8.0), float(rng.choice((-1.0, 1.0)))

    def along(t: Array) -> Array:
        return np.asarray(first + 1.3 * t)

    def place(t: Array) -> Array:
        line, yaw = _rounded(along(t), -1.0, 1.0)
        sway = 0.25 * np.sin(2.0 * np.pi * t / 6.3 + a)
        x = line[:, 0] - sway * np.sin(yaw)
        y = sense * (line[:, 1] + sway * np.cos(yaw))
        return np.stack([x, y, 1.4 + 0.15 * np.sin(2.0 * np.pi * t / 4.7 + b)], 1)

    def heading(t: Array) -> Array:
        yaw = sense * _rounded(along(t), -1.0, 2.0)[1] + 0.2 * np.sin(2.0 * np.pi * t / 5.9 + c)
        return np.stack([yaw, 0.05 * np.sin(2.0 * np.pi * t / 3.7)], 1)

    return Path(place, heading)


WORLDS: Final = {
    "room": (room, room_path),
    "corridor": (corridor, corridor_path),
    "bottom": (bottom, bottom_path),
}
"""World and path by name."""


def _ring(along_m: Array) -> tuple[Array, Array]:
    """Return the ring's centre line (n, 2) and its direction (n,), anticlockwise from one side."""
    r = CORNER_M
    straight = np.array([RING_M[0] - 2 * r, RING_M[1] - 2 * r] * 2)
    pieces = np.ravel(np.column_stack([straight, np.full(4, 0.5 * np.pi * r)]))
    ends = np.concatenate([[0.0], np.cumsum(pieces)])
    lap, left = np.divmod(along_m, ends[-1])
    piece = np.searchsorted(ends, left, side="right") - 1
    side, is_corner = piece // 2, piece % 2 == 1
    gone = left - ends[piece]
    quarter = 0.5 * np.pi * side
    half = np.array(RING_M) / 2
    starts = np.array([[-half[0] + r, -half[1]], [half[0], -half[1] + r],
                       [half[0] - r, half[1]], [-half[0], half[1] - r]])  # fmt: skip
    direction = np.stack([np.cos(quarter), np.sin(quarter)], -1)
    bent = np.where(is_corner, gone / r, 0.0)
    begin = starts[side] + direction * np.where(is_corner, straight[side], gone)[:, None]
    inward = np.stack([-direction[:, 1], direction[:, 0]], -1)
    arc = r * (np.sin(bent)[:, None] * direction + (1.0 - np.cos(bent))[:, None] * inward)
    return begin + arc, quarter + bent + 2.0 * np.pi * lap


def _rounded(along_m: Array, behind_m: float, ahead_m: float) -> tuple[Array, Array]:
    """Return places (n, 2) and directions (n,) of the ring, means over a piece of it."""
    shift = np.linspace(behind_m, ahead_m, 13)
    lines, yaws = zip(*(_ring(along_m + part) for part in shift), strict=True)
    return np.mean(lines, axis=0), np.mean(yaws, axis=0)


def _image(run: Run, world: World, time_s: float, R_wc: Array, p_w: Array) -> Image:
    faults = run.images
    rng = np.random.default_rng((run.seed, 7, round(1e6 * time_s)))
    grey = render(world, run.camera, R_wc, p_w, run.water)
    if run.water is not None:
        _snow(grey, run.water.flakes, rng)
    if faults.covered_s[0] <= time_s < faults.covered_s[1]:
        grey = np.zeros_like(grey)
    gain = 1.0 + faults.gain_drift * np.sin(2.0 * np.pi * time_s / 17.0)
    noise = rng.standard_normal(grey.shape, dtype=np.float32)
    shown: Image = np.clip(gain * grey + faults.noise * noise + 0.5, 0.0, 255.0).astype(np.uint8)
    return shown


def _snow(grey: Picture, flakes: int, rng: np.random.Generator) -> None:
    """Draw bright flakes that are elsewhere in every image: nothing that could be followed."""
    rows, columns = grey.shape
    for _ in range(flakes):
        row, column, radius = rng.integers(rows), rng.integers(columns), int(rng.integers(1, 4))
        around = np.s_[
            max(row - radius, 0) : row + radius + 1, max(column - radius, 0) : column + radius + 1
        ]
        grey[around] = np.maximum(grey[around], rng.uniform(140.0, 230.0))


def _quaternions(R: Array) -> Array:
    """Return unit quaternions (n, 4), x, y, z, w, of rotations (n, 3, 3), by their eigenvector."""
    xx, yy, zz = R[:, 0, 0], R[:, 1, 1], R[:, 2, 2]
    K = np.empty((len(R), 4, 4))
    K[:, 0, 0], K[:, 1, 1], K[:, 2, 2] = xx - yy - zz, yy - xx - zz, zz - xx - yy
    K[:, 3, 3] = xx + yy + zz
    K[:, 0, 1] = K[:, 1, 0] = R[:, 1, 0] + R[:, 0, 1]
    K[:, 0, 2] = K[:, 2, 0] = R[:, 2, 0] + R[:, 0, 2]
    K[:, 1, 2] = K[:, 2, 1] = R[:, 2, 1] + R[:, 1, 2]
    K[:, 0, 3] = K[:, 3, 0] = R[:, 2, 1] - R[:, 1, 2]
    K[:, 1, 3] = K[:, 3, 1] = R[:, 0, 2] - R[:, 2, 0]
    K[:, 2, 3] = K[:, 3, 2] = R[:, 1, 0] - R[:, 0, 1]
    q = np.linalg.eigh(K)[1][:, :, -1]
    return np.asarray(q * np.where(q[:, 3:] < 0.0, -1.0, 1.0))
