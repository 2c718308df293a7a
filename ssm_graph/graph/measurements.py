"""All aids of a problem as rows of its graph, and what became of each measurement.

With the errors of a measurement whitened, its ``t`` is the sum over its components of the squared
error and of its posterior variance ``H P H'``.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from factors.similarity import Kernel, LogKernel, Similarity
from ssm_graph.base.frozen import Array
from ssm_graph.engine.extras import Extras
from ssm_graph.engine.reweighting import Lengths, TailSchedule
from ssm_graph.engine.states import States
from ssm_graph.graph.aids.aid import Aid, Linearised, RowStates
from ssm_graph.graph.aids.depth import DepthMeans
from ssm_graph.graph.aids.gnss import Fixes
from ssm_graph.graph.freed import Freed
from ssm_graph.mission.answer import (
    LOW_WEIGHT,
    MISFIT,
    SLOW_SIGMAS,
    SUSPECT_SHARE,
    TRUSTED,
    doubt_of_run,
)
from ssm_graph.mission.estimate import AidTable
from ssm_graph.mission.problem import Problem


class AidRows(NamedTuple):
    """Whitened rows of all measurements, ``A d = b`` with ``b`` minus the error."""

    keyframe: NDArray[np.intp]
    """(R,)"""
    error: Array
    """(R,)"""
    jacobian: Array
    """(R, width)"""


class StepLike(Protocol):
    """What is asked of a solution."""

    def variance(self, keyframe: NDArray[np.intp], rows: Array) -> Array: ...  # noqa: D102


class JudgedAid(NamedTuple):
    """Measurements of one aid and what became of them."""

    aid: Aid
    time_s: Array
    """(M,) of their keyframes, s"""
    error: Array
    """(M, d) predicted minus measured, whitened"""
    mahalanobis_sq: Array
    """(M,)"""
    weight: Array
    """(M,)"""


def states_at(
    states: States, keyframe: NDArray[np.intp], extras: Extras, *, g_n: Array | None = None
) -> RowStates:
    """Return the states of rows from those of all keyframes, with gravity ``g_n`` (K, 3) of them.

    Only beams ask for gravity, where the clock of the DVL is in doubt.
    """
    own = (states.R_nb, states.p_n, states.v_n, states.bias, states.walks)
    R_nb, p_n, v_n, bias, walks = (column[keyframe] for column in own)
    gravity = np.zeros(3) if g_n is None else g_n[keyframe]
    return RowStates(R_nb, p_n, v_n, bias, walks, states.constants, extras, gravity)


def aids_of(problem: Problem) -> tuple[Aid, ...]:
    """Return all aids of a problem: depth, GNSS and the further ones."""
    found: list[Aid] = []
    if problem.depths is not None:
        found.append(DepthMeans.of_readings(problem.depths, problem.keyframe_s, problem.frame))
    if problem.fixes is not None:
        found.append(problem.fixes)
    return (*found, *problem.aids)


class Measurements:
    """Some aids of a problem, their M measurements of R components one after the other."""

    def __init__(self, aids: Iterable[Aid], extras: Extras, freed: Freed | None = None) -> None:
        self.all = tuple(aids)
        self._extras, self._freed = extras, freed
        sizes = [np.full(len(aid), aid.dim) for aid in self.all]
        self.dim = np.concatenate([np.zeros(0, dtype=np.intp), *sizes])
        """(M,) components of each measurement"""
        self.measurement = np.repeat(np.arange(len(self.dim)), self.dim)
        """(R,) of each component"""

    @classmethod
    def of_problem(cls, problem: Problem, freed: Freed | None = None) -> Measurements:
        """Return those of a problem, each with a weight of its own."""
        return cls(aids_of(problem), problem.extras, freed)

    def __len__(self) -> int:
        return len(self.dim)

    def at_keyframes(self, aid: Aid, states: States) -> RowStates:
        """Return the states of all measurements of one aid."""
        return states_at(states, aid.keyframe, self._extras)

    def whitened(self, aid: Aid, states: States) -> Linearised:
        """Linearise one aid, with what it was found to be off by."""
        rows = aid.whitened(self.at_keyframes(aid, states))
        if self._freed is None:
            return rows
        return self._freed.on_aid(aid.name, rows, self._extras, states.constants)

    def follow(self, states: States) -> None:
        """Let what is only slowly a function of the states follow them."""
        self.all = tuple(
            aid.led_along(
                states_at(states, np.maximum(aid.keyframe - 1, 0), self._extras),
                self.at_keyframes(aid, states),
            )
            for aid in self.all
        )

    def rows(self, states: States, weights: Array | None = None) -> AidRows:
        """Linearise all of them, with weights (M,)."""
        keyframes, errors = [np.zeros(0, dtype=np.intp)], [np.zeros(0)]
        jacobians = [np.zeros((0, self._extras.width))]
        for aid in self.all:
            error, jacobian = self.whitened(aid, states)
            keyframes.append(np.repeat(aid.keyframe, aid.dim))
            errors.append(error.ravel())
            jacobians.append(jacobian.reshape(-1, self._extras.width))
        scale = 1.0 if weights is None else np.sqrt(weights)[self.measurement]
        return AidRows(
            np.concatenate(keyframes),
            scale * np.concatenate(errors),
            np.asarray((scale * np.concatenate(jacobians).T).T),
        )

    def lengths(self, states: States, step: StepLike, similarity: Similarity) -> Lengths:
        """Return the ``t`` of the similarity measure, and the part of the posterior variance."""
        keyframe, error, jacobian = self.rows(states)
        spread = self._summed(step.variance(keyframe, jacobian))
        square = self._summed(error**2)
        return Lengths(square + spread if similarity is Similarity.EXPECTED else square, spread)

    def tails(self, wanted: Kernel, warm: Kernel) -> TailSchedule:
        """Return how they are weighed beside beams weighed by ``wanted``, at first by ``warm``."""
        sizes = [len(aid) for aid in self.all]
        begin = np.cumsum([0, *sizes]).astype(np.intp)
        dim = np.array([aid.dim for aid in self.all], np.intp)
        return TailSchedule(aid_kernel(wanted), (warm,) * len(sizes), begin, dim)

    def squares(self, states: States) -> Array:
        """Return the squared whitened errors (M,)."""
        return self._summed(self.rows(states).error ** 2)

    def loss(self, states: States, kernels: Sequence[Kernel]) -> float:
        """Return what they cost with the robust loss of each aid in place of their squares."""
        t, total = self.squares(states), 0.0
        for aid, kernel in zip(self.all, kernels, strict=True):
            own, dim = self.of(aid, t), aid.dim
            loss = kernel.similarity(np.zeros_like(own), dim=dim) - kernel.similarity(own, dim=dim)
            total += float(loss.sum())
        return total

    def of(self, aid: Aid, values: Array) -> Array:
        """Return what is one of the aids' of values (M,), as a view."""
        begin = sum(len(before) for before in self.all[: self.all.index(aid)])
        return values[begin : begin + len(aid)]

    def judged(
        self, states: States, keyframe_s: Array, mahalanobis_sq: Array, weights: Array
    ) -> list[JudgedAid]:
        """Return what became of them at final states, with ``t`` and weights (M,)."""
        return [
            JudgedAid(
                aid,
                keyframe_s[aid.keyframe],
                self.whitened(aid, states).error,
                self.of(aid, mahalanobis_sq),
                self.of(aid, weights),
            )
            for aid in self.all
        ]

    def _summed(self, values: Array) -> Array:
        """Return the sums (M,) over the components of each measurement."""
        summed = np.bincount(self.measurement, weights=values, minlength=len(self))
        return np.asarray(summed, dtype=np.float64)


