"""The weights of the further aids through the passes of the similarity loop."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from factors.similarity import Kernel, Similarity
from ssm_graph.base.frozen import Array
from ssm_graph.engine.gnc import NEAR_SIGMAS
from ssm_graph.engine.mixing import Mixing
from ssm_graph.engine.states import States
from ssm_graph.graph.aids.weighted import StepLike, WeightedAid, WeightedAids
from ssm_graph.mission.doubts import LOW_WEIGHT, MISFIT, SUSPECT_SHARE, TRUSTED
from ssm_graph.mission.estimate import AidTable


@dataclass(frozen=True, slots=True)
class AidKernel:
    """What the measurements of further aids are weighed by.

    M-estimators and truncation are made for one component and have no place here: a method that
    weighs the beams by one of them weighs the aids by the warm kernel.
    """

    wanted: Kernel
    warm: Kernel
    """Of the first passes."""
    judged_by: Similarity

    @property
    def last(self) -> Kernel:
        """The kernel of the answer."""
        is_similarity = self.wanted.published_with is Similarity.EXPECTED
        return self.wanted if is_similarity else self.warm


class AidWeighing:
    """Weights of M measurements: those used in the pass at hand, and those it led to."""

    def __init__(self, aids: WeightedAids, kernel: AidKernel, first: Array) -> None:
        self.aids, self.used, self.settled = aids, first, first
        self.mahalanobis_sq = np.zeros(len(aids))
        self._kernel, self._now = kernel, kernel.warm
        self._mixing = Mixing()

    def judge(self, states: States, step: StepLike) -> float:
        """Weigh all measurements at the states of a pass; return the largest change."""
        if len(self.aids) == 0:
            return 0.0
        t = self.aids.mahalanobis_sq(states, step, self._kernel.judged_by)
        self.mahalanobis_sq, self.settled = t, self._now.weight(t, dim=self.aids.dim)
        return float(np.max(np.abs(self.settled - self.used)))

    @property
    def may_end(self) -> bool:
        """Whether the kernel in force is the one of the answer."""
        return len(self.aids) == 0 or self._now == self._kernel.last

    def go_on(self, update_sigmas: float) -> None:
        """Take the weights of the next pass, mixed where the answer is near."""
        if len(self.aids) == 0:
            return
        if update_sigmas >= NEAR_SIGMAS:
            self.used = self.settled
            return
        self.used = self._mixing.next_weights(self.used, self.settled)
        if self._now != self._kernel.last:
            self._now, self._mixing = self._kernel.last, Mixing()

    def cost(self, states: States) -> float:
        """Return what the measurements cost with their robust loss in place of their squares."""
        t, kernel, total = self.aids.squares(states), self._kernel.last, 0.0
        for dim in np.unique(self.aids.dim):
            own = t[self.aids.dim == dim]
            loss = kernel.similarity(np.zeros_like(own), dim=dim) - kernel.similarity(own, dim=dim)
            total += float(loss.sum())
        return total

    def table(self, states: States, keyframe_s: Array) -> AidTable | None:
        """Return what became of the measurements; None if there are none."""
        if len(self.aids) == 0:
            return None
        return self.aids.table(
            states,
            keyframe_s=keyframe_s,
            mahalanobis_sq=self.mahalanobis_sq,
            weights=self.settled,
        )

    def doubts(self, states: States) -> list[str]:
        """Say in a sentence each which aid disagrees with the answer."""
        squares = self.aids.squares(states)
        return [
            doubt
            for aid in self.aids.all
            if (doubt := self._doubt(aid, self.aids.of(aid, squares) / aid.dim))
        ]

    def _doubt(self, aid: WeightedAid, mean_sq: Array) -> str:
        weights = self.aids.of(aid, self.settled)
        share = float(np.mean(weights < LOW_WEIGHT)) if len(weights) else 0.0
        if share > SUSPECT_SHARE:
            return (
                f"{100.0 * share:.0f} % of the {len(weights)} {aid.name} measurements contradict "
                f"the answer (weight below {LOW_WEIGHT}): {aid.hint}"
            )
        trusted = mean_sq[weights >= TRUSTED]
        misfit = float(np.mean(trusted)) if len(trusted) else 0.0
        if misfit <= MISFIT:
            return ""
        return (
            f"{aid.name} measurements that count miss the answer by {np.sqrt(misfit):.1f} of their "
            f"own sigmas (rms): their noise is stated too small, or {aid.hint}"
        )
