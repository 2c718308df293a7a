"""The scaled unscented transform, of many runs at once, and a Cholesky root that always comes.

Points stand at the mean and at plus and minus ``sqrt(s)`` times every column of a root of the
covariance, ``s = alpha^2 (n + kappa)``. With ``kappa = 3 - n`` the spread ``s`` does not depend on
``n``, and a point that moves only what a function does not see gives the value at the mean: its
weight joins that of the middle. So the transform of the few variables that a function sees, first
in the order of the root, is the transform of all of them, exactly.

References
----------
.. [1] S. J. Julier, "The Scaled Unscented Transformation", American Control Conference, 2002.
.. [2] E. A. Wan, R. van der Merwe, "The Unscented Kalman Filter", in S. Haykin (ed.), "Kalman
   Filtering and Neural Networks", Wiley, 2001.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np

from ssm_graph.base.errors import ConfigError
from ssm_graph.base.frozen import Array

JITTER: Final = (0.0, 1e-12, 1e-10, 1e-8, 1e-6)
"""Shares of the largest variance that are put on the diagonal, one after the other."""


@dataclass(frozen=True, slots=True)
class Spread:
    """How far the points stand; the defaults are ``kappa = 3 - n`` with ``alpha`` 1."""

    alpha: float = 1.0
    beta: float = 2.0
    n_plus_kappa: float = 3.0

    def __post_init__(self) -> None:
        for name in ("alpha", "n_plus_kappa"):
            if not 0.0 < getattr(self, name) < np.inf:
                raise ConfigError(
                    f"{name}: expected a number above 0, got {getattr(self, name)}; try "
                    f"{Spread.__dataclass_fields__[name].default}"
                )

    @property
    def scale(self) -> float:
        """``n + lambda``: the squared distance of the points, in sigmas."""
        return self.alpha**2 * self.n_plus_kappa

    def weights(self, n: int) -> tuple[float, float, float]:
        """Return the weights of the middle in mean and covariance, and that of another point."""
        middle = 1.0 - n / self.scale
        return middle, middle + 1.0 - self.alpha**2 + self.beta, 0.5 / self.scale


class Root(NamedTuple):
    """A lower triangular root (..., n, n) of covariances, and what it took."""

    root: Array
    n_repaired: int
    """How many of them were not positive definite and got a jitter or a floor."""


def root_of(cov: Array) -> Root:
    """Return ``L`` with ``L L' = P``; what is not positive definite is made so, and counted.

    First with a jitter on the diagonal, at last with eigenvalues floored at the largest jitter.
    """
    try:
        return Root(np.asarray(np.linalg.cholesky(cov), dtype=np.float64), 0)
    except np.linalg.LinAlgError:
        pass
    shape = cov.shape
    flat = cov.reshape(-1, *shape[-2:])
    found = np.empty(flat.shape)
    count = 0
    for i, one in enumerate(flat):
        found[i], was_good = _repaired(0.5 * (one + one.T))
        count += not was_good
    return Root(found.reshape(shape), count)


def _repaired(cov: Array) -> tuple[Array, bool]:
    largest = max(float(np.max(np.diagonal(cov))), np.finfo(float).tiny)
    for jitter in JITTER:
        try:
            found = np.linalg.cholesky(cov + jitter * largest * np.eye(len(cov)))
            return np.asarray(found, dtype=np.float64), jitter == 0.0
        except np.linalg.LinAlgError:
            continue
    values, vectors = np.linalg.eigh(cov)
    half = vectors * np.sqrt(np.maximum(values, JITTER[-1] * largest))
    R = np.asarray(np.linalg.qr(half.T, mode="r"))
    return np.asarray(R.T * np.sign(np.diagonal(R))), False


class Transformed(NamedTuple):
    """Moments of a function of a random vector."""

    mean: Array
    """(..., m)"""
    cov: Array
    """(..., m, m)"""
    half: Array
    """(..., n, m) the covariance of the vector with the function is ``root @ half``."""


def unscented(
    function: Callable[[Array], Array],
    mean: Array,
    root: Array,
    *,
    spread: Spread,
    difference: Callable[[Array, Array], Array] = np.subtract,
) -> Transformed:
    """Return the moments of a function of vectors by the scaled symmetric points.

    Parameters
    ----------
    function : takes (..., 2 n + 1, n) and returns (..., 2 n + 1, m).
    mean, root : (..., n) and (..., n, n) with ``root root'`` the covariance.
    spread : where the points stand.
    difference : of two values of the function; of angles it wraps.
    """
    n = mean.shape[-1]
    moved = np.sqrt(spread.scale) * np.swapaxes(root, -1, -2)
    points = np.repeat(mean[..., None, :], 2 * n + 1, axis=-2)
    points[..., 1 : n + 1, :] += moved
    points[..., n + 1 :, :] -= moved
    values = function(points)
    _, middle_cov, other = spread.weights(n)
    middle = values[..., :1, :]
    offsets = difference(values, middle)
    # The middle's weight in the mean multiplies no offset.
    shift = other * offsets[..., 1:, :].sum(axis=-2)
    from_mean = offsets - shift[..., None, :]
    rest = from_mean[..., 1:, :]
    first = from_mean[..., 0, :]
    cov = other * (np.swapaxes(rest, -1, -2) @ rest)
    cov = cov + middle_cov * first[..., :, None] * first[..., None, :]
    half = (rest[..., :n, :] - rest[..., n:, :]) * (other * np.sqrt(spread.scale))
    return Transformed(middle[..., 0, :] + shift, cov, half)
