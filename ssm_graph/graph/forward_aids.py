"""Weighted aids in the forward pass: each measurement meets the prediction first, as beams do.

What a prediction and its covariance cannot mean starts without weight; the smoother, which knows
the whole mission, judges it again. Ranges to a beacon whose place is unknown are left to
:mod:`ssm_graph.graph.beacon_start`: their linearisation there would mean nothing.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from factors.similarity import WEIGHT_FLOOR, Kernel
from ssm_graph.base.frozen import Array
from ssm_graph.graph.aids.aid import Aid, RowStates
from ssm_graph.graph.aids.ranges import Ranges
from ssm_graph.graph.beam_weights import GATE, WEIGHT_ROUNDS
from ssm_graph.graph.measurements import Measurements


class Met(NamedTuple):
    """One measurement at the state of its keyframe."""

    number: int
    """Among all of them"""
    innovation: Array
    """(d,) measured minus predicted, whitened"""
    H: Array
    """(d, width)"""


class ForwardAids:
    """The weighted aids of a problem, keyframe by keyframe."""

    def __init__(self, aids: Measurements) -> None:
        self.weights = np.ones(len(aids))
        """(M,) of all measurements, as far as they have been met"""
        self._at: dict[int, list[tuple[Aid, int]]] = {}
        number = 0
        for aid in aids.all:
            is_unknown = ~aid.is_known[aid.beacon] if isinstance(aid, Ranges) else None
            for i, k in enumerate(aid.keyframe.tolist()):
                if is_unknown is None or not is_unknown[i]:
                    self._at.setdefault(k, []).append((aid.take(slice(i, i + 1)), number))
                number += 1

    def at(self, k: int, state: RowStates) -> Iterator[Met]:
        """Yield the measurements of a keyframe, linearised at its state before all of them."""
        for aid, number in self._at.get(k, ()):
            error, jacobian = aid.whitened(state.rows_of_one())
            yield Met(number, -error[0], jacobian[0])

    def weigh(self, met: Met, predicted: Array, kernel: Kernel) -> float:
        """Return the weight of a measurement, and keep it.

        ``predicted`` (d, d) is the covariance of what was predicted, in the measurement's sigmas.
        """
        weight = settled_weight(met.innovation, predicted, kernel)
        self.weights[met.number] = weight
        return weight


def settled_weight(innovation: Array, predicted: Array, kernel: Kernel) -> float:
    """Return the weight of a whitened measurement (d,); none beyond the gate.

    With ``S = H P H' + 1 / weight`` the posterior of the innovation has mean ``S^-1 innovation /
    weight`` and covariance ``S^-1 H P H' / weight``.
    """
    dim = len(innovation)
    if np.any(innovation**2 >= GATE**2 * (predicted.diagonal() + 1.0)):
        return WEIGHT_FLOOR
    weight = 1.0
    for _ in range(WEIGHT_ROUNDS):
        share = np.linalg.inv(np.eye(dim) + weight * predicted)
        left = share @ innovation
        t = float(left @ left + np.trace(share @ predicted))
        last, weight = weight, float(kernel.weight(t, dim=dim))
        if abs(weight - last) < 1e-2:
            break
    return weight
