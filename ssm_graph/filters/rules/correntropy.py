"""The maximum correntropy filter."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np
from numpy.typing import NDArray

from factors.similarity import WEIGHT_FLOOR
from ssm_graph.base.errors import ConfigError
from ssm_graph.base.frozen import Array
from ssm_graph.filters.rules.update import (
    Corrected,
    Groups,
    MeasurementModel,
    Result,
    Runs,
    Update,
    UpdateRule,
    correct,
    each_or_nan,
    prepare,
)


@final
@dataclass(frozen=True)
class CorrentropyUpdate(UpdateRule):
    """MCKF: every whitened component of state and measurement weighed by a Gaussian kernel.

    The measurements are linearised once, at the prediction; only the weights are iterated.

    As published, the weights have no floor. A measurement beyond 38 kernel widths then underflows
    to weight zero and infinite noise, and drops out as if it were absent; a prediction that rows of
    full weight contradict as much gets an infinite covariance, and the run is lost.
    With a floor, neither happens.

    References
    ----------
    .. [1] B. Chen, X. Liu, H. Zhao, J. C. Principe, "Maximum correntropy Kalman filter",
       Automatica 76, 2017.
    """

    width: float = 2.0
    """Kernel width, in sigmas."""
    tolerance: float = 1e-6
    """Length of the step over that of the state before it, where the state is a vector; of error
    states, which may be zero, largest step of a component in its predicted sigma."""
    max_iterations: int = 10_001
    floor: float = WEIGHT_FLOOR
    """Smallest weight of a row and of a component of the prediction; zero as published."""

    def __post_init__(self) -> None:
        if not (np.isfinite(self.width) and self.width > 0.0):
            raise ConfigError(f"width: expected above zero, got {self.width}")

    def __str__(self) -> str:
        return f"correntropy(width={self.width:g})"

    def __call__(self, P: Array, model: MeasurementModel, mean: Array | None = None) -> Update:
        """Correct the predictions of B runs."""
        result, is_robust = Result(P, model), Groups(model).is_robust
        runs: Runs = np.arange(len(P))
        sigma = np.sqrt(np.einsum("bii->bi", P))
        unit = sigma[:, :, None] * sigma[:, None, :]
        root = sigma[:, :, None] * each_or_nan(np.linalg.cholesky, P / unit)
        iterate = model.at(np.zeros(sigma.shape))
        for number in range(1, self.max_iterations + 1):
            own = root[runs]
            g_state = self._kernel(np.linalg.solve(own, iterate.xi[..., None])[..., 0])
            g_rows = np.where(is_robust, self._kernel(iterate.innovation), 1.0)
            scaled = (own / g_state[:, None, :]) @ np.swapaxes(own, 1, 2)
            done = correct(prepare(iterate, scaled), weights=g_rows)
            before, iterate = iterate.xi, iterate.linear_move(done.step)
            has_stopped = self._has_settled(iterate.xi, before, mean, runs, sigma)
            has_stopped |= ~np.isfinite(done.step).all(axis=1)  # run away: its caller will see
            if number == self.max_iterations:
                has_stopped[:] = True
            if not np.any(has_stopped):
                continue
            result.keep(
                runs,
                has_stopped,
                iterate.xi,
                covariance=_joseph(P[runs], done),
                weights=g_rows,
                state_weight=g_state.min(axis=1),
                mahalanobis_sq=iterate.innovation**2,
                n_iterations=number,
            )
            left = ~has_stopped
            if not np.any(left):
                break
            runs, iterate = runs[left], iterate.take(left)
        return result.finish()

    def _kernel(self, e: Array) -> Array:
        return np.maximum(np.exp(-0.5 * (e / self.width) ** 2), self.floor)

    def _has_settled(
        self, xi: Array, before: Array, mean: Array | None, runs: Runs, sigma: Array
    ) -> NDArray[np.bool_]:
        moved = xi - before
        if mean is None:
            return np.asarray(np.all(np.abs(moved) < self.tolerance * sigma[runs], axis=1))
        length = np.linalg.norm(before + mean[runs], axis=1)
        return np.asarray(np.linalg.norm(moved, axis=1) / length < self.tolerance)


def _joseph(covariance: Array, done: Corrected) -> Array:
    """Return the posterior covariance of any gain, with the nominal noise, as published."""
    gain = done.gain
    left = np.eye(covariance.shape[1]) - gain @ done.prepared.H
    joseph = left @ covariance @ np.swapaxes(left, 1, 2)
    return np.asarray(joseph + gain @ np.swapaxes(gain, 1, 2))
