"""Patches of earlier images found in a later one, through the change of the view.

By inverse composition [1]_, with gain and offset of the light apart: what optical flow has gathered
of drift goes, and points that were out of sight are found again. Two forms of the same thing:
compiled loops, and NumPy where numba is not there; a test holds them to be equal.

References
----------
.. [1] S. Baker, I. Matthews, "Lucas-Kanade 20 Years On", IJCV 56, 2004.
"""

from __future__ import annotations

from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ssm_graph.systems.visual_ranges.extras import compiled, numba_is_used

Array = NDArray[np.float64]
Image = NDArray[np.uint8]
Mask = NDArray[np.bool_]


class Aligned(NamedTuple):
    """Where patches were found in another view."""

    pixels: Array
    """(n, 2)"""
    likeness: Array
    """(n,) correlation of the patches, gain and offset apart: 1 is the same; -1 where it failed."""


_HALF: Final = 5
_SIDE = np.arange(-_HALF, _HALF + 1.0)
_PATCH = np.stack(np.meshgrid(_SIDE, _SIDE), axis=-1).reshape(-1, 2)  # (121, 2) of (x, y)
_STEPS: Final = 12
_SETTLED_PIXELS: Final = 0.01
_FLAT: Final = 1e-3
_LEAST_SPREAD: Final = 3.0  # grey levels


def align(
    sources: list[Image],
    source: NDArray[np.int64],
    pixels: Array,
    affine: Array,
    image: Image,
    guess: Array,
) -> Aligned:
    """Return where patches of earlier images are in ``image``, by inverse composition.

    Parameters
    ----------
    sources
        Earlier images; ``source`` (n,) says which one each patch is cut from, around ``pixels``
        (n, 2).
    affine
        (n, 2, 2) offsets in ``image`` to offsets in the source.
    guess
        (n, 2) where each is looked for in ``image``.
    """
    if numba_is_used():
        out, likeness = guess.copy(), np.full(len(pixels), -1.0)
        for index in np.unique(source):
            mine = np.flatnonzero(source == index)
            out[mine], likeness[mine] = _align_loop(
                sources[index], pixels[mine], affine[mine], image, guess[mine]
            )
        return Aligned(out, likeness)
    return align_numpy(sources, source, pixels, affine, image, guess)


def align_numpy(
    sources: list[Image],
    source: NDArray[np.int64],
    pixels: Array,
    affine: Array,
    image: Image,
    guess: Array,
) -> Aligned:
    """Return :func:`align` by NumPy."""
    n = len(pixels)
    patch, gradient = np.empty((n, len(_PATCH))), np.empty((n, len(_PATCH), 2))
    usable = np.zeros(n, dtype=bool)
    for index in np.unique(source):
        mine = np.flatnonzero(source == index)
        places = pixels[mine, None] + _PATCH @ affine[mine].transpose(0, 2, 1)
        patch[mine], usable[mine] = _sampled(sources[index], places)
        for axis in range(2):
            step = 0.5 * affine[mine][:, None, :, axis]
            ahead, ahead_in = _sampled(sources[index], places + step)
            behind, behind_in = _sampled(sources[index], places - step)
            gradient[mine, :, axis] = ahead - behind
            usable[mine] &= ahead_in & behind_in
    return _inverse_compositional(image, patch, gradient, guess, usable)


def _inverse_compositional(
    image: Image, patch: Array, gradient: Array, guess: Array, usable: Mask
) -> Aligned:
    """Return patches (n, m) found in the image by their gradients (n, m, 2)."""
    patch = patch - patch.mean(axis=1, keepdims=True)
    spread = np.sqrt((patch * patch).mean(axis=1))
    gradient = gradient - gradient.mean(axis=1, keepdims=True)
    hessian = np.einsum("nma,nmb->nab", gradient, gradient)
    det = hessian[:, 0, 0] * hessian[:, 1, 1] - hessian[:, 0, 1] ** 2
    trace = hessian[:, 0, 0] + hessian[:, 1, 1]
    usable = usable & (spread > _LEAST_SPREAD) & (det > _FLAT * trace * trace)
    at, likeness = guess.copy(), np.full(len(guess), -1.0)
    going = np.flatnonzero(usable)
    inverse = np.zeros_like(hessian)
    inverse[going] = np.linalg.inv(hessian[going])
    for _ in range(_STEPS):
        if not going.size:
            break
        seen, inside = _sampled(image, at[going, None] + _PATCH)
        seen = seen - seen.mean(axis=1, keepdims=True)
        power = np.sqrt((seen * seen).mean(axis=1))
        gain = spread[going] / np.maximum(power, 1e-9)
        product = (seen * patch[going]).mean(axis=1)
        likeness[going] = np.where(
            inside & (power > 0.3 * spread[going]), product / (power * spread[going] + 1e-9), -1.0
        )
        error = seen * gain[:, None] - patch[going]
        slope = np.einsum("nma,nm->na", gradient[going], error)
        step = -np.einsum("nab,nb->na", inverse[going], slope)
        length = np.sqrt((step * step).sum(axis=1))
        step *= np.minimum(1.0, 2.0 / np.maximum(length, 1e-9))[:, None]
        at[going] += step
        likeness[going[~inside]] = -1.0
        going = going[inside & (length > _SETTLED_PIXELS)]
    return Aligned(at, np.where(likeness > 0.0, likeness, -1.0))


