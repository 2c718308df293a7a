"""Measurements as rows ``Z = H X + noise``, and steps 5.1 to 5.5 of the paper that take them.

Rows are computed minus measured. Those of R runs stand side by side; a row that a run does not have
is all zeros and changes nothing.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from factors.similarity import Kernel, expected_mahalanobis_sq
from factors.so3 import cross, skew, times
from ssm_graph.base.earth import LocalFrame
from ssm_graph.base.frozen import Array
from ssm_graph.filters.geodetic.mechanisation import (
    DP,
    DV,
    EPS,
    ERROR_DIM,
    HEIGHT,
    LAT,
    PHI,
    GeodeticState,
    Track,
    earth_terms,
    enu_D_place,
)
from ssm_graph.filters.side_by_side import BeamGrid, FixGrid, Measurements


class Rows(NamedTuple):
    """Linearised measurements of one keyframe; those of one group share an auxiliary parameter."""

    Z: Array
    """(R, m) computed minus measured"""
    H: Array
    """(R, m, 15)"""
    sigma: Array
    """(R, m) nominal standard deviation, of missing rows 1"""
    group: NDArray[np.intp]
    """(m,) of each row, from 0"""

    def followed_by(self, other: Rows) -> Rows:
        """Return these rows, then others with groups of their own."""
        Z, H, sigma = (
            np.concatenate(pair, axis=1) for pair in zip(self[:3], other[:3], strict=True)
        )
        return Rows(Z, H, sigma, np.append(self.group, other.group + self.group[-1] + 1))


class Places(NamedTuple):
    """Position fixes in geodetic coordinates."""

    place: Array
    """(K, R, 3) latitude, longitude, rad, height, m, of the antenna; NaN where there is none"""
    whitener: Array
    """(K, R, 3, 3) ``W`` with ``W' W`` the information along east, north, up"""
    lever_arm_b: Array
    """(R, 3) m"""


def places_of(fixes: FixGrid, frames: Sequence[LocalFrame]) -> Places:
    """Return fixes in geodetic coordinates, each run's by the navigation frame of its problem."""
    place, whitener = np.full(fixes.position_n.shape, np.nan), fixes.root_information.copy()
    for run, frame in enumerate(frames):
        used = fixes.root_information[:, run].any(axis=(1, 2))
        position_n = fixes.position_n[used, run]
        place[used, run] = np.stack(frame.geodetic_from_p_n(position_n), axis=-1)
        whitener[used, run] = whitener[used, run] @ frame.R_nl_at(position_n)
    return Places(place, whitener, fixes.lever_arm_b)


def beam_rows(grid: BeamGrid, k: int, state: GeodeticState) -> Rows:
    """Return the B beams of a keyframe, each a scalar measurement of its own.

    With ``a`` the beam and ``m`` the lever arm x beam, both turned into local axes, and the drift
    ``eps`` that is still in the gyro reading (eqs. 19 to 24 of the paper, with lever arm)::

        h = a . v + m_b . gyro_b - m . w_ie
        H = [v x a - w_ie x m,  a,  -m . d w_ie/d lat,  m_b,  0]
    """
    turn, has = np.swapaxes(state.R_lb, 1, 2), np.isfinite(grid.sigma[k])
    arm_b = cross(grid.lever_arm_b[:, None], grid.beam_b[k])
    beam, arm = grid.beam_b[k] @ turn, arm_b @ turn
    omega_ie = earth_terms(state).omega_ie[:, None]
    v, gyro_b = state.velocity_enu[:, None], (grid.gyro_b[k] - state.gyro_bias)[:, None]
    computed = (beam * v + arm_b * gyro_b - arm * omega_ie).sum(axis=-1)
    H = np.zeros((*has.shape, ERROR_DIM))
    H[..., PHI] = cross(v, beam) - cross(omega_ie, arm)
    H[..., DV] = beam
    H[..., LAT] = arm[..., 1] * omega_ie[..., 2] - arm[..., 2] * omega_ie[..., 1]
    H[..., EPS] = arm_b
    Z = np.where(has, computed - grid.speed[k], 0.0)
    return Rows(Z, H, np.where(has, grid.sigma[k], 1.0), np.arange(has.shape[1]))


def aid_rows(
    measured: Measurements,
    places: Places,
    k: int,
    state: GeodeticState,
    track: Track | None,
    X: Array,
) -> Rows | None:
    """Return depth and fix of keyframe ``k``, at most four rows; None where no run has either.

    State and predicted errors ``X`` (R, 15) are those at the keyframe as mechanised; the track is
    the interval that ends there, None at the first.
    """
    rows = []
    if np.isfinite(measured.depths.depth[k]).any():
        rows.append(_depth_row(measured, k, state, track, X))
    if np.isfinite(places.place[k]).any():
        rows.append(_fix_rows(places, k, state))
    return functools.reduce(Rows.followed_by, rows) if rows else None


