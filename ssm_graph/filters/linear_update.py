"""The linear update that every rule repeats, and the book-keeping of runs that have stopped."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ssm_graph.data import Array
from ssm_graph.filters.model import NOMINAL, Iterate, MeasurementModel, Runs, Update


class Corrected(NamedTuple):
    """Outcome of one linear update of R runs, in the chart at the prediction."""

    iterate: Iterate
    """where it was linearised"""
    predicted_cov: Array
    """(R, n, n)"""
    PHt: Array
    """(R, n, m) predicted covariance times the transposed Jacobian"""
    gain: Array
    """(R, n, m)"""
    step: Array
    """(R, n) of the local error"""

    def covariance(self) -> Array:
        """Return the posterior covariance (R, n, n) in the chart at the prediction."""
        return np.asarray(self.predicted_cov - self.gain @ np.swapaxes(self.PHt, 1, 2))

    def local_covariance(self, after: Iterate) -> Array:
        """Return the posterior covariance (R, n, n) of the local error where the step led."""
        covariance = self.covariance()
        covariance = 0.5 * (covariance + np.swapaxes(covariance, 1, 2))
        return after.both_to_local(covariance)

    def local_sigma(self) -> Array:
        """Return the posterior sigmas (R, n) of the local error."""
        variance = np.einsum("bii->bi", self.predicted_cov) - (self.gain * self.PHt).sum(axis=2)
        J = self.iterate.local_D_xi
        if J is not None:
            c = J.shape[-1]
            block = self.predicted_cov[:, :c, :c] - self.gain[:, :c] @ np.swapaxes(
                self.PHt[:, :c], 1, 2
            )
            variance[:, :c] = np.asarray((J @ block) * J).sum(axis=2)
        return np.asarray(np.sqrt(np.maximum(variance, 0.0)))

    def expected_squares(self, after: Iterate) -> Array:
        """Return innovation squared plus posterior variance (R, m) of the rows of ``after``."""
        H = self.iterate.in_chart(after.jacobian)
        spread = H @ self.predicted_cov - (H @ self.gain) @ np.swapaxes(self.PHt, 1, 2)
        variance = (spread * H).sum(axis=2)
        return np.asarray(after.innovation**2 + np.maximum(variance, 0.0))


def correct(iterate: Iterate, *, predicted_cov: Array, weights: Array) -> Corrected:
    """Make one Kalman update at an iterate, the mean restarted from the prediction.

    With ``H`` the Jacobian with respect to the deviation ``xi`` and ``R = diag(1 / weights)``::

        K = P H' (H P H' + R)^-1,  xi+ = K (innovation + H xi),  P+ = P - K H P

    The step ``xi+ - xi`` is handed back as one of the local error.
    """
    H = iterate.in_chart(iterate.jacobian)
    PHt = predicted_cov @ np.swapaxes(H, 1, 2)
    S = H @ PHt
    np.einsum("bii->bi", S)[...] += 1.0 / weights
    gain = PHt @ np.linalg.inv(S)
    missed = iterate.innovation + (H @ iterate.xi[..., None])[..., 0]
    change = (gain @ missed[..., None])[..., 0] - iterate.xi
    return Corrected(iterate, predicted_cov, PHt, gain, iterate.to_local(change[..., None])[..., 0])


def predicted_squares(iterate: Iterate, covariance: Array) -> Array:
    """Return innovation squared plus predicted variance (R, m) of every row."""
    H = iterate.in_chart(iterate.jacobian)
    return np.asarray(iterate.innovation**2 + ((H @ covariance) * H).sum(axis=2))


def expected_state_square(scale_cov: Array, xi: Array, covariance: Array) -> Array:
    """Return ``tr((xi xi' + P+) P^-1)`` (R,), solved in correlation form.

    All in the chart at the prediction.
    """
    scale = np.sqrt(np.einsum("bii->bi", scale_cov))
    unit = scale[:, :, None] * scale[:, None, :]
    moment = covariance + xi[:, :, None] * xi[:, None, :]
    return np.asarray(np.einsum("bii->b", np.linalg.solve(scale_cov / unit, moment / unit)))


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
        self._present = model.present
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
        self, runs: Runs, which: NDArray[np.bool_], after: Iterate, **columns: NDArray[Any] | int
    ) -> None:
        """Store what was found for those of ``runs`` that have stopped."""
        stopped = runs[which]
        self._update.xi[stopped] = after.xi[which]
        self._update.innovation[stopped] = after.innovation[which]
        for name, values in columns.items():
            kept = values if isinstance(values, int) else values[which]
            getattr(self._update, name)[stopped] = kept

    def finish(self) -> Update:
        """Return the update; missing rows have weight 1."""
        weights = np.where(self._present, self._update.weights, 1.0)
        return self._update._replace(weights=weights)
