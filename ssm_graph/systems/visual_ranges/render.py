"""Grey images of a world of walls, by plain NumPy: inverse depth and place on a wall are planes.

Along a ray ``d = (x, y, 1)`` of the camera, a wall's plane is met at the depth ``1 / w`` with ``w``
linear in x and y, and so are the coordinates on the wall times ``w``: three rows of numbers a wall,
and one division a pixel.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ssm_graph.base.frozen import Array
from ssm_graph.systems.visual_ranges.camera import Camera
from ssm_graph.systems.visual_ranges.world import Picture, Wall, World

Image = NDArray[np.uint8]
Window = tuple[slice, slice]

NEAREST_M: Final = 0.05
"""Walls nearer than this are not drawn."""


class Water(NamedTuple):
    """What lies between the camera and what it sees."""

    attenuation_per_m: float
    veil: float
    """Grey of the water itself, which is all that is left far off."""
    flakes: int
    """Of marine snow in an image."""


def render(
    world: World, lens: Camera, R_wc: Array, p_w: Array, water: Water | None = None
) -> Picture:
    """Return what a camera sees, grey (H, W) from 0 to 255, black where there is no wall.

    In water what is far off fades into its veil; snow is not drawn here.

    Parameters
    ----------
    lens : its size, focal lengths and centre, pixels; the first pixel has its centre at (0, 0).
    R_wc : (3, 3) camera axes (x right, y down, z forward) in the world.
    p_w : (3,) place of the camera, m.
    """
    inverse_depth = np.full((lens.height, lens.width), 1e-6, dtype=np.float32)
    grey = np.zeros((lens.height, lens.width), dtype=np.float32)
    for wall in world.walls:
        if (p_w - wall.corner_w) @ wall.normal_w <= NEAREST_M / 10:
            continue
        window = _window(wall, lens, R_wc, p_w)
        if window is not None:
            _draw(world, wall, lens, (R_wc, p_w), window, inverse_depth, grey)
    if water is not None:
        x = (np.arange(lens.width, dtype=np.float32) - lens.cx) / lens.fx
        y = (np.arange(lens.height, dtype=np.float32) - lens.cy) / lens.fy
        away = np.sqrt(1.0 + x[None] ** 2 + y[:, None] ** 2) / inverse_depth
        grey = water.veil + (grey - water.veil) * np.exp(-water.attenuation_per_m * away)
    return np.asarray(grey, dtype=np.float32)


def _window(wall: Wall, lens: Camera, R_wc: Array, p_w: Array) -> Window | None:
    """Return the part of the image that a wall can be in: its corners', cut before the camera."""
    along, up = wall.along_w * wall.size_m[0], wall.up_w * wall.size_m[1]
    corners = wall.corner_w + np.array([0 * along, along, along + up, up])
    seen = (corners - p_w) @ R_wc
    inside = []
    for one, next_one in zip(seen, np.roll(seen, -1, axis=0), strict=True):
        if one[2] >= NEAREST_M:
            inside.append(one)
        if (one[2] < NEAREST_M) != (next_one[2] < NEAREST_M):
            share = (NEAREST_M - one[2]) / (next_one[2] - one[2])
            inside.append(one + share * (next_one - one))
    if not inside:
        return None
    cut = np.array(inside)
    pixels = cut[:, :2] / cut[:, 2:] * (lens.fx, lens.fy) + (lens.cx, lens.cy)
    low = np.clip(np.floor(pixels.min(axis=0)), 0, (lens.width, lens.height)).astype(int)
    high = np.clip(np.ceil(pixels.max(axis=0)) + 1, 0, (lens.width, lens.height)).astype(int)
    if (high <= low).any():
        return None
    return slice(low[1], high[1]), slice(low[0], high[0])


def _draw(
    world: World,
    wall: Wall,
    lens: Camera,
    pose: tuple[Array, Array],
    window: Window,
    inverse_depth: Picture,
    grey: Picture,
) -> None:
    """Draw a wall where it is nearer than what was drawn before."""
    R_wc, p_w = pose
    x = ((np.arange(lens.width) - lens.cx) / lens.fx).astype(np.float32)[window[1]]
    y = ((np.arange(lens.height) - lens.cy) / lens.fy).astype(np.float32)[window[0]]
    away = (wall.corner_w - p_w) @ wall.normal_w
    w_row = wall.normal_w @ R_wc / away
    offset = p_w - wall.corner_w

    def plane(row: Array) -> Picture:
        a, b, c = row.astype(np.float32)
        return np.asarray(y[:, None] * b + (x * a + c)[None, :], dtype=np.float32)

    w = plane(w_row)
    old = inverse_depth[window]
    rows, columns = np.nonzero(w > old)
    nearer = w[rows, columns]
    on: list[Picture] = []
    for axis, size in zip((wall.along_w, wall.up_w), wall.size_m, strict=True):
        place = plane(axis @ R_wc + (axis @ offset) * w_row)[rows, columns] / nearer
        inside = (place >= 0.0) & (place <= size)
        if not inside.all():
            rows, columns, nearer = rows[inside], columns[inside], nearer[inside]
            on = [kept[inside] for kept in on]
            place = place[inside]
        on.append(place)
    if not len(rows):
        return
    old[rows, columns] = nearer
    # A pixel's footprint, metres on the wall: wider where the wall is seen at a slant.
    slant = np.abs(away) * nearer / np.sqrt(1 + x[columns] ** 2 + y[rows] ** 2)
    footprint = 1.0 / (nearer * lens.fx * np.sqrt(np.maximum(slant, 0.05)))
    grey[window][rows, columns] = _sampled(
        world.pictures[wall.picture], on[0] / world.texel_m, on[1] / world.texel_m,
        footprint / world.texel_m,
    )  # fmt: skip


def _sampled(pictures: tuple[Picture, ...], u: Picture, v: Picture, footprint: Picture) -> Picture:
    """Return grey at columns ``u`` and rows ``v``, between neighbours and between two levels."""
    level = np.clip(np.log2(np.maximum(footprint, 1.0)), 0.0, len(pictures) - 1.001)
    low = level.astype(np.intp)
    found = np.empty(len(u), dtype=np.float32)
    for number in range(int(low.min()), int(low.max()) + 1):
        own = np.flatnonzero(low == number)
        if len(own):
            part = (level[own] - number).astype(np.float32)
            first = _bilinear(pictures[number], u[own] / 2**number, v[own] / 2**number)
            scale = 2 ** (number + 1)
            second = _bilinear(pictures[number + 1], u[own] / scale, v[own] / scale)
            found[own] = first + part * (second - first)
    return found


def _bilinear(picture: Picture, u: Picture, v: Picture) -> Picture:
    """Return grey between the centres of the elements; the picture repeats."""
    n_rows, n_columns = picture.shape
    u, v = u - np.float32(0.5), v - np.float32(0.5)
    column, row = np.floor(u).astype(np.int32), np.floor(v).astype(np.int32)
    a, b = u - column, v - row
    column, row = column % n_columns, row % n_rows
    next_column = np.where(column + 1 == n_columns, 0, column + 1)
    this, after = row * n_columns, np.where(row + 1 == n_rows, 0, row + 1) * n_columns
    flat = picture.reshape(-1)
    top, right = flat[this + column], flat[this + next_column]
    bottom, corner = flat[after + column], flat[after + next_column]
    top = top + a * (right - top)
    return np.asarray(top + b * (bottom + a * (corner - bottom) - top), dtype=np.float32)
