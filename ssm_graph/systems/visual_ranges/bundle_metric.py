"""Ranges and what the vehicle says as the further terms of one bundle adjustment.

Both have a scale of their own, the ranges in units of their own (of the sound speed), dead
reckoning in those of its DVL; a prior says how far apart they may be.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ssm_graph.base.frozen import Array
from ssm_graph.systems.visual_ranges.bundle import FurtherRows
from ssm_graph.systems.visual_ranges.bundle_ranges import BundleRanges
from ssm_graph.systems.visual_ranges.vehicle_terms import FREE, MetricState, VehicleTerms

Indices = NDArray[np.int64]


@dataclass(frozen=True)
class BundleMetric:
    """Terms of a problem; see :class:`.bundle.FurtherTerms`.

    The variables are those of the ranges, then log s, two of the vertical and the depth of the
    origin; none where all are held.
    """

    ranges: BundleRanges | None
    terms: VehicleTerms
    """On the problem's poses"""
    state: MetricState
    link: float
    """Standard deviation of the logarithm of both scales' ratio."""
    is_free: bool = False

    @property
    def n_ranges(self) -> int:
        """Variables of the ranges."""
        return 0 if self.ranges is None else self.ranges.n_extra

    @property
    def n_extra(self) -> int:
        """Number of variables."""
        return self.n_ranges + (len(FREE) if self.is_free else 0)

    @property
    def prior(self) -> Array:
        """(E, E) information of the variables' prior."""
        made, own = np.zeros((self.n_extra, self.n_extra)), self.n_ranges
        if self.ranges is not None:
            made[:own, :own] = self.ranges.prior
        if self.is_free:
            made[own:, own:] = np.diag(FREE**-2.0)
            if own:
                both = np.ix_([0, own], [0, own])
                made[both] += np.array([[1.0, -1.0], [-1.0, 1.0]]) / self.link**2
        return made

    def prior_error(self, extra: Array) -> Array:
        """Return (E,) by how much the changed variables are off their prior's mean."""
        own = self.n_ranges
        now = extra.copy()
        if self.ranges is not None:
            now[:own] = self.ranges.prior_error(extra[:own])
            if self.is_free and own:
                now[own] += self.state.log_scale - float(np.log(self.ranges.scale))
        return now

    def rows(self, R_cw: Array, t_cw: Array, extra: Array) -> FurtherRows:
        """Return whitened rows at poses (K, ...) and a change (E,) of the variables from now."""
        own = self.n_ranges
        state = self.state.moved(extra[own:]) if self.is_free else self.state
        added = self.terms.rows(R_cw, t_cw, state)
        by_extra = np.zeros((len(added.error), self.n_extra))
        if self.is_free:
            by_extra[:, own:] = added.by_extra
        if self.ranges is None:
            return FurtherRows(
                added.error, added.first, added.by_first, by_extra, added.second, added.by_second
            )
        first = self.ranges.rows(R_cw, t_cw, extra[:own])
        wider = np.zeros((len(first.error), self.n_extra))
        wider[:, :own] = first.by_extra
        return FurtherRows(
            np.concatenate([first.error, added.error]),
            np.concatenate([first.pose, added.first]),
            np.concatenate([first.by_pose, added.by_first]),
            np.concatenate([wider, by_extra]),
            np.concatenate([np.full(len(first.error), -1), added.second]),
            np.concatenate([np.zeros_like(first.by_pose), added.by_second]),
        )

    def weights(self, error: Array, variance: Array) -> Array:
        """Return similarity weights (M,) of whitened errors and their predictions' variance."""
        n = len(error) - len(self.terms)
        own = self.terms.weights(error[n:], variance[n:])
        if self.ranges is None:
            return own
        return np.concatenate([self.ranges.weights(error[:n], variance[:n]), own])
