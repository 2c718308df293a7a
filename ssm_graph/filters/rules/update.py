"""One update of many runs: what a rule is given and returns, the linear step that all repeat.

Shapes: B runs side by side, of them R that still go on; n states, m rows.
"""

from __future__ import annotations

import contextlib
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from ssm_graph.base.frozen import Array

Runs = NDArray[np.intp]
NOMINAL = -1
"""Group of rows that always count in full."""


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
        J = None if self.local_D_xi is None else self.local_D_xi[kept]
        return Iterate(self.xi[kept], self.innovation[kept], self.jacobian[kept], J)

    def linear_move(self, step: Array) -> Iterate:
        """Return the iterate after steps (R, n), the measurements as they were linearised."""
        moved = (self.jacobian @ step[..., None])[..., 0]
        return Iterate(self.xi + step, self.innovation - moved, self.jacobian)

    def in_chart(self, rows: Array) -> Array:
        """Return Jacobian rows (R, m, n) of the local error as those of ``xi``."""
        J = self.local_D_xi
        if J is None:
            return rows
        c = J.shape[-1]
        return np.concatenate([rows[..., :c] @ J, rows[..., c:]], axis=-1)

    def to_local(self, columns: Array) -> Array:
        """Return columns (R, n, k) of ``xi`` as those of the local error."""
        J = self.local_D_xi
        if J is None:
            return columns
        c = J.shape[-1]
        return np.concatenate([J @ columns[:, :c], columns[:, c:]], axis=1)


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
    def __call__(self, P: Array, model: MeasurementModel, mean: Array | None = None) -> Update:
        """Correct the predictions of B runs.

        Parameters
        ----------
        P : (B, n, n) covariance of the predictions.
        model : the measurements.
        mean : (B, n) predicted means where the state is a plain vector; published stopping rules
            ask for its length. Error states have none: zero.
        """


class Prepared(NamedTuple):
    """What updates of R runs at one iterate have in common, whatever the weights."""

    iterate: Iterate
    predicted_cov: Array
    """(R, n, n)"""
    H: Array
    """(R, m, n) Jacobian with respect to the deviation"""
    PHt: Array
    """(R, n, m)"""
    HPHt: Array
    """(R, m, m)"""

    def take(self, kept: NDArray[np.bool_]) -> Prepared:
        """Return what belongs to some runs."""
        P, H, PHt, HPHt = (x[kept] for x in self[1:])
        return Prepared(self.iterate.take(kept), P, H, PHt, HPHt)

    def squares(self) -> Array:
        """Return innovation squared plus predicted variance (R, m) of every row."""
        return np.asarray(self.iterate.innovation**2 + np.einsum("bii->bi", self.HPHt))


def prepare(iterate: Iterate, predicted_cov: Array) -> Prepared:
    """Return the products of predicted covariance and Jacobian at an iterate."""
    H = iterate.in_chart(iterate.jacobian)
    PHt = predicted_cov @ np.swapaxes(H, 1, 2)
    return Prepared(iterate, predicted_cov, H, PHt, H @ PHt)


class Corrected(NamedTuple):
    """Outcome of one linear update of R runs, in the chart at the prediction."""

    prepared: Prepared
    scale: Array
    """(R, 1, 1) of the predicted covariance"""
    S_inv: Array
    """(R, m, m) inverse covariance of the innovation"""
    pull: Array
    """(R, m) that times what the prediction misses"""
    step: Array
    """(R, n) of the local error"""

    @property
    def gain(self) -> Array:
        """Kalman gain (R, n, m)."""
        return np.asarray((self.scale * self.prepared.PHt) @ self.S_inv)

    def covariance(self) -> Array:
        """Return the posterior covariance (R, n, n) in the chart at the prediction."""
        PHt = self.scale * self.prepared.PHt
        P = self.scale * self.prepared.predicted_cov - PHt @ self.S_inv @ np.swapaxes(PHt, 1, 2)
        return np.asarray(0.5 * (P + np.swapaxes(P, 1, 2)))

    def local_sigma(self) -> Array:
        """Return the posterior sigmas (R, n) of the local error."""
        P, PHt = self.scale * self.prepared.predicted_cov, self.scale * self.prepared.PHt
        gain = PHt @ self.S_inv
        variance = np.einsum("bii->bi", P) - (gain * PHt).sum(axis=2)
        J = self.prepared.iterate.local_D_xi
        if J is not None:
            c = J.shape[-1]
            block = P[:, :c, :c] - gain[:, :c] @ np.swapaxes(PHt[:, :c], 1, 2)
            variance[:, :c] = ((J @ block) * J).sum(axis=2)
        return np.asarray(np.sqrt(np.maximum(variance, 0.0)))

    def expected_squares(self, after: Iterate) -> Array:
        """Return innovation squared plus posterior variance (R, m) of the rows of ``after``."""
        prior, scale = self.prepared, self.scale
        if after.jacobian is prior.iterate.jacobian:
            HPHt, rows = scale * prior.HPHt, scale * prior.HPHt
            variance = np.einsum("bii->bi", HPHt) - ((rows @ self.S_inv) * rows).sum(axis=2)
        else:
            H = prior.iterate.in_chart(after.jacobian)
            rows = scale * (H @ prior.PHt)
            variance = ((scale * (H @ prior.predicted_cov)) * H).sum(axis=2)
            variance -= ((rows @ self.S_inv) * rows).sum(axis=2)
        return np.asarray(after.innovation**2 + np.maximum(variance, 0.0))

    def expected_state_square(self) -> Array:
        """Return ``tr((xi xi' + P+) P^-1)`` (R,) with the nominal covariance, never inverted.

        With ``xi = P H' pull`` scaled: ``P^-1 xi = H' pull`` and ``tr(P+ P^-1) = n - tr(K H)``.
        """
        scale = self.scale[:, 0, 0]
        HPHt = self.prepared.HPHt
        length = (self.pull * (HPHt @ self.pull[..., None])[..., 0]).sum(axis=1)
        explained = scale * (HPHt * self.S_inv).sum(axis=(1, 2))
        return np.asarray(scale**2 * length + scale * (self.prepared.PHt.shape[1] - explained))


