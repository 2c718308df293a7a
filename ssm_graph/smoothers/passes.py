"""One pass of the batch smoother: the weights that it is made with, and what it came to."""

from __future__ import annotations

from typing import NamedTuple

from ssm_graph.base.frozen import Array
from ssm_graph.engine.chain import ChainSolution
from ssm_graph.engine.reweighting import Lengths, Schedule, TailSchedule
from ssm_graph.engine.states import States
from ssm_graph.graph.beam_rows import BeamRows
from ssm_graph.graph.first_values import FirstValues
from ssm_graph.graph.measurements import Measurements
from ssm_graph.smoothers.faults.watch import FaultWatch
from ssm_graph.smoothers.settings import WARM_KERNEL, SmootherConfig


class Pass(NamedTuple):
    """What one pass came to."""

    states: States
    step: ChainSolution
    beam_rows: BeamRows
    mahalanobis_sq: Array
    """(M,) of the beams"""
    weights: Array
    """(M,) that these lead to"""
    aid_lengths: Lengths
    """(A,) of the measurements of weighted aids"""
    aid_weights: Array
    """(A,)"""
    update_sigmas: float
    weight_change: float


class Weights(NamedTuple):
    """Of one pass, and the schedules that say by which kernels they are judged."""

    beams: Array
    """(M,)"""
    aids: Array
    """(A,)"""
    of_beams: Schedule
    of_aids: TailSchedule

    @classmethod
    def begin(cls, config: SmootherConfig, first: FirstValues, aids: Measurements) -> Weights:
        """Return those of the first pass, after the forward pass."""
        of_beams = config.schedule()
        of_aids = aids.tails(config.kernel, WARM_KERNEL)
        return cls(of_beams.first_weights(first.weights), first.aid_weights, of_beams, of_aids)

    def after(self, last: Pass, faults: FaultWatch) -> Weights:
        """Return those of the pass after ``last``."""
        of_beams, beams = self.of_beams.after(
            self.beams, last.weights, t=last.mahalanobis_sq, update_sigmas=last.update_sigmas
        )
        of_aids, aids = self.of_aids.after(
            self.aids, last.aid_weights, last.aid_lengths, update_sigmas=last.update_sigmas
        )
        return Weights(faults.leave_out(beams), faults.leave_aids_out(aids), of_beams, of_aids)

    def may_end(self, last: Pass) -> bool:
        """Return whether the weights that the pass led to may be those of the answer."""
        of_aids = len(self.aids) == 0 or self.of_aids.may_end(last.aid_lengths, self.aids)
        return of_aids and self.of_beams.may_end(last.weights)
