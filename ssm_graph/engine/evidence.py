"""What the data say of errors that rows have in common, whatever the trajectory.

A column ``c`` of errors of the whitened rows, ``A d + c s = b + noise``, is judged with the
trajectory ``d`` eliminated: with ``M = I - A (A'A)^-1 A'`` its size ``s`` has information ``c'M c``
and score ``c'M b``. Residuals alone would not do: the trajectory takes over most of what a sensor
is off by for long, and the sensors that are right get the rest.

One elimination of the chain serves any number of columns, on rows of one keyframe or on those from
one to the next. With its conditionals ``R_k d_k + S_k d_{k+1} = rhs_k`` what the trajectory
explains is ``sum y_k'y_k``, ``y_k = R_k^-T (A_k'c - S_{k-1}' y_{k-1})``. Of a column that has ended
n numbers go on, and all that they will explain to the end of the mission is one quadratic form,
known from a pass backwards.
"""

from __future__ import annotations

import itertools
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular
from scipy.linalg.blas import dsyrk

from ssm_graph.base.errors import SolverError
from ssm_graph.base.frozen import Array
from ssm_graph.engine.chain import ChainSolution

ROUNDING = 1e-10
"""Share of the largest eigenvalue below which one is rounding: sums of some 1e5 rows, twice."""
TILE = 256
"""Rows and columns that are mirrored at a time."""


class Evidence(NamedTuple):
    """What the data say of the sizes of columns, the trajectory eliminated."""

    score: Array
    """(C,)"""
    information: Array
    """(C, C)"""

    def without(self, score: Array, crossed: Array, inner: Array) -> Evidence:
        """Return the same with m further columns eliminated.

        Parameters
        ----------
        score : (m,) of these.
        crossed : (m, C) their information with the columns here.
        inner : (m, m) that among themselves, with that of their prior.
        """
        root = root_of(inner)
        right = np.column_stack([crossed, score])
        half = solve_triangular(root, right, lower=True, check_finite=False, overwrite_b=True)
        # BLAS counts by columns: the transpose, which is the same, needs no turning round.
        explained = dsyrk(-1.0, half[:, :-1], beta=1.0, c=self.information.T, trans=1, lower=1)
        _mirror_lower(explained)
        return Evidence(self.score - half[:, :-1].T @ half[:, -1], explained.T)

    def freed(self, combined: Array, prior: Array) -> Evidence:
        """Return the same once ``combined`` (C, m), sums of columns, may be of any size."""
        used, columns = _used(combined)
        crossed = columns.T @ self.information[used]
        return self.without(
            columns.T @ self.score[used], crossed, crossed[:, used] @ columns + prior
        )

    def sizes(self, combined: Array, prior: Array) -> Array:
        """Return how large (m,) ``combined`` (C, m), sums of columns, are."""
        used, columns = _used(combined)
        inner = columns.T @ self.information[np.ix_(used, used)] @ columns + prior
        return np.asarray(np.linalg.solve(inner, columns.T @ self.score[used]))


class OwnRows(NamedTuple):
    """Whitened rows of one keyframe each, in the order of these."""

    keyframe: NDArray[np.intp]
    """(R,)"""
    jacobian: Array
    """(R, n)"""
    missed: Array
    """(R,) measured minus predicted, at the solution"""


class BetweenRows(NamedTuple):
    """Whitened rows from each keyframe to the next."""

    jacobian: Array
    """(K - 1, m, 2 n) by the keyframe before and the one after"""
    missed: Array
    """(K - 1, m)"""


class Columns(NamedTuple):
    """What a unit of each of C columns does to whitened rows."""

    own: Array
    """(R, C)"""
    between: Array
    """(K - 1, m, C)"""


