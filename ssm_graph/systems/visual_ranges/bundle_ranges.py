"""Ranges as further terms of a bundle adjustment, whitened, with the variables they bring."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ssm_graph.base.frozen import Array
from ssm_graph.systems.visual_ranges.bundle import FurtherRows
from ssm_graph.systems.visual_ranges.range_fit import BIAS_M, CLOCK_S
from ssm_graph.systems.visual_ranges.range_terms import RangeTerms
from ssm_graph.systems.visual_ranges.ranges import Indices
from ssm_graph.systems.visual_ranges.weights import RangeKernel

FREE_LOG_SCALE = 3.0
FREE_ANCHOR_M = 1e3
"""Prior standard deviations of what the ranges have to say themselves."""


@dataclass(frozen=True)
class BundleRanges:
    """Ranges of the key frames of a problem; see :class:`.bundle.FurtherTerms`.

    The variables are log s, clock, then place and bias of each anchor, as changes from now; none
    where all are held.
    """

    terms: RangeTerms
    pose: Indices
    """(M,) index of each range's key frame among the problem's poses"""
    scale: float
    clock_s: float
    anchors: Array
    """(J, 3) m, map axes"""
    biases: Array
    """(J,) m"""
    kernel: RangeKernel
    is_free: bool = False
    """Whether scale, clock, anchors and biases may move."""

    @property
    def n_extra(self) -> int:
        """Number of variables."""
        return 2 + 4 * len(self.anchors) if self.is_free else 0

    @property
    def prior(self) -> Array:
        """(E, E) information of the variables' prior."""
        if not self.is_free:
            return np.zeros((0, 0))
        own = [FREE_ANCHOR_M, FREE_ANCHOR_M, FREE_ANCHOR_M, BIAS_M] * len(self.anchors)
        return np.diag(np.array([FREE_LOG_SCALE, CLOCK_S, *own]) ** -2.0)

    def prior_error(self, extra: Array) -> Array:
        """Return (E,) by how much clock and biases are from zero; the rest has no mean."""
        if not self.is_free:
            return extra
        now = np.zeros(self.n_extra)
        now[1], now[5::4] = self.clock_s + extra[1], self.biases + extra[5::4]
        return now

    def rows(self, R_cw: Array, t_cw: Array, extra: Array) -> FurtherRows:
        """Return whitened rows at poses (K, ...) and a change (E,) of the variables from now."""
        change = extra if self.is_free else np.zeros(2 + 4 * len(self.anchors))
        own = change[2:].reshape(-1, 4)
        s = self.scale * float(np.exp(change[0]))
        terms = self.terms.on(self.pose)
        found = terms.linearise(
            R_cw,
            t_cw,
            s,
            anchors=self.anchors + own[:, :3],
            biases=self.biases + own[:, 3],
            clock_s=self.clock_s + float(change[1]),
        )
        by_extra = np.zeros((len(terms), self.n_extra))
        if self.is_free:
            rows = np.arange(len(terms))[:, None]
            by_extra[:, 0], by_extra[:, 1] = s * found.scale, found.clock
            at = (2 + 4 * terms.anchor)[:, None] + np.arange(4)
            by_extra[rows, at] = np.concatenate([found.anchor, found.bias[:, None]], axis=1)
        white = 1.0 / terms.sigma_m
        return FurtherRows(
            found.error * white,
            self.pose.astype(np.int64),
            found.pose * white[:, None],
            by_extra * white[:, None],
        )

    def weights(self, error: Array, variance: Array) -> Array:
        """Return similarity weights (M,) of whitened errors and their predictions' variance."""
        return self.kernel.weight(error, variance, np.ones_like(error))
