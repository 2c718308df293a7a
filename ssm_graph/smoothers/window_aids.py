"""What aids measured within a window: whitened rows where they were linearised, and weights."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, Final, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from factors.similarity import WEIGHT_FLOOR, Kernel, Similarity
from factors.tails import likeliest_tail, tails_of
from ssm_graph.base.frozen import Array
from ssm_graph.base.times import Indices
from ssm_graph.engine.reweighting import Lengths
from ssm_graph.engine.states import States
from ssm_graph.graph.aids.aid import Aid, Rows, RowStates
from ssm_graph.graph.aids.depth import DepthMeans
from ssm_graph.graph.aids.gnss import Fixes
from ssm_graph.graph.first_weights import settled_weights
from ssm_graph.graph.measurements import JudgedAid, aid_kernel
from ssm_graph.smoothers.keyframe import Keyframe, Sensors


def row_states(sensors: Sensors, states: States) -> RowStates:
    """Return the states as rows take them; gravity, which none here asks for, is left out."""
    return RowStates(*states, sensors.extras, np.zeros(3))


REMEMBERED: Final = 600.0
"""Measurements that left the window tell the tail of their sensor; so many more make them count for
a third. Three times what it takes to outweigh the doubt before the first."""


class SensorRows(NamedTuple):
    """What one sensor measured at a keyframe, whitened by the stated noise."""

    sensor: str
    error: Array
    """(m,) predicted minus measured"""
    jacobian: Array
    """(m, n)"""
    weight: Array
    """(m,)"""
    component: Indices
    """(m,) which beam or axis"""


class _Measured(NamedTuple):
    """All measurements of one aid."""

    aid: Aid
    """Its keyframes are counted within the window"""
    error: Array
    """(M, d) whitened, where it is linearised, as the next"""
    jacobian: Array
    """(M, d, n)"""
    weight: Array
    """(M,)"""
    t: Array
    """(M,)"""
    spread: Array
    """(M,) the posterior variance in it"""
    is_out: NDArray[np.bool_]
    """(M,) which were too far from their prediction to get any weight later"""

    def take(self, rows: Rows) -> _Measured:
        """Return some measurements."""
        if rows == slice(0, len(self.weight)):
            return self
        columns: tuple[Any, ...] = tuple(column[rows] for column in self[1:])
        return _Measured(self.aid.take(rows), *columns)

    def evidence(self, tails: tuple[Kernel, ...]) -> Array:
        """Return how likely (C,) each of some tails makes them."""
        return Lengths(self.t, self.spread).evidence(tails, self.weight, dim=self.aid.dim)

    def replaced(self, rows: slice, by: _Measured) -> _Measured:
        """Return these with as many others in the place of successive ones."""
        if rows.stop - rows.start == len(self.weight):
            return by
        head, tail = self.take(np.s_[: rows.start]), self.take(np.s_[rows.stop :])
        return head.followed_by(by).followed_by(tail)

    def followed_by(self, other: _Measured) -> _Measured:
        """Return these, then the others."""
        if len(self.weight) == 0 or len(other.weight) == 0:
            return other if len(self.weight) == 0 else self
        pairs = zip(self[1:], other[1:], strict=True)
        columns: tuple[Any, ...] = tuple(np.concatenate(pair) for pair in pairs)
        return _Measured(self.aid.followed_by(other.aid), *columns)

    def are_far(self, step: Array, root_cov: Array, sigmas: float) -> NDArray[np.bool_]:
        """Return which (M,) are further than that from what the graph predicts of one keyframe."""
        root, left = self.jacobian @ root_cov, -self.error - self.jacobian @ step
        S = root @ np.swapaxes(root, 1, 2) + np.eye(self.aid.dim)
        distance_sq = (left * np.linalg.solve(S, left[..., None])[..., 0]).sum(axis=1)
        return np.asarray(distance_sq > sigmas**2 * self.aid.dim)

    def rows_of(self, begin: int, end: int) -> slice:
        """Return which belong to successive keyframes."""
        search = self.aid.keyframe.searchsorted
        return slice(int(search(begin)), int(search(end)))


class WindowAids:
    """The measurements of all aids of a window, by name.

    Arrays are replaced, never written into, so that a copy costs no more than its names.
    """

    def __init__(self, sensors: Sensors) -> None:
        self._sensors = sensors
        self._all: dict[str, _Measured] = {}
        self._left: dict[str, Array] = {}
        """(C,) evidence for tails, of what has left the window"""
        self._kernels: dict[str, Kernel] = {}
        """The tails found"""

    def copy(self) -> Self:
        """Return the same, to go its own way."""
        twin = type(self)(self._sensors)
        twin._all, twin._left = dict(self._all), dict(self._left)
        twin._kernels = dict(self._kernels)
        return twin

    @property
    def _weighted(self) -> list[str]:
        return [name for name, one in self._all.items() if one.aid.is_weighted]

    @property
    def weights(self) -> Array:
        """(M,) of all measurements that have one."""
        return np.concatenate([np.zeros(0), *(self._all[name].weight for name in self._weighted)])

    def append(self, keyframe: Keyframe, k: int, at: States, before: States | None) -> None:
        """Add what was measured at keyframe ``k``, the newest, linearised ``at`` (1, ...).

        Those that follow the way from the keyframe before are led along it from ``before``.
        """
        for name, aid in keyframe.aids.items():
            here = np.zeros(len(aid), np.intp)
            own = row_states(self._sensors, at.take(here))
            way = None if before is None else row_states(self._sensors, before.take(here))
            added = self._linearised(aid.led_along(way, own).moved_to(k), own)
            known = self._all.get(name)
            self._all[name] = added if known is None else known.followed_by(added)

    def _linearised(self, aid: Aid, at: RowStates) -> _Measured:
        error, jacobian = aid.whitened(at)
        n = len(aid)
        none = np.zeros(n)
        return _Measured(aid, error, jacobian, np.ones(n), none, none, np.zeros(n, bool))

    def linearise(self, begin: int, end: int, at: States) -> None:
        """Linearise those of successive keyframes anew at the states (K, ...) of all.

        What follows the way from the keyframe before is led along it, but at the first one; those
        of a single keyframe keep what its prediction came with.
        """
        for name, one in self._all.items():
            rows = one.rows_of(begin, end)
            if rows.start == rows.stop:
                continue
            some = one.take(rows)
            aid, k = some.aid, some.aid.keyframe
            own, n_first = row_states(self._sensors, at.take(k)), int(k.searchsorted(1))
            led = aid
            if n_first < len(k):
                way = (row_states(self._sensors, at.take(k[n_first:] - i)) for i in (1, 0))
                led = aid.take(np.s_[n_first:]).led_along(*way)
            if n_first and len(at.p_n) > 1:
                here = row_states(self._sensors, at.take(k[:n_first]))
                first = aid.take(np.s_[:n_first]).led_along(None, here)
                led = first.followed_by(led) if n_first < len(k) else first
            error, jacobian = led.whitened(own)
            self._all[name] = one.replaced(
                rows, some._replace(aid=led, error=error, jacobian=jacobian)
            )

    def drop(self, count: int) -> None:
        """Forget the first keyframes."""
        kept = {name: one.take(one.rows_of(count, 1 << 62)) for name, one in self._all.items()}
        self._all = {
            name: one._replace(aid=one.aid.moved_to(one.aid.keyframe - count))
            for name, one in kept.items()
            if len(one.aid)
        }

    def find_tails(self, kernel: Kernel, leaving: int) -> None:
        """Give each sensor the likeliest tail, the heaviest being that of ``kernel``.

        The first ``leaving`` keyframes are about to go; what they tell is kept.
        """
        tails = tails_of(aid_kernel(kernel))
        for name in self._weighted:
            one = self._all[name]
            left = self._left.get(name, np.zeros(0))
            left = left if len(left) == len(tails) else np.zeros(len(tails))
            gone = one.take(one.rows_of(0, leaving))
            if len(gone.aid):
                left = left * np.exp(-len(gone.aid) / REMEMBERED) + gone.evidence(tails)
                self._left[name] = left
            evidence = left + one.take(one.rows_of(leaving, 1 << 62)).evidence(tails)
            self._kernels[name] = likeliest_tail(tails, evidence, dim=one.aid.dim)

    def rows(self, begin: int) -> tuple[Indices, Array]:
        """Return the weighted rows (R, n + 1) from a keyframe on, and the keyframe of each."""
        n = self._sensors.state_dim
        keyframes, blocks = [np.zeros(0, np.intp)], [np.zeros((0, n + 1))]
        for one in self._all.values():
            first = int(one.aid.keyframe.searchsorted(begin))
            rows = np.empty((*one.error[first:].shape, n + 1))
            rows[..., :n] = one.jacobian[first:]
            np.negative(one.error[first:], out=rows[..., n])
            # What is out has no row at all: floors of what is far off would move a free height.
            weight = np.where(one.is_out[first:], 0.0, one.weight[first:])
            rows *= np.sqrt(weight)[:, None, None]
            keyframes.append(np.repeat(one.aid.keyframe[first:], rows.shape[1]))
            blocks.append(rows.reshape(-1, n + 1))
        return np.concatenate(keyframes), np.concatenate(blocks)

    def refuse_far(self, k: int, step: Array, root_cov: Array, *, sigmas: float) -> None:
        """Let no depth or fix of the newest keyframe count that is too far from its prediction.

        Of a fix that only its height puts there the height does not count, and the rest does. As
        for the others, step (n,) and root (n, n) are what the graph predicts.
        """
        for name in (DepthMeans.name, Fixes.name):
            one = self._all.get(name)
            rows = np.s_[0:0] if one is None else one.rows_of(k, k + 1)
            if one is None or rows.start == rows.stop:
                continue
            some = one.take(rows)
            is_out = some.are_far(step, root_cov, sigmas)
            if isinstance(some.aid, Fixes) and is_out.any():
                level = self._level(some, is_out)
                is_out = level.are_far(step, root_cov, sigmas)
                some = self._level(some, some.are_far(step, root_cov, sigmas) & ~is_out)
            self._all[name] = one.replaced(rows, some._replace(is_out=is_out))

    def _level(self, fixes: _Measured, which: NDArray[np.bool_]) -> _Measured:
        """Return fixes, some of them (M,) without what their height says."""
        if not which.any():
            return fixes
        assert isinstance(fixes.aid, Fixes)
        aid = fixes.aid.without_height(which, self._sensors.frame)
        anew = aid.root_information @ np.linalg.cholesky(fixes.aid.covariance_n)
        error = (anew @ fixes.error[..., None])[..., 0]
        return fixes._replace(aid=aid, error=error, jacobian=anew @ fixes.jacobian)

    def meet_prediction(self, k: int, step: Array, root_cov: Array, kernel: Kernel) -> bool:
        """Weigh the measurements of the newest keyframe by what all before it predict, together.

        Returns whether there are any.
        """
        met = [(name, self._all[name].rows_of(k, k + 1)) for name in self._weighted]
        met = [(name, rows) for name, rows in met if rows.stop > rows.start]
        if not met:
            return False
        some = [self._all[name].take(rows) for name, rows in met]
        dims = np.concatenate([np.full(len(one.aid), one.aid.dim) for one in some])
        measurement = np.repeat(np.arange(len(dims)), dims)
        is_out = np.concatenate([one.is_out for one in some])
        counts = np.where(is_out, 0.0, 1.0)[measurement]
        H = np.concatenate([one.jacobian.reshape(-1, len(step)) for one in some])
        H = H * counts[:, None]
        error = counts * np.concatenate([one.error.ravel() for one in some])
        root = H @ root_cov
        weights = settled_weights(-error - H @ step, root @ root.T, measurement, aid_kernel(kernel))
        weights = np.where(is_out, WEIGHT_FLOOR, weights)
        begin = 0
        for name, rows in met:
            one, count = self._all[name], rows.stop - rows.start
            own = np.concatenate([one.weight[: rows.start], weights[begin : begin + count]])
            self._all[name] = one._replace(weight=own)
            begin += count
        return True

    def judge(self, step: Array, covariance: Array, similarity: Similarity) -> Array:
        """Find the ``t`` of all measurements with weights at a solution (K, n), (K, n, n).

        Returns (M,) how many posterior sigmas each would move the answer if its weight changed by
        one.
        """
        pulls = [np.zeros(0)]
        for name in self._weighted:
            one = self._all[name]
            J, k = one.jacobian, one.aid.keyframe
            t = np.sum(self._errors(one, step) ** 2, axis=-1)
            spread = ((J @ covariance[k]) * J).sum(axis=(-2, -1))
            if similarity is Similarity.EXPECTED:
                t = t + spread
            self._all[name] = one._replace(t=t, spread=spread)
            pulls.append(np.sqrt(t * spread))
        return np.concatenate(pulls)

    @staticmethod
    def _errors(one: _Measured, step: Array) -> Array:
        return np.asarray(one.error + (one.jacobian @ step[one.aid.keyframe][..., None])[..., 0])

    def settled(self, kernel: Kernel) -> Array:
        """Return the weights (M,) that the present ``t`` ask for."""
        settled = [np.zeros(0)]
        for name in self._weighted:
            one, own = self._all[name], self._kernels.get(name, aid_kernel(kernel))
            settled.append(np.where(one.is_out, WEIGHT_FLOOR, own.weight(one.t, dim=one.aid.dim)))
        return np.concatenate(settled)

    @property
    def keyframe_of_weight(self) -> Indices:
        """(M,) where all measurements that have a weight stand."""
        own = [self._all[name].aid.keyframe for name in self._weighted]
        return np.concatenate([np.zeros(0, np.intp), *own])

    def renew(self, weights: Array) -> None:
        """Take weights (M,)."""
        begin = 0
        for name in self._weighted:
            one = self._all[name]
            own = weights[begin : begin + len(one.weight)]
            begin += len(one.weight)
            self._all[name] = one._replace(weight=own)

    def judged(self, begin: int, end: int, time_s: Array, step: Array) -> dict[str, JudgedAid]:
        """Return what became of the weighted measurements of successive keyframes.

        ``time_s`` (K,) and ``step`` (K, n) are those of all.
        """
        found = {}
        for name in self._weighted:
            one = self._all[name]
            some = one.take(one.rows_of(begin, end))
            if len(some.aid):
                times = time_s[some.aid.keyframe]
                found[name] = JudgedAid(
                    some.aid, times, self._errors(some, step), some.t, some.weight
                )
        return found

    def rows_at(self, k: int, step: Array) -> Iterator[SensorRows]:
        """Yield what each aid measured at keyframe ``k``, where a step (K, n) leads to."""
        for name, one in self._all.items():
            own = one.take(one.rows_of(k, k + 1))
            if len(own.aid):
                weight = np.repeat(own.weight, own.aid.dim)
                error = self._errors(own, step).ravel()
                component = np.arange(len(error)) % own.aid.dim
                H = own.jacobian.reshape(len(error), -1)
                yield SensorRows(name, error, H, weight, component)

    def pack(self) -> Iterator[tuple[str, Array]]:
        """Yield name and array of all that :meth:`unpack` needs."""
        for name, one in self._all.items():
            for column, array in one.aid.pack():
                yield f"aid_{name}_{column}", array
            yield f"aid_{name}_weight_now", one.weight
            yield f"aid_{name}_t_now", one.t
            yield f"aid_{name}_spread_now", one.spread
            yield f"aid_{name}_out_now", one.is_out.astype(np.float64)
        for name, left in self._left.items():
            yield f"aid_{name}_left_tails", left

    @classmethod
    def unpack(cls, arrays: Mapping[str, Array], sensors: Sensors, at: States) -> Self:
        """Return what was packed, linearised at the states (K, ...)."""
        aids = cls(sensors)
        for name, template in sensors.aids.items():
            prefix = f"aid_{name}_"
            own = {n.removeprefix(prefix): a for n, a in arrays.items() if n.startswith(prefix)}
            if "left_tails" in own:
                aids._left[name] = own.pop("left_tails")
            if own:
                aid = template.unpack(own)
                anew = aids._linearised(aid, row_states(sensors, at.take(aid.keyframe)))
                none = np.zeros(len(aid))  # older ones have no such columns
                aids._all[name] = anew._replace(
                    weight=own["weight_now"],
                    t=own["t_now"],
                    spread=own.get("spread_now", none),
                    is_out=own.get("out_now", none) > 0.0,
                )
        return aids

    def at(self, k: int) -> dict[str, Aid]:
        """Return what was measured at one keyframe."""
        found = {name: one.aid.at(k) for name, one in self._all.items()}
        return {name: aid for name, aid in found.items() if len(aid)}
