"""Elimination of a chain of keyframes by QR, done again only from where something changed.

Each keyframe is eliminated in order of time, with the rows that measure it and the inertial rows to
the next one; what is left is square-root information carried to the next. Rows that have not
changed need not be eliminated again: what they carry is kept.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.linalg.lapack import dgeqrf

from ssm_graph.data import Array
from ssm_graph.errors import SolverError
from ssm_graph.problem.error_state import STATE_DIM

_N = STATE_DIM
_RHS = 2 * _N
_TRIANGLE = np.triu(np.ones((_N, _N)))
_CARRIED = np.triu(np.ones((_N, _N + 1)))


class Chain:
    """Square-root information of K keyframes, and their solution.

    Rows are whitened, ``A d = b`` with ``b`` as the last column: 16 columns for one keyframe, 31
    for two successive ones.
    """

    def __init__(self, root: Array | None = None) -> None:
        """``root``: as below, of a chain that this one has to make anew."""
        self.root = np.zeros((_N, _N)) if root is None else root
        """(15, 15) square-root information of the last keyframe, from all before it and its own"""
        self.carried: list[Array] = []
        """(15, 16) on each keyframe, from all before it"""
        self._tail = np.zeros((0, _N))
        self._gain = np.zeros((0, _N, _N))
        self._own = np.zeros((0, _N, _N))

    def eliminate(
        self, carried: Array, rows: Sequence[Array], between: Sequence[Array], *, begin: int
    ) -> None:
        """Eliminate from keyframe ``begin`` to the last.

        Parameters
        ----------
        carried : (15, 16) on keyframe ``begin``, from all before it.
        rows : (m, 16) of each keyframe from ``begin`` on.
        between : (15, 31) from each of these to the next, one less.

        Raises
        ------
        SolverError
            If a keyframe is not determined.
        """
        del self.carried[begin:]
        eliminated = np.zeros((len(rows), _N, 2 * _N + 1))
        for i, own in enumerate(rows):
            self.carried.append(carried)
            if i == len(between):
                triangle = dgeqrf(np.concatenate([carried, own]))[0]
                eliminated[i, :, :_N], eliminated[i, :, _RHS] = (
                    triangle[:_N, :_N],
                    triangle[:_N, _N],
                )
                break
            # Large rows first: Householder's reflections lose the digits of small rows above them.
            stack = np.zeros((_RHS + len(own), _RHS + 1), order="F")
            stack[:_N] = between[i]
            stack[_N:_RHS, :_N], stack[_N:_RHS, _RHS] = carried[:, :_N], carried[:, _N]
            stack[_RHS:, :_N], stack[_RHS:, _RHS] = own[:, :_N], own[:, _N]
            triangle = dgeqrf(stack, overwrite_a=1)[0]
            eliminated[i] = triangle[:_N]
            carried = triangle[_N:_RHS, _N:] * _CARRIED
        self._keep(eliminated, begin)

    def _keep(self, eliminated: Array, begin: int) -> None:
        R = eliminated[:, :, :_N] * _TRIANGLE
        identity = np.broadcast_to(np.eye(_N), R.shape)
        try:
            # One substitution for all: the inverse times the right-hand side would lose digits.
            solved = np.linalg.solve(R, np.concatenate([eliminated[:, :, _N:], identity], axis=2))
        except np.linalg.LinAlgError as error:
            raise SolverError(
                "a keyframe of the window is not determined: look for zero or infinite sigmas"
            ) from error
        R_inv = solved[:, :, _N + 1 :]
        own = R_inv @ np.swapaxes(R_inv, 1, 2)
        self._gain = np.concatenate([self._gain[:begin], solved[:, :, :_N]])
        self._tail = np.concatenate([self._tail[:begin], solved[:, :, _N]])
        self._own = np.concatenate([self._own[:begin], own])
        self.root = R[-1]

    def solve(self) -> tuple[Array, Array]:
        """Return the solution (K, 15) and the marginal covariance (K, 15, 15) of every keyframe.

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
