"""The Student's t filter with an inverse-Wishart scale of the prediction."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import final

import numpy as np

from ssm_graph.base.errors import ConfigError
from ssm_graph.base.frozen import Array
from ssm_graph.filters.rules.update import (
    Groups,
    MeasurementModel,
    Result,
    Update,
    UpdateRule,
    correct,
    prepare,
)


class Scale(Enum):
    """The scale matrix of the prediction."""

    ESTIMATED = "inverse-Wishart about the nominal covariance"
    FIXED = "the nominal covariance"


@final
@dataclass(frozen=True)
class StudentUpdate(UpdateRule):
    """RSTKF: prediction and measurement both Student's t, by variational Bayes.

    A fixed number of passes without a stopping test or a floor, as published; the first pass
    starts from the prediction, so that its measurement weight comes from the innovation. The
    measurements are linearised once, at the prediction.

    References
    ----------
    .. [1] Y. Huang, Y. Zhang, N. Li, Z. Wu, J. A. Chambers, "A Novel Robust Student's t-Based
       Kalman Filter", IEEE Transactions on Aerospace and Electronic Systems 53, 2017.
    """

    scale: Scale = Scale.ESTIMATED
    state_dof: float = 5.0
    measurement_dof: float = 5.0
    tau: float = 5.0
    """Degrees of freedom by which the scale matrix holds on to the nominal covariance."""
    n_iterations: int = 10

    def __post_init__(self) -> None:
        for name in ("state_dof", "measurement_dof", "tau", "n_iterations"):
            if not (np.isfinite(getattr(self, name)) and getattr(self, name) > 0):
                raise ConfigError(f"{name}: expected above zero, got {getattr(self, name)}")

    def __str__(self) -> str:
        return f"student(dof={self.measurement_dof:g})"

    def __call__(self, P: Array, model: MeasurementModel, mean: Array | None = None) -> Update:  # noqa: ARG002
        """Correct the predictions of B runs."""
        groups, result = Groups(model), Result(P, model)
        runs = np.arange(len(P))
        n_states, size = P.shape[1], groups.size(runs)
        iterate = model.at(np.zeros(P.shape[:2]))
        posterior = scale_cov = P
        squares = prepare(iterate, P).squares()
        for _ in range(self.n_iterations):
            xi = iterate.xi
            moment = posterior + xi[:, :, None] * xi[:, None, :]
            t_state = _trace_of_ratio(moment, scale_cov)
            state_weight = (self.state_dof + n_states) / (self.state_dof + t_state)
            t = groups.total(squares)
            weights = (self.measurement_dof + size) / (self.measurement_dof + t)
            if self.scale is Scale.ESTIMATED:
                scale_cov = self.tau * P + state_weight[:, None, None] * moment
                scale_cov = scale_cov / (self.tau + 1.0)
            done = correct(
                prepare(iterate, scale_cov),
                weights=groups.spread(weights, nominal=1.0),
                state_weight=state_weight,
            )
            iterate = iterate.linear_move(done.step)
            posterior, squares = done.covariance(), done.expected_squares(iterate)
        result.keep(
            runs,
            np.ones(len(runs), bool),
            iterate.xi,
            covariance=posterior,
            weights=groups.spread(weights, nominal=1.0),
            state_weight=state_weight,
            mahalanobis_sq=groups.spread(t, nominal=0.0),
            n_iterations=self.n_iterations,
        )
        return result.finish()


def _trace_of_ratio(moment: Array, scale_cov: Array) -> Array:
    """Return ``tr(moment scale_cov^-1)`` (B,), solved in correlation form."""
    sigma = np.sqrt(np.einsum("bii->bi", scale_cov))
    unit = sigma[:, :, None] * sigma[:, None, :]
    return np.asarray(np.einsum("bii->b", np.linalg.solve(scale_cov / unit, moment / unit)))
