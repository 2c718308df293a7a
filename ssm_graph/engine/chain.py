"""Elimination of a chain of keyframes with a border: constants that rows of any keyframe may see.

Keyframe by keyframe in time, by QR: the rows that measure a keyframe, the rows to the next one and
what is carried from before. The border's columns take part in every reflection; rows that are left
with the border alone are gathered and eliminated at the end. The cost of a keyframe does not depend
on how many there are, and the border is never squared. Keyframes whose rows have not changed, nor
any before them, need not be eliminated again: what they carry is kept.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dgeqrf

from ssm_graph.base.errors import SolverError
from ssm_graph.base.frozen import Array
from ssm_graph.base.stepwise import Steps, finished


class ChainSolution(NamedTuple):
    """Solution of a chain with its covariance.

    That of keyframe ``k`` is ``conditional[k] + sensitivity[k] constants_cov sensitivity[k]'``, and
    with the constants ``sensitivity[k] constants_cov``.
    """

    step: Array
    """(K, n)"""
    constants_step: Array
    """(C,)"""
    conditional: Array
    """(K, n, n) covariance of each keyframe if the constants were known"""
    sensitivity: Array
    """(K, n, C) how each keyframe follows the constants"""
    constants_cov: Array
    """(C, C)"""
    gain: Array
    """(K, n, n) how each keyframe follows the next, negative"""
    R: Array
    """(K, n, n) upper triangular; without the border ``R_k (d_k + gain_k d_{k+1}) = rhs_k``"""

    @property
    def sigma(self) -> Array:
        """Standard deviations (K n + C,) of all components, keyframe by keyframe."""
        own = np.diagonal(self.conditional, axis1=1, axis2=2)
        shared = (self.sensitivity @ self.constants_cov) * self.sensitivity
        variances = [(own + shared.sum(axis=2)).ravel(), np.diagonal(self.constants_cov)]
        return np.asarray(np.sqrt(np.concatenate(variances)))

    def covariance(self, size: int) -> Array:
        """Return the covariance (K, size, size) of the first states of every keyframe."""
        return self.covariance_of(slice(0, size))

    def covariance_of(self, states: slice) -> Array:
        """Return the covariance (K, m, m) of some states of every keyframe."""
        part = self.sensitivity[:, states]
        shared = part @ self.constants_cov @ part.mT
        return np.asarray(self.conditional[:, states, states] + shared)

    def neighbour_covariance(self, size: int) -> Array:
        """Return the covariance (K - 1, size, size) of every keyframe with the next."""
        part = self.sensitivity[:, :size]
        shared = part[:-1] @ self.constants_cov @ part[1:].mT
        return np.asarray(shared - self.gain[:-1, :size] @ self.conditional[1:, :, :size])

    def end_covariance(self, begin: int) -> Array:
        """Return that of the last keyframe's states from ``begin`` on, and of the constants."""
        part = self.sensitivity[-1, begin:]
        shared = part @ self.constants_cov
        own = self.conditional[-1, begin:, begin:] + shared @ part.T
        return np.block([[own, shared], [shared.T, self.constants_cov]])

    def variance(self, keyframe: NDArray[np.intp], rows: Array) -> Array:
        """Return ``H P H'`` (M,) of rows (M, n + C) at their keyframes."""
        n = self.step.shape[1]
        own, border = rows[:, :n], rows[:, n:]
        through = np.einsum("mi,mij->mj", own, self.sensitivity[keyframe]) + border
        inner = np.einsum("mi,mij,mj->m", own, self.conditional[keyframe], own, optimize=True)
        return np.asarray(inner + ((through @ self.constants_cov) * through).sum(axis=1))


@cache
def _upper(rows: int, columns: int) -> Array:
    return np.triu(np.ones((rows, columns)))