class ChainEvidence:
    """One solution of the chain, ready for columns anywhere along it."""

    def __init__(self, solution: ChainSolution, own: OwnRows, between: BetweenRows) -> None:
        self._own, self._between = own, between
        self._n_keyframes, self._n = solution.R.shape[:2]
        self._first_row = np.searchsorted(own.keyframe, np.arange(self._n_keyframes + 1))
        self._R_invT = np.swapaxes(np.linalg.inv(solution.R), 1, 2)
        self._step = np.zeros_like(solution.R)
        S = solution.R[:-1] @ solution.gain[:-1]
        self._step[1:] = -self._R_invT[1:] @ np.swapaxes(S, 1, 2)
        # All that what comes to a keyframe explains there and later.
        self._ahead = np.empty((self._n_keyframes + 1, self._n, self._n))
        self._ahead[-1] = 0.0
        identity = np.eye(self._n)
        self._ahead[-2] = identity
        for k in range(self._n_keyframes - 2, -1, -1):
            step = self._step[k + 1]
            self._ahead[k] = identity + step.T @ self._ahead[k + 1] @ step

    def of(self, blocks: NDArray[np.intp], own: Columns, shared: Columns) -> Evidence:
        """Return the evidence of N blocks of B columns each, and of C columns in all the blocks.

        Rows between two keyframes belong to the block of the first of them.

        Parameters
        ----------
        blocks : (N + 1) growing keyframes; block ``i`` is from the i-th to before the next.
        own : B columns that each block has for itself.
        shared : C columns.
        """
        width, n_blocks, n = own.own.shape[1], len(blocks) - 1, self._n
        own, shared = self._along(blocks, own), self._along(blocks, shared)
        both = Columns(
            np.hstack([own.own, shared.own]),
            np.concatenate([own.between, shared.between], axis=2),
        )
        history, outgoing = self._histories(blocks, both, width)
        total = n_blocks * width
        common = np.arange(total, total + shared.own.shape[1])
        size = total + len(common)
        score, information = np.zeros(size), np.zeros((size, size))
        incoming = np.zeros((n, size))
        for i, (begin, end) in enumerate(itertools.pairwise(blocks.tolist())):
            now = np.arange(i * width, (i + 1) * width)
            active, before = np.concatenate([now, common]), slice(0, i * width)
            dense, missed = self._inside(blocks[0], begin, end, both)
            score[active] += dense.T @ missed
            flat = history[i]
            flat[:, n + width :] += flat[:, :n] @ incoming[:, common]
            explained = flat[:, n:].T @ flat
            information[np.ix_(active, active)] += dense.T @ dense - explained[:, n:]
            information[active, before] -= explained[:, :n] @ incoming[:, before]
            onward = outgoing[i]
            incoming[:, common] = onward[:, n + width :] + onward[:, :n] @ incoming[:, common]
            incoming[:, before] = onward[:, :n] @ incoming[:, before]
            incoming[:, now] = onward[:, n : n + width]
            until_now = slice(0, (i + 1) * width)
            ahead = self._ahead[end]
            information[now, until_now] -= incoming[:, now].T @ ahead @ incoming[:, until_now]
        information[common] -= incoming[:, common].T @ self._ahead[blocks[-1]] @ incoming
        # Of two blocks, what the later one knows of the earlier one stands below the diagonal.
        _mirror_lower(information)
        return Evidence(score, information)

    def each(self, blocks: NDArray[np.intp], own: Columns) -> tuple[Array, Array]:
        """Return score (N, B) and information (N, B, B) of the columns of each block alone.

        Parameters as of :meth:`of`.
        """
        n, width, own = self._n, own.own.shape[1], self._along(blocks, own)
        history, outgoing = self._histories(blocks, own, width)
        score, information = np.zeros((len(history), width)), np.zeros((len(history), width, width))
        for i, (begin, end) in enumerate(itertools.pairwise(blocks.tolist())):
            dense, missed = self._inside(blocks[0], begin, end, own)
            y, onward = history[i][:, n:], outgoing[i][:, n:]
            score[i] = dense.T @ missed
            information[i] = dense.T @ dense - y.T @ y - onward.T @ self._ahead[end] @ onward
        return score, information

    def _along(self, blocks: NDArray[np.intp], columns: Columns) -> Columns:
        """Return columns on the rows of these blocks alone."""
        begin, end = blocks[[0, -1]]
        rows = slice(self._first_row[begin], self._first_row[end])
        return Columns(columns.own[rows], columns.between[begin:end])

    def _inside(self, first: int, begin: int, end: int, columns: Columns) -> tuple[Array, Array]:
        """Return columns and errors of all rows of a block; those of columns are from first on."""
        rows = slice(self._first_row[begin], self._first_row[end])
        skipped = self._first_row[first]
        between = columns.between[begin - first : end - first]
        own = columns.own[rows.start - skipped : rows.stop - skipped]
        dense = np.concatenate([own, between.reshape(-1, between.shape[2])])
        missed = [self._own.missed[rows], self._between.missed[begin:end].ravel()]
        return dense, np.concatenate(missed)

    def _loads(self, blocks: NDArray[np.intp], columns: Columns) -> tuple[Array, Array]:
        """Return ``R^-T A'c`` (K, n, C) of own rows and those to the next, and of those before.

        K are the keyframes of the blocks, and the first one after them if there is one.
        """
        n, width = self._n, columns.own.shape[1]
        begin, end = blocks[[0, -1]].tolist()
        rows = slice(self._first_row[begin], self._first_row[end])
        keyframe = self._own.keyframe[rows]
        slot = np.arange(rows.start, rows.stop) - self._first_row[keyframe]
        count = np.diff(self._first_row[begin : end + 1])
        n_keyframes = min(end + 1, self._n_keyframes) - begin
        jacobian = np.zeros((n_keyframes, int(count.max(initial=0)), n))
        dense = np.zeros((*jacobian.shape[:2], width))
        jacobian[keyframe - begin, slot] = self._own.jacobian[rows]
        dense[keyframe - begin, slot] = columns.own
        load = jacobian.mT @ dense
        through = self._between.jacobian[begin:end].mT @ columns.between
        load[:-1] += through[:, :n]
        before = np.zeros_like(load)
        before[1:] = through[:, n:]
        R_invT = self._R_invT[begin : end + 1]
        return R_invT @ load, R_invT @ before

    def _histories(
        self, blocks: NDArray[np.intp], columns: Columns, width: int
    ) -> tuple[list[Array], list[Array]]:
        """Take the columns of every block through its keyframes, all blocks side by side.

        Returns of each block ``y`` at its keyframes (k n, n + B + C), and what comes to the first
        keyframe after it (n, n + B + C): of what came to the block, of its own columns, and of the
        shared ones as if they began with it.
        """
        n, size = self._n, self._n + columns.own.shape[1]
        load, before = self._loads(blocks, columns)
        steps = self._step[blocks[0] : blocks[-1] + 1]
        blocks = blocks - blocks[0]
        length = np.diff(blocks)
        order = np.argsort(-length, kind="stable")
        longest = int(length.max(initial=0))
        history = np.zeros((len(length), longest, n, size))
        at = np.zeros((len(length), n, size))
        at[:, :, :n] = np.eye(n)
        begin = blocks[:-1][order]
        # Shared columns also act on the rows that lead from the block before.
        at[order > 0, :, n + width :] = before[begin[order > 0]][:, :, width:]
        for t in range(longest):
            going = int(np.sum(length > t))
            k = begin[:going] + t
            if t:
                at[:going] = steps[k] @ at[:going]
                at[:going, :, n:] += before[k]
            at[:going, :, n:] += load[k]
            history[:going, t] = at[:going]
        end = blocks[1:][order]
        is_inside = end < len(steps)
        k = np.where(is_inside, end, 0)
        onward = steps[k] @ at
        onward[:, :, n : n + width] += before[k][:, :, :width]
        is_last = order == len(order) - 1
        onward[is_last, :, n + width :] += before[k[is_last]][:, :, width:]
        onward[~is_inside] = 0.0
        place = np.argsort(order)
        flat = [history[place[i], : length[i]].reshape(-1, size) for i in range(len(length))]
        return flat, [onward[place[i]] for i in range(len(length))]


