"""Aids whose every measurement has a weight, as every beam has: what one is, and all of them.

A measurement of several components, a position fix, is right or wrong as a whole and has one
weight. With its errors whitened, ``t`` is the sum over its components of the squared error and of
its posterior variance ``H P H'``.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import NamedTuple, Protocol, final

import numpy as np
from numpy.typing import NDArray

from factors.similarity import Similarity
from ssm_graph.base.frozen import Array
from ssm_graph.engine.states import States
from ssm_graph.graph.aids.rows import AidRows
from ssm_graph.graph.augmented_rows import Rows, RowStates, states_of
from ssm_graph.mission.estimate import AidTable


class Measured(NamedTuple):
    """Measurements of one aid, linearised; leading axes are those of the rows asked for."""

    error: Array
    """(..., d) predicted minus measured, not whitened."""
    jacobian: Array
    """(..., d, width)"""


class WeightedAid(ABC):
    """A kind of measurement with a weight for each; see :class:`WeightedAids`."""

    name: str
    unit: str
    """Of its errors: m, rad or m/s"""
    hint: str
    """What to look at when it contradicts the answer."""

    def __init__(
        self, keyframe: NDArray[np.intp], root_information: Array, labels: Sequence[str]
    ) -> None:
        """Take the keyframes (N,) of the measurements and what whitens them (N, d, d).

        ``labels`` are what the components of all of them are called, (N d,).
        """
        self.keyframe, self.root_information = keyframe, root_information
        self.labels = tuple(labels)

    @property
    def dim(self) -> int:
        """Components of each measurement."""
        return int(self.root_information.shape[-1])

    @abstractmethod
    def measured(self, at: RowStates, rows: Rows | int) -> Measured:
        """Linearise some of the measurements at their states."""

    @final
    def whitened(self, at: RowStates, rows: Rows | int) -> Measured:
        """Return errors and Jacobians of unit variance."""
        root, (error, jacobian) = self.root_information[rows], self.measured(at, rows)
        return Measured((root @ error[..., None])[..., 0], root @ jacobian)

    @final
    def at_keyframes(self, states: States) -> RowStates:
        """Return the states of all measurements."""
        return states_of(states, self.keyframe, g_n=states.p_n)


class StepLike(Protocol):
    """What is asked of a solution."""

    def variance(self, keyframe: NDArray[np.intp], rows: Array) -> Array: ...  # noqa: D102


class WeightedAids:
    """All weighted aids of a problem, their M measurements of R components one after the other."""

    def __init__(self, aids: Sequence[WeightedAid]) -> None:
        self.all = tuple(aids)
        sizes = [np.full(len(aid.keyframe), aid.dim) for aid in self.all]
        self.dim = np.concatenate([np.zeros(0, dtype=np.intp), *sizes])
        """(M,) components of each measurement"""
        self.measurement = np.repeat(np.arange(len(self.dim)), self.dim)
        """(R,) of each component"""
        self._last: tuple[States, AidRows] | None = None

    def __len__(self) -> int:
        return len(self.dim)

    def rows(self, states: States) -> AidRows:
        """Linearise all of them, not weighted; only where there are any.

        A pass asks for the same states up to four times: the last rows are kept.
        """
        if self._last is None or self._last[0] is not states:
            self._last = states, self._linearised(states)
        return self._last[1]

    def _linearised(self, states: States) -> AidRows:
        keyframes, errors, jacobians = [], [], []
        for aid in self.all:
            error, jacobian = aid.whitened(aid.at_keyframes(states), np.s_[:])
            keyframes.append(np.repeat(aid.keyframe, aid.dim))
            errors.append(error.ravel())
            jacobians.append(jacobian.reshape(-1, jacobian.shape[-1]))
        return AidRows(np.concatenate(keyframes), np.concatenate(errors), np.concatenate(jacobians))

    def weighted_rows(self, states: States, weights: Array) -> AidRows:
        """Linearise all of them with their weights (M,)."""
        keyframe, error, jacobian = self.rows(states)
        scale = np.sqrt(weights)[self.measurement]
        return AidRows(keyframe, scale * error, scale[:, None] * jacobian)

    def mahalanobis_sq(self, states: States, step: StepLike, similarity: Similarity) -> Array:
        """Return the ``t`` (M,) of the similarity measure."""
        keyframe, error, jacobian = self.rows(states)
        square = error**2
        if similarity is Similarity.EXPECTED:
            square = square + step.variance(keyframe, jacobian)
        return self._summed(square)

    def squares(self, states: States) -> Array:
        """Return the squared whitened errors (M,)."""
        return self._summed(self.rows(states).error ** 2) if len(self) else np.zeros(0)

    def of(self, aid: WeightedAid, values: Array) -> Array:
        """Return what is one of the aids' of values (M,), as a view."""
        i = self.all.index(aid)
        begin = sum(len(before.keyframe) for before in self.all[:i])
        return values[begin : begin + len(aid.keyframe)]

    def table(
        self, states: States, *, keyframe_s: Array, mahalanobis_sq: Array, weights: Array
    ) -> AidTable:
        """Return what became of all components, at final states."""
        innovations = [
            -aid.measured(aid.at_keyframes(states), np.s_[:]).error.ravel() for aid in self.all
        ]
        repeated = [aid.dim * len(aid.keyframe) for aid in self.all]
        keyframe = np.concatenate([aid.keyframe for aid in self.all])
        kinds = zip(self.all, repeated, strict=True)
        names = [(aid.name, aid.unit) for aid, count in kinds for _ in range(count)]
        return AidTable(
            aid=tuple(name for name, _ in names),
            component=tuple(label for aid in self.all for label in aid.labels),
            unit=tuple(unit for _, unit in names),
            time_s=keyframe_s[keyframe][self.measurement],
            innovation=np.concatenate(innovations),
            mahalanobis_sq=mahalanobis_sq[self.measurement],
            weight=weights[self.measurement],
        )

    def _summed(self, values: Array) -> Array:
        """Return the sums (M,) over the components of each measurement."""
        summed = np.bincount(self.measurement, weights=values, minlength=len(self))
        return np.asarray(summed, dtype=np.float64)
