"""Measurements of the geodetic filter as linear rows ``Z = H X + noise``, computed minus measured.

Rows of many runs stand side by side; a row that a run does not have is all zeros with sigma 1 and
changes nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from factors.so3 import cross, skew
from ssm_graph.base.earth import LocalFrame
from ssm_graph.base.errors import DataError
from ssm_graph.base.frozen import Array
from ssm_graph.filters.geodetic.error_model import (
    DP,
    DV,
    EPS,
    ERROR_DIM,
    HEIGHT,
    LAT,
    PHI,
    enu_D_place,
)
from ssm_graph.filters.geodetic.mechanisation import GeodeticState, Track, earth_terms
from ssm_graph.graph.aids.depth import Depths
from ssm_graph.graph.aids.gnss import Fixes
from ssm_graph.mission.bottom_track import require_bottom_track
from ssm_graph.mission.problem import Beams, Problem
from ssm_graph.sensors.dvl import N_BEAMS


class Rows(NamedTuple):
    """Linearised measurements of one keyframe."""

    Z: Array
    """(B, m) computed minus measured"""
    H: Array
    """(B, m, 15)"""
    sigma: Array
    """(B, m) nominal standard deviation"""


class BeamGrid(NamedTuple):
    """Beams at their keyframes; NaN speed where there is none."""

    speed: Array
    """(B, K, 4) m/s"""
    sigma: Array
    """(B, K, 4) m/s"""
    gyro_b: Array
    """(B, K, 4, 3) rad/s"""
    beam_b: Array
    """(B, K, 4, 3)"""
    arm_b: Array
    """(B, K, 4, 3) lever arm x beam, m"""


class DepthGrid(NamedTuple):
    """Depth readings at their keyframes, at most R each; NaN where there is none."""

    depth: Array
    """(B, K, R) m"""
    before_s: Array
    """(B, K, R) how long before the keyframe, s"""
    sigma: Array
    """(B,) m"""
    lever_arm_b: Array
    """(B, 3) m"""


class FixGrid(NamedTuple):
    """GNSS fixes at their keyframes; NaN where there is none."""

    place: Array
    """(B, K, 3) latitude, longitude, rad, height, m, of the antenna"""
    whitener: Array
    """(B, K, 3, 3) ``W`` with ``W' W`` the information along east, north, up"""
    lever_arm_b: Array
    """(B, 3) m"""


class Measurements(NamedTuple):
    """All measurements of B runs."""

    beams: BeamGrid
    depths: DepthGrid
    fixes: FixGrid


def gather(problems: Sequence[Problem]) -> Measurements:
    """Lay the measurements of runs with equally many keyframes side by side."""
    for problem in problems:
        require_bottom_track(problem)
    n = problems[0].n_keyframes
    widest = max((_most_per_keyframe(p.depths) for p in problems), default=0)
    return Measurements(
        beams=BeamGrid(*_stacked([_beam_grid(p.beams, n) for p in problems])),
        depths=DepthGrid(*_stacked([_depth_grid(p, widest) for p in problems])),
        fixes=FixGrid(*_stacked([_fix_grid(p.fixes, p.frame, n) for p in problems])),
    )


def _stacked(grids: Sequence[tuple[Array, ...]]) -> list[Array]:
    return [np.stack(arrays) for arrays in zip(*grids, strict=True)]


def _beam_grid(beams: Beams, n: int) -> tuple[Array, ...]:
    _require_single("beam", beams.keyframe * N_BEAMS + beams.beam)
    at = beams.keyframe, beams.beam
    speed, sigma = np.full((n, N_BEAMS), np.nan), np.ones((n, N_BEAMS))
    gyro_b, beam_b, arm_b = np.zeros((3, n, N_BEAMS, 3))
    speed[at], sigma[at] = beams.speed, beams.sigma
    gyro_b[at], beam_b[at] = beams.gyro_b, beams.beam_b
    arm_b[at] = cross(beams.lever_arm_b, beams.beam_b)
    return speed, sigma, gyro_b, beam_b, arm_b


def _most_per_keyframe(depths: Depths | None) -> int:
    return 0 if depths is None else int(np.max(np.bincount(depths.keyframe), initial=0))


def _depth_grid(problem: Problem, widest: int) -> tuple[Array, ...]:
    depths, n = problem.depths, problem.n_keyframes
    depth, before_s = np.full((2, n, widest), np.nan)
    if depths is None:
        return depth, before_s, np.ones(()), np.zeros(3)
    count = np.bincount(depths.keyframe, minlength=n)
    column = np.arange(len(depths.depth)) - np.repeat(np.cumsum(count) - count, count)
    at = depths.keyframe, column
    depth[at] = depths.depth
    before_s[at] = problem.keyframe_s[depths.keyframe] - depths.time_s
    return depth, before_s, np.asarray(depths.sigma), depths.lever_arm_b


def _fix_grid(fixes: Fixes | None, frame: LocalFrame, n: int) -> tuple[Array, ...]:
    place, whitener = np.full((n, 3), np.nan), np.zeros((n, 3, 3))
    if fixes is None:
        return place, whitener, np.zeros(3)
    _require_single("GNSS fix", fixes.keyframe)
    place[fixes.keyframe] = np.stack(frame.geodetic_from_p_n(fixes.position_n), axis=-1)
    R_nl = frame.R_nl_at(fixes.position_n)
    covariance_l = np.swapaxes(R_nl, 1, 2) @ fixes.covariance_n @ R_nl
    whitener[fixes.keyframe] = np.linalg.inv(np.linalg.cholesky(covariance_l))
    return place, whitener, fixes.lever_arm_b