def _depth_row(
    measured: Measurements, k: int, state: GeodeticState, track: Track | None, X: Array
) -> Rows:
    """Return the mean of the readings since the last keyframe, carried to this one.

    A reading is compared with the sensor's height as mechanised at its own time; the error ``dh``
    there is that of the keyframe but for what it grew since, taken as quadratic from zero after
    the last feedback; only biases that are not fed back make it grow::

        Z = mean(h(t_i) + depth_i + dh (1 - (t_i / T)^2)),   H = dh - (phi x lever arm) . up
    """
    grid = measured.depths
    depth, before_s = grid.depth[k], measured.keyframe_s[k, :, None] - grid.time_s[k]
    lever_l = (state.R_lb @ grid.lever_arm_b[..., None])[..., 0]
    height = (state.height + lever_l[:, 2])[:, None]
    grown = np.zeros_like(depth)
    if track is not None:
        lever_up = (track.turned @ grid.lever_arm_b[:, None, :, None])[..., 0]
        lever_up = (lever_up @ track.middle.R_lb[:, 2, :, None])[..., 0]
        span = track.elapsed_s[:, -1:]
        time_s = np.clip(span - np.nan_to_num(before_s), 0.0, span)
        height = _interpolated(track.elapsed_s, track.height + lever_up, time_s)
        grown = X[:, HEIGHT, None] * (1.0 - (time_s / span) ** 2)
    is_read = np.isfinite(depth)
    count = is_read.sum(axis=1)
    has, divisor = count > 0, np.maximum(count, 1)
    H = np.zeros((len(depth), 1, ERROR_DIM))
    H[:, 0, HEIGHT] = has
    # e_up x lever arm
    H[:, 0, 0] = np.where(has, -lever_l[:, 1], 0.0)
    H[:, 0, 1] = np.where(has, lever_l[:, 0], 0.0)
    Z = np.where(is_read, height + depth + grown, 0.0).sum(axis=1) / divisor
    sigma = np.where(has, grid.sigma / np.sqrt(divisor), 1.0)
    return Rows(Z[:, None], H, sigma[:, None], np.zeros(1, np.intp))


def _interpolated(nodes: Array, values: Array, at: Array) -> Array:
    """Return values (B, R) at ``at`` (B, R), linear between nodes (B, N + 1) that rise from 0."""
    right = np.sum(nodes[:, None, :] < at[:, :, None], axis=-1)
    right = np.clip(right, 1, nodes.shape[1] - 1)
    x_0, x_1 = (np.take_along_axis(nodes, i, axis=1) for i in (right - 1, right))
    y_0, y_1 = (np.take_along_axis(values, i, axis=1) for i in (right - 1, right))
    return np.asarray(y_0 + (y_1 - y_0) * (at - x_0) / (x_1 - x_0))


def _fix_rows(grid: Places, k: int, state: GeodeticState) -> Rows:
    """Return a fix as three whitened rows: ``W (place computed - place measured + lever arm)``."""
    place, W = grid.place[k], grid.whitener[k]
    lever_l = (state.R_lb @ grid.lever_arm_b[..., None])[..., 0]
    computed = np.stack([state.lat, state.lon, state.height], axis=-1)
    off = np.where(np.isfinite(place), computed - place, 0.0)
    D = enu_D_place(state.lat, state.height)
    H = np.zeros((len(place), 3, ERROR_DIM))
    H[:, :, PHI] = W @ skew(lever_l)
    H[:, :, DP] = W @ D
    Z = (W @ ((D @ off[..., None]) + lever_l[..., None]))[..., 0]
    return Rows(Z, H, np.ones_like(Z), np.zeros(3, np.intp))


class Settled(NamedTuple):
    """The posterior of one keyframe and what its measurements had to do with it, B runs."""

    X: Array
    """(B, 15)"""
    P: Array
    """(B, 15, 15)"""
    weight: Array
    """(B, m) the auxiliary parameter of each row, as in the last gain"""
    mahalanobis_sq: Array
    """(B, m) t of its group at the posterior"""
    iterations: NDArray[np.intp]
    """(B,)"""


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
    """Correct by measurements whose noise variances adapt to their agreement, each for itself.

    A beam or a depth is one row, a fix three: t is summed over them. From the prediction, ``X^0 =
    X-`` and ``P^0 = P-``, all jointly, for t = 0, 1, ...::

        lambda_j = -2 f'(((Z_j - H_j X^t)^2 + H_j P^t H_j') / sigma_j^2)
        K        = P- H' (H P- H' + diag(sigma_j^2 / lambda_j))^-1
        X^(t+1)  = X- + K (Z - H X-)
        P^(t+1)  = (I - K H) P- (I - K H)' + K diag(sigma_j^2 / lambda_j) K'

    until ``|X^(t+1) - X^t| <= tolerance |X^(t+1)|``, every error in its own predicted sigma: the
    paper's norm would add radians and metres.  The iteration itself needs ``H X`` and ``H P H'``
    only; the covariance follows once at its end. Runs end each at its own time.
    """
    H, sigma_sq = rows.H, rows.sigma**2
    same = (rows.group[:, None] == rows.group).astype(float)
    dim = same.sum(axis=0)
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
        weight[going] = kernel.weight(t @ same, dim=dim)
        S = _with_diagonal(spread[going], sigma_sq[going] / weight[going])
        gain: Array = np.asarray(np.linalg.inv(S))
        corrected = prior[going] + times(scaled_PHt[going], times(gain, innovation[going]))
        gain = spread[going] @ gain
        error[going] = innovation[going] - times(gain, innovation[going])
        left = (gain * spread[going]).sum(axis=-1)
        variance_left[going] = np.diagonal(spread[going], axis1=1, axis2=2) - left
        np.maximum(variance_left, 0.0, out=variance_left)
        iterations[going] += 1
        change = np.linalg.norm(corrected - previous[going], axis=1)
        previous[going] = corrected
        more = change > tolerance * np.linalg.norm(corrected, axis=1)
        going = going[more & (iterations[going] < max_iterations)]
    t = expected_mahalanobis_sq(error, variance_left, sigma=rows.sigma) @ same
    X, P = _gained(X, P, rows, sigma_sq / weight)
    return Settled(X, P, weight, t, iterations)


def _with_diagonal(matrix: Array, added: Array) -> Array:
    """Return a copy of (B, m, m) with (B, m) added to its diagonals."""
    result = matrix.copy()
    diagonal = np.arange(added.shape[1])
    result[:, diagonal, diagonal] += added
    return result
