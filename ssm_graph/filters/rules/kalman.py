"""Updates that take a measurement in full or not at all."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np

from ssm_graph.base import chi2
from ssm_graph.base.errors import ConfigError
from ssm_graph.base.frozen import Array
from ssm_graph.filters.rules.update import (
    NOMINAL,
    Groups,
    MeasurementModel,
    Prepared,
    Result,
    Update,
    UpdateRule,
    correct,
    prepare,
)

LEFT_OUT = 1e-12
"""Weight of a row that a gate rejects: none, but regular."""


@final
@dataclass(frozen=True)
class KalmanUpdate(UpdateRule):
    """The standard update, linearised once at the prediction.

    References
    ----------
    .. [1] R. E. Kalman, "A New Approach to Linear Filtering and Prediction Problems", Journal of
       Basic Engineering 82, 1960.
    """

    def __str__(self) -> str:
        return "gaussian"

    def __call__(self, P: Array, model: MeasurementModel, mean: Array | None = None) -> Update:  # noqa: ARG002
        """Correct the predictions of B runs."""
        prepared = prepare(model.at(np.zeros(P.shape[:2])), P)
        return _once(prepared, model, np.ones(model.present.shape))


@final
@dataclass(frozen=True)
class GatedUpdate(UpdateRule):
    """The standard update behind a chi-square gate on the innovations of each group of rows.

    References
    ----------
    .. [1] Y. Bar-Shalom, X. R. Li, T. Kirubarajan, "Estimation with Applications to Tracking and
       Navigation", Wiley, 2001, section 5.4.
    """

    confidence: float = 0.9973
    """Share of good measurements that pass; three sigma of one."""

    def __post_init__(self) -> None:
        if not 0.0 < self.confidence < 1.0:
            raise ConfigError(f"confidence: expected a number in (0, 1), got {self.confidence}")

    def __str__(self) -> str:
        return f"gate({self.confidence:g})"

    def __call__(self, P: Array, model: MeasurementModel, mean: Array | None = None) -> Update:  # noqa: ARG002
        """Correct the predictions of B runs."""
        prepared = prepare(model.at(np.zeros(P.shape[:2])), P)
        S, weights = prepared.HPHt + np.eye(len(model.group)), np.ones(model.present.shape)
        for name in np.unique(model.group[model.group != NOMINAL]):
            # Missing rows are zeros: they add nothing to the length.
            own = np.flatnonzero(model.group == name)
            nu, inner = prepared.iterate.innovation[:, own], S[:, own[:, None], own]
            nis = (nu * np.linalg.solve(inner, nu[..., None])[..., 0]).sum(axis=1)
            n_rows = np.maximum(model.present[:, own].sum(axis=1), 1)
            weights[nis > chi2.ppf(self.confidence, n_rows), own[:, None]] = LEFT_OUT
        update = _once(prepared, model, weights)
        return update._replace(weights=np.where(update.weights < 1.0, 0.0, 1.0))


def _once(prepared: Prepared, model: MeasurementModel, weights: Array) -> Update:
    groups, result = Groups(model), Result(prepared.predicted_cov, model)
    runs = np.arange(len(prepared.H))
    done = correct(prepared, weights=weights)
    after = prepared.iterate.linear_move(done.step)
    t = groups.total(done.expected_squares(after))
    result.keep(
        runs,
        np.ones(len(runs), bool),
        after.xi,
        covariance=done.covariance(),
        weights=weights,
        mahalanobis_sq=groups.spread(t, nominal=0.0),
        n_iterations=1,
    )
    return result.finish()
