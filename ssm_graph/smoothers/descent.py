"""A Gauss-Newton step that does not raise the cost."""

from __future__ import annotations

import numpy as np

from ssm_graph.base.frozen import Array
from ssm_graph.base.stepwise import Steps
from ssm_graph.engine.chain import ChainSolution
from ssm_graph.engine.states import States
from ssm_graph.graph.beam_rows import BeamRows
from ssm_graph.graph.linearize import GraphLinearizer

MAX_HALVINGS = 10
COST_SLACK = 1e-2
"""A rise of the cost by less is rounding: one residual at its sigma costs 0.5."""
MAX_AHEAD = 3
"""Whole steps that may raise the cost, as long as the last one ends below it."""


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

    Where the whole one does, further whole ones come first: a turn by much leaves the tight rows
    between successive keyframes wrong by what the next step mends, and a short way along the first
    one is all that halves of it come to. Returns the states moved to, and their beams.
    """
    n = len(states.p_n)
    for halvings in range(MAX_HALVINGS):
        scale = 0.5**halvings
        moved = states.moved(scale * step.step, scale * step.constants_step)
        yield 0.006 * n
        rows = linearizer.beam_rows(moved)
        yield 0.004 * n
        if linearizer.cost(moved, rows, weights, aid_weights) <= cost + COST_SLACK:
            return moved, rows
        yield 0.005 * n
        if halvings == 0:
            ahead = yield from _ahead_steps(linearizer, states, step, weights, cost, aid_weights)
            if ahead is not None:
                return ahead
    return states, linearizer.beam_rows(states)


def _ahead_steps(
    linearizer: GraphLinearizer,
    states: States,
    step: ChainSolution,
    weights: Array,
    cost: float,
    aid_weights: Array | None,
) -> Steps[tuple[States, BeamRows] | None]:
    """Return where some whole steps lead, turning along what states carry, if that is below."""
    for _ in range(MAX_AHEAD):
        states = states.moved(step.step, step.constants_step, swings=True)
        rows = linearizer.beam_rows(states)
        yield 0.01 * len(states.p_n)
        now = linearizer.cost(states, rows, weights, aid_weights)
        if now <= cost + COST_SLACK:
            return states, rows
        if not np.isfinite(now):
            return None
        step = yield from linearizer.solve_steps(states, rows, weights, aid_weights)
    return None
