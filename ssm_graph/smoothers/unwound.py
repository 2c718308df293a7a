"""Whole circles that an answer turns where the inertial data saw nothing.

The heading before and after a stretch without inertial data is known modulo a circle alone. What
meets the beams there one after the other may go round the wrong way, and no step of Gauss-Newton
leads back from there.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from factors import so3
from ssm_graph.base.frozen import Array
from ssm_graph.base.runs import runs_of
from ssm_graph.base.stepwise import Steps
from ssm_graph.engine.reweighting import NEAR_SIGMAS
from ssm_graph.engine.states import States
from ssm_graph.graph.linearize import GraphLinearizer
from ssm_graph.imu.preintegration import Unseen
from ssm_graph.smoothers.descent import descend_steps

MOST_PASSES: Final = 12
"""Of Gauss-Newton from where the vehicle turns the shorter way."""


def unwound_steps(
    linearizer: GraphLinearizer, states: States, weights: Array, aid_weights: Array
) -> Steps[States]:
    """Return the states, or those that turn the shorter way, where these cost less.

    Both are judged by the same weights (M,) of the beams, and (A,) of the aids.
    """
    tried = shorter(states, linearizer.problem.chain.unseen, linearizer.problem.keyframe_s)
    if tried is states:
        return states
    linearizer.follow(tried)
    rows = linearizer.beam_rows(tried)
    for _ in range(MOST_PASSES):
        step = yield from linearizer.solve_steps(tried, rows, weights, aid_weights)
        cost = linearizer.cost(tried, rows, weights, aid_weights)
        tried, rows = yield from descend_steps(
            linearizer, tried, step, weights, cost, aid_weights=aid_weights
        )
        if np.max(np.abs(step.step.ravel()) / step.sigma[: step.step.size]) < NEAR_SIGMAS:
            break
    now, before = (
        linearizer.cost(one, linearizer.beam_rows(one), weights, aid_weights)
        for one in (tried, states)
    )
    return tried if now < before else states


def shorter(states: States, unseen: Sequence[Unseen], keyframe_s: Array) -> States:
    """Return the states with every turn of more than half a circle that nobody saw made shorter.

    The body's velocities stay as they are, and what follows goes on from where that leads.
    """
    turns = so3.log(states.R_nb[:-1].mT @ states.R_nb[1:])
    is_unseen = np.array([bool(one.gap_s and one.rate[2]) for one in unseen], bool)
    for begin, end in runs_of(is_unseen):
        if abs(float(turns[begin:end, 2].sum())) <= np.pi:
            continue
        R_begin = states.R_nb[begin]
        whole = so3.log((R_begin.T @ states.R_nb[end])[None])
        share = (keyframe_s[begin : end + 1] - keyframe_s[begin]) / np.ptp(keyframe_s[[begin, end]])
        R_nb, v_n = states.R_nb.copy(), states.v_n.copy()
        R_nb[begin : end + 1] = R_begin @ so3.exp(share[:, None] * whole)
        turned = R_nb @ states.R_nb.mT
        v_n = np.einsum("kij,kj->ki", turned, states.v_n)
        more = 0.5 * (v_n - states.v_n)
        step = (more[:-1] + more[1:]) * np.diff(keyframe_s)[:, None]
        p_n = states.p_n + np.concatenate([np.zeros((1, 3)), np.cumsum(step, axis=0)])
        states = states._replace(R_nb=R_nb, v_n=v_n, p_n=p_n)
    return states
