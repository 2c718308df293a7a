"""How well the inertial data fit an answer, measured by what they could still miss.

Of the whitened errors of the inertial factors most is taken up by the states: hardly anything else
sees a keyframe's biases. With the factor ``A_i d_i + A_j d_j = b + noise`` and the posterior
covariance ``P`` of both keyframes its expected square is ``15 - tr(A P A')``; the sum over all
factors is what the chi-square of the inertial data has for degrees of freedom.
"""

from __future__ import annotations

from typing import NamedTuple

import gtsam
import numpy as np

from ssm_graph.data import Array
from ssm_graph.graph.interfaces import Step
from ssm_graph.problem.error_state import STATE_DIM

# Columns of GTSAM's inertial factor, x_i v_i x_j v_j b_i b_j, as pairs of error states.
BEGIN, END = np.r_[0:9, 18:24], np.r_[9:18, 24:30]


class InertialFit(NamedTuple):
    """Sum of squared whitened errors, and what it is if the noise is as stated."""

    chi_sq: float
    dof: float


def inertial_rows(inertial: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> Array:
    """Return the whitened rows (K - 1, 15, 31) in GTSAM's order of columns, ``b`` last."""
    linear = inertial.linearize(values)
    rows = np.empty((linear.size(), STATE_DIM, 2 * STATE_DIM + 1))
    for k in range(len(rows)):
        rows[k] = linear.at(k).augmentedJacobian()
    return rows


def inertial_fit(
    inertial: gtsam.NonlinearFactorGraph, values: gtsam.Values, step: Step
) -> InertialFit:
    """Return the fit of the inertial data at the answer, ``step`` being the one that led there."""
    rows = inertial_rows(inertial, values)
    A_i, A_j, P, n_rows = rows[:, :, BEGIN], rows[:, :, END], step.covariance, rows[:, :, -1].size
    explained = np.sum((A_i @ P[:-1]) * A_i) + np.sum((A_j @ P[1:]) * A_j)
    explained += 2.0 * np.sum((A_i @ step.neighbour_covariance) * A_j)
    return InertialFit(float(np.sum(rows[:, :, -1] ** 2)), float(n_rows - explained))
