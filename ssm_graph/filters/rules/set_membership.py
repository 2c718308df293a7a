"""The law of the set-membership filter: led on, clipped, cut, shared, and sound at every step.

Where the law of a Kalman filter hands on a covariance, this hands on an ellipsoid beside a box,
both of which hold the state as long as each stated bound is true. Box and ellipsoid cut each
other: the box is exact along the axes, the ellipsoid knows how components hang together.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike

from ssm_graph.base.frozen import Array, ReadOnlyArrays
from ssm_graph.filters.rules.ellipsoids import (
    CERTAIN,
    Ellipsoids,
    Mask,
    around_box,
    cut_by_strip,
    intersected,
    segments,
    sum_shape,
)

CUTS_BOX: Final = 0.99
"""A box of less than so much of the ellipsoid's half-width cuts it."""
PROJECTIONS: Final = 3
HALVINGS: Final = 30
NEWTON_STEPS: Final = 20


@dataclass(frozen=True, slots=True, eq=False)
class Sets(ReadOnlyArrays):
    """A batch of sets: in an ellipsoid and in a box."""

    ellipsoid: Ellipsoids
    low: Array
    """(..., n)"""
    high: Array
    """(..., n)"""
    floor: Array
    """(n,) half-widths below which no cut makes a set thinner: far below what matters, far above
    what rounding makes of it. Bounds that meet to the last digit would leave a point."""

    @property
    def half_widths(self) -> Array:
        """(..., n) of the smallest box that is known to hold the state."""
        return 0.5 * (self.high - self.low)

    @property
    def middle(self) -> Array:
        """(..., n) of that box."""
        return 0.5 * (self.high + self.low)

    def contains(self, points: ArrayLike) -> Mask:
        """Return which points (..., n) are inside."""
        x = np.asarray(points, dtype=np.float64)
        in_box = ((x >= self.low) & (x <= self.high)).all(axis=-1)
        return np.asarray(self.ellipsoid.contains(x) & in_box)

    def excess(self, points: ArrayLike) -> Array:
        """Return (...): at most 1 inside; the larger of ``e'P^-1e`` and the box's own, squared."""
        x = np.asarray(points, dtype=np.float64)
        in_box = np.max(np.abs(x - self.middle) / self.half_widths, axis=-1) ** 2
        return np.asarray(np.maximum(self.ellipsoid.excess(x), in_box))

    def nearest(self, points: Array) -> Array:
        """Return the points of the sets next to some (..., n), in units of their half-widths.

        Box and ellipsoid hold the state, so that each projection brings a point no further from
        it; a few of them by turns end in both but for a little, which a segment to the middle
        takes away.
        """
        scale = self.ellipsoid.half_widths
        Q = self.ellipsoid.shape / (scale[..., :, None] * scale[..., None, :])
        size, axes = np.linalg.eigh(Q)
        x = points
        for _ in range(PROJECTIONS):
            x = np.clip(x, self.low, self.high)
            z = np.einsum("...ji,...j->...i", axes, (x - self.ellipsoid.center) / scale)
            moved = np.einsum("...ij,...j->...i", axes, _onto(size, z)) * scale
            x = moved + self.ellipsoid.center
        inside = np.clip(self.ellipsoid.center, self.low, self.high)
        share, good = np.ones(x.shape[:-1]), np.zeros(x.shape[:-1])
        for _ in range(HALVINGS):
            holds = self.contains(inside + share[..., None] * (x - inside))
            if np.all(holds & (share >= 1.0)):
                return np.asarray(x)
            good = np.where(holds, share, good)
            share = np.where(holds, 0.5 * (share + 1.0), 0.5 * (share + good))
        return np.asarray(inside + good[..., None] * (x - inside))

    def __getitem__(self, index: Any) -> Sets:
        """Return those of an index into the batch."""
        return Sets(
            self.ellipsoid[index],
            self.low[index].copy(),
            self.high[index].copy(),
            self.floor,
        )

    def where(self, mask: Mask, other: Sets) -> Sets:
        """Return these where a mask (...) says so, and others elsewhere."""
        return Sets(
            self.ellipsoid.where(mask, other.ellipsoid),
            np.where(mask[..., None], self.low, other.low),
            np.where(mask[..., None], self.high, other.high),
            self.floor,
        )

    @classmethod
    def of(cls, ellipsoid: Ellipsoids, floor: ArrayLike) -> Sets:
        """Return the sets of which ellipsoids alone are known."""
        half = ellipsoid.half_widths
        low, high = ellipsoid.center - half, ellipsoid.center + half
        return cls(ellipsoid, low, high, np.array(floor, dtype=np.float64))

    @classmethod
    def of_box(cls, center: ArrayLike, half_widths: ArrayLike, floor: ArrayLike) -> Sets:
        """Return boxes as sets."""
        around = around_box(center, half_widths)
        half = np.broadcast_to(np.asarray(half_widths, dtype=np.float64), around.center.shape)
        low, high = around.center - half, around.center + half
        return cls(around, low, high, np.array(floor, dtype=np.float64))


