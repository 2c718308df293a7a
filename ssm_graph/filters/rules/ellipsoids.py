"""Ellipsoids as sets: sums, strips, intersections and projections that never lose a point.

``E(c, P) = {x : (x - c)' P^-1 (x - c) <= 1}`` with P positive definite. Every operation returns a
set that holds the exact result; leading axes are a batch. Components may have any units, for no
criterion here mixes them: sizes are volumes, and sums are weighed by the volume of their result.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ssm_graph.base.errors import DataError
from ssm_graph.base.frozen import Array, ReadOnlyArrays

Mask = NDArray[np.bool_]

ROUNDING: Final = 1e-12
"""By which every shape is made larger, so that rounding takes no point out."""
CERTAIN: Final = 1e-9
"""By how much of their widths sets have to be apart for it to be told from rounding."""
SUM_ROUNDS: Final = 3
"""Fixed-point rounds for the weights of a sum; any are valid, these only settle the size."""
TIGHTEST: Final = 1e-6
"""Half-width of a strip over that of the ellipsoid below which it counts as this wide, and by how
much one cut may shrink a shape: thinner sets are made thicker, which loses no point."""
MIX_GRID: Final = np.linspace(0.0, 1.0, 33)[1:-1]
"""Weights that are tried for an intersection; any is valid."""


@dataclass(frozen=True, slots=True, eq=False)
class Ellipsoids(ReadOnlyArrays):
    """A batch of ellipsoids."""

    center: Array
    """(..., n)"""
    shape: Array
    """(..., n, n) P, symmetric positive definite"""

    @property
    def n(self) -> int:
        """Dimension."""
        return int(self.center.shape[-1])

    @property
    def half_widths(self) -> Array:
        """(..., n) of the smallest box around each."""
        return np.asarray(np.sqrt(np.einsum("...ii->...i", self.shape)))

    @property
    def log_volume(self) -> Array:
        """(...) half the log of det P: of the volume but for that of the unit ball."""
        return np.asarray(0.5 * np.linalg.slogdet(self.shape)[1])

    def excess(self, points: ArrayLike) -> Array:
        """Return ``e' P^-1 e`` (...) of points (..., n): at most 1 inside."""
        e = np.asarray(points, dtype=np.float64) - self.center
        return np.asarray(np.einsum("...i,...i->...", e, solved(self.shape, e)))

    def contains(self, points: ArrayLike) -> Mask:
        """Return which points (..., n) are inside, without a tolerance."""
        return np.asarray(self.excess(points) <= 1.0)

    def extent(self, h: ArrayLike) -> Array:
        """Return ``sqrt(h' P h)`` (...): the half-width along a vector h (..., n)."""
        row = np.asarray(h, dtype=np.float64)
        return np.asarray(np.sqrt(np.einsum("...i,...ij,...j->...", row, self.shape, row)))

    def projected(self, components: list[int]) -> Ellipsoids:
        """Return the shadow on some components, exactly."""
        return Ellipsoids(
            self.center[..., components], self.shape[..., components, :][..., components]
        )

    def sampled(self, rng: np.random.Generator, count: int, *, on_surface: bool = False) -> Array:
        """Return points (count, ..., n), uniform within each or on its surface (of the ball)."""
        z = rng.standard_normal((count, *self.center.shape))
        z /= np.linalg.norm(z, axis=-1, keepdims=True)
        if not on_surface:
            z *= rng.random((*z.shape[:-1], 1)) ** (1.0 / self.n)
        root = np.linalg.cholesky(self.shape)
        return np.asarray(self.center + np.einsum("...ij,...j->...i", root, z))

    def __getitem__(self, index: Any) -> Ellipsoids:
        """Return those of an index into the batch."""
        return Ellipsoids(self.center[index].copy(), self.shape[index].copy())

    def where(self, mask: Mask, other: Ellipsoids) -> Ellipsoids:
        """Return these where a mask (...) says so, and others elsewhere."""
        return Ellipsoids(
            np.where(mask[..., None], self.center, other.center),
            np.where(mask[..., None, None], self.shape, other.shape),
        )


