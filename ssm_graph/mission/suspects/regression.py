"""Regressions whose errors walk, with a loss that a bad reading cannot buy."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular

from ssm_graph.base.frozen import Array

DOF: Final = 4.0
"""Of the Student distribution that residuals are judged by."""
MEDIAN_SQUARE: Final = 0.455
"""Of a standard Gaussian."""
EXPECTED_LOSS: Final = 0.485
"""Mean loss of a standard Gaussian residual,"""
NEUTRAL: Final = 0.926
"""and a residual that has it."""
TINY: Final = 1e-12
Mask = NDArray[np.bool_]


def loss(residual: Array, scale: float) -> Array:
    """Return minus the logarithm of the likelihood of each residual (n,), less a constant."""
    return np.asarray(0.5 * (DOF + 1.0) * np.log1p((residual / scale) ** 2 / DOF))


def scale_of(residual: Array) -> float:
    """Return the scale of residuals whose sigma is stated as one; not less than one."""
    return max(1.0, float(np.sqrt(_median(residual**2) / MEDIAN_SQUARE)))


def _median(values: Array) -> float:
    """Return the median of numbers (n,), one or more: a third of ``numpy.median``'s time."""
    half = len(values) // 2
    if len(values) % 2:
        return float(np.partition(values, half)[half])
    low, high = np.partition(values, (half - 1, half))[half - 1 : half + 1]
    return float(0.5 * (low + high))


def whitened(W: Array, values: Array) -> Array:
    """Return ``W @ values`` for complex ``values`` (n, c), which are not made of ``W`` (n, n)."""
    return np.asarray((W @ values.view(float)).view(complex))


def whitener(covariance: Array) -> Array:
    """Return the matrix that whitens errors of a covariance (n, n)."""
    n = len(covariance)
    return np.asarray(solve_triangular(np.linalg.cholesky(covariance), np.eye(n), lower=True))


def walk_covariance(time_s: Array) -> Array:
    """Return the covariance (n, n) of a random walk of unit density, from the first time on."""
    t = time_s - time_s[0]
    return np.asarray(np.minimum.outer(t, t))


def twice_walk_covariance(time_s: Array) -> Array:
    """Return the covariance (n, n) of the integral of a random walk of unit density."""
    t = time_s - time_s[0]
    low, high = np.minimum.outer(t, t), np.maximum.outer(t, t)
    return np.asarray(low**2 * (3.0 * high - low) / 6.0)


def robust_residual(y: Array, X: Array, known: Mask, *, rounds: int = 3) -> tuple[Array, Array]:
    """Return residuals (n,) and coefficients (c,) of a regression with a Student loss.

    Rows that are not ``known`` (n,), before or after all logs, say nothing for or against.
    """
    weight = known.astype(float)
    for _ in range(rounds):
        root = np.sqrt(weight)
        coefficients = np.linalg.lstsq(X * root[:, None], y * root, rcond=1e-10)[0]
        residual = y - X @ coefficients
        squared = residual.real**2 + residual.imag**2
        usual = _median(squared[known]) if known.any() else 1.0
        scale_sq = max(usual / MEDIAN_SQUARE, TINY)
        weight = known * (DOF + 1.0) / (DOF + squared / scale_sq)
    return np.where(known, residual, NEUTRAL), coefficients
