"""Ranges as further terms of a bundle adjustment, with or without their own unknowns free.

Whitened by each range's sigma; a weight of its own for each, with the posterior variance of the
prediction in it. In a window scale, anchors, biases and clock are held at what all ranges say; over
the whole map they are free.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ssm_graph.systems.visual_ranges.bundle import Array, FurtherRows
from ssm_graph.systems.visual_ranges.range_fit import BIAS_M, CLOCK_S
from ssm_graph.systems.visual_ranges.range_terms import RangeTerms
from ssm_graph.systems.visual_ranges.weights import RangeKernel


@dataclass(frozen=True)
class RangeValues:
    """What ranges depend on beside the path."""

    scale: float
    """metres a map unit"""
    anchors: Array
    """(J, 3) m, map axes"""
    biases: Array
    """(J,) m"""
    clock_s: float = 0.0


@dataclass(frozen=True)
class RangeBundle:
    """Ranges of the key frames of a problem; the change of the values is (log s, a_j, b_j, clock)."""

    terms: RangeTerms
    """their ``key_frame`` counts the problem's poses"""
    values: RangeValues
    kernel: RangeKernel
    is_free: bool
    """Whether the values may change."""

    @property
    def n_extra(self) -> int:
        """Unknowns beside the poses."""
        return 2 + 4 * len(self.values.biases) if self.is_free else 0

    @property
    def prior(self) -> Array:
        """Information (E, E) of biases and clock; places and scale only as much as keeps finite."""
        if not self.is_free:
            return np.zeros((0, 0))
        n = len(self.values.biases)
        return np.diag(
            np.concatenate([[1e-4], np.full(3 * n, 1e-6), np.full(n, BIAS_M**-2), [CLOCK_S**-2]])
        )

    def changed(self, extra: Array) -> RangeValues:
        """Return the values after a change (E,)."""
        if not self.is_free:
            return self.values
        n, v = len(self.values.biases), self.values
        return RangeValues(
            v.scale * float(np.exp(extra[0])),
            v.anchors + extra[1 : 1 + 3 * n].reshape(n, 3),
            v.biases + extra[1 + 3 * n : 1 + 4 * n],
            v.clock_s + float(extra[-1]),
        )

    def rows(self, R_cw: Array, t_cw: Array, extra: Array) -> FurtherRows:
        """Return whitened rows at poses (K, ...) and a change (E,) of the values."""
        v, terms = self.changed(extra), self.terms
        found = terms.linearise(
            R_cw, t_cw, v.scale, anchors=v.anchors, biases=v.biases, clock_s=v.clock_s
        )
        by_extra = np.zeros((len(terms), self.n_extra))
        if self.is_free:
            n, row = len(v.biases), np.arange(len(terms))
            by_extra[:, 0] = found.scale * v.scale
            place = 1 + 3 * terms.anchor[:, None] + np.arange(3)
            by_extra[row[:, None], place] = found.anchor
            by_extra[row, 1 + 3 * n + terms.anchor] = found.bias
            by_extra[:, -1] = found.clock
        white = 1.0 / terms.sigma_m
        return FurtherRows(
            found.error * white, terms.key_frame, found.pose * white[:, None],
            by_extra * white[:, None],
        )  # fmt: skip

    def prior_error(self, extra: Array) -> Array:
        """Return (E,) by how much the values are off the prior's mean."""
        if not self.is_free:
            return np.zeros(0)
        n, v = len(self.values.biases), self.changed(extra)
        return np.concatenate([extra[:1], extra[1 : 1 + 3 * n], v.biases, [v.clock_s]])

    def weights(self, error: Array, variance: Array) -> Array:
        """Return similarity weights (M,) of whitened errors and their predictions' variance."""
        return self.kernel.weight(error, variance, np.ones_like(error))

    def at(self, index: Array, n_poses: int) -> RangeBundle:
        """Return the ranges whose key frames a window holds; ``index`` (K,) is -1 for others."""
        where = index[self.terms.key_frame]
        kept = self.terms.rows(where >= 0)
        assert n_poses > where.max(initial=-1)
        return replace(self, terms=replace(kept, key_frame=where[where >= 0]))