def checked_shape(name: str, shape: ArrayLike) -> Array:
    """Return a matrix (n, n) that is finite, symmetric and positive definite, else refuse it."""
    P = np.asarray(shape, dtype=np.float64)
    if P.ndim != 2 or P.shape[0] != P.shape[1] or not np.isfinite(P).all():
        raise DataError(f"{name}: expected a square matrix of finite numbers, got shape {P.shape}")
    if not np.allclose(P, P.T, rtol=1e-12, atol=0.0):
        worst = float(np.abs(P - P.T).max())
        raise DataError(f"{name}: expected a symmetric matrix, got one off by {worst:g}")
    least = float(np.linalg.eigvalsh(P)[0])
    if least <= 0.0:
        raise DataError(
            f"{name}: expected a positive definite matrix, got a least eigenvalue of {least:g}; "
            "give what is known exactly a small width"
        )
    return P


def around_box(center: ArrayLike, half_widths: ArrayLike) -> Ellipsoids:
    """Return the ellipsoid of least volume around boxes (..., n)."""
    b = np.asarray(half_widths, dtype=np.float64)
    shape = np.einsum("...i,ij->...ij", b**2, np.eye(b.shape[-1])) * (b.shape[-1] + ROUNDING)
    at = np.broadcast_to(np.asarray(center, dtype=np.float64), b.shape).copy()
    return Ellipsoids(at, shape)


def sum_shape(shapes: Array) -> Array:
    """Return P (..., n, n) of an ellipsoid around the Minkowski sum of S centred ones.

    ``P = sum_s A_s / p_s`` with p > 0, ``sum p = 1`` holds the sum (Cauchy and Schwarz), whatever
    p; the least volume has ``p_s ~ sqrt(tr(P^-1 A_s))`` [1], which is iterated from the scale-free
    traces of the diagonal.

    Parameters
    ----------
    shapes : (..., S, n, n) A_s, positive semidefinite; segments and zeros are such. Together they
        must span all components.

    References
    ----------
    .. [1] C. Durieu, E. Walter, B. Polyak, "Multi-input multi-output ellipsoidal state bounding",
       Journal of Optimization Theory and Applications 111, 2001.
    """
    total = shapes.sum(axis=-3)
    scale = 1.0 / np.einsum("...ii->...i", total)
    size = np.einsum("...sii,...i->...s", shapes, scale)
    for round_ in range(SUM_ROUNDS):
        root = np.sqrt(np.maximum(size, 0.0))
        inverse = np.divide(1.0, root, out=np.zeros_like(root), where=root > 0.0)
        P = np.einsum("...s,...sij->...ij", inverse, shapes) * root.sum(axis=-1)[..., None, None]
        if round_ < SUM_ROUNDS - 1:
            size = np.einsum("...ij,...sji->...s", np.linalg.inv(P), shapes)
    return symmetric(P)


def segments(directions: Array) -> Array:
    """Return the degenerate shapes (..., S, n, n) of segments ``[-d, d]``, d (..., S, n)."""
    return directions[..., :, None] * directions[..., None, :]


def cut_by_strip(
    sets: Ellipsoids, h: ArrayLike, low: ArrayLike, high: ArrayLike, *, floor: ArrayLike = 0.0
) -> tuple[Ellipsoids, Mask]:
    """Return the ellipsoids of least volume around ``E and {low <= h.x <= high}``, and misses.

    With ``u = h.(x - c) / sqrt(h'Ph)`` the strip is first cut to ``[-1, 1]``, which all of E is
    in; let it be ``|u - e| <= r``. Each x in both has, for any q >= 0,
    ``(x-c)'P^-1(x-c) + q (u - e)^2 <= 1 + q r^2``: an ellipsoid. Its volume is least for
    ``s = 1 + q`` of ``(n-1) r^2 s^2 - (1 - r^2 - e^2) s - (n+1) e^2 = 0``, or q = 0.

    A strip that misses an ellipsoid leaves it as it is and is told in the mask (...): no point is
    in both, that is certain but for rounding.

    Parameters
    ----------
    h : (n,) or (..., n)
    low, high : (...), may be infinite.
    floor : (...) half-width along h below which a strip counts as this wide.
    """
    n = sets.n
    if n < 2:
        raise DataError(f"cut_by_strip: expected two components or more, got {n}; intervals do")
    row, P = np.asarray(h, dtype=np.float64), sets.shape
    Ph = (P @ row[..., None])[..., 0]
    root = np.sqrt((row * Ph).sum(axis=-1))
    at = (row * sets.center).sum(axis=-1)
    below, above = (np.asarray(low) - at) / root, (np.asarray(high) - at) / root
    misses = (below > 1.0 + CERTAIN) | (above < -1.0 - CERTAIN)
    below, above = below.clip(-1.0, 1.0), above.clip(-1.0, 1.0)
    e, r = 0.5 * (above + below), 0.5 * (above - below)
    r = np.maximum(r, np.maximum(np.asarray(floor) / root, TIGHTEST))
    rest = 1.0 - r**2 - e**2
    s = rest + np.sqrt(rest**2 + 4.0 * (n * n - 1.0) * r**2 * e**2)
    s = np.where(misses, 1.0, np.maximum(s / (2.0 * (n - 1.0) * r**2), 1.0))
    q = s - 1.0
    unit = Ph / root[..., None]
    delta = np.maximum(1.0 + q * r**2 - q * e**2 / s, TIGHTEST)
    # P - (q/s) u u', as a sum of squares (Joseph): no digit is lost where the strip is thin.
    column = (q / (s * root))[..., None] * unit
    rest_of = np.eye(n) - column[..., :, None] * row[..., None, :]
    shape = rest_of @ P @ np.swapaxes(rest_of, -1, -2)
    thin = (np.sqrt(q) / s)[..., None] * unit
    shape = delta[..., None, None] * (shape + thin[..., :, None] * thin[..., None, :])
    cut = Ellipsoids(sets.center + (q * e / s)[..., None] * unit, symmetric(shape))
    is_cut = s > 1.0
    return (cut if is_cut.all() else cut.where(is_cut, sets)), misses


