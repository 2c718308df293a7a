"""The weights that the measurements of a keyframe get from what was predicted before them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from factors.similarity import WEIGHT_FLOOR, Kernel, expected_mahalanobis_sq
from ssm_graph.base.frozen import Array
from ssm_graph.base.times import Indices
from ssm_graph.mission.answer import LOW_WEIGHT, TRUSTED

GATE = 5.0
"""Beams further than this many innovation sigmas from the prediction start without weight."""
POOR = 10.0
"""Beam sigmas; a prediction less certain than this does not tell good beams from bad ones."""
MEMORY_PINGS = 3.0
"""What a beam was worth is remembered for about so many pings."""
WEIGHT_ROUNDS = 10


def met_weights(
    innovation: Array, predicted: Array, variance: Array, kernel: Kernel, *, trust: Array
) -> Array:
    """Return the weights of the beams of one ping that meets its prediction.

    A prediction that is much less certain than the beams cannot tell which of them is wrong: any
    three of four agree with it, and with each other. Then those that were wrong before are taken to
    be wrong still, as long as three others are left; any of them may prove right. Where that does
    not help, and no beam agrees with the others, the ping is left out until its neighbours in time
    decide: least squares would lay the fault of one beam upon the velocity.

    Parameters
    ----------
    innovation : (m,) m/s, measured minus predicted.
    predicted : (m, m) covariance of the predicted speeds, (m/s)^2.
    variance : (m,) of the measured ones.
    kernel : turns Mahalanobis distances into weights.
    trust : (m,) what each beam was worth in the pings before, 0 to 1.
    """
    is_poor = bool(np.any(predicted.diagonal() > POOR**2 * variance))
    first: Array | float = 1.0
    if is_poor and np.sum(trust >= TRUSTED) >= 3:
        first = np.where(trust >= TRUSTED, 1.0, WEIGHT_FLOOR)
    weights = settle_weights(innovation, predicted, variance, kernel, first=first)
    is_undecided = is_poor and bool(np.all(weights < LOW_WEIGHT))
    return np.full(len(weights), WEIGHT_FLOOR) if is_undecided else weights


def updated_trust(trust: Array, beam: Indices, weights: Array) -> Array:
    """Return what each beam (B,) is worth after one more ping with weights (m,) of its beams.

    A ping without a beam that agrees says nothing of any of them.
    """
    if np.all(weights < LOW_WEIGHT):
        return trust
    updated = trust.copy()
    updated[beam] += (weights - trust[beam]) / MEMORY_PINGS
    return updated


def settle_weights(
    innovation: Array,
    predicted: Array,
    variance: Array,
    kernel: Kernel,
    *,
    first: Array | float = 1.0,
) -> Array:
    """Return the beams' weights at one ping, beginning with ``first`` of those that pass the gate.

    The posterior of the innovation needs no state: with ``S = H P H' + R / weight`` it has mean
    ``R / weight S^-1 innovation`` and covariance ``H P H' - H P H' S^-1 H P H'``.
    """
    sigma, spread = np.sqrt(variance), predicted.diagonal()
    weights = np.where(innovation**2 < GATE**2 * (spread + variance), first, WEIGHT_FLOOR)
    for _ in range(WEIGHT_ROUNDS):
        S = predicted.copy()
        S.flat[:: len(S) + 1] += variance / weights
        gain = predicted @ np.linalg.inv(S)
        left = innovation - gain @ innovation
        left_variance = spread - (gain * predicted).sum(axis=1)
        t = expected_mahalanobis_sq(left, np.maximum(left_variance, 0.0), sigma=sigma)
        settled = kernel.weight(t)
        if np.abs(settled - weights).max() < 1e-2:
            return settled
        weights = settled
    return weights


def settled_weights(
    innovation: Array, predicted: Array, measurement: NDArray[np.intp], kernel: Kernel
) -> Array:
    """Return the weights (m,) of whitened measurements that meet one prediction together.

    Those beyond the gate begin with none. With ``S = H P H' + 1 / weight`` the posterior of the
    innovation has mean ``innovation - H P H' S^-1 innovation`` and covariance ``H P H' - H P H'
    S^-1 H P H'``.

    Parameters
    ----------
    innovation : (R,) measured minus predicted, in sigmas.
    predicted : (R, R) covariance of what was predicted.
    measurement : (R,) which measurement, 0 to m - 1 in order, a component is of.
    kernel : turns Mahalanobis distances into weights.
    """
    dim, spread = np.bincount(measurement).astype(float), predicted.diagonal()
    is_odd = np.bincount(measurement, weights=innovation**2 >= GATE**2 * (spread + 1.0)) > 0.0
    weights = np.where(is_odd, WEIGHT_FLOOR, 1.0)
    for _ in range(WEIGHT_ROUNDS):
        S = predicted + np.diag(1.0 / weights[measurement])
        gain = np.linalg.solve(S, predicted).T
        left = innovation - gain @ innovation
        left_variance = np.maximum(spread - (gain * predicted).sum(axis=1), 0.0)
        t = np.bincount(measurement, weights=left**2 + left_variance)
        last, weights = weights, kernel.weight(t, dim=dim)
        if np.abs(weights - last).max() < 1e-2:
            break
    return weights