class Chain:
    """Square-root information of K keyframes of n states and C constants, and their solution.

    Rows are whitened, ``A d = b`` with ``b`` as the last column: n + C + 1 columns for one
    keyframe, 2 n + C + 1 for two successive ones.
    """

    def __init__(self, dim: int, n_constants: int = 0, *, root: Array | None = None) -> None:
        """Take n and C, and ``root`` as below, of a chain that this one has to make anew."""
        n, width = dim, n_constants
        self._n, self._n_constants = n, width
        self.root = np.zeros((n, n)) if root is None else root
        """(n, n) square-root information of the last keyframe, from all before it and its own"""
        self.carried: list[Array] = []
        """(n, n + C + 1) on each keyframe, from all before it"""
        self._left: list[Array] = []
        self._R = np.zeros((0, n, n))
        self._gain, self._own = self._R, self._R
        self._answers = np.zeros((0, n, width + 1))

    def successor(self) -> Chain:
        """Return an empty chain that makes this one anew."""
        return Chain(self._n, self._n_constants, root=self.root)

    def eliminate(
        self, carried: Array, own: Sequence[Array], between: Sequence[Array] | Array, *, begin: int
    ) -> None:
        """Eliminate from keyframe ``begin`` to the last.

        Parameters
        ----------
        carried : (n, n + C + 1) on keyframe ``begin``, from all before it.
        own : (m, n + C + 1) of each keyframe from ``begin`` on.
        between : (n, 2 n + C + 1) from each of these to the next, one less.

        Raises
        ------
        SolverError
            If a keyframe is not determined.
        """
        finished(self.eliminate_steps(carried, own, between, begin=begin))

    def eliminate_steps(
        self, carried: Array, own: Sequence[Array], between: Sequence[Array] | Array, *, begin: int
    ) -> Steps[None]:
        """Make :meth:`eliminate` in steps."""
        n, border = self._n, self._n_constants + 1
        del self.carried[begin:], self._left[begin:]
        triangle = _upper(n, n + border)
        eliminated = np.zeros((len(own), n, 2 * n + border))
        for i, rows in enumerate(own):
            self.carried.append(carried)
            if i == len(between):
                reduced = dgeqrf(np.concatenate([carried, rows]))[0]
                eliminated[i, :, :n], eliminated[i, :, 2 * n :] = reduced[:n, :n], reduced[:n, n:]
                if border > 1:
                    self._left.append(reduced[n : n + min(len(rows), border), n:])
                break
            # Large rows first: Householder's reflections lose the digits of small rows above them.
            stack = np.zeros((2 * n + len(rows), 2 * n + border), order="F")
            stack[:n] = between[i]
            stack[n : 2 * n, :n], stack[n : 2 * n, 2 * n :] = carried[:, :n], carried[:, n:]
            stack[2 * n :, :n], stack[2 * n :, 2 * n :] = rows[:, :n], rows[:, n:]
            reduced = dgeqrf(stack, overwrite_a=1)[0]
            eliminated[i] = reduced[:n]
            carried = reduced[n : 2 * n, n:] * triangle
            if border > 1:
                self._left.append(reduced[2 * n : 2 * n + min(len(rows), border), 2 * n :])
            yield 0.025
        yield 0.011 * len(own)
        self._keep(eliminated, begin)

    def _keep(self, eliminated: Array, begin: int) -> None:
        n = self._n
        R = eliminated[:, :, :n] * _upper(n, n)
        identity = np.broadcast_to(np.eye(n), R.shape)
        try:
            # One substitution for all: the inverse times the right-hand side would lose digits.
            solved = np.linalg.solve(R, np.concatenate([eliminated[:, :, n:], identity], axis=2))
        except np.linalg.LinAlgError as error:
            raise SolverError(_UNDETERMINED) from error
        gain, answers, R_inv = np.split(solved, [n, solved.shape[2] - n], axis=2)
        # Columns of the border, and the solution without it, go back through the chain together.
        answers[:, :, :-1] *= -1.0
        self._R = np.concatenate([self._R[:begin], R])
        self._gain = np.concatenate([self._gain[:begin], gain])
        self._answers = np.concatenate([self._answers[:begin], answers])
        self._own = np.concatenate([self._own[:begin], R_inv @ R_inv.mT])
        self.root = R[-1]

    def solve(self, border: Array | None = None) -> ChainSolution:
        """Return the solution; ``border`` (m, C + 1) are rows on the constants alone.

        Backwards in time, ``d_k = R^-1 b - M d_{k+1}`` and ``P_k = R^-1 R^-T + M P_{k+1} M'``
        with ``M = R^-1 S``.

        Raises
        ------
        SolverError
            If the rows do not determine everything, or the solution is not finite.
        """
        return finished(self.solve_steps(border))

    def solve_steps(self, border: Array | None = None) -> Steps[ChainSolution]:
        """Make :meth:`solve` in steps."""
        answers, conditional = self._answers.copy(), self._own.copy()
        dot, add, subtract = np.dot, np.add, np.subtract
        led, half, whole = np.empty(answers.shape[1:]), *np.empty((2, self._n, self._n))
        answer, covariance = answers[-1], conditional[-1]
        before = (column[-2::-1] for column in (self._gain, self._gain.mT, answers, conditional))
        # Into arrays that are there already: most of the time is that of small arrays made.
        for M, M_T, own_answer, own_covariance in zip(*before, strict=True):
            subtract(own_answer, dot(M, answer, led), own_answer)
            add(own_covariance, dot(dot(M, covariance, half), M_T, whole), own_covariance)
            answer, covariance = own_answer, own_covariance
            yield 0.007
        constants_step, constants_cov = self._solve_border(border)
        sensitivity = answers[:, :, :-1]
        step = answers[:, :, -1] + sensitivity @ constants_step
        if not all(np.all(np.isfinite(x)) for x in (step, conditional, constants_cov)):
            raise SolverError(
                "the linear solution is not finite: look for time stamps far apart, or sigmas that "
                "differ by more than 12 orders of magnitude"
            )
        return ChainSolution(
            step, constants_step, conditional, sensitivity, constants_cov, self._gain, self._R
        )

    def _solve_border(self, border: Array | None) -> tuple[Array, Array]:
        """Return solution (C,) and covariance (C, C) of the constants from all rows on them."""
        size = self._n_constants
        if size == 0:
            return np.zeros(0), np.zeros((0, 0))
        left = [np.triu(rows) for rows in self._left]
        rows = np.concatenate([*left, np.zeros((0, size + 1)) if border is None else border])
        triangle = np.asarray(np.linalg.qr(rows, mode="r"))
        right = np.column_stack([triangle[:size, size], np.eye(size)])
        try:
            solved: Array = np.linalg.solve(triangle[:size, :size], right)
        except np.linalg.LinAlgError as error:
            raise SolverError(_UNDETERMINED) from error
        return solved[:, 0], solved[:, 1:] @ solved[:, 1:].T

    def move(self, jacobian: Array) -> None:
        """Let ``root`` be of a last keyframe whose errors are ``jacobian`` (n, n) times these."""
        self.root = self.root @ np.linalg.inv(jacobian)

    def drop(self, count: int) -> None:
        """Forget the first keyframes; what they carried on to the others stays.

        A chain with constants cannot: they would forget what those keyframes said of them.
        """
        del self.carried[:count], self._left[:count]
        self._R, self._gain, self._answers, self._own = (
            column[count:] for column in (self._R, self._gain, self._answers, self._own)
        )


_UNDETERMINED = (
    "elimination failed: a keyframe or a calibration is not determined, look for zero or infinite "
    "sigmas"
)
