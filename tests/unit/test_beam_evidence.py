"""Evidence of columns along the chain against the same in one dense matrix."""

from __future__ import annotations

import numpy as np
import pytest

from ssm_graph.base.frozen import Array
from ssm_graph.engine.beam_evidence import ChainEvidence, WhitenedBeams
from ssm_graph.engine.chain import ChainSolution

K, N, M = 30, 15, 90


def chain(rng: np.random.Generator) -> ChainSolution:
    """Return conditionals of a chain that forgets."""
    R = np.triu(rng.normal(size=(K, N, N))) + 3.0 * np.eye(N)
    S = 0.2 * rng.normal(size=(K, N, N))
    S[-1] = 0.0
    none = np.zeros(0)
    return ChainSolution(none, none, none, none, none, np.asarray(np.linalg.solve(R, S)), R)


def dense_information(solution: ChainSolution, beams: WhitenedBeams, columns: Array) -> Array:
    """Return ``c' (I - A (A'A)^-1 A') c`` by one triangular matrix of the whole chain."""
    root = np.zeros((K * N, K * N))
    A = np.zeros((M, K * N))
    for k in range(K):
        root[k * N : (k + 1) * N, k * N : (k + 1) * N] = solution.R[k]
        if k + 1 < K:
            root[k * N : (k + 1) * N, (k + 1) * N : (k + 2) * N] = solution.R[k] @ solution.gain[k]
    for row, k in enumerate(beams.keyframe):
        A[row, k * N : (k + 1) * N] = beams.jacobian[row]
    y = np.linalg.solve(root.T, A.T @ columns)
    return np.asarray(columns.T @ columns - y.T @ y)


@pytest.mark.parametrize("blocks", [[0, K], [0, 8, 9, 21, K], [3, 10, 10, 14, 25]], ids=str)
def test_evidence_is_that_of_the_dense_matrix(blocks: list[int]) -> None:
    """Blocks of any length, one without keyframes too, in a piece or in the whole of the chain."""
    rng = np.random.default_rng(4)
    solution = chain(rng)
    keyframe = np.sort(rng.integers(0, K, M))
    beams = WhitenedBeams(keyframe, 0.02 * rng.normal(size=(M, N)), rng.normal(size=M))
    own, shared = rng.normal(size=(M, 2)), rng.normal(size=(M, 3))
    n_blocks = len(blocks) - 1
    columns = np.zeros((M, 2 * n_blocks + 3))
    for i in range(n_blocks):
        inside = (blocks[i] <= keyframe) & (keyframe < blocks[i + 1])
        columns[inside, 2 * i : 2 * i + 2] = own[inside]
        columns[inside, 2 * n_blocks :] = shared[inside]
    found = ChainEvidence(solution, beams).of(blocks, own, shared)
    expected = dense_information(solution, beams, columns)
    np.testing.assert_allclose(found.information, expected, atol=1e-9)
    np.testing.assert_allclose(found.score, columns.T @ beams.missed, atol=1e-12)
