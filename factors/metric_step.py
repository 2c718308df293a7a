"""Motion between two cameras, in metres, from a vehicle's dead reckoning, over a map with a scale.

In bulk for a bundle adjustment, whose poses are world to camera, and as a GTSAM factor between two
similarities of a loop's graph.
"""

from __future__ import annotations

from typing import NamedTuple

import gtsam
import numpy as np

from factors.checks import check_numbers, checked_array
from factors.so3 import Array, left_jacobian_solve, log, skew, times


class MetricStepResidual(NamedTuple):
    """Residuals (N, 3) and Jacobians (N, 3, 6) by ``(rho, phi)`` in ``Exp(rho, phi) T_cw``."""

    step: Array
    """m, along the axes of the first camera, map less dead reckoning"""
    step_D_first: Array
    step_D_second: Array
    step_D_log_scale: Array
    """(N, 3)"""
    turn: Array
    """rad"""
    turn_D_first: Array
    turn_D_second: Array


def metric_step_residual(
    first: tuple[Array, Array],
    second: tuple[Array, Array],
    scale: float,
    *,
    step_m: Array,
    turn: Array,
) -> MetricStepResidual:
    """Return residuals of steps and turns with Jacobians.

    With world to camera ``R_1, t_1`` and ``R_2, t_2``, and ``Q = R_2 R_1'``::

        step = scale (t_1 - Q' t_2) - step_m,    turn = Log(Q turn_measured')

    Parameters
    ----------
    first, second : rotations (N, 3, 3) and translations (N, 3), world to camera, map units.
    scale : metres a map unit.
    step_m : (N, 3) measured, from first to second camera, axes of the first, m.
    turn : (N, 3, 3) measured, first camera to second.
    """
    R_1, t_1 = first
    R_2, t_2 = second
    Q = R_2 @ np.swapaxes(R_1, -1, -2)
    back = np.swapaxes(Q, -1, -2)
    way = scale * (t_1 - times(back, t_2))
    off = log(Q @ np.swapaxes(turn, -1, -2))
    eye, none = np.broadcast_to(np.eye(3), Q.shape), np.zeros_like(Q)
    # Columns of the inverse left Jacobian, by which a turn from the left changes the logarithm.
    solved = np.stack([left_jacobian_solve(off, axis + 0.0 * off) for axis in np.eye(3)], axis=-1)
    return MetricStepResidual(
        step=way - step_m,
        step_D_first=np.concatenate([scale * eye, -skew(way)], axis=-1),
        step_D_second=np.concatenate([-scale * back, none], axis=-1),
        step_D_log_scale=way,
        turn=off,
        turn_D_first=np.concatenate([none, -solved @ Q], axis=-1),
        turn_D_second=np.concatenate([none, solved], axis=-1),
    )


def metric_step_factor(
    keys: tuple[int, int], *, sigma: float, step: Array, weight: float = 1.0
) -> gtsam.CustomFactor:
    """Return the step between two nodes of a graph of similarities ``x -> s (R x + t)``.

    Of a node ``s t`` is the camera's place in the corrected map and ``R`` its axes, so that::

        error = R_1' (s_2 t_2 - s_1 t_1) - step

    Unlike a ``BetweenFactor`` it is in the units of the corrected map, all of which dead reckoning
    knows: it holds the map's scale where the graph would let it drift.

    Parameters
    ----------
    keys : of two ``Similarity3``, camera to map.
    sigma : standard deviation of a coordinate, map units.
    step : (3,) from first to second, axes of the first camera, map units.
    weight : similarity weight; the effective variance is ``sigma^2 / weight``.

    Raises
    ------
    ValueError
        If a number is not finite, or ``sigma`` or ``weight`` is not above zero.
    """
    name = "metric_step_factor"
    check_numbers(name, sigma=sigma, weight=weight)
    measured = checked_array(name, "step", step, (3,))

    def evaluate(
        this: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Array] | None
    ) -> Array:
        first, second = this.keys()
        one, two = values.atSimilarity3(first), values.atSimilarity3(second)
        R_1, R_2 = one.rotation().matrix(), two.rotation().matrix()
        way = R_1.T @ (two.scale() * two.translation() - one.scale() * one.translation())
        if jacobians is not None:
            # S Exp(turn, step, scale) takes the origin to S(step), to first order.
            none = np.zeros((3, 1))
            jacobians[0] = np.hstack([skew(way), -one.scale() * np.eye(3), none])
            jacobians[1] = np.hstack([np.zeros((3, 3)), two.scale() * R_1.T @ R_2, none])
        return np.asarray(way - measured)

    noise = gtsam.noiseModel.Isotropic.Sigma(3, sigma / np.sqrt(weight))
    return gtsam.CustomFactor(noise, [*keys], evaluate)