@dataclass(frozen=True, slots=True, eq=False)
class Image(ReadOnlyArrays):
    """What a motion makes of sets: everything lies in ``center + A (x - c) + segments``."""

    A: Array
    """(..., n, n)"""
    center: Array
    """(..., n)"""
    spans: Array
    """(..., S, n) half segments: what remains of the motion beside its line, and its noise."""
    low: Array
    """(..., n) of the motion's image of the box, by itself."""
    high: Array
    """(..., n)"""


def led_on(sets: Sets, image: Image) -> Sets:
    """Return sets around an image: the Minkowski sum, within the image of the box."""
    ellipsoid = sets.ellipsoid
    moved = image.A @ ellipsoid.shape @ np.swapaxes(image.A, -1, -2)
    parts = np.concatenate([moved[..., None, :, :], segments(image.spans)], axis=-3)
    center = np.broadcast_to(image.center, ellipsoid.center.shape)
    around = Ellipsoids(center.copy(), sum_shape(parts))
    return _tightened(Sets(around, image.low.copy(), image.high.copy(), sets.floor))[0]


def saturated(sets: Sets, levels: ArrayLike) -> Sets:
    """Return sets around the images under ``x_l -> sign(x_l) min(|x_l|, s_l)``.

    Over ``[c - m, c + m]`` a component is its chord's slope k times itself, and a rest whose ends
    are at the kinks or the borders, for it is linear between them: ``k = 1`` and no rest where
    nothing is clipped. What is clipped lies within the levels, which cuts like a measurement.
    """
    s = np.asarray(levels, dtype=np.float64)
    ellipsoid = sets.ellipsoid
    half = ellipsoid.half_widths
    first, last = ellipsoid.center - half, ellipsoid.center + half
    slope = (np.clip(last, -s, s) - np.clip(first, -s, s)) / (last - first)
    at = np.stack([first, last, np.clip(-s, first, last), np.clip(s, first, last)])
    rest = np.clip(at, -s, s) - slope * at
    middle, spread = 0.5 * (rest.max(0) + rest.min(0)), 0.5 * (rest.max(0) - rest.min(0))
    touched = np.any((first < -s) | (last > s), axis=-1)
    if not touched.any():
        return sets
    image = Image(
        A=slope[..., :, None] * np.eye(ellipsoid.n),
        center=slope * ellipsoid.center + middle,
        spans=np.maximum(spread, sets.floor)[..., :, None] * np.eye(ellipsoid.n),
        low=np.clip(sets.low, -s, s),
        high=np.clip(sets.high, -s, s),
    )
    return led_on(sets, image).where(touched, sets)


def measured(sets: Sets, h: ArrayLike, value: ArrayLike, bound: ArrayLike) -> tuple[Sets, Mask]:
    """Return sets around ``{x in set : |h.x - value| <= bound}`` and which measurements miss.

    Parameters
    ----------
    h : (n,) or (..., n)
    value : (...), NaN where there is none: the set stays.
    bound : (...), may be infinite.
    """
    y, r = np.asarray(value, dtype=np.float64), np.asarray(bound, dtype=np.float64)
    known = np.isfinite(y)
    low = np.where(known, y - r, -np.inf)
    high = np.where(known, y + r, np.inf)
    row = np.broadcast_to(np.asarray(h, dtype=np.float64), sets.low.shape)
    floor = np.abs(row) @ sets.floor
    cut, missed = cut_by_strip(sets.ellipsoid, row, low, high, floor=floor)
    box_low, box_high = _box_of_strip(sets, row, low, high)
    kept, empty = _tightened(Sets(cut, box_low, box_high, sets.floor))
    missed = missed | empty
    return kept.where(~missed, sets), missed


