"""Steps 5.1 to 5.5 of the paper: gain, state, covariance and one auxiliary parameter a beam."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from factors.similarity import Kernel, expected_mahalanobis_sq
from ssm_graph.base.frozen import Array
from ssm_graph.filters.geodetic.measurements import Rows


class Settled(NamedTuple):
    """The posterior of one keyframe and the beams' part in it, B runs."""

    X: Array
    """(B, 15)"""
    P: Array
    """(B, 15, 15)"""
    weight: Array
    """(B, m) the auxiliary parameters, as in the last gain"""
    mahalanobis_sq: Array
    """(B, m) t at the posterior"""
    iterations: NDArray[np.intp]
    """(B,)"""


def correct(X: Array, P: Array, rows: Rows) -> tuple[Array, Array]:
    """Return errors and covariance after measurements with their nominal noise."""
    return _gained(X, P, rows, rows.sigma**2)


def _gained(X: Array, P: Array, rows: Rows, variance: Array) -> tuple[Array, Array]:
    """Kalman gain, state, and covariance in Joseph's form."""
    H = rows.H
    PHt = P @ np.swapaxes(H, 1, 2)
    K = PHt @ np.linalg.inv(_with_diagonal(H @ PHt, variance))
    innovation = rows.Z - (H @ X[..., None])[..., 0]
    A = np.eye(X.shape[1]) - K @ H
    P = A @ P @ np.swapaxes(A, 1, 2) + (K * variance[:, None]) @ np.swapaxes(K, 1, 2)
    P = 0.5 * (P + np.swapaxes(P, 1, 2))
    return X + (K @ innovation[..., None])[..., 0], P


def settle(
    X: Array, P: Array, rows: Rows, *, kernel: Kernel, tolerance: float, max_iterations: int
) -> Settled:
    """Correct by beams whose noise variances adapt to their agreement, each for itself.

    From the prediction, ``X^0 = X-`` and ``P^0 = P-``, all beams jointly, for t = 0, 1, ...::

        lambda_j = -2 f'(((Z_j - H_j X^t)^2 + H_j P^t H_j') / sigma_j^2)
        K        = P- H' (H P- H' + diag(sigma_j^2 / lambda_j))^-1
        X^(t+1)  = X- + K (Z - H X-)
        P^(t+1)  = (I - K H) P- (I - K H)' + K diag(sigma_j^2 / lambda_j) K'

    until ``|X^(t+1) - X^t| <= tolerance |X^(t+1)|``, every error in its own predicted sigma: the
    paper's norm would add radians and metres.  The iteration itself needs ``H X`` and ``H P H'``
    only; the covariance follows once at its end. Runs end each at its own time.
    """
    H, sigma_sq = rows.H, rows.sigma**2
    PHt = P @ np.swapaxes(H, 1, 2)
    spread = H @ PHt
    innovation = rows.Z - (H @ X[..., None])[..., 0]
    unit = np.sqrt(np.maximum(np.diagonal(P, axis1=1, axis2=2), np.finfo(float).tiny))
    scaled_PHt = PHt / unit[..., None]
    prior = X / unit
    previous = prior.copy()
    error, variance_left = innovation.copy(), np.diagonal(spread, axis1=1, axis2=2).copy()
    weight = np.ones_like(rows.Z)
    iterations = np.zeros(len(X), np.intp)
    going = np.arange(len(X))
    while len(going):
        t = expected_mahalanobis_sq(error[going], variance_left[going], sigma=rows.sigma[going])
        weight[going] = kernel.weight(t)
        S = _with_diagonal(spread[going], sigma_sq[going] / weight[going])
        gain: Array = np.asarray(np.linalg.inv(S))
        corrected = prior[going] + _times(scaled_PHt[going], _times(gain, innovation[going]))
        gain = spread[going] @ gain
        error[going] = innovation[going] - _times(gain, innovation[going])
        left = (gain * spread[going]).sum(axis=-1)
        variance_left[going] = np.diagonal(spread[going], axis1=1, axis2=2) - left
        np.maximum(variance_left, 0.0, out=variance_left)
        iterations[going] += 1
        change = np.linalg.norm(corrected - previous[going], axis=1)
        previous[going] = corrected
        more = change > tolerance * np.linalg.norm(corrected, axis=1)
        going = going[more & (iterations[going] < max_iterations)]
    t = expected_mahalanobis_sq(error, variance_left, sigma=rows.sigma)
    X, P = _gained(X, P, rows, sigma_sq / weight)
    return Settled(X, P, weight, t, iterations)


def _with_diagonal(matrix: Array, added: Array) -> Array:
    """Return a copy of (B, m, m) with (B, m) added to its diagonals."""
    result = matrix.copy()
    diagonal = np.arange(added.shape[1])
    result[:, diagonal, diagonal] += added
    return result


def _times(matrix: Array, vector: Array) -> Array:
    return np.asarray((matrix @ vector[..., None])[..., 0])
