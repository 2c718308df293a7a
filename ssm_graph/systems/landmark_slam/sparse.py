"""Path and map by normal equations of a band: what ranks many opinions on one log, and quickly.

The rows are those of `smoother`, and so are the weights, but judged by residuals alone: no marginal
of an observation is found, only the joint covariance of the landmarks. A pass takes a tenth of the
time of elimination by QR.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from scipy.linalg import cho_solve_banded, cholesky_banded
from scipy.sparse import csr_matrix

from factors.bearing_range import half_turn
from ssm_graph.base.frozen import Array
from ssm_graph.systems.landmark_slam.problem import SlamNoise, SlamProblem
from ssm_graph.systems.landmark_slam.smoother import (
    FAR_M,
    Rows,
    SmootherSettings,
    Values,
    linearised,
    with_drift,
)
from ssm_graph.systems.landmark_slam.weights import weights_of

PASSES: Final = 20
"""At most; opinions whose path has not settled by then are seldom good ones."""
SETTLED: Final = 1e-3
"""m and rad by which the last pass moves anything at most."""
BAND: Final = 6
"""Diagonals below and on the main one: two poses of three numbers each."""
LONGEST: Final = 1.0
"""m and rad that a pass moves a pose by at most: farther off rows are straight lines no more."""


class Quick(NamedTuple):
    """Where it stands."""

    values: Values
    rows: Rows
    cov: Array
    """(2 L, 2 L) of the landmarks, m^2"""


def smooth_quickly(
    problem: SlamProblem, noise: SlamNoise, first: Values, settings: SmootherSettings
) -> Quick:
    """Return path and map of a log whose observations have their landmarks."""
    values = with_drift(problem, first)
    K, L, d = len(problem.time_s), len(values.landmarks), len(values.drift)
    n = 3 * K + 2 * L + d
    places = 3 * K + np.arange(2 * L)
    weights = np.ones(len(problem.keyframe))
    for count in range(PASSES):
        rows = linearised(problem, noise, values)
        if count:
            t = np.square(rows.own_error).sum(axis=1)
            weights = weights_of(settings.kernel, t, rows.n_rows)
        A, b = _system(problem, rows, weights, values)
        step, cov = _solved(A.T @ A, A.T @ b, 3 * K)
        step *= min(1.0, LONGEST / max(float(np.abs(step[: 3 * K]).max()), 1e-12))
        pose = values.pose + step[: 3 * K].reshape(-1, 3)
        pose[:, 2] = half_turn(pose[:, 2])
        moved = values.landmarks + step[places].reshape(-1, 2)
        values = Values(pose, moved, values.drift + step[n - d :])
        if np.abs(step).max() < SETTLED:
            break
    return Quick(values, linearised(problem, noise, values), cov[: 2 * L, : 2 * L])


def _solved(H: csr_matrix, g: Array, n_path: int) -> tuple[Array, Array]:
    """Return the solution of ``H x = g``, and the covariance of what comes after the path.

    The path is a chain, so that its normal equations have a band; the rest, landmarks and drift, is
    few. Path eliminated, what is left of the rest is dense.
    """
    path = H[:n_path, :n_path].tocoo()
    band = np.zeros((BAND, n_path))
    lower = path.row >= path.col
    band[path.row[lower] - path.col[lower], path.col[lower]] = path.data[lower]
    cross = H[:n_path, n_path:].toarray()
    factor = cholesky_banded(band, lower=True, check_finite=False)
    solved = cho_solve_banded(
        (factor, True), np.column_stack([cross, g[:n_path]]), check_finite=False
    )
    cov = np.linalg.inv(H[n_path:, n_path:].toarray() - cross.T @ solved[:, :-1])
    rest = cov @ (g[n_path:] - cross.T @ solved[:, -1])
    return np.concatenate([solved[:, -1] - solved[:, :-1] @ rest, rest]), cov


def _system(
    problem: SlamProblem, rows: Rows, weights: Array, values: Values
) -> tuple[csr_matrix, Array]:
    """Return all weighted rows, and what they want."""
    K, L, d = len(problem.time_s), len(values.landmarks), len(values.drift)
    n, M = 3 * K + 2 * L + d, len(problem.keyframe)
    k, three = np.arange(K - 1)[:, None], np.arange(3)
    drift_at = np.broadcast_to(n - d + np.arange(d), (K - 1, d))
    of_between = np.hstack([3 * k + np.arange(6), drift_at])
    of_own = np.hstack(
        [3 * problem.keyframe[:, None] + three, 3 * K + 2 * problem.landmark[:, None] + [0, 1]]
    )
    root = np.sqrt(weights)[:, None]
    off = problem.start - values.pose[0]
    off[2] = half_turn(off[2])
    # What was seen by a range alone, or a bearing, leaves its landmark wide.
    prior = np.concatenate([1.0 / problem.start_sigma, np.full(2 * L, 1.0 / FAR_M)])
    prior = np.concatenate([prior, 1.0 / problem.drift_sigma])
    wants = np.concatenate([off, np.zeros(2 * L), -values.drift])
    at = np.concatenate([three, np.arange(3 * K, n)])
    data = np.concatenate(
        [
            np.concatenate([rows.between, rows.between_drift], axis=2).ravel(),
            (root[..., None] * rows.own).ravel(),
            prior,
        ]
    )
    columns = np.concatenate(
        [np.repeat(of_between, 3, axis=0).ravel(), np.repeat(of_own, 2, axis=0).ravel(), at]
    )
    lengths = np.concatenate(
        [np.full(3 * (K - 1), 6 + d), np.full(2 * M, 5), np.ones(len(prior), dtype=int)]
    )
    begins = np.append(0, np.cumsum(lengths))
    b = np.concatenate(
        [-rows.between_error.ravel(), -(root * rows.own_error).ravel(), prior * wants]
    )
    return csr_matrix((data, columns, begins), shape=(len(lengths), n)), b
