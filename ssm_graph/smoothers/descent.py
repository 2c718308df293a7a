"""The step of one pass, as far as it lowers the cost."""

from __future__ import annotations

from ssm_graph.base.frozen import Array
from ssm_graph.base.stepwise import Steps
from ssm_graph.engine.chain import ChainSolution
from ssm_graph.engine.states import States
from ssm_graph.graph.beam_rows import BeamRows
from ssm_graph.graph.linearize import GraphLinearizer

MAX_HALVINGS = 10
COST_SLACK = 1e-2
"""A rise of the cost by less is rounding: one residual at its sigma costs 0.5."""


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
