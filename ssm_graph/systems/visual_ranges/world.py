"""Worlds of textured walls: a room, a ring of corridors that repeat, a bottom under water."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ssm_graph.base.frozen import Array

Picture = NDArray[np.float32]

ROOM_M: Final = (8.0, 6.0, 3.0)
PILLAR_M: Final = (2.6, 2.85, -0.1, 0.15)
"""x from, to, y from, to"""
RING_M: Final = (22.0, 12.0)
"""Sides of the corridors' centre line: 68 m about, 66 with its corners rounded."""
LIFT_M: Final = ((-1.5, -1.5), (1.5, 1.5))
"""Two corners of the shaft in the block."""
CORRIDOR_M: Final = (2.4, 2.6)
"""Width and height."""
BOTTOM_M: Final = (26.0, 20.0)
"""Sides of the bottom."""
BOULDERS: Final = 14
REPEAT_M: Final = 12.8
"""The walls of the corridor look the same again after it: a trap for whoever closes loops."""


@dataclass(frozen=True, slots=True, eq=False)
class Wall:
    """A rectangle with a picture on it, seen from the side to which ``along x up`` points."""

    corner_w: Array
    """(3,) m"""
    along_w: Array
    """(3,) unit vector of the picture's columns"""
    up_w: Array
    """(3,) unit vector of its rows"""
    size_m: tuple[float, float]
    """Along and up."""
    picture: int
    """Index into the world's pictures."""

    @property
    def normal_w(self) -> Array:
        """(3,) to the side that is seen."""
        return np.cross(self.along_w, self.up_w)


@dataclass(frozen=True, slots=True, eq=False)
class World:
    """Walls and what is on them."""

    walls: tuple[Wall, ...]
    pictures: tuple[tuple[Picture, ...], ...]
    """Of each: levels, each half as fine as the one before, grey from 0 to 255; it repeats."""
    texel_m: float
    """Side of a picture's finest element."""
    obstacles: tuple[Wall, ...]
    """What stands in the way of radio waves, seen or hidden behind walls that let them through."""

    def is_blocked(self, from_w: Array, to_w: Array) -> NDArray[np.bool_]:
        """Return whether a wall stands between (N, 3) and (N, 3) or (3,), m."""
        start, way = from_w, to_w - from_w
        blocked = np.zeros(len(start), dtype=bool)
        for wall in self.obstacles:
            falls = way @ wall.normal_w
            with np.errstate(divide="ignore", invalid="ignore"):
                share = ((wall.corner_w - start) @ wall.normal_w) / falls
            hit = start + np.nan_to_num(share)[:, None] * way - wall.corner_w
            along, up = hit @ wall.along_w, hit @ wall.up_w
            inside = (along >= 0) & (along <= wall.size_m[0]) & (up >= 0) & (up <= wall.size_m[1])
            blocked |= (falls < 0.0) & (share > 1e-6) & (share < 1.0 - 1e-6) & inside
        return blocked


