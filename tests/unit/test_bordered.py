"""A chain with a border, against the same rows solved as one dense system."""

from __future__ import annotations

import itertools
from typing import NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray

from ssm_graph.base.errors import SolverError
from ssm_graph.base.frozen import Array
from ssm_graph.engine.chain import Chain, ChainSolution


class ChainRows(NamedTuple):
    """Rows ``A d = b`` of K keyframes of n states with a border of C constants, ``b`` last."""

    start: Array
    """(n, n + C + 1)"""
    between: Array
    """(K - 1, n, 2 n + C + 1)"""
    own: Array
    """(M, n + C + 1)"""
    first: NDArray[np.intp]
    """(K + 1,) where the own rows of each keyframe begin, and M"""
    border: Array
    """(m, C + 1)"""


def solve(rows: ChainRows) -> ChainSolution:
    """Eliminate and solve."""
    n, width = rows.start.shape
    chain = Chain(n, width - n - 1)
    own = [rows.own[a:b] for a, b in itertools.pairwise(rows.first.tolist())]
    chain.eliminate(rows.start, own, rows.between, begin=0)
    return chain.solve(rows.border)


def random_rows(
    rng: np.random.Generator, *, keyframes: int, n: int, constants: int, most: int = 5
) -> ChainRows:
    """Return rows of random numbers; some keyframes are not measured at all."""
    counts = rng.integers(0, most + 1, size=keyframes)
    first = np.append(0, np.cumsum(counts))
    return ChainRows(
        start=np.hstack([10.0 * np.eye(n), np.zeros((n, constants)), rng.normal(size=(n, 1))]),
        between=_without_border(rng.normal(size=(keyframes - 1, n, 2 * n + constants + 1)), n),
        own=rng.normal(size=(first[-1], n + constants + 1)),
        first=first,
        border=np.hstack([np.eye(constants), rng.normal(size=(constants, 1))]),
    )


def _without_border(between: Array, n: int) -> Array:
    between[:, :, 2 * n : -1] = 0.0
    return between


def dense(rows: ChainRows) -> tuple[Array, Array]:
    """Return solution and covariance of all variables, keyframes before constants."""
    n, n_keyframes = len(rows.start), len(rows.first) - 1
    n_constants = rows.start.shape[1] - n - 1
    total = n * n_keyframes + n_constants
    blocks = []

    def place(part: Array, k: int, width: int) -> None:
        wide = np.zeros((len(part), total + 1))
        wide[:, n * k : n * k + width] = part[:, :width]
        wide[:, total - n_constants :] = part[:, width:]
        blocks.append(wide)

    place(rows.start, 0, n)
    for k in range(n_keyframes):
        place(rows.own[rows.first[k] : rows.first[k + 1]], k, n)
        if k < n_keyframes - 1:
            place(rows.between[k], k, 2 * n)
    place(rows.border, 0, 0)
    A = np.concatenate(blocks)
    solution = np.linalg.lstsq(A[:, :-1], A[:, -1])[0]
    return solution, np.linalg.inv(A[:, :-1].T @ A[:, :-1])


@pytest.mark.parametrize(
    ("keyframes", "n", "constants", "most"),
    [(1, 4, 2, 5), (2, 4, 2, 5), (9, 4, 3, 5), (9, 4, 0, 5), (9, 5, 7, 3), (6, 3, 2, 12)],
)
def test_as_a_dense_system(keyframes: int, n: int, constants: int, most: int) -> None:
    """Steps, marginal covariances, and those between keyframes and constants."""
    rng = np.random.default_rng(keyframes + constants)
    rows = random_rows(rng, keyframes=keyframes, n=n, constants=constants, most=most)
    got = solve(rows)
    solution, covariance = dense(rows)
    end = n * keyframes
    np.testing.assert_allclose(got.step.ravel(), solution[:end], rtol=1e-8, atol=1e-9)
    np.testing.assert_allclose(got.constants_step, solution[end:], rtol=1e-8, atol=1e-9)
    np.testing.assert_allclose(got.constants_cov, covariance[end:, end:], rtol=1e-8, atol=1e-12)
    marginals, variances = got.covariance(n), got.sigma[:end].reshape(-1, n) ** 2
    for k in range(keyframes):
        own = slice(n * k, n * k + n)
        np.testing.assert_allclose(marginals[k], covariance[own, own], rtol=1e-7, atol=1e-10)
        np.testing.assert_allclose(variances[k], np.diag(covariance[own, own]), rtol=1e-7)
        shared = got.sensitivity[k] @ got.constants_cov
        np.testing.assert_allclose(shared, covariance[own, end:], rtol=1e-7, atol=1e-10)
    joint = np.r_[end - n + 1 : end, end : end + constants]
    np.testing.assert_allclose(
        got.end_covariance(1), covariance[np.ix_(joint, joint)], rtol=1e-7, atol=1e-10
    )


def test_variance_of_rows_takes_the_border_along() -> None:
    """``H P H'`` holds the correlation of a keyframe with the constants."""
    rng = np.random.default_rng(3)
    rows = random_rows(rng, keyframes=5, n=4, constants=3)
    got, (_, covariance) = solve(rows), dense(rows)
    keyframe = np.array([0, 4, 2, 2])
    H = rng.normal(size=(4, 7))
    for i, k in enumerate(keyframe):
        wide = np.zeros(len(covariance))
        wide[4 * k : 4 * k + 4], wide[20:] = H[i, :4], H[i, 4:]
        np.testing.assert_allclose(got.variance(keyframe, H)[i], wide @ covariance @ wide)


@pytest.mark.parametrize("keyframes", [2, 3, 10, 30])
def test_triangles_rebuild_the_information(keyframes: int) -> None:
    """``R`` and ``R gain`` of every keyframe, in their places, have the ``A'A`` of all rows."""
    rows = random_rows(np.random.default_rng(keyframes), keyframes=keyframes, n=4, constants=0)
    got, (_, covariance) = solve(rows), dense(rows)
    whole = np.zeros_like(covariance)
    for k in range(keyframes):
        own = slice(4 * k, 4 * k + 4)
        whole[own, own] = got.R[k]
        assert np.all(np.tril(got.R[k], -1) == 0.0)
        if k + 1 < keyframes:
            whole[own, 4 * k + 4 : 4 * k + 8] = got.R[k] @ got.gain[k]
    information = np.linalg.inv(covariance)
    np.testing.assert_allclose(
        whole.T @ whole, information, rtol=0.0, atol=1e-8 * np.abs(information).max()
    )


def test_what_is_not_determined_is_refused() -> None:
    """A constant without a prior that no row sees."""
    rng = np.random.default_rng(4)
    rows = random_rows(rng, keyframes=4, n=3, constants=2)
    rows.own[:, 3], rows.border[0] = 0.0, 0.0
    with pytest.raises(SolverError, match="not determined"):
        solve(rows)


def test_what_is_not_finite_is_refused() -> None:
    """A NaN in a row does not get through."""
    rng = np.random.default_rng(5)
    rows = random_rows(rng, keyframes=4, n=3, constants=2)
    rows.between[1, 0, 0] = np.nan
    with pytest.raises(SolverError):
        solve(rows)