def intersected(first: Ellipsoids, second: Ellipsoids) -> tuple[Ellipsoids, Mask]:
    """Return ellipsoids around both of two, never larger than the first, and which are apart.

    For w in [0, 1] each x in both has ``w q1(x) + (1-w) q2(x) <= 1``, which is ``E(c, d X)`` with
    ``X = (w P1^-1 + (1-w) P2^-1)^-1``, ``c = X (w P1^-1 c1 + (1-w) P2^-1 c2)``,
    ``d = 1 - (c2-c1)' (P1/w + P2/(1-w))^-1 (c2-c1)``. The w of least volume of a grid is taken; a
    d < 0 proves that nothing is in both [1]: the first is returned then.

    References
    ----------
    .. [1] I. Gilitschenski, U. D. Hanebeck, "A robust computational test for overlap of two
       arbitrary-dimensional ellipsoids", FUSION 2012.
    """
    L = np.linalg.cholesky(first.shape)
    difference = second.center - first.center
    inner = np.linalg.solve(L, np.swapaxes(np.linalg.solve(L, second.shape), -1, -2))
    size, axes = np.linalg.eigh(symmetric(inner))  # of the second where the first is a unit ball
    to_first = L @ axes
    offset = solved(to_first, difference)
    w, v = MIX_GRID, 1.0 - MIX_GRID
    lam, off = size[..., None, :], offset[..., None, :]
    scale = lam / (w[:, None] * lam + v[:, None])  # of X
    d = 1.0 - np.sum(off**2 / (1.0 / w[:, None] + lam / v[:, None]), axis=-1)
    apart = d.min(axis=-1) < -CERTAIN
    log_volume = 0.5 * np.log(scale).sum(axis=-1) + 0.5 * np.log(np.maximum(d, TIGHTEST)) * first.n
    best = np.argmin(log_volume, axis=-1)[..., None]
    is_less = np.take_along_axis(log_volume, best, -1)[..., 0] < 0.0
    mix = np.take_along_axis(scale, best[..., None], -2)[..., 0, :]
    v_best = v[best] / size  # of the second's inverse in these axes
    center = first.center + np.einsum("...ij,...j->...i", to_first, mix * v_best * offset)
    factor = np.maximum(np.take_along_axis(d, best, -1)[..., 0], TIGHTEST)
    shape = (to_first * (factor[..., None] * mix)[..., None, :]) @ np.swapaxes(to_first, -1, -2)
    both = Ellipsoids(center, symmetric(shape))
    return both.where(is_less & ~apart, first), apart


def solved(matrix: Array, vector: Array) -> Array:
    """Return ``matrix^-1 vector`` of a batch."""
    shape = np.broadcast_shapes(matrix.shape[:-1], vector.shape)
    column = np.broadcast_to(vector, shape)[..., None]
    return np.asarray(np.linalg.solve(matrix, column)[..., 0])


def symmetric(P: Array) -> Array:
    """Return the symmetric part, larger by `ROUNDING`."""
    return np.asarray((0.5 + 0.5 * ROUNDING) * (P + np.swapaxes(P, -1, -2)))
