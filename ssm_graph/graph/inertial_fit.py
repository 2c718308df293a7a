"""How well the inertial data fit an answer, measured by what they could still miss.

Of the whitened errors of the inertial factors most is taken up by the states: hardly anything else
sees a keyframe's biases. With the factor ``A_i d_i + A_j d_j = b + noise`` and the posterior
covariance ``P`` of both keyframes its expected square is ``15 - tr(A P A')``; the sum over all
factors is what the chi-square of the inertial data has for degrees of freedom.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ssm_graph.base.frozen import Array
from ssm_graph.engine.error_state import STATE_DIM
from ssm_graph.graph.linearize import Step


class InertialFit(NamedTuple):
    """Sum of squared whitened errors, and what it is if the noise is as stated."""

    chi_sq: float
    dof: float


def inertial_fit(rows: Array, step: Step) -> InertialFit:
    """Return the fit of the inertial rows (K - 1, 15, 31), ``step`` being the one that led there.

    The rows are those at the answer, see :mod:`ssm_graph.graph.inertial_rows`.
    """
    A_i, A_j, b = np.split(rows, [STATE_DIM, 2 * STATE_DIM], axis=2)
    P, n_rows = step.covariance, b.size
    explained = np.sum((A_i @ P[:-1]) * A_i) + np.sum((A_j @ P[1:]) * A_j)
    explained += 2.0 * np.sum((A_i @ step.neighbour_covariance) * A_j)
    return InertialFit(float(np.sum(b**2)), float(n_rows - explained))
