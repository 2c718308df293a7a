"""What the data say of an error that some beam speeds have in common, whatever the trajectory.

A column ``c`` of errors of the whitened beam rows, ``A d + c s = b + noise``, is judged with the
trajectory ``d`` eliminated: with ``M = I - A (A'A)^-1 A'`` its size ``s`` has information ``c'M c``
and score ``c'M b``. Residuals alone would not do: the trajectory takes over most of what a beam is
off by for long, and the beams that are right get the rest.

One elimination of the chain serves any number of columns. With its conditionals ``R_k d_k + S_k
d_{k+1} = rhs_k`` what the trajectory explains is ``sum y_k'y_k``, ``y_k = R_k^-T (A_k'c_k -
S_{k-1}' y_{k-1})``. Of a column that has ended n numbers go on, and all that they will explain to
the end of the mission is one quadratic form, known from a pass backwards.
"""

from __future__ import annotations

import itertools
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ssm_graph.base.frozen import Array
from ssm_graph.engine.chain import ChainSolution


class Evidence(NamedTuple):
    """What the data say of the sizes of columns, the trajectory eliminated."""

    score: Array
    """(C,)"""
    information: Array
    """(C, C)"""


class WhitenedBeams(NamedTuple):
    """Beam rows in the order of their keyframes, divided by their sigmas as weighted."""

    keyframe: NDArray[np.intp]
    """(M,)"""
    jacobian: Array
    """(M, n)"""
    missed: Array
    """(M,) measured minus predicted, at the solution"""


class _Carried(NamedTuple):
    """How the columns that act in one block go through its keyframes."""

    transition: Array
    """(n, n) what is left at its end of what columns before it had left"""
    explained: Array
    """(B + C, n + B + C) by its keyframes: against what was left before, and among themselves"""
    left: Array
    """(n, B + C) at its end"""


class ChainEvidence:
    """One solution of the chain, ready for columns anywhere along it."""

    def __init__(self, solution: ChainSolution, beams: WhitenedBeams) -> None:
        self._beams, self._n = beams, solution.R.shape[1]
        self._first_row = np.searchsorted(beams.keyframe, np.arange(len(solution.R) + 1)).tolist()
        R_invT = np.swapaxes(np.linalg.inv(solution.R), 1, 2)
        self._load = np.einsum("mij,mj->mi", R_invT[beams.keyframe], beams.jacobian, optimize=True)
        self._step = np.zeros_like(solution.R)
        S = solution.R[:-1] @ solution.gain[:-1]
        self._step[1:] = -R_invT[1:] @ np.swapaxes(S, 1, 2)
        self._ahead = np.zeros_like(solution.R)
        identity = np.eye(self._n)
        for k in range(len(solution.R) - 2, -1, -1):
            step = self._step[k + 1]
            self._ahead[k] = step.T @ (identity + self._ahead[k + 1]) @ step

    def of(self, blocks: list[int], own: Array, shared: Array) -> Evidence:
        """Return the evidence of N blocks of B columns each, and of C columns in all the blocks.

        Parameters
        ----------
        blocks : N + 1 keyframes; block ``i`` is from the i-th to before the next.
        own : (M, B) what a unit of each column of its block does to a whitened row.
        shared : (M, C) the same of the shared columns.
        """
        n_own, n_blocks = own.shape[1], len(blocks) - 1
        n = n_blocks * n_own
        common = np.arange(n, n + shared.shape[1])
        score, information = np.zeros(n + len(common)), np.zeros((n + len(common),) * 2)
        dense = np.hstack([own, shared])
        left, left_shared = np.zeros((self._n, n)), np.zeros((self._n, len(common)))
        for i, (begin, end) in enumerate(itertools.pairwise(blocks)):
            now = np.arange(i * n_own, (i + 1) * n_own)
            active, before = np.concatenate([now, common]), slice(0, i * n_own)
            rows = slice(self._first_row[begin], self._first_row[end])
            score[active] += dense[rows].T @ self._beams.missed[rows]
            carried = self._carry(begin, end, dense, left_shared)
            among = dense[rows].T @ dense[rows] - carried.explained[:, self._n :]
            information[np.ix_(active, active)] += among
            crossed = carried.explained[:, : self._n] @ left[:, before]
            information[active, before] -= crossed
            left[:, before] = carried.transition @ left[:, before]
            left[:, now], left_shared = np.split(carried.left, [n_own], axis=1)
            until_now = slice(0, (i + 1) * n_own)
            information[now, until_now] -= (
                left[:, now].T @ self._ahead[end - 1] @ left[:, until_now]
            )
        all_left = np.hstack([left, left_shared])
        information[common] -= left_shared.T @ self._ahead[blocks[-1] - 1] @ all_left
        lower = np.tril(information)
        return Evidence(score, lower + np.tril(information, -1).T)

    def _carry(self, begin: int, end: int, dense: Array, left_shared: Array) -> _Carried:
        """Take the columns (M, B + C) of a block through its keyframes."""
        width, n = dense.shape[1], self._n
        at = np.zeros((n, n + width))
        at[:, :n] = np.eye(n)
        at[:, n + width - left_shared.shape[1] :] = left_shared
        history = np.empty((end - begin, *at.shape))
        for k in range(begin, end):
            at = self._step[k] @ at
            rows = slice(self._first_row[k], self._first_row[k + 1])
            at[:, n:] += self._load[rows].T @ dense[rows]
            history[k - begin] = at
        flat = history.reshape(-1, n + width)
        explained = flat[:, n:].T @ flat
        return _Carried(at[:, :n], explained, at[:, n:])
