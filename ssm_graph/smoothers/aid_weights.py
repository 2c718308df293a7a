"""The weights of the further aids through the passes of the similarity loop."""

from __future__ import annotations

import numpy as np

from factors.similarity import Kernel, Similarity
from ssm_graph.base.frozen import Array
from ssm_graph.engine.reweighting import NEAR_SIGMAS, Mixing
from ssm_graph.engine.states import States
from ssm_graph.graph.measurements import JudgedAid, Measurements, StepLike, aid_kernel


class AidWeighing:
    """Weights of M measurements: those used in the pass at hand, and those it led to."""

    def __init__(
        self,
        aids: Measurements,
        first: Array,
        *,
        wanted: Kernel,
        warm: Kernel,
        judged_by: Similarity,
    ) -> None:
        """Begin with weights (M,) and the ``warm`` kernel; end with what ``wanted`` asks for."""
        self.aids, self.used, self.settled = aids, first, first
        self.mahalanobis_sq = np.zeros(len(aids))
        self._last, self._now, self._judged_by = aid_kernel(wanted), warm, judged_by
        self._mixing = Mixing()

    def judge(self, states: States, step: StepLike) -> float:
        """Weigh all measurements at the states of a pass; return the largest change."""
        if len(self.aids) == 0:
            return 0.0
        t = self.aids.mahalanobis_sq(states, step, self._judged_by)
        self.mahalanobis_sq, self.settled = t, self._now.weight(t, dim=self.aids.dim)
        return float(np.max(np.abs(self.settled - self.used)))

    @property
    def may_end(self) -> bool:
        """Whether the kernel in force is the one of the answer."""
        return len(self.aids) == 0 or self._now == self._last

    def go_on(self, update_sigmas: float) -> None:
        """Take the weights of the next pass, mixed where the answer is near."""
        if len(self.aids) == 0:
            return
        if update_sigmas >= NEAR_SIGMAS:
            self.used = self.settled
            return
        self.used = self._mixing.next_weights(self.used, self.settled)
        if self._now != self._last:
            self._now, self._mixing = self._last, Mixing()

    def cost(self, states: States) -> float:
        """Return what the measurements cost with their robust loss in place of their squares."""
        t, kernel, total = self.aids.squares(states), self._last, 0.0
        for dim in np.unique(self.aids.dim):
            own = t[self.aids.dim == dim]
            loss = kernel.similarity(np.zeros_like(own), dim=dim) - kernel.similarity(own, dim=dim)
            total += float(loss.sum())
        return total

    def judged(self, states: States, keyframe_s: Array) -> list[JudgedAid]:
        """Return what became of the measurements at final states."""
        return self.aids.judged(states, keyframe_s, self.mahalanobis_sq, self.settled)
