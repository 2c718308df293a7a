"""Evidence of columns along the chain against the same in one dense matrix."""

from __future__ import annotations

import numpy as np
import pytest

from ssm_graph.base.errors import SolverError
from ssm_graph.base.frozen import Array
from ssm_graph.engine.chain import ChainSolution
from ssm_graph.engine.evidence import (
    BetweenRows,
    ChainEvidence,
    Columns,
    Evidence,
    OwnRows,
    root_of,
)

K, N, M, WIDE = 30, 15, 90, 6


def chain(rng: np.random.Generator) -> ChainSolution:
    """Return conditionals of a chain that forgets."""
    R = np.triu(rng.normal(size=(K, N, N))) + 3.0 * np.eye(N)
    S = 0.2 * rng.normal(size=(K, N, N))
    S[-1] = 0.0
    none = np.zeros(0)
    return ChainSolution(none, none, none, none, none, np.asarray(np.linalg.solve(R, S)), R)


def dense_information(
    solution: ChainSolution, own: OwnRows, between: BetweenRows, columns: Array
) -> Array:
    """Return ``c' (I - A (A'A)^-1 A') c`` by one triangular matrix of the whole chain."""
    root = np.zeros((K * N, K * N))
    A = np.zeros((M + (K - 1) * WIDE, K * N))
    for k in range(K):
        root[k * N : (k + 1) * N, k * N : (k + 1) * N] = solution.R[k]
        if k + 1 < K:
            root[k * N : (k + 1) * N, (k + 1) * N : (k + 2) * N] = solution.R[k] @ solution.gain[k]
            rows = slice(M + k * WIDE, M + (k + 1) * WIDE)
            A[rows, k * N : (k + 2) * N] = between.jacobian[k]
    for row, k in enumerate(own.keyframe):
        A[row, k * N : (k + 1) * N] = own.jacobian[row]
    y = np.linalg.solve(root.T, A.T @ columns)
    return np.asarray(columns.T @ columns - y.T @ y)


@pytest.mark.parametrize("blocks", [[0, K], [0, 8, 9, 21, K], [3, 10, 14, 25]], ids=str)
def test_evidence_is_that_of_the_dense_matrix(blocks: list[int]) -> None:
    """Columns on rows of one keyframe and between two; a piece or the whole of the chain."""
    rng = np.random.default_rng(4)
    solution = chain(rng)
    keyframe = np.sort(rng.integers(0, K, M))
    own_rows = OwnRows(keyframe, 0.02 * rng.normal(size=(M, N)), rng.normal(size=M))
    between_rows = BetweenRows(
        0.02 * rng.normal(size=(K - 1, WIDE, 2 * N)), rng.normal(size=(K - 1, WIDE))
    )
    own = Columns(rng.normal(size=(M, 2)), rng.normal(size=(K - 1, WIDE, 2)))
    shared = Columns(rng.normal(size=(M, 3)), rng.normal(size=(K - 1, WIDE, 3)))
    n_blocks = len(blocks) - 1
    columns = np.zeros((M + (K - 1) * WIDE, 2 * n_blocks + 3))
    of_interval = np.repeat(np.arange(K - 1), WIDE)
    for i in range(n_blocks):
        for at, begin, stack in (
            (keyframe, 0, [own.own, shared.own]),
            (
                of_interval,
                M,
                [part.between.reshape(-1, part.between.shape[2]) for part in (own, shared)],
            ),
        ):
            inside = np.flatnonzero((blocks[i] <= at) & (at < blocks[i + 1]))
            columns[begin + inside, 2 * i : 2 * i + 2] = stack[0][inside]
            columns[begin + inside, 2 * n_blocks :] = stack[1][inside]
    found = ChainEvidence(solution, own_rows, between_rows).of(np.array(blocks), own, shared)
    expected = dense_information(solution, own_rows, between_rows, columns)
    missed = np.concatenate([own_rows.missed, between_rows.missed.ravel()])
    np.testing.assert_allclose(found.information, expected, atol=1e-9)
    np.testing.assert_allclose(found.score, columns.T @ missed, atol=1e-12)


def test_columns_are_eliminated_with_their_prior() -> None:
    """As if they were noise along them; and sums of columns as the columns that they are."""
    rng = np.random.default_rng(3)
    own, shared, missed = rng.normal(size=(30, 8)), rng.normal(size=(30, 2)), rng.normal(size=30)
    prior = np.diag([1.0, 4.0])
    blocks = Evidence(own.T @ missed, own.T @ own)
    left = blocks.without(shared.T @ missed, shared.T @ own, shared.T @ shared + prior)
    whitener = np.linalg.inv(np.eye(30) + shared @ np.diag([1.0, 0.25]) @ shared.T)
    np.testing.assert_allclose(left.information, own.T @ whitener @ own)
    np.testing.assert_allclose(left.score, own.T @ whitener @ missed)
    every = np.hstack([own, shared])
    combined = np.zeros((10, 2))
    combined[[8, 9], [0, 1]] = 1.0
    freed = Evidence(every.T @ missed, every.T @ every).freed(combined, prior)
    np.testing.assert_allclose(freed.information[:8, :8], left.information, atol=1e-12)


def test_what_is_rounding_beside_another_is_taken_for_little_known() -> None:
    """Two columns that are alike but for rounding."""
    alike = np.array([[8e10, 2e10, 2e10], [2e10, 1e10, 1e10], [2e10, 1e10, 1e10 - 1e-3]])
    with pytest.raises(np.linalg.LinAlgError):
        np.linalg.cholesky(alike)
    root = root_of(alike)
    assert np.allclose(root, np.tril(root))
    assert np.all(np.diagonal(root) > 0.0)
    np.testing.assert_allclose(root @ root.T, alike, rtol=1e-8)
    sound = np.array([[2.0, 1.0], [1.0, 3.0]])
    np.testing.assert_array_equal(root_of(sound), np.linalg.cholesky(sound))
    with pytest.raises(SolverError, match="no finite number"):
        root_of(np.full((2, 2), np.inf))
