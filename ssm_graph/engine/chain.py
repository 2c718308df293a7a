"""Elimination of a chain of keyframes by QR, done again only from where something changed.

Each keyframe is eliminated in order of time, with the rows that measure it and the inertial rows to
the next one; what is left is square-root information carried to the next. Rows that have not
changed need not be eliminated again: what they carry is kept.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import numpy as np
from scipy.linalg.lapack import dgeqrf

from ssm_graph.base.errors import SolverError
from ssm_graph.base.frozen import Array
from ssm_graph.engine.error_state import STATE_DIM


@cache
def _upper(rows: int, columns: int) -> Array:
    return np.triu(np.ones((rows, columns)))


class Chain:
    """Square-root information of K keyframes, and their solution.

    Rows are whitened, ``A d = b`` with ``b`` as the last column: n + 1 columns for one keyframe of
    n states, 2 n + 1 for two successive ones.
    """

    def __init__(self, root: Array | None = None, *, dim: int = STATE_DIM) -> None:
        """Take n, and ``root`` as below, of a chain that this one has to make anew."""
        self._dim = n = dim
        self.root = np.zeros((n, n)) if root is None else root
        """(n, n) square-root information of the last keyframe, from all before it and its own"""
        self.carried: list[Array] = []
        """(n, n + 1) on each keyframe, from all before it"""
        self._tail = np.zeros((0, n))
        self._gain = np.zeros((0, n, n))
        self._own = np.zeros((0, n, n))

    def successor(self) -> Chain:
        """Return an empty chain that makes this one anew."""
        return Chain(self.root, dim=self._dim)

    def eliminate(
        self, carried: Array, rows: Sequence[Array], between: Sequence[Array], *, begin: int
    ) -> None:
        """Eliminate from keyframe ``begin`` to the last.

        Parameters
        ----------
        carried : (n, n + 1) on keyframe ``begin``, from all before it.
        rows : (m, n + 1) of each keyframe from ``begin`` on.
        between : (n, 2 n + 1) from each of these to the next, one less.

        Raises
        ------
        SolverError
            If a keyframe is not determined.
        """
        n, rhs = self._dim, 2 * self._dim
        del self.carried[begin:]
        eliminated = np.zeros((len(rows), n, 2 * n + 1))
        for i, own in enumerate(rows):
            self.carried.append(carried)
            if i == len(between):
                triangle = dgeqrf(np.concatenate([carried, own]))[0]
                eliminated[i, :, :n], eliminated[i, :, rhs] = (
                    triangle[:n, :n],
                    triangle[:n, n],
                )
                break
            # Large rows first: Householder's reflections lose the digits of small rows above them.
            stack = np.zeros((rhs + len(own), rhs + 1), order="F")
            stack[:n] = between[i]
            stack[n:rhs, :n], stack[n:rhs, rhs] = carried[:, :n], carried[:, n]
            stack[rhs:, :n], stack[rhs:, rhs] = own[:, :n], own[:, n]
            triangle = dgeqrf(stack, overwrite_a=1)[0]
            eliminated[i] = triangle[:n]
            carried = triangle[n:rhs, n:] * _upper(n, n + 1)
        self._keep(eliminated, begin)

    def _keep(self, eliminated: Array, begin: int) -> None:
        n = self._dim
        R = eliminated[:, :, :n] * _upper(n, n)
        identity = np.broadcast_to(np.eye(n), R.shape)
        try:
            # One substitution for all: the inverse times the right-hand side would lose digits.
            solved = np.linalg.solve(R, np.concatenate([eliminated[:, :, n:], identity], axis=2))
        except np.linalg.LinAlgError as error:
            raise SolverError(
                "a keyframe of the window is not determined: look for zero or infinite sigmas"
            ) from error
        R_inv = solved[:, :, n + 1 :]
        own = R_inv @ np.swapaxes(R_inv, 1, 2)
        self._gain = np.concatenate([self._gain[:begin], solved[:, :, :n]])
        self._tail = np.concatenate([self._tail[:begin], solved[:, :, n]])
        self._own = np.concatenate([self._own[:begin], own])
        self.root = R[-1]

    def solve(self) -> tuple[Array, Array]:
        """Return the solution (K, n) and the marginal covariance (K, n, n) of every keyframe.

        Backwards in time, ``d_k = R^-1 b - M d_{k+1}`` and ``P_k = R^-1 R^-T + M P_{k+1} M'``
        with ``M = R^-1 S``.
        """
        step, covariance = self._tail.copy(), self._own.copy()
        dot = np.dot
        for k in range(len(step) - 2, -1, -1):
            M = self._gain[k]
            step[k] -= dot(M, step[k + 1])
            covariance[k] += dot(dot(M, covariance[k + 1]), M.T)
        if not (np.all(np.isfinite(step)) and np.all(np.isfinite(covariance))):
            raise SolverError(
                "the window has no finite solution: check noise and time stamps of [imu] there"
            )
        return step, covariance

    def drop(self, count: int) -> None:
        """Forget the first keyframes; what they carried on to the others stays."""
        del self.carried[:count]
        self._gain, self._tail, self._own = (
            column[count:] for column in (self._gain, self._tail, self._own)
        )
