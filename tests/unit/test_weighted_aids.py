"""Rows of all further aids together."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from factors.similarity import Similarity
from ssm_graph.graph.aids.weighted import Measured, WeightedAid
from ssm_graph.graph.linearize import GraphLinearizer
from ssm_graph.mission.problem import build_problem
from ssm_graph.smoothers.batch import warm_start
from tests.aids_fixture import with_every_aid


def test_the_same_states_are_linearised_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Solution, cost and weights of a pass share the rows; other states have rows of their own."""
    problem = build_problem(with_every_aid().mission)
    linearizer, states = GraphLinearizer(problem), warm_start(problem).states
    n_calls, whitened = 0, WeightedAid.whitened

    def counted(aid: WeightedAid, *at: Any) -> Measured:
        nonlocal n_calls
        n_calls += 1
        return whitened(aid, *at)

    monkeypatch.setattr(WeightedAid, "whitened", counted)
    linearizer.follow(states)
    beams = linearizer.beam_rows(states)
    ones = np.ones(len(beams.error))
    step = linearizer.solve(states, beams, ones)
    linearizer.cost(states, beams, ones)
    linearizer.weighted.mahalanobis_sq(states, step, Similarity.EXPECTED)
    assert n_calls == len(linearizer.weighted.all) == 4
    moved = states.moved(step.step, step.constants_step)
    assert np.any(linearizer.weighted.squares(moved) != linearizer.weighted.squares(states))
