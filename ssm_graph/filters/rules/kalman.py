"""Updates that take a measurement in full or not at all."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import final

import numpy as np
from scipy.stats import chi2

from ssm_graph.base.errors import ConfigError
from ssm_graph.base.frozen import Array
from ssm_graph.filters.rules.update import (
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


class Gate(Enum):
    """What a chi-square gate passes or rejects as a whole."""

    PING = "all robust rows together"
    BEAM = "every robust row for itself"


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
    """The standard update behind a chi-square gate on the innovations.

    References
    ----------
    .. [1] Y. Bar-Shalom, X. R. Li, T. Kirubarajan, "Estimation with Applications to Tracking and
       Navigation", Wiley, 2001, section 5.4.
    """

    by: Gate
    confidence: float = 0.9973
    """Share of good measurements that pass; three sigma of one."""

    def __post_init__(self) -> None:
        if not 0.0 < self.confidence < 1.0:
            raise ConfigError(f"confidence: expected a number in (0, 1), got {self.confidence}")

    def __str__(self) -> str:
        return f"gate({self.confidence:g} on each {self.by.name.lower()})"

    def __call__(self, P: Array, model: MeasurementModel, mean: Array | None = None) -> Update:  # noqa: ARG002
        """Correct the predictions of B runs."""
        prepared = prepare(model.at(np.zeros(P.shape[:2])), P)
        rows, robust = prepared.iterate, Groups(model).is_robust
        S = prepared.HPHt + np.eye(model.present.shape[1])
        if self.by is Gate.BEAM:
            is_bad = rows.innovation**2 > chi2.ppf(self.confidence, 1) * np.einsum("bii->bi", S)
        else:
            # Missing rows are zeros: they add nothing to the length.
            inner = S[:, robust][:, :, robust]
            nu = rows.innovation[:, robust]
            nis = (nu * np.linalg.solve(inner, nu[..., None])[..., 0]).sum(axis=1)
            n_rows = np.maximum(model.present[:, robust].sum(axis=1), 1)
            is_bad = (nis > chi2.ppf(self.confidence, n_rows))[:, None] & np.ones_like(robust)
        update = _once(prepared, model, np.where(is_bad & robust, LEFT_OUT, 1.0))
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
