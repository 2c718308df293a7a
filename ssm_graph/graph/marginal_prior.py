"""What marginalised keyframes leave on the oldest one that stays: a square-root prior."""

from __future__ import annotations

from typing import NamedTuple

import gtsam
import numpy as np

from ssm_graph.data import Array
from ssm_graph.problem.error_state import STATE_DIM, InitialMoments
from ssm_graph.problem.trajectory import KeyframeStates


class MarginalPrior(NamedTuple):
    """Half the squared length of ``root_information @ deviation - offset``.

    The deviation is taken at the point where the prior was made, which stays: with its exact
    derivative at the present states the prior is the same function wherever these go. Position
    deviates along the body axes of that point, independent of the rotation, as in any inertial
    filter; GTSAM's chart of a pose would bend it along with the attitude.
    """

    R_nb: Array
    p_n: Array
    v_n: Array
    bias: Array
    root_information: Array
    """(15, 15)"""
    offset: Array
    """(15,)"""

    def whitened(self, states: KeyframeStates) -> Array:
        """Return the whitened error (15,) of the first keyframe of ``states``."""
        return np.asarray(self.root_information @ self._deviation(states) - self.offset)

    def rows(self, states: KeyframeStates) -> Array:
        """Return whitened rows (15, 16) at the first keyframe of ``states``, ``b`` last."""
        deviation = self._deviation(states)
        rows = np.empty((STATE_DIM, STATE_DIM + 1))
        rows[:, :STATE_DIM] = self.root_information
        rows[:, :3] = rows[:, :3] @ gtsam.Rot3.LogmapDerivative(deviation[:3])
        rows[:, 3:6] = rows[:, 3:6] @ self.R_nb.T @ states.R_nb[0]
        rows[:, STATE_DIM] = self.offset - self.root_information @ deviation
        return rows

    def _deviation(self, states: KeyframeStates) -> Array:
        return np.concatenate(
            [
                gtsam.Rot3.Logmap(gtsam.Rot3(self.R_nb.T @ states.R_nb[0])),
                self.R_nb.T @ (states.p_n[0] - self.p_n),
                states.v_n[0] - self.v_n,
                states.bias[0] - self.bias,
            ]
        )


def prior_at_start(start: InitialMoments) -> MarginalPrior:
    """Return the initial state as such a prior."""
    return MarginalPrior(
        R_nb=start.R_nb,
        p_n=start.p_n,
        v_n=start.v_n,
        bias=start.bias,
        root_information=np.linalg.inv(np.linalg.cholesky(start.covariance)),
        offset=np.zeros(STATE_DIM),
    )


def prior_on_last(states: KeyframeStates, root_information: Array, *, step: Array) -> MarginalPrior:
    """Return a prior on the last keyframe: ``step`` (15,) off its state, with that information."""
    return MarginalPrior(
        R_nb=states.R_nb[-1].copy(),
        p_n=states.p_n[-1].copy(),
        v_n=states.v_n[-1].copy(),
        bias=states.bias[-1].copy(),
        root_information=root_information,
        offset=root_information @ step,
    )


def moved_chart(step: Array) -> Array:
    """Return how the local error (15,) after a step follows that before it, (15, 15)."""
    jacobian = np.eye(STATE_DIM)
    jacobian[:3, :3] = gtsam.Rot3.ExpmapDerivative(step[:3])
    jacobian[3:6, 3:6] = gtsam.Rot3.Expmap(step[:3]).matrix().T
    return jacobian
