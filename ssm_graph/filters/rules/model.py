"""What an update rule needs to know of the measurements of one step, and what it returns."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from ssm_graph.base.frozen import Array

Runs = NDArray[np.intp]
NOMINAL = -1
"""Group of rows that always count in full, such as depth and GNSS."""


@dataclass(frozen=True, slots=True)
class Iterate:
    """Where R runs have got to, and their measurements linearised there.

    Rows are whitened: noise of unit variance, zeros where nothing was measured.
    """

    xi: Array
    """(R, n) deviation from the prediction: a difference in a vector space, a chart on a
    manifold"""
    innovation: Array
    """(R, m) measured minus predicted"""
    jacobian: Array
    """(R, m, n) of the prediction, with respect to the local error"""
    local_D_xi: Array | None = None
    """(R, c, c) how the first ``c`` components of the local error follow those of ``xi``; the
    others, and all where None, are the same."""

    def take(self, kept: NDArray[np.bool_]) -> Iterate:
        """Return the iterate of some runs."""
        J = self.local_D_xi
        return Iterate(
            self.xi[kept],
            self.innovation[kept],
            self.jacobian[kept],
            None if J is None else J[kept],
        )

    def linear_move(self, step: Array) -> Iterate:
        """Return the iterate after steps (R, n), the measurements as they were linearised."""
        moved = (self.jacobian @ step[..., None])[..., 0]
        return Iterate(self.xi + step, self.innovation - moved, self.jacobian)

    def in_chart(self, rows: Array) -> Array:
        """Return Jacobian rows (R, m, n) of the local error as those of ``xi``."""
        J = self.local_D_xi
        if J is None:
            return rows
        turned = rows.copy()
        turned[..., : J.shape[-1]] = rows[..., : J.shape[-1]] @ J
        return turned

    def to_local(self, columns: Array) -> Array:
        """Return columns (R, n, k) of ``xi`` as those of the local error."""
        J = self.local_D_xi
        if J is None:
            return columns
        turned = columns.copy()
        turned[:, : J.shape[-1]] = J @ columns[:, : J.shape[-1]]
        return turned

    def both_to_local(self, covariance: Array) -> Array:
        """Return a covariance (R, n, n) of ``xi`` as that of the local error."""
        return self.to_local(np.swapaxes(self.to_local(covariance), 1, 2))


class MeasurementModel(Protocol):
    """Measurements of one step of B runs side by side, about their predictions."""

    present: NDArray[np.bool_]
    """(B, m) which rows were measured"""
    group: NDArray[np.intp]
    """(m,) rows of one group share an auxiliary parameter; :data:`NOMINAL` rows have none"""

    def at(self, xi: Array) -> Iterate:
        """Return all B runs at deviations (B, n) from their predictions."""

    def move(self, iterate: Iterate, step: Array, runs: Runs) -> Iterate:
        """Return where local steps (R, n) lead; ``runs`` (R,) says which runs these are."""


class Update(NamedTuple):
    """Result of one update of B runs."""

    xi: Array
    """(B, n) posterior mean as a deviation from the prediction"""
    covariance: Array
    """(B, n, n) posterior covariance of the local error at the last linearisation"""
    weights: Array
    """(B, m) weight of each row in the last pass; 1 for nominal and missing rows"""
    state_weight: Array
    """(B,) weight of the prediction; 1 where the rule trusts it"""
    mahalanobis_sq: Array
    """(B, m) squared length of each row's group at the end"""
    innovation: Array
    """(B, m) whitened, at the end"""
    n_iterations: NDArray[np.intp]
    """(B,) linear updates made"""


class UpdateRule(ABC):
    """One way to correct predictions by measurements."""

    @abstractmethod
    def __call__(
        self, covariance: Array, model: MeasurementModel, mean: Array | None = None
    ) -> Update:
        """Correct the predictions of B runs.

        Parameters
        ----------
        covariance : (B, n, n) of the predictions.
        model : the measurements.
        mean : (B, n) predicted means where the state is a plain vector; published stopping rules
            ask for its length. Error states have none: zero.
        """
