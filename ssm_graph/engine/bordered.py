"""Elimination of a chain of keyframes with a border: constants that rows of any keyframe may see.

Keyframe by keyframe in time, by QR: the rows that measure a keyframe, the rows to the next one and
what is carried from before. The border's columns take part in every reflection; rows that are left
with the border alone are gathered and eliminated at the end. The cost of a keyframe does not depend
on how many there are, and the border is never squared.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dgeqrf

from ssm_graph.base.errors import SolverError
from ssm_graph.base.frozen import Array
from ssm_graph.base.stepwise import Steps, finished


class ChainRows(NamedTuple):
    """Whitened rows ``A d = b`` of K keyframes of n states with a border of C constants."""

    start: Array
    """(n, n + C + 1) on the first keyframe: what is known of it, ``b`` last"""
    between: Array
    """(K - 1, n, 2 n + C + 1) from each keyframe to the next"""
    own: Array
    """(M, n + C + 1) of one keyframe each, in their order"""
    first: NDArray[np.intp]
    """(K + 1,) where the own rows of each keyframe begin, and M"""
    border: Array
    """(m, C + 1) on the constants alone"""


class BorderedSolution(NamedTuple):
    """Solution of a bordered chain with its covariance.

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

    def covariance(self, size: int) -> Array:
        """Return the covariance (K, size, size) of the first states of every keyframe."""
        return self.covariance_of(slice(0, size))

    def covariance_of(self, states: slice) -> Array:
        """Return the covariance (K, m, m) of some states of every keyframe."""
        part = self.sensitivity[:, states]
        shared = part @ self.constants_cov @ np.swapaxes(part, 1, 2)
        return np.asarray(self.conditional[:, states, states] + shared)

    def neighbour_covariance(self, size: int) -> Array:
        """Return the covariance (K - 1, size, size) of every keyframe with the next."""
        part = self.sensitivity[:, :size]
        shared = part[:-1] @ self.constants_cov @ np.swapaxes(part[1:], 1, 2)
        return np.asarray(shared - self.gain[:-1, :size] @ self.conditional[1:, :, :size])

    def end_covariance(self, begin: int) -> Array:
        """Return that of the last keyframe's states from ``begin`` on, and of the constants."""
        part = self.sensitivity[-1, begin:]
        shared = part @ self.constants_cov
        own = self.conditional[-1, begin:, begin:] + shared @ part.T
        return np.block([[own, shared], [shared.T, self.constants_cov]])

    def variances(self) -> Array:
        """Return the variance (K, n) of every state."""
        own = np.diagonal(self.conditional, axis1=1, axis2=2)
        shared = (self.sensitivity @ self.constants_cov) * self.sensitivity
        return np.asarray(own + shared.sum(axis=2))

    def variance(self, keyframe: NDArray[np.intp], rows: Array) -> Array:
        """Return ``H P H'`` (M,) of rows (M, n + C) at their keyframes."""
        n = self.step.shape[1]
        own, border = rows[:, :n], rows[:, n:]
        through = np.einsum("mi,mij->mj", own, self.sensitivity[keyframe]) + border
        inner = np.einsum("mi,mij,mj->m", own, self.conditional[keyframe], own, optimize=True)
        return np.asarray(inner + np.einsum("mi,ij,mj->m", through, self.constants_cov, through))


def solve_bordered(rows: ChainRows) -> BorderedSolution:
    """Eliminate and solve.

    Raises
    ------
    SolverError
        If the rows do not determine everything, or the solution is not finite.
    """
    return finished(solve_bordered_steps(rows))