def joined_aids(judged: Sequence[JudgedAid]) -> JudgedAid:
    """Return successive measurements of one aid as one."""
    aids, *columns = zip(*judged, strict=True)
    return JudgedAid(aids[0].joined(aids), *(np.concatenate(column) for column in columns))


def without(judged: Sequence[JudgedAid], left_out: NDArray[np.bool_]) -> list[JudgedAid]:
    """Return what became of those measurements that are not left out (M,)."""
    found, begin = [], 0
    for one in judged:
        kept = ~left_out[begin : begin + len(one.aid)]
        begin += len(one.aid)
        found.append(JudgedAid(one.aid.take(kept), *(column[kept] for column in one[1:])))
    return found


def aid_kernel(wanted: Kernel) -> Kernel:
    """Return what the measurements of aids are weighed by, beside beams weighed by ``wanted``.

    M-estimators and truncation are made for one component and have no place here: beside them it is
    the logarithm's kernel.
    """
    return wanted if wanted.published_with is Similarity.EXPECTED else LogKernel()


def aid_table(judged: Sequence[JudgedAid]) -> AidTable | None:
    """Return what became of all components; None if there are none."""
    if not any(len(one.aid) for one in judged):
        return None
    dims = [one.aid.dim for one in judged]
    pairs = list(zip(judged, dims, strict=True))
    names = [(one.aid.name, one.aid.unit) for one in judged for _ in one.aid.labels]
    errors = [np.linalg.solve(one.aid.root_information, one.error[..., None]) for one in judged]
    return AidTable(
        aid=tuple(name for name, _ in names),
        component=tuple(label for one in judged for label in one.aid.labels),
        unit=tuple(unit for _, unit in names),
        time_s=np.concatenate([np.repeat(one.time_s, dim) for one, dim in pairs]),
        innovation=-np.concatenate([error.ravel() for error in errors]),
        mahalanobis_sq=np.concatenate([np.repeat(one.mahalanobis_sq, dim) for one, dim in pairs]),
        weight=np.concatenate([np.repeat(one.weight, dim) for one, dim in pairs]),
    )


def doubts_of_aids(judged: Sequence[JudgedAid], *, is_searched: bool = False) -> list[str]:
    """Say in a sentence each which aid disagrees with the answer.

    ``is_searched`` if faults that last have been looked for.
    """
    least = SLOW_SIGMAS if is_searched else 0.0
    return [doubt for one in judged if len(one.aid) and (doubt := _doubt(one, least))]


def _doubt(one: JudgedAid, least_sigmas: float) -> str:
    aid, weights = one.aid, one.weight
    share = float(np.mean(weights < LOW_WEIGHT))
    if share > SUSPECT_SHARE:
        return (
            f"{100.0 * share:.0f} % of the {len(weights)} {aid.name} measurements contradict "
            f"the answer (weight below {LOW_WEIGHT}): {aid.hint}"
        )
    if isinstance(aid, DepthMeans | Fixes):
        whitened_sq = np.sum(one.error**2, axis=1)
        return doubt_of_run(
            type(aid), one.time_s, whitened_sq, dim=aid.dim, least_sigmas=least_sigmas
        )
    trusted = np.mean(one.error**2, axis=1)[weights >= TRUSTED]
    misfit = float(np.mean(trusted)) if len(trusted) else 0.0
    if misfit <= MISFIT:
        return ""
    return (
        f"{aid.name} measurements that count miss the answer by {np.sqrt(misfit):.1f} of their "
        f"own sigmas (rms): their noise is stated too small, or {aid.hint}"
    )