def _smooth_noise(rows: int, columns: int, cell: int, rng: np.random.Generator) -> Picture:
    """Return noise of unit variance at its knots, linear between them; it repeats at its edges."""
    knots = rng.standard_normal((max(rows // cell, 1), max(columns // cell, 1))).astype(np.float32)
    for axis, size in enumerate((rows, columns)):
        n = knots.shape[axis]
        at = np.arange(size, dtype=np.float32) * (n / size)
        low = at.astype(np.intp)
        part = (at - low).reshape((-1, 1) if axis == 0 else (1, -1))
        knots = np.take(knots, low, axis) * (1 - part) + np.take(knots, (low + 1) % n, axis) * part
    return knots


def picture(size_m: tuple[float, float], texel_m: float, rng: np.random.Generator) -> Picture:
    """Return a picture of clouds, boards and spots for a wall of ``size_m``, along and up."""
    columns, rows = (max(round(size / texel_m), 8) for size in size_m)
    grey = np.full((rows, columns), 120.0, dtype=np.float32)
    for cell_m, contrast in ((1.2, 18.0), (0.3, 12.0), (0.08, 9.0)):
        cell = max(int(cell_m / texel_m), 1)
        if cell < min(rows, columns):
            grey += contrast * _smooth_noise(rows, columns, cell, rng)
    n_boards = int(6 * size_m[0] * size_m[1])
    for longest_m, count in ((0.5, n_boards), (0.12, 3 * n_boards)):
        longest = longest_m / texel_m
        for row, column, shade, h, w in zip(
            rng.integers(0, rows, count),
            rng.integers(0, columns, count),
            rng.normal(0.0, 45.0, count),
            rng.uniform(0.15, 1.0, count) * longest,
            rng.uniform(0.15, 1.0, count) * longest,
            strict=True,
        ):
            grey[row : row + max(int(h), 1), column : column + max(int(w), 1)] += shade
    return np.clip(grey, 8.0, 247.0)


def levels(finest: Picture) -> tuple[Picture, ...]:
    """Return a picture and its halves, down to a few elements."""
    found = [finest]
    while min(found[-1].shape) >= 8:
        last = found[-1][: found[-1].shape[0] // 2 * 2, : found[-1].shape[1] // 2 * 2]
        found.append(0.25 * (last[::2, ::2] + last[1::2, ::2] + last[::2, 1::2] + last[1::2, 1::2]))
    return (*found,)


def _wall(corner: Array, along: Array, up: Array, number: int) -> Wall:
    length, height = float(np.linalg.norm(along)), float(np.linalg.norm(up))
    return Wall(corner, along / length, up / height, (length, height), number)


def _box(low: Array, high: Array, *, inwards: bool) -> list[tuple[Array, Array, Array]]:
    """Return corner, along and up of the faces of a box: four sides, floor, ceiling."""
    size = high - low
    x, y, z = np.diag(size)
    faces = [
        (low, x, z),  # normal -y
        (low + x, y, z),  # +x
        (low + x + y, -x, z),  # +y
        (low + y, -y, z),  # -x
        (low, y, x),  # -z
        (low + z, x, y),  # +z
    ]
    if not inwards:
        return faces
    return [(corner + along, -along, up) for corner, along, up in faces]


def room(seed: int, *, texel_m: float = 0.006) -> World:
    """Return a room of 8 x 6 x 3 m, the middle of its floor at the origin, with three boxes.

    The pillar stands in the way of radio waves, two cabinets in corners.
    """
    rng = np.random.default_rng((seed, 1))
    length, width, height = ROOM_M
    half = np.array([length / 2, width / 2, 0.0])
    faces = _box(-half, half + np.array([0.0, 0.0, height]), inwards=True)
    n_walls = len(faces)
    x0, x1, y0, y1 = PILLAR_M
    for low, high in (
        ([x0, y0, 0.0], [x1, y1, height]),
        ([-4.0, -3.0, 0.0], [-3.0, -2.2, 1.9]),
        ([-3.9, 2.1, 0.0], [-2.6, 2.95, 1.1]),
    ):
        faces += _box(np.array(low), np.array(high), inwards=False)
    walls = [_wall(*face, number) for number, face in enumerate(faces)]
    pictures = [levels(picture(wall.size_m, texel_m, rng)) for wall in walls]
    return World((*walls,), (*pictures,), texel_m, (*walls[n_walls:],))


def corridor(seed: int, *, texel_m: float = 0.006) -> World:
    """Return a ring of four corridors about a block; its walls repeat every 12.8 m.

    The middle of the ring's floor is at the origin. A lift's shaft in the block stands in the way
    of radio waves.
    """
    rng = np.random.default_rng((seed, 2))
    width, height = CORRIDOR_M
    centre = np.array([*RING_M, 0.0]) / 2
    aside = np.array([width / 2, width / 2, 0.0])
    up = np.array([0.0, 0.0, height])
    outer = _box(-centre - aside, centre + aside + up, inwards=True)
    inner = _box(-centre + aside, centre - aside + up, inwards=False)[:4]
    pictures = [
        levels(picture((REPEAT_M, size), texel_m, rng)) for size in (height, width * 4, width * 4)
    ]
    walls = [_wall(*face, 0) for face in outer[:4]]
    walls += [_wall(*face, number) for number, face in enumerate(outer[4:], 1)]
    walls += [_wall(*face, 0) for face in inner]
    shaft = _box(np.array([*LIFT_M[0], 0.0]), np.array([*LIFT_M[1], height]), inwards=False)
    hidden = [_wall(*face, 0) for face in shaft]
    return World((*walls,), (*pictures,), texel_m, (*hidden,))


def bottom(seed: int, *, texel_m: float = 0.012) -> World:
    """Return a flat bottom of 26 x 20 m, its middle at the origin, with boulders up to 1.2 m high.

    Nothing but boulders stands in the way of sound.
    """
    rng = np.random.default_rng((seed, 15))
    half = np.array([BOTTOM_M[0] / 2, BOTTOM_M[1] / 2, 0.0])
    faces = [_box(-half, half + np.array([0.0, 0.0, 1.0]), inwards=True)[4]]
    for _ in range(BOULDERS):
        low = np.array([*(rng.uniform(-0.85, 0.85, 2) * half[:2]), 0.0])
        size = np.array([*rng.uniform(0.5, 1.6, 2), rng.uniform(0.25, 1.2)])
        faces += [
            *_box(low, low + size, inwards=False)[:4],
            _box(low, low + size, inwards=False)[5],
        ]
    walls = [_wall(*face, number) for number, face in enumerate(faces)]
    pictures = [levels(picture(wall.size_m, texel_m, rng)) for wall in walls]
    return World((*walls,), (*pictures,), texel_m, (*walls[1:],))