def _sampled(image: Image, places: Array) -> tuple[Array, Mask]:
    """Return grey values (n, m) at places (n, m, 2), bilinear, and which rows lie all inside."""
    height, width = image.shape
    whole = np.floor(places).astype(np.int64)
    rest = places - whole
    x, y = whole[..., 0], whole[..., 1]
    inside = ((x >= 0) & (y >= 0) & (x < width - 1) & (y < height - 1)).all(axis=-1)
    at = np.clip(y, 0, height - 2) * width + np.clip(x, 0, width - 2)
    grey = image.reshape(-1)
    a, b = grey[at].astype(np.float64), grey[at + 1].astype(np.float64)
    c, d = grey[at + width].astype(np.float64), grey[at + width + 1].astype(np.float64)
    u, v = rest[..., 0], rest[..., 1]
    upper, lower = a + u * (b - a), c + u * (d - c)
    return upper + v * (lower - upper), inside


@compiled
def _bilinear(image: Any, x: float, y: float) -> float:  # pragma: no cover  (compiled)
    """Return the grey value at a place inside the image."""
    left, top = int(x), int(y)
    u, v = x - left, y - top
    a, b = float(image[top, left]), float(image[top, left + 1])
    c, d = float(image[top + 1, left]), float(image[top + 1, left + 1])
    upper, lower = a + u * (b - a), c + u * (d - c)
    return upper + v * (lower - upper)


@compiled
def _cut(  # pragma: no cover  (compiled)
    image: Any, x: float, y: float, affine: Any, patch: Any, gradient: Any
) -> bool:
    """Fill in patch (m,) and gradient (m, 2) around a place; False where it is not all inside."""
    height, width = image.shape
    side = 2 * _HALF + 1
    for row in range(side):
        for column in range(side):
            u, v = column - _HALF, row - _HALF
            at_x = x + affine[0, 0] * u + affine[0, 1] * v
            at_y = y + affine[1, 0] * u + affine[1, 1] * v
            reach_x = 0.5 * max(abs(affine[0, 0]), abs(affine[0, 1]))
            reach_y = 0.5 * max(abs(affine[1, 0]), abs(affine[1, 1]))
            if at_x - reach_x < 0.0 or at_y - reach_y < 0.0:
                return False
            if at_x + reach_x >= width - 1 or at_y + reach_y >= height - 1:
                return False
            m = row * side + column
            patch[m] = _bilinear(image, at_x, at_y)
            for axis in range(2):
                dx, dy = 0.5 * affine[0, axis], 0.5 * affine[1, axis]
                gradient[m, axis] = _bilinear(image, at_x + dx, at_y + dy) - _bilinear(
                    image, at_x - dx, at_y - dy
                )
    return True


@compiled
def _align_loop(  # pragma: no cover  (compiled)
    source: Any, pixels: Any, affine: Any, image: Any, guess: Any
) -> Any:
    n, side = len(pixels), 2 * _HALF + 1
    size = side * side
    height, width = image.shape
    out, likeness = guess.copy(), np.full(n, -1.0)
    patch, gradient, seen = np.zeros(size), np.zeros((size, 2)), np.zeros(size)
    for i in range(n):
        if not _cut(source, pixels[i, 0], pixels[i, 1], affine[i], patch, gradient):
            continue
        patch -= patch.mean()
        spread = np.sqrt((patch * patch).mean())
        gradient[:, 0] -= gradient[:, 0].mean()
        gradient[:, 1] -= gradient[:, 1].mean()
        xx = (gradient[:, 0] * gradient[:, 0]).sum()
        xy = (gradient[:, 0] * gradient[:, 1]).sum()
        yy = (gradient[:, 1] * gradient[:, 1]).sum()
        det, trace = xx * yy - xy * xy, xx + yy
        if not (spread > _LEAST_SPREAD and det > _FLAT * trace * trace):
            continue
        x, y = guess[i, 0], guess[i, 1]
        alike = -1.0
        for _ in range(_STEPS):
            left, right = np.floor(x - _HALF), np.floor(x + _HALF)
            top, bottom = np.floor(y - _HALF), np.floor(y + _HALF)
            if left < 0 or top < 0 or right >= width - 1 or bottom >= height - 1:
                alike = -1.0
                break
            mean = 0.0
            for m in range(size):
                seen[m] = _bilinear(image, x + m % side - _HALF, y + m // side - _HALF)
                mean += seen[m]
            mean /= size
            power, product = 0.0, 0.0
            for m in range(size):
                seen[m] -= mean
                power += seen[m] * seen[m]
                product += seen[m] * patch[m]
            power = np.sqrt(power / size)
            product /= size
            alike = product / (power * spread + 1e-9) if power > 0.3 * spread else -1.0
            gain = spread / max(power, 1e-9)
            slope_x, slope_y = 0.0, 0.0
            for m in range(size):
                error = seen[m] * gain - patch[m]
                slope_x += gradient[m, 0] * error
                slope_y += gradient[m, 1] * error
            step_x = -(yy * slope_x - xy * slope_y) / det
            step_y = -(xx * slope_y - xy * slope_x) / det
            length = np.sqrt(step_x * step_x + step_y * step_y)
            limit = min(1.0, 2.0 / max(length, 1e-9))
            x += step_x * limit
            y += step_y * limit
            if length <= _SETTLED_PIXELS:
                break
        out[i, 0], out[i, 1] = x, y
        likeness[i] = alike if alike > 0.0 else -1.0
    return out, likeness
