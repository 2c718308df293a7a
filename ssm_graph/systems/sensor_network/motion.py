"""Motions with bounds of what their lines leave out: of a robot in the plane, and of any function.

The state is east, north [m] and the yaw [rad] from east, or any place and angle that turn alike.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import j1

from ssm_graph.base.frozen import Array
from ssm_graph.filters.rules.set_membership import Image, Sets

POSITION = (0, 1)
HEADING = 2


def planar_step(state: ArrayLike, advance: ArrayLike, turn: ArrayLike) -> Array:
    """Return where states (..., 3) go: ``p + R(theta) advance``, ``theta + turn``.

    Parameters
    ----------
    advance : (..., 2) m, forward and left during the step.
    turn : (...) rad during the step, after the advance.
    """
    x, d = np.asarray(state, dtype=np.float64), np.asarray(advance, dtype=np.float64)
    cos, sin = np.cos(x[..., 2]), np.sin(x[..., 2])
    return np.stack(
        [
            x[..., 0] + cos * d[..., 0] - sin * d[..., 1],
            x[..., 1] + sin * d[..., 0] + cos * d[..., 1],
            x[..., 2] + np.asarray(turn, dtype=np.float64),
        ],
        axis=-1,
    )


def sine_line(half_width: ArrayLike) -> tuple[Array, Array]:
    """Return slope s and bound b with ``|sin e - s e| <= b`` for all ``|e| <= a``, a (...) rad.

    The slope is that of the first Chebyshev polynomial, 2 J1(a) / a, nearly the best; the bound is
    exact for it: on [0, a] the rest is largest at ``cos e = s`` or at the end. Beyond half a turn
    the slope is 0 and the bound 1.
    """
    a = np.asarray(half_width, dtype=np.float64)
    within = a < math.pi
    safe = np.clip(a, 1e-12, math.pi)
    s = np.where(within, 2.0 * j1(safe) / safe, 0.0)
    e = np.minimum(np.arccos(np.clip(s, -1.0, 1.0)), safe)
    inner, end = np.abs(np.sin(e) - s * e), np.abs(np.sin(safe) - s * safe)
    return s, np.where(within, np.maximum(inner, end), 1.0)


def cosine_range(low: ArrayLike, high: ArrayLike) -> tuple[Array, Array]:
    """Return the least and the largest cosine over the angles from low to high (...), rad."""
    a, b = np.asarray(low, dtype=np.float64), np.asarray(high, dtype=np.float64)
    turn = 2.0 * math.pi
    has_top = np.floor(b / turn) >= np.ceil(a / turn)
    has_bottom = np.floor((b - math.pi) / turn) >= np.ceil((a - math.pi) / turn)
    ends = np.stack([np.cos(a), np.cos(b)])
    return (
        np.where(has_bottom, -1.0, ends.min(axis=0)),
        np.where(has_top, 1.0, ends.max(axis=0)),
    )


def planar_image(
    sets: Sets,
    advance: ArrayLike,
    turn: ArrayLike,
    noise: ArrayLike,
    *,
    advance_bound: ArrayLike = (0.0, 0.0),
) -> Image:
    """Return what the step of :func:`planar_step` makes of sets, noise added.

    With ``theta = c + e``, ``|e| <= a``, and the advance of length d along u and its normal t,
    ``R(theta) advance = d (cos e u + sin e t)``. The cosine lies in [cos a, 1], the sine on a line
    but for the bound of :func:`sine_line`: two half segments, together 1/4 of Lagrange's
    ``d a^2 / 2`` along u and of the order of a^3 along t, which at any a is a bound.

    Parameters
    ----------
    advance : (..., 2) m
    turn : (...) rad
    noise : (3,) or (..., 3) bounds of what is added to each component in the step.
    advance_bound : (2,) or (..., 2) bounds of the error of the advance, m, which turns with the
        heading.
    """
    d, w = np.asarray(advance, dtype=np.float64), np.asarray(noise, dtype=np.float64)
    more = np.broadcast_to(np.asarray(advance_bound, dtype=np.float64), d.shape)
    c = sets.ellipsoid.center
    low, high = sets.low[..., HEADING], sets.high[..., HEADING]
    a = np.maximum(np.maximum(high - c[..., 2], c[..., 2] - low), 0.0)
    size = np.broadcast_to(np.hypot(d[..., 0], d[..., 1]), a.shape)
    angle = c[..., 2] + np.arctan2(d[..., 1], d[..., 0])
    along = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    across = np.stack([-along[..., 1], along[..., 0]], axis=-1)
    slope, rest = sine_line(a)
    least = np.where(a < math.pi, np.cos(np.minimum(a, math.pi)), -1.0)
    A = np.broadcast_to(np.eye(3), (*a.shape, 3, 3)).copy()
    A[..., :2, 2] = (size * slope)[..., None] * across
    center = c + 0.0
    center[..., :2] += (0.5 * (1.0 + least) * size)[..., None] * along
    center[..., 2] += np.asarray(turn, dtype=np.float64)
    spans = np.zeros((*a.shape, 7, 3))
    spans[..., 0, :2] = (0.5 * (1.0 - least) * size)[..., None] * along
    spans[..., 1, :2] = (rest * size)[..., None] * across
    spans[..., 2:5, :] = w[..., None, :] * np.eye(3)
    # What the advance errs by turns with the heading: a disc of the box's corner holds it.
    spans[..., 5:, :2] = turned_bound(a, c[..., 2], more)
    move_low, move_high = _box_of_advance(low, high, d, more)
    at = np.asarray(turn)[..., None]
    zero = np.zeros_like(move_low[..., :1])
    return Image(
        A,
        center,
        spans,
        sets.low + np.concatenate([move_low, zero + at], axis=-1) - w,
        sets.high + np.concatenate([move_high, zero + at], axis=-1) + w,
    )


def turned_bound(a: Array, angle: Array, bound: Array) -> Array:
    """Return two half segments (..., 2, 2) around a box that is turned by ``angle`` give or take a.

    A box of half-widths b turned by e lies within the box ``b1 + |sin e| b2``, ``b2 + |sin e| b1``.
    """
    most = np.where(a < 0.5 * math.pi, np.sin(np.minimum(a, 0.5 * math.pi)), 1.0)
    wide = bound + most[..., None] * bound[..., ::-1]
    cos, sin = np.cos(angle), np.sin(angle)
    rows = np.stack([np.stack([cos, sin], -1), np.stack([-sin, cos], -1)], axis=-2)
    return np.asarray(wide[..., :, None] * rows)


def _box_of_advance(low: Array, high: Array, d: Array, bound: Array) -> tuple[Array, Array]:
    """Return the box of ``R(theta) (d + delta)`` for headings from low to high."""
    size, angle = np.hypot(d[..., 0], d[..., 1]), np.arctan2(d[..., 1], d[..., 0])
    quarter = 0.5 * math.pi
    east = cosine_range(low + angle, high + angle)
    north = cosine_range(low + angle - quarter, high + angle - quarter)
    cos = np.max(np.abs(cosine_range(low, high)), axis=0)
    sin = np.max(np.abs(cosine_range(low - quarter, high - quarter)), axis=0)
    more = np.stack(
        [cos * bound[..., 0] + sin * bound[..., 1], sin * bound[..., 0] + cos * bound[..., 1]], -1
    )
    first = np.stack([size * east[0], size * north[0]], axis=-1) - more
    last = np.stack([size * east[1], size * north[1]], axis=-1) + more
    return first, last


def lagrange_remainder(half_widths: ArrayLike, hessian: ArrayLike) -> Array:
    """Return by how much a function may leave its tangent over a box, (..., m).

    ``|f_l(c+e) - f_l(c) - J_l e| <= 1/2 sum_ij max|H_l,ij| b_i b_j`` (Lagrange), for functions
    whose second derivatives are bounded by their user: by hand, or by intervals.

    Parameters
    ----------
    half_widths : (..., n) of the box.
    hessian : (m, n, n) largest absolute second derivatives over the box.
    """
    b, H = np.asarray(half_widths, dtype=np.float64), np.asarray(hessian, dtype=np.float64)
    return np.asarray(0.5 * np.einsum("lij,...i,...j->...l", np.abs(H), b, b))
