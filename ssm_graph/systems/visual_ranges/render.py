"""Grey images of a world of walls: inverse depth and place on a wall are planes.

Along a ray ``d = (x, y, 1)`` of the camera, a wall's plane is met at the depth ``1 / w`` with ``w``
linear in x and y, and so are the coordinates on the wall times ``w``: three rows of numbers a wall,
and one division a pixel. Compiled loops draw, or NumPy where numba is not there; a test holds them
to be equal.
"""

from __future__ import annotations

from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ssm_graph.base.frozen import Array
from ssm_graph.systems.visual_ranges.camera import Camera
from ssm_graph.systems.visual_ranges.extras import compiled, numba_is_used
from ssm_graph.systems.visual_ranges.world import Picture, Wall, World

Image = NDArray[np.uint8]
Window = tuple[slice, slice]

NEAREST_M: Final = 0.05
"""Walls nearer than this are not drawn."""
LEAST_SLANT: Final = 0.05
"""Sine of the angle of sight, below which a footprint grows no more."""
TOP_LEVEL: Final = 1.001
"""So much below the number of levels: there is always a next one."""
N_LEVELS: Final = 16
"""Levels handed to the compiled loop, always as many, so that it is compiled once."""


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
    away = float((wall.corner_w - p_w) @ wall.normal_w)
    w_row = wall.normal_w @ R_wc / away
    offset = p_w - wall.corner_w
    places = [axis @ R_wc + (axis @ offset) * w_row for axis in (wall.along_w, wall.up_w)]
    planes = np.array([w_row, *places], dtype=np.float32)
    pictures = world.pictures[wall.picture]
    sides = (float(wall.size_m[0]), float(wall.size_m[1]), world.texel_m)
    sight = (abs(away), float(lens.fx))
    if numba_is_used():
        padded = (*pictures, *pictures[-1:] * (N_LEVELS - len(pictures)))[:N_LEVELS]
        n_levels = min(len(pictures), N_LEVELS)
        _draw_loop(
            planes, x, y, sides, sight, padded, n_levels, inverse_depth[window], grey[window]
        )
    else:
        _draw_numpy(planes, x, y, sides, sight, pictures, inverse_depth[window], grey[window])


@compiled
def _one_loop(picture: Any, u: Any, v: Any, step: Any) -> Any:  # pragma: no cover  (compiled)
    """Do :func:`_bilinear` for one pixel, at places ``u``, ``v`` of the finest level."""
    n_rows, n_columns = picture.shape
    a, b = u * step - np.float32(0.5), v * step - np.float32(0.5)
    column, row = np.floor(a), np.floor(b)
    a, b = a - column, b - row
    left, above = int(column), int(row)
    if left < 0 or left >= n_columns:
        left %= n_columns
    if above < 0 or above >= n_rows:
        above %= n_rows
    right = 0 if left + 1 == n_columns else left + 1
    below = 0 if above + 1 == n_rows else above + 1
    top = picture[above, left] + a * (picture[above, right] - picture[above, left])
    base = picture[below, left] + a * (picture[below, right] - picture[below, left])
    return top + b * (base - top)


@compiled
def _draw_loop(  # pragma: no cover  (compiled)
    planes: Any, x: Any, y: Any, sides: Any, sight: Any, pictures: Any, n_levels: Any,
    inverse_depth: Any, grey: Any,
) -> None:  # fmt: skip
    """Do :func:`_draw_numpy`."""
    texel = np.float32(sides[2])
    for i in range(len(y)):
        for j in range(len(x)):
            w = y[i] * planes[0, 1] + (x[j] * planes[0, 0] + planes[0, 2])
            if not w > inverse_depth[i, j]:
                continue
            u = (y[i] * planes[1, 1] + (x[j] * planes[1, 0] + planes[1, 2])) / w
            v = (y[i] * planes[2, 1] + (x[j] * planes[2, 0] + planes[2, 2])) / w
            if not (0.0 <= u <= sides[0] and 0.0 <= v <= sides[1]):
                continue
            inverse_depth[i, j] = w
            slant = sight[0] * w / np.sqrt(1.0 + x[j] ** 2 + y[i] ** 2)
            footprint = 1.0 / (w * sight[1] * np.sqrt(max(slant, LEAST_SLANT)))
            level = min(np.log2(max(footprint / sides[2], 1.0)), n_levels - TOP_LEVEL)
            low = int(level)
            u, v = u / texel, v / texel
            first = _one_loop(pictures[low], u, v, np.float32(0.5**low))
            second = _one_loop(pictures[low + 1], u, v, np.float32(0.5 ** (low + 1)))
            grey[i, j] = first + np.float32(level - low) * (second - first)


def _draw_numpy(
    planes: Picture,
    x: Picture,
    y: Picture,
    sides: tuple[float, float, float],
    sight: tuple[float, float],
    pictures: tuple[Picture, ...],
    inverse_depth: Picture,
    grey: Picture,
) -> None:
    """Draw a wall in its window, in place.

    Parameters
    ----------
    planes : (3, 3) of inverse depth, and of columns and rows on the wall times it, m.
    x, y : of the rays of columns and rows.
    sides : of the wall along and up, and of an element of its finest picture, m.
    sight : distance of the wall's plane, m, and focal length, pixels.
    """

    def plane(row: Picture) -> Picture:
        a, b, c = row
        return np.asarray(y[:, None] * b + (x * a + c)[None, :], dtype=np.float32)

    w = plane(planes[0])
    rows, columns = np.nonzero(w > inverse_depth)
    nearer = w[rows, columns]
    on: list[Picture] = []
    for row, size in zip(planes[1:], sides[:2], strict=True):
        place = plane(row)[rows, columns] / nearer
        inside = (place >= 0.0) & (place <= size)
        if not inside.all():
            rows, columns, nearer = rows[inside], columns[inside], nearer[inside]
            on = [kept[inside] for kept in on]
            place = place[inside]
        on.append(place)
    if not len(rows):
        return
    inverse_depth[rows, columns] = nearer
    # A pixel's footprint, metres on the wall: wider where the wall is seen at a slant.
    slant = sight[0] * nearer / np.sqrt(1 + x[columns] ** 2 + y[rows] ** 2)
    footprint = 1.0 / (nearer * sight[1] * np.sqrt(np.maximum(slant, LEAST_SLANT)))
    texel = sides[2]
    grey[rows, columns] = _sampled(pictures, on[0] / texel, on[1] / texel, footprint / texel)


def _sampled(pictures: tuple[Picture, ...], u: Picture, v: Picture, footprint: Picture) -> Picture:
    """Return grey at columns ``u`` and rows ``v``, between neighbours and between two levels."""
    level = np.clip(np.log2(np.maximum(footprint, 1.0)), 0.0, len(pictures) - TOP_LEVEL)
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
