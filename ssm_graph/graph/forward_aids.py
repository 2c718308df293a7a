"""Weighted aids in the forward pass: those of a keyframe meet the prediction first, as beams do.

They meet it together, for one of them judges the others: met one after the other, a gross one that
an uncertain prediction lets pass would have all later ones refused. What a prediction and its
covariance cannot mean starts without weight; the smoother, which knows the whole mission, judges
again. Ranges to a beacon whose place is unknown are left to :mod:`ssm_graph.graph.beacon_start`:
their linearisation there would mean nothing.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from factors.similarity import WEIGHT_FLOOR, Kernel
from ssm_graph.base.frozen import Array
from ssm_graph.graph.aids.acoustic import RangeAid
from ssm_graph.graph.aids.weighted import WeightedAid, WeightedAids
from ssm_graph.graph.augmented_rows import RowStates
from ssm_graph.graph.beam_weights import GATE, WEIGHT_ROUNDS


class Met(NamedTuple):
    """The measurements of one keyframe, linearised at one state: R components of m of them."""

    numbers: list[int]
    """(m,) among all measurements"""
    measurement: NDArray[np.intp]
    """(R,) which of the m a component is of"""
    innovation: Array
    """(R,) measured minus predicted, whitened"""
    H: Array
    """(R, width)"""


class ForwardAids:
    """The weighted aids of a problem, keyframe by keyframe."""

    def __init__(self, aids: WeightedAids) -> None:
        self.weights = np.ones(len(aids))
        """(M,) of all measurements, as far as they have been met"""
        self._at: dict[int, list[tuple[WeightedAid, int, int]]] = {}
        number = 0
        for aid in aids.all:
            for i, k in enumerate(aid.keyframe.tolist()):
                if not (isinstance(aid, RangeAid) and not aid.is_to_known(i)):
                    self._at.setdefault(k, []).append((aid, i, number))
                number += 1

    def has(self, k: int) -> bool:
        """Return whether a keyframe has measurements to meet."""
        return k in self._at

    def at(self, k: int, state: RowStates) -> Met:
        """Return the measurements of a keyframe that has some, linearised at a state."""
        here = self._at[k]
        errors, jacobians = zip(*(aid.whitened(state, i) for aid, i, _ in here), strict=True)
        return Met(
            numbers=[number for *_, number in here],
            measurement=np.repeat(np.arange(len(here)), [aid.dim for aid, *_ in here]),
            innovation=-np.concatenate(errors),
            H=np.concatenate(jacobians),
        )

    def weigh(self, met: Met, innovation: Array, predicted: Array, kernel: Kernel) -> Array:
        """Return the weights (R,) of the components, and keep those of their measurements.

        ``innovation`` (R,) is that at the prediction, ``predicted`` (R, R) the covariance of what
        was predicted, both in the measurements' sigmas.
        """
        weights = settled_weights(innovation, predicted, met.measurement, kernel)
        self.weights[met.numbers] = weights
        return weights[met.measurement]


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
