"""One pass of the similarity loop, and what a loop ended with."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

from ssm_graph.base.frozen import Array
from ssm_graph.base.stepwise import Steps
from ssm_graph.engine.chain import ChainSolution
from ssm_graph.engine.states import States
from ssm_graph.graph.beam_rows import BeamRows
from ssm_graph.graph.first_values import FirstValues
from ssm_graph.graph.inertial_rows import inertial_fit
from ssm_graph.graph.linearize import GraphLinearizer
from ssm_graph.mission.estimate import Iteration, NoiseFound, Status
from ssm_graph.smoothers.aid_weights import AidWeighing
from ssm_graph.smoothers.noise import noise_found

MAX_HALVINGS = 10
COST_SLACK = 1e-2
"""A rise of the cost by less is rounding: one residual at its sigma costs 0.5."""


class Pass(NamedTuple):
    """State of the loop after one iteration."""

    states: States
    step: ChainSolution
    beam_rows: BeamRows
    mahalanobis_sq: Array
    weights: Array
    update_sigmas: float
    weight_change: float


class Solved(NamedTuple):
    """How a solution ended."""

    linearizer: GraphLinearizer
    last: Pass
    iterations: tuple[Iteration, ...]
    status: Status
    notes: tuple[str, ...]
    first: FirstValues
    aids: AidWeighing

    def again(self) -> FirstValues:
        """Return where another solution may start."""
        return replace(
            self.first,
            states=self.last.states,
            weights=self.last.weights,
            aid_weights=self.aids.settled,
        )


def noise_of_steps(solved: Solved, used: Array) -> Steps[NoiseFound]:
    """Return what a solution says of the noise; ``used`` (B,) are its sigmas over the stated."""
    linearizer, last = solved.linearizer, solved.last
    inertial = linearizer.inertial_rows(last.states)
    fit = inertial_fit(inertial, last.step)
    yield 0.005 * len(inertial)
    return noise_found(
        linearizer.problem,
        error=last.beam_rows.error,
        variance=last.step.variance(linearizer.problem.beams.keyframe, last.beam_rows.jacobian),
        weights=last.weights,
        inertial=fit,
        used=used,
    )


def descend_steps(
    linearizer: GraphLinearizer,
    states: States,
    step: ChainSolution,
    weights: Array,
    cost: float,
    *,
    aid_weights: Array | None = None,
) -> Steps[tuple[States, BeamRows]]:
    """Take the Gauss-Newton step, halved while it raises the cost at these weights.

    Returns the states moved to, and their beams.
    """
    for halvings in range(MAX_HALVINGS):
        scale = 0.5**halvings
        moved = states.moved(scale * step.step, scale * step.constants_step)
        yield 0.006 * len(moved.p_n)
        rows = linearizer.beam_rows(moved)
        yield 0.004 * len(moved.p_n)
        if linearizer.cost(moved, rows, weights, aid_weights) <= cost + COST_SLACK:
            return moved, rows
        yield 0.005 * len(moved.p_n)
    return states, linearizer.beam_rows(states)