def root_of(information: Array) -> Array:
    """Return the lower root of an information with that of a prior.

    A wrong unit makes columns of 1e12 times their priors that are alike: what is left of one beside
    another is rounding then, of either sign, and such a one is taken for as little known as that.

    Raises :class:`SolverError` where it is not finite.
    """
    if not np.isfinite(information).all():
        raise SolverError("what the data say of a fault is no finite number")
    try:
        return np.asarray(np.linalg.cholesky(information))
    except np.linalg.LinAlgError:
        scale = np.sqrt(np.abs(np.diagonal(information)))
        value, turn = np.linalg.eigh(information / np.outer(scale, scale))
        half = turn * np.sqrt(np.maximum(value, ROUNDING * value[-1])) * scale[:, None]
        root = np.linalg.qr(half.T).R.T
        return np.asarray(root * np.copysign(1.0, np.diagonal(root)))


def _used(combined: Array) -> tuple[NDArray[np.intp], Array]:
    """Return which columns sums (C, m) are made of, few of many, and by how much of each."""
    used = np.flatnonzero(combined.any(axis=1))
    return used, combined[used]


def _mirror_lower(square: Array) -> None:
    """Set what is above the diagonal to what is below it, in tiles that fit the cache."""
    for begin in range(0, len(square), TILE):
        end = begin + TILE
        square[:begin, begin:end] = square[begin:end, :begin].T
        diagonal = square[begin:end, begin:end]
        diagonal[:] = np.tril(diagonal) + np.tril(diagonal, -1).T
