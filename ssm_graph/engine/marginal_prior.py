"""What marginalised keyframes leave on the oldest one that stays: a square-root prior."""

from __future__ import annotations

from typing import NamedTuple

import gtsam
import numpy as np

from ssm_graph.base.frozen import Array
from ssm_graph.engine.error_state import InitialMoments
from ssm_graph.engine.states import States


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
    extra: Array
    """(E,) of extra variables that are carried in the state"""
    root_information: Array
    """(n, n) with n = 15 + E"""
    offset: Array
    """(n,)"""

    def whitened(self, states: States) -> Array:
        """Return the whitened error (n,) of the first keyframe of ``states``."""
        return np.asarray(self.root_information @ self._deviation(states) - self.offset)

    def rows(self, states: States) -> Array:
        """Return whitened rows (n, n + 1) at the first keyframe of ``states``, ``b`` last."""
        deviation = self._deviation(states)
        n = len(deviation)
        rows = np.empty((n, n + 1))
        rows[:, :n] = self.root_information
        rows[:, :3] = rows[:, :3] @ gtsam.Rot3.LogmapDerivative(deviation[:3])
        rows[:, 3:6] = rows[:, 3:6] @ self.R_nb.T @ states.R_nb[0]
        rows[:, n] = self.offset - self.root_information @ deviation
        return rows

    def _deviation(self, states: States) -> Array:
        return np.concatenate(
            [
                gtsam.Rot3.Logmap(gtsam.Rot3(self.R_nb.T @ states.R_nb[0])),
                self.R_nb.T @ (states.p_n[0] - self.p_n),
                states.v_n[0] - self.v_n,
                states.bias[0] - self.bias,
                states.walks[0] - self.extra,
            ]
        )


def prior_at_start(start: InitialMoments) -> MarginalPrior:
    """Return the initial state as such a prior."""
    return MarginalPrior(
        R_nb=start.R_nb,
        p_n=start.p_n,
        v_n=start.v_n,
        bias=start.bias,
        extra=start.extra,
        root_information=np.linalg.inv(np.linalg.cholesky(start.covariance)),
        offset=np.zeros(len(start.covariance)),
    )


def prior_on(state: States, root_information: Array, *, offset: Array) -> MarginalPrior:
    """Return a prior on a keyframe at its state (1, ...) that is linearised there."""
    R_nb, p_n, v_n, bias, extra = (column[0].copy() for column in state[:5])
    return MarginalPrior(R_nb, p_n, v_n, bias, extra, root_information, offset)


def moved_chart(step: Array) -> Array:
    """Return how the local error (n,) after a step follows that before it, (n, n)."""
    jacobian = np.eye(len(step))
    jacobian[:3, :3] = gtsam.Rot3.ExpmapDerivative(step[:3])
    jacobian[3:6, 3:6] = gtsam.Rot3.Expmap(step[:3]).matrix().T
    return jacobian