def _require_single(what: str, slot: NDArray[np.intp]) -> None:
    if len(np.unique(slot)) < len(slot):
        raise DataError(
            f"two readings of one {what} share a keyframe: expected at most one; drop readings "
            "less than 2 ms apart"
        )


def beam_rows(grid: BeamGrid, k: int, state: GeodeticState) -> Rows:
    """Return the four beams of a keyframe, each a scalar measurement of its own.

    With ``a`` the beam and ``m`` the lever arm x beam, both turned into local axes, and the drift
    ``eps`` that is still in the gyro reading (eqs. 19 to 24 of the paper, with lever arm)::

        h = a . v + m_b . gyro_b - m . w_ie
        H = [v x a - w_ie x m,  a,  -m . d w_ie/d lat,  m_b,  0]
    """
    turn = np.swapaxes(state.R_lb, 1, 2)
    beam, arm, arm_b = grid.beam_b[:, k] @ turn, grid.arm_b[:, k] @ turn, grid.arm_b[:, k]
    omega_ie = earth_terms(state).omega_ie[:, None]
    v = state.velocity_enu[:, None]
    speed = grid.speed[:, k]
    has = np.isfinite(speed)
    gyro_b = grid.gyro_b[:, k] - state.gyro_bias[:, None]
    computed = (beam * v + arm_b * gyro_b - arm * omega_ie).sum(axis=-1)
    H = np.zeros((*speed.shape, ERROR_DIM))
    H[..., PHI] = cross(v, beam) - cross(omega_ie, arm)
    H[..., DV] = beam
    H[..., LAT] = arm[..., 1] * omega_ie[..., 2] - arm[..., 2] * omega_ie[..., 1]
    H[..., EPS] = arm_b
    return Rows(np.where(has, computed - speed, 0.0), H, grid.sigma[:, k])


def nominal_rows(
    measurements: Measurements, k: int, state: GeodeticState, track: Track | None, X: Array
) -> Rows | None:
    """Return depth and fix of a keyframe, four rows; None where no run has either.

    Parameters
    ----------
    measurements : of all keyframes.
    k : keyframe.
    state : as mechanised, at the keyframe.
    track : the interval that ends there; None at the first keyframe.
    X : (B, 15) predicted errors at the keyframe.
    """
    has_depth = np.isfinite(measurements.depths.depth[:, k]).any()
    has_fix = np.isfinite(measurements.fixes.place[:, k]).any()
    if not (has_depth or has_fix):
        return None
    rows = [
        *([_depth_row(measurements.depths, k, state, track, X)] if has_depth else []),
        *([_fix_rows(measurements.fixes, k, state)] if has_fix else []),
    ]
    return Rows(*(np.concatenate(arrays, axis=1) for arrays in zip(*rows, strict=True)))


def _depth_row(
    grid: DepthGrid, k: int, state: GeodeticState, track: Track | None, X: Array
) -> Rows:
    """Return the mean of the readings since the last keyframe, carried to this one.

    A reading is compared with the sensor's height as mechanised at its own time; the error ``dh``
    there is that of the keyframe but for what it grew since, taken as quadratic from zero after
    the last feedback; only biases that are not fed back make it grow::

        Z = mean(h(t_i) + depth_i + dh (1 - (t_i / T)^2)),   H = dh - (phi x lever arm) . up
    """
    depth, before_s = grid.depth[:, k], grid.before_s[:, k]
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
    has = np.isfinite(depth)
    count = has.sum(axis=1)
    total = np.where(has, height + depth + grown, 0.0).sum(axis=1)
    H = np.zeros((len(depth), 1, ERROR_DIM))
    H[:, 0, HEIGHT] = count > 0
    # e_up x lever arm
    H[:, 0, 0] = np.where(count > 0, -lever_l[:, 1], 0.0)
    H[:, 0, 1] = np.where(count > 0, lever_l[:, 0], 0.0)
    Z = total / np.maximum(count, 1)
    sigma = np.where(count > 0, grid.sigma / np.sqrt(np.maximum(count, 1)), 1.0)
    return Rows(Z[:, None], H, sigma[:, None])


def _interpolated(nodes: Array, values: Array, at: Array) -> Array:
    """Return values (B, R) at ``at`` (B, R), linear between nodes (B, N + 1) that rise from 0."""
    right = np.sum(nodes[:, None, :] < at[:, :, None], axis=-1)
    right = np.clip(right, 1, nodes.shape[1] - 1)
    x_0, x_1 = (np.take_along_axis(nodes, i, axis=1) for i in (right - 1, right))
    y_0, y_1 = (np.take_along_axis(values, i, axis=1) for i in (right - 1, right))
    return np.asarray(y_0 + (y_1 - y_0) * (at - x_0) / (x_1 - x_0))


def _fix_rows(grid: FixGrid, k: int, state: GeodeticState) -> Rows:
    """Return a fix as three whitened rows: ``W (place computed - place measured + lever arm)``."""
    place, W = grid.place[:, k], grid.whitener[:, k]
    lever_l = (state.R_lb @ grid.lever_arm_b[..., None])[..., 0]
    computed = np.stack([state.lat, state.lon, state.height], axis=-1)
    off = np.where(np.isfinite(place), computed - place, 0.0)
    D = enu_D_place(state.lat, state.height)
    H = np.zeros((len(place), 3, ERROR_DIM))
    H[:, :, PHI] = W @ skew(lever_l)
    H[:, :, DP] = W @ D
    Z = (W @ ((D @ off[..., None]) + lever_l[..., None]))[..., 0]
    return Rows(Z, H, np.ones_like(Z))