def shared(own: Sets, other: Sets) -> tuple[Sets, Mask]:
    """Return sets around both of two, never of a larger volume than one's own, and which are apart.

    Nothing is asked of how the two came about: each holds the state, so both do.
    """
    both, apart = intersected(own.ellipsoid, other.ellipsoid)
    low, high = np.maximum(own.low, other.low), np.minimum(own.high, other.high)
    kept, empty = _tightened(Sets(both, low, high, own.floor))
    apart = apart | empty
    return kept.where(~apart, own), apart


def _onto(size: Array, z: Array) -> Array:
    """Return the points next to z (..., n) of ``sum z^2 / size <= 1``, axes of an ellipsoid.

    Newton's method for the multiplier m of ``sum size z^2 / (size + m)^2 = 1``, which comes up to
    it from below.
    """
    m = np.zeros(z.shape[:-1])
    for _ in range(NEWTON_STEPS):
        down = size + m[..., None]
        terms = size * z**2 / down**2
        excess = terms.sum(axis=-1) - 1.0
        if np.all(excess <= CERTAIN):
            break
        m = m + np.maximum(excess, 0.0) / (2.0 * (terms / down).sum(axis=-1) + 1e-300)
    near = z * size / (size + m[..., None])
    left = np.sqrt(np.sum(near**2 / size, axis=-1))
    return np.asarray(near / np.maximum(left, 1.0)[..., None])


def _box_of_strip(sets: Sets, row: Array, low: Array, high: Array) -> tuple[Array, Array]:
    """Return the box cut by ``low <= row.x <= high``, component by component."""
    ends = np.stack([row * sets.low, row * sets.high])
    least, most = ends.min(axis=0), ends.max(axis=0)
    others_low = least.sum(axis=-1, keepdims=True) - least
    others_high = most.sum(axis=-1, keepdims=True) - most
    first, last = low[..., None] - others_high, high[..., None] - others_low
    safe = np.where(row != 0.0, row, 1.0)
    a, b = first / safe, last / safe
    small, large = np.where(row > 0.0, a, b), np.where(row > 0.0, b, a)
    small = np.where(row != 0.0, small, -np.inf)
    large = np.where(row != 0.0, large, np.inf)
    return np.maximum(sets.low, small), np.minimum(sets.high, large)


def _tightened(sets: Sets) -> tuple[Sets, Mask]:
    """Return sets whose box and ellipsoid have cut each other, and which have nothing in both."""
    ellipsoid, floor = sets.ellipsoid, sets.floor
    box_low, box_high, empty = _widened(sets.low, sets.high, floor)
    half, axes = ellipsoid.half_widths, np.eye(ellipsoid.n)
    for axis in range(ellipsoid.n):
        low, high = box_low[..., axis], box_high[..., axis]
        at, m = ellipsoid.center[..., axis], half[..., axis] * CUTS_BOX
        if np.any((low > at - m) | (high < at + m)):
            ellipsoid, missed = cut_by_strip(ellipsoid, axes[axis], low, high, floor=floor[axis])
            empty |= missed
            half = ellipsoid.half_widths
    thin = half < floor
    if thin.any():
        more = np.where(thin, floor**2, 0.0)[..., None] * np.eye(ellipsoid.n)
        ellipsoid = Ellipsoids(ellipsoid.center, ellipsoid.shape + more)
        half = ellipsoid.half_widths
    low = np.maximum(box_low, ellipsoid.center - half)
    high = np.minimum(box_high, ellipsoid.center + half)
    low, high, missed = _widened(low, high, floor)
    return Sets(ellipsoid, low, high, floor), empty | missed


def _widened(low: Array, high: Array, floor: Array) -> tuple[Array, Array, Mask]:
    """Return boxes no thinner than the floor, and which had nothing in them."""
    empty = np.any(low - high > CERTAIN * (1.0 + floor + np.abs(low)), axis=-1)
    lack = np.maximum(floor - 0.5 * (high - low), 0.0)
    return low - lack, high + lack, empty