def solve_bordered_steps(rows: ChainRows) -> Steps[BorderedSolution]:
    """Make :func:`solve_bordered` in steps."""
    n_keyframes, n = len(rows.first) - 1, rows.start.shape[0]
    eliminated, left = yield from _eliminate_steps(rows)
    R = np.triu(eliminated[:, :, :n])
    try:
        constants_step, constants_cov = _solve_border(np.concatenate([left, rows.border]))
        # One substitution for all: the inverse times the right-hand side would lose digits.
        identity = np.broadcast_to(np.eye(n), R.shape)
        solved = np.linalg.solve(R, np.concatenate([eliminated[:, :, n:], identity], axis=2))
    except np.linalg.LinAlgError as error:
        raise SolverError(
            "elimination failed: a keyframe or a calibration is not determined, look for zero or "
            "infinite sigmas"
        ) from error
    yield 0.011 * n_keyframes
    gain, answers, R_inv = np.split(solved, [n, solved.shape[2] - n], axis=2)
    conditional = R_inv @ np.swapaxes(R_inv, 1, 2)
    # Columns of the border, and the solution without it, go back through the chain together.
    answers[:, :, :-1] *= -1.0
    dot, gain = np.dot, np.ascontiguousarray(gain)
    answers = np.ascontiguousarray(answers)
    for k in range(n_keyframes - 2, -1, -1):
        M = gain[k]
        answers[k] -= dot(M, answers[k + 1])
        conditional[k] += dot(dot(M, conditional[k + 1]), M.T)
        yield 0.008
    sensitivity = answers[:, :, :-1]
    step = answers[:, :, -1] + sensitivity @ constants_step
    if not (np.all(np.isfinite(step)) and np.all(np.isfinite(constants_cov))):
        raise SolverError(
            "the linear solution is not finite: look for time stamps far apart, or sigmas that "
            "differ by more than 12 orders of magnitude"
        )
    return BorderedSolution(step, constants_step, conditional, sensitivity, constants_cov, gain, R)


def _eliminate_steps(rows: ChainRows) -> Steps[tuple[Array, Array]]:
    """Return the rows of every keyframe after elimination, and what is left for the border.

    The former are (K, n, 2 n + C + 1), upper triangular but for what LAPACK keeps below.
    """
    n, width = rows.start.shape
    n_keyframes = len(rows.first) - 1
    eliminated = np.zeros((n_keyframes, n, n + width))
    triangle = np.triu(np.ones((n, width)))
    first, between, own = rows.first.tolist(), rows.between, rows.own
    most = max(int(np.diff(rows.first).max(initial=0)), 0)
    left = np.zeros((n_keyframes, min(most, width - n), width - n))
    carried = rows.start
    for k in range(n_keyframes - 1):
        begin, end = first[k], first[k + 1]
        # Large rows first: Householder's reflections lose the digits of small rows above them.
        stack = np.zeros((2 * n + end - begin, n + width), order="F")
        stack[:n] = between[k]
        stack[n : 2 * n, :n], stack[n : 2 * n, 2 * n :] = carried[:, :n], carried[:, n:]
        stack[2 * n :, :n], stack[2 * n :, 2 * n :] = own[begin:end, :n], own[begin:end, n:]
        reduced = dgeqrf(stack, overwrite_a=1)[0]
        eliminated[k] = reduced[:n]
        carried = reduced[n : 2 * n, n:] * triangle
        remains = min(end - begin, width - n)
        left[k, :remains] = reduced[2 * n : 2 * n + remains, 2 * n :]
        yield 0.025
    last = np.concatenate([carried, own[first[-2] :]])
    reduced = dgeqrf(last)[0]
    eliminated[-1, :, :n], eliminated[-1, :, 2 * n :] = reduced[:n, :n], reduced[:n, n:]
    remains = min(len(last) - n, width - n)
    left[-1, :remains] = reduced[n : n + remains, n:]
    return eliminated, np.triu(left).reshape(-1, width - n)


def _solve_border(rows: Array) -> tuple[Array, Array]:
    """Return solution (C,) and covariance (C, C) of the constants from all rows on them."""
    size = rows.shape[1] - 1
    triangle = np.asarray(np.linalg.qr(rows, mode="r"))
    right = np.column_stack([triangle[:size, size], np.eye(size)])
    solved: Array = np.linalg.solve(triangle[:size, :size], right)
    return solved[:, 0], solved[:, 1:] @ solved[:, 1:].T
