"""The preintegrated process: prediction of state and covariance, many runs at once."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from factors.inertial import Intervals, predict
from ssm_graph.base.earth import LocalFrame
from ssm_graph.base.frozen import Array
from ssm_graph.engine.states import NavigationStates
from ssm_graph.imu.preintegration import gravity_gradient, gtsam_gravity


class Prediction(NamedTuple):
    """States of B runs at the end of an interval."""

    states: NavigationStates
    transition: Array
    """(B, 15, 15) of the error state."""
    process_cov: Array
    """(B, 15, 15)"""


class Process:
    """Predicts B runs from keyframe to keyframe."""

    def __init__(self, intervals: Sequence[Intervals], frame: LocalFrame) -> None:
        columns = zip(*intervals, strict=True)
        self._intervals = Intervals(*(np.stack(column, axis=1) for column in columns))
        self._frame = frame
        self._gravity_gradient = gravity_gradient(frame)

    def predict(self, k: int, states: NavigationStates) -> Prediction:
        """Predict from keyframe ``k`` to the next."""
        interval = Intervals(*(column[k] for column in self._intervals))
        middle = states.p_n + 0.5 * interval.span_s[:, None] * states.v_n
        g_n = gtsam_gravity(self._frame, middle)
        moved = predict(interval, states, g_n=g_n, gradient=self._gravity_gradient)
        return Prediction(NavigationStates(*moved.state), moved.transition, moved.noise(interval))
