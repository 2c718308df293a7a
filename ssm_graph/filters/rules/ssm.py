"""Updates by statistical similarity: one auxiliary parameter a group of rows.

With every row a group of its own this is the filter that keeps the good beams of a ping; with one
group for all it is the SSMKF.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum
from typing import final

import numpy as np
from numpy.typing import NDArray

from factors.similarity import WEIGHT_FLOOR, Kernel, LogKernel, Similarity
from ssm_graph.base.frozen import Array
from ssm_graph.engine.error_state import Linearised
from ssm_graph.filters.rules.update import (
    Corrected,
    Groups,
    Iterate,
    MeasurementModel,
    Prepared,
    Result,
    Runs,
    Update,
    UpdateRule,
    correct,
    prepare,
)


class StopRule(Enum):
    """What an iteration is judged by."""

    SIGMAS = "largest step of a component, in its own posterior sigma"
    RELATIVE = "length of the step over that of the state, as published: mixed units"


class Floor(Enum):
    """What keeps weights from vanishing."""

    CLIPPED = "never below the floor"
    ADDED = "the floor is added to what falls below it, as in the authors' own code"

    def applied_to(self, kernel: Kernel, t: Array, dim: Array) -> Array:
        """Return the kernel's weights of squared lengths ``t``."""
        if self is Floor.CLIPPED:
            return kernel.weight(t, dim=dim)
        raw = kernel.raw_weight(t, dim=dim)
        return np.where(raw < WEIGHT_FLOOR, raw + WEIGHT_FLOOR, raw)


@final
@dataclass(frozen=True)
class SsmUpdate(UpdateRule):
    """The iterated update of the statistical similarity measure.

    Starts from the plain Kalman update; judges every group of rows by the expected squared length
    of its innovation under the posterior, reweights, and repeats from the prediction until the
    state has settled.

    References
    ----------
    .. [1] Y. Huang, Y. Zhang, Y. Zhao, P. Shi, J. A. Chambers, "A Novel Outlier-Robust Kalman
       Filtering Framework Based on Statistical Similarity Measure", IEEE Transactions on Automatic
       Control 66, 2021: one parameter for the measurement and one for the state.
    .. [2] Xu et al., "Combined navigation robust filtering method based on statistical similarity
       measurement", 2021: one parameter for every beam, the prediction trusted.
    """

    kernel: Kernel = field(default_factory=LogKernel)
    state_kernel: Kernel | None = None
    """Reweights the prediction as well, as in [1]_; None trusts it, as in [2]_."""
    similarity: Similarity = Similarity.EXPECTED
    max_iterations: int = 50
    tolerance: float = 1e-8
    stop: StopRule = StopRule.SIGMAS
    """The published rule adds metres to radians; counted in sigmas it has no unit."""
    floor: Floor = Floor.CLIPPED
    linearised: Linearised = Linearised.EACH_PASS

    def __str__(self) -> str:
        state = "" if self.state_kernel is None else f", prediction {self.state_kernel}"
        plain = ", plain" if self.similarity is Similarity.PLAIN else ""
        return f"{self.kernel}{state}{plain}"

    def __call__(self, P: Array, model: MeasurementModel, mean: Array | None = None) -> Update:
        """Correct the predictions of B runs."""
        groups, result = Groups(model), Result(P, model)
        runs: Runs = np.arange(len(P))
        weights, state_weight = np.ones(model.present.shape), np.ones(len(runs))
        is_once = self.linearised is Linearised.ONCE
        prepared = prepare(model.at(np.zeros(P.shape[:2])), P)
        for number in range(1, self.max_iterations + 1):
            done = correct(prepared, weights=weights, state_weight=state_weight)
            at = prepared.iterate
            iterate = at.linear_move(done.step) if is_once else model.move(at, done.step, runs)
            is_plain = self.similarity is Similarity.PLAIN
            t = groups.total(iterate.innovation**2 if is_plain else done.expected_squares(iterate))
            has_stopped = self._has_settled(done, iterate, mean, runs)
            has_stopped |= ~np.isfinite(done.step).all(axis=1)  # run away: its caller will see
            if number == self.max_iterations:
                has_stopped[:] = True
            if np.any(has_stopped):
                result.keep(
                    runs,
                    has_stopped,
                    iterate.xi,
                    covariance=done.covariance(),
                    weights=weights,
                    state_weight=state_weight,
                    mahalanobis_sq=groups.spread(t, nominal=0.0),
                    n_iterations=number,
                )
            left = ~has_stopped
            if not np.any(left):
                break
            settled = self.floor.applied_to(self.kernel, t, groups.size(runs))
            weights = groups.spread(settled, nominal=1.0)[left]
            state_weight = self._state_weight(done, state_weight)[left]
            prepared, runs = self._next(prepared, iterate, left), runs[left]
        return result.finish()

    def _next(self, prepared: Prepared, iterate: Iterate, left: NDArray[np.bool_]) -> Prepared:
        """Return what the next pass begins with, of the runs that are left."""
        all_left = bool(np.all(left))
        if self.linearised is Linearised.ONCE:
            same = prepared if all_left else prepared.take(left)
            xi, innovation = iterate.xi[left], iterate.innovation[left]
            return same._replace(iterate=Iterate(xi, innovation, same.iterate.jacobian))
        P = prepared.predicted_cov
        return prepare(iterate, P) if all_left else prepare(iterate.take(left), P[left])

    def _has_settled(
        self, done: Corrected, iterate: Iterate, mean: Array | None, runs: Runs
    ) -> NDArray[np.bool_]:
        if self.stop is StopRule.SIGMAS:
            sigma = done.local_sigma()
            return np.asarray(np.all(np.abs(done.step) <= self.tolerance * sigma, axis=1))
        state = iterate.xi if mean is None else iterate.xi + mean[runs]
        length = np.linalg.norm(done.step, axis=1)
        return np.asarray(length <= self.tolerance * np.linalg.norm(state, axis=1))

    def _state_weight(self, done: Corrected, used: Array) -> Array:
        """Return the weights of the prediction, judged by its nominal covariance."""
        if self.state_kernel is None:
            return used
        t = done.expected_state_square()
        n_states = done.step.shape[1]
        return self.floor.applied_to(self.state_kernel, t, np.full_like(t, n_states))