def correct(prepared: Prepared, *, weights: Array, state_weight: Array | None = None) -> Corrected:
    """Make one Kalman update at an iterate, the mean restarted from the prediction.

    With ``H`` the Jacobian with respect to the deviation ``xi``, ``P`` the predicted covariance
    over ``state_weight`` and ``R = diag(1 / weights)``::

        K = P H' (H P H' + R)^-1,  xi+ = K (innovation + H xi),  P+ = P - K H P

    The step ``xi+ - xi`` is handed back as one of the local error.
    """
    iterate = prepared.iterate
    scale = np.ones((1, 1, 1)) if state_weight is None else 1.0 / state_weight[:, None, None]
    S = scale * prepared.HPHt
    np.einsum("bii->bi", S)[...] += 1.0 / weights
    S_inv = each_or_nan(np.linalg.inv, S)
    missed = iterate.innovation + (prepared.H @ iterate.xi[..., None])[..., 0]
    pull = (S_inv @ missed[..., None])[..., 0]
    change = ((scale * prepared.PHt) @ pull[..., None])[..., 0] - iterate.xi
    step = iterate.to_local(change[..., None])[..., 0]
    return Corrected(prepared, scale, S_inv, pull, step)


def each_or_nan(function: Callable[[Any], Any], stack: Array) -> Array:
    """Apply a function to square matrices (R, m, m) that refuses some of them.

    NaN comes of a run that has run away, which ends nobody else's.
    """
    try:
        return np.asarray(function(stack))
    except np.linalg.LinAlgError:
        results = np.full_like(stack, np.nan)
        for run, single in enumerate(stack):
            with contextlib.suppress(np.linalg.LinAlgError):
                results[run] = function(single)
        return results


class Groups:
    """Which rows share an auxiliary parameter."""

    def __init__(self, model: MeasurementModel) -> None:
        names = np.unique(model.group[model.group != NOMINAL])
        self._member = (model.group[:, None] == names).astype(float)
        self.is_robust = model.group != NOMINAL
        self._size = model.present @ self._member

    def total(self, per_row: Array) -> Array:
        """Return sums (R, G) over the rows (R, m) of each group."""
        return np.asarray(per_row @ self._member)

    def size(self, runs: Runs) -> Array:
        """Return the number of rows (R, G) that were measured."""
        return np.asarray(self._size[runs])

    def spread(self, per_group: Array, *, nominal: float) -> Array:
        """Return each row's group value (R, m), ``nominal`` for rows without a group."""
        return np.where(self.is_robust, per_group @ self._member.T, nominal)


class Result:
    """Fills an :class:`Update` while runs stop one after the other."""

    def __init__(self, covariance: Array, model: MeasurementModel) -> None:
        n_runs, n_rows = model.present.shape
        self._model = model
        self._update = Update(
            xi=np.zeros((n_runs, covariance.shape[1])),
            covariance=np.empty_like(covariance),
            weights=np.ones((n_runs, n_rows)),
            state_weight=np.ones(n_runs),
            mahalanobis_sq=np.zeros((n_runs, n_rows)),
            innovation=np.zeros((n_runs, n_rows)),
            n_iterations=np.zeros(n_runs, dtype=np.intp),
        )

    def keep(
        self, runs: Runs, which: NDArray[np.bool_], xi: Array, **columns: NDArray[Any] | int
    ) -> None:
        """Store what was found for those of ``runs`` that have stopped, in the chart of ``xi``."""
        stopped = runs[which]
        self._update.xi[stopped] = xi[which]
        for name, values in columns.items():
            kept = values if isinstance(values, int) else values[which]
            getattr(self._update, name)[stopped] = kept

    def finish(self) -> Update:
        """Return the update: covariances of the local errors, missing rows with weight 1."""
        update = self._update
        end = self._model.at(update.xi)
        return update._replace(
            covariance=end.to_local(end.to_local(update.covariance).mT),
            innovation=end.innovation,
            weights=np.where(self._model.present, update.weights, 1.0),
        )
