"""The navigation filter: predict with the inertial sensors, correct by one update rule.

Any rule of the literature goes in; the process and the measurements are the same for all, and the
same as the graph's. With :class:`SsmUpdate` and a group for every beam it is the filter of [1]_.

References
----------
.. [1] Xu et al., "Combined navigation robust filtering method based on statistical similarity
   measurement", 2021, steps 5.1 to 5.5.
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import Enum

import numpy as np

from ssm_graph.base.frozen import Array
from ssm_graph.engine.error_state import VELOCITY
from ssm_graph.engine.states import NavigationStates
from ssm_graph.filters.navigation.history import FilterHistory
from ssm_graph.filters.navigation.measurements import KeyframeModel
from ssm_graph.filters.navigation.stack import Stack, stack_problems
from ssm_graph.filters.rules.model import Update, UpdateRule
from ssm_graph.mission.estimate import OnKeyframe
from ssm_graph.mission.problem import Problem
from ssm_graph.sensors.dvl import N_BEAMS

RUNAWAY_SIGMA = 1e4
"""m/s; a filter this uncertain of its velocity has run away."""


class Grouping(Enum):
    """How the beams of a ping share auxiliary parameters."""

    PER_BEAM = "one for every beam"
    PER_PING = "one for the whole ping"

    @property
    def groups(self) -> np.ndarray[tuple[int], np.dtype[np.intp]]:
        """(4,) group of each beam."""
        per_beam = self is Grouping.PER_BEAM
        return np.arange(N_BEAMS) if per_beam else np.zeros(N_BEAMS, dtype=np.intp)


def run_filter(
    problems: Sequence[Problem],
    rule: UpdateRule,
    *,
    grouping: Grouping,
    on_keyframe: OnKeyframe | None = None,
) -> FilterHistory:
    """Filter B runs side by side.

    Parameters
    ----------
    problems : with equal numbers of keyframes, one navigation frame, and the same kinds of aids.
    rule : how a ping corrects the prediction.
    grouping : which beams the rule takes as one measurement.
    on_keyframe : called after each keyframe.
    """
    # A run that overflows is found by what comes of it, and is no reason to warn.
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        return _Filter(stack_problems(problems), rule, grouping).run(on_keyframe)


class _Filter:
    def __init__(self, stack: Stack, rule: UpdateRule, grouping: Grouping) -> None:
        self._stack, self._rule, self._groups = stack, rule, grouping.groups
        self._lost = np.zeros(len(stack.problems), dtype=bool)

    def run(self, on_keyframe: OnKeyframe | None) -> FilterHistory:
        stack = self._stack
        n_keyframes = stack.n_keyframes
        history = FilterHistory.empty(n_keyframes, len(self._lost))
        predicted, covariance = stack.start, stack.start_cov
        states = None
        for k in range(n_keyframes):
            if states is not None:
                prediction = stack.process.predict(k - 1, states)
                predicted, F = prediction.states, prediction.transition
                covariance = F @ covariance @ np.swapaxes(F, 1, 2) + prediction.process_cov
                history.transition[k - 1] = F
            history.predicted.put(k, predicted, covariance)
            states, covariance = self._correct(k, predicted, covariance, states, history)
            states, covariance = self._without_lost(states, covariance)
            history.posterior.put(k, states, covariance)
            history.posterior.lose(k, self._lost)
            if on_keyframe is not None:
                on_keyframe(k + 1, n_keyframes)
        return history

    def _without_lost(
        self, states: NavigationStates, covariance: Array
    ) -> tuple[NavigationStates, Array]:
        """Put runs that have run away back to their start, where they meet no measurement.

        The others go on beside them.
        """
        variance = np.einsum("bii->bi", covariance)
        self._lost |= ~np.all(variance > 0.0, axis=1)
        self._lost |= ~np.all(variance[:, VELOCITY] < RUNAWAY_SIGMA**2, axis=1)
        self._lost |= ~np.all(np.isfinite(states.p_n + states.v_n), axis=1)
        if not np.any(self._lost):
            return states, covariance
        self._stack.silence(self._lost)
        columns = (
            np.where(self._lost.reshape(-1, *(1,) * (own.ndim - 1)), start, own)
            for own, start in zip(states, self._stack.start, strict=True)
        )
        kept = np.where(self._lost[:, None, None], self._stack.start_cov, covariance)
        return NavigationStates(*columns), kept

    def _correct(
        self,
        k: int,
        predicted: NavigationStates,
        covariance: Array,
        before: NavigationStates | None,
        history: FilterHistory,
    ) -> tuple[NavigationStates, Array]:
        model = KeyframeModel(self._stack, k, predicted, beam_groups=self._groups, before=before)
        if not np.any(model.present):
            return predicted, covariance
        update = self._rule(covariance, model)
        self._keep_beams(k, model, update, history)
        return predicted.displaced(update.xi), update.covariance

    def _keep_beams(
        self, k: int, model: KeyframeModel, update: Update, history: FilterHistory
    ) -> None:
        root_information = self._stack.beams.root_information[k]
        present = model.present[:, :N_BEAMS]
        scale = np.where(present, root_information, np.nan)
        history.innovation[k] = model.predicted.innovation[:, :N_BEAMS] / scale
        history.mahalanobis_sq[k] = np.where(present, update.mahalanobis_sq[:, :N_BEAMS], np.nan)
        history.weight[k] = np.where(present, update.weights[:, :N_BEAMS], np.nan)
        history.n_iterations[k] = update.n_iterations
