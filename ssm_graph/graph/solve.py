"""Elimination by QR and marginal covariances by the square-root recursion.

Cholesky loses navigation-grade chains, and so do marginals from an information matrix; both stay
with the square roots here.
"""

from __future__ import annotations

from typing import NamedTuple

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, V, X

from ssm_graph.data import Array
from ssm_graph.errors import SolverError
from ssm_graph.problem.error_state import STATE_DIM

# Separators come in key order (b, v, x); the error state is (x, v, b).
_SEPARATOR_ORDER = np.r_[9:15, 6:9, 0:6]


class LinearSolution(NamedTuple):
    """Solution of one linear graph."""

    delta: gtsam.VectorValues
    R: Array
    """(K, 15, 15) upper triangular; ``R_k d_k + S_k d_{k+1} = rhs_k``."""
    S: Array
    """(K, 15, 15) coupling to the next keyframe; zero for the last."""

    def last_step(self) -> Array:
        """Return the step (15,) of the last keyframe."""
        k = len(self.R) - 1
        return np.concatenate([self.delta.at(symbol(k)) for symbol in (X, V, B)])


def solve_linear(
    linear: gtsam.GaussianFactorGraph, ordering: gtsam.Ordering, *, n_keyframes: int
) -> LinearSolution:
    """Eliminate by QR and solve.

    Raises
    ------
    SolverError
        If the graph does not determine all states, or the solution is not finite.
    """
    try:
        tree = linear.eliminateMultifrontal(ordering, gtsam.EliminateQR)
        delta = tree.optimize()
    except RuntimeError as error:
        raise SolverError(
            f"elimination failed: {str(error).strip().splitlines()[0]}; a keyframe is not "
            "determined, look for zero or infinite sigmas"
        ) from error
    if not np.all(np.isfinite(delta.vector())):
        raise SolverError(
            "the linear solution is not finite: look for time stamps far apart, or sigmas that "
            "differ by more than 12 orders of magnitude"
        )
    cliques = gtsam.GaussianFactorGraph()
    cliques.push_back(tree)
    R = np.zeros((n_keyframes, STATE_DIM, STATE_DIM))
    S = np.zeros_like(R)
    # The root holds the last two keyframes; then one clique a keyframe, backwards in time.
    root = _conditional(cliques, 0).R()
    R[-1] = root[-STATE_DIM:, -STATE_DIM:]
    if n_keyframes == 1:
        return LinearSolution(delta, R, S)
    R[-2] = root[:STATE_DIM, :STATE_DIM]
    S[-2] = root[:STATE_DIM, STATE_DIM:]
    separated = np.empty((n_keyframes - 2, STATE_DIM, STATE_DIM))
    for k in range(n_keyframes - 2):
        clique = _conditional(cliques, n_keyframes - 2 - k)
        R[k] = clique.R()
        separated[k] = clique.S()
    S[: n_keyframes - 2, :, _SEPARATOR_ORDER] = separated
    return LinearSolution(delta, R, S)


def _conditional(cliques: gtsam.GaussianFactorGraph, i: int) -> gtsam.GaussianConditional:
    clique = cliques.at(i)
    assert isinstance(clique, gtsam.GaussianConditional)
    return clique


def marginal_covariances(solution: LinearSolution) -> Array:
    """Return the marginal covariance (K, 15, 15) of every keyframe.

    Backwards in time, ``P_k = R^-1 R^-T + M P_{k+1} M'`` with ``M = R^-1 S``.
    """
    R_inv = np.linalg.inv(solution.R)
    covariance: Array = np.asarray(R_inv @ np.swapaxes(R_inv, 1, 2), dtype=np.float64)
    M = R_inv @ solution.S
    M_T = np.ascontiguousarray(np.swapaxes(M, 1, 2))
    for k in range(len(covariance) - 2, -1, -1):
        covariance[k] += M[k] @ covariance[k + 1] @ M_T[k]
    return covariance
