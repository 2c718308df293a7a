"""What the smoother found of the current, as part of its answer."""

from __future__ import annotations

import numpy as np

from ssm_graph.estimate import CurrentTrack
from ssm_graph.graph.linearize import Step
from ssm_graph.graph.states import States
from ssm_graph.problem.current import CURRENT, CURRENT_UP
from ssm_graph.problem.error_state import STATE_DIM
from ssm_graph.problem.problem import Problem


def current_of(problem: Problem, states: States, step: Step) -> CurrentTrack | None:
    """Return the current of an answer with its covariance, None if the problem has none."""
    extras, n = problem.extras, problem.n_keyframes
    if CURRENT not in extras:
        return None
    velocity, covariance = np.zeros((n, 3)), np.zeros((n, 3, 3))
    known = [*_columns(problem, CURRENT), *_columns(problem, CURRENT_UP)]
    within = step.solution.covariance_of(slice(STATE_DIM, extras.state_dim))
    for i, a in enumerate(known):
        velocity[:, i] = states.walks[:, a]
        for j, b in enumerate(known):
            covariance[:, i, j] = within[:, a, b]
    return CurrentTrack(problem.keyframe_s, velocity, covariance)


def _columns(problem: Problem, name: str) -> range:
    """Return the walks of a variable, none for one that there is not."""
    if name not in problem.extras:
        return range(0)
    columns = problem.extras.columns(name)
    return range(columns.start - STATE_DIM, columns.stop - STATE_DIM)
