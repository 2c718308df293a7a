"""Ranges in a run: hung on key frames as they come, the start of the scale, and what all say since.

In a window scale and anchors are held; they follow from all ranges so far at their present places,
so that the past is kept instead of forgotten.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ssm_graph.systems.visual_ranges.bundle import Adjusted, Problem
from ssm_graph.systems.visual_ranges.mapping import Window
from ssm_graph.systems.visual_ranges.range_bundle import RangeBundle, RangeValues
from ssm_graph.systems.visual_ranges.range_fit import (
    Solution,
    places_of,
    problem_of,
    solution,
    unknowns_of,
)
from ssm_graph.systems.visual_ranges.range_terms import FramePoses, RangeTerms, hang
from ssm_graph.systems.visual_ranges.ranges import Ranges
from ssm_graph.systems.visual_ranges.start import Start, StartRules, find_start
from ssm_graph.systems.visual_ranges.visual_map import VisualMap

Array = NDArray[np.float64]

_RETRY_S: Final = 1.0
_MOST_ROWS: Final = 1500


class Ranging:
    """What the ranges of a run have told so far."""

    def __init__(self, ranges: Ranges, lever_arm_m: Array, rules: StartRules) -> None:
        self._ranges, self._lever, self._rules = ranges, lever_arm_m, rules
        self.terms: RangeTerms | None = None
        self.start: Start | None = None
        self.values: RangeValues | None = None
        self.solution: Solution | None = None
        self.started_s: float | None = None
        self.weight = np.full(len(ranges), np.nan)
        self.error_m = np.full(len(ranges), np.nan)
        self._tried_s = -np.inf

    def renew(self, frames: FramePoses, world: VisualMap, *, is_last: bool = False) -> bool:
        """Hang all ranges so far anew and ask them; return whether the scale has just started."""
        now = float(frames.time_s[-1])
        ranges = self._ranges.rows(self._ranges.time_s <= now)
        if not len(ranges):
            return False
        R, t = world.frames["R_cw"], world.frames["t_cw"]
        self.terms = hang(ranges, frames, R, t, lever_arm_m=self._lever)
        if self.values is not None:
            self._refresh(world)
            return False
        if now - self._tried_s < _RETRY_S and not is_last:
            return False
        self._tried_s = now
        places = places_of(self.terms, R, t, self._ranges.time_s)
        self.start = find_start(places, self._ranges.names, self._rules)
        if not self.start.has_scale:
            return False
        self._take(self.start.solution)
        self.started_s = now
        return True

    def _take(self, found: Solution | None) -> None:
        assert found is not None
        self.solution = found
        self.values = RangeValues(found.scale, found.anchors, found.biases, found.clock_s)

    def _refresh(self, world: VisualMap) -> None:
        """Scale, anchors, biases and clock from all ranges at their present places."""
        assert self.terms is not None and self.values is not None
        step = max(1, len(self.terms) // _MOST_ROWS)
        terms = self.terms.rows(np.arange(len(self.terms) - 1, -1, -step)[::-1])
        R, t = world.frames["R_cw"], world.frames["t_cw"]
        places = places_of(terms, R, t, self._ranges.time_s)
        problem = problem_of(
            places, len(self._ranges.names), self._rules.kernel,
            drift=self._rules.drift, bias_walk_m=self._rules.bias_walk_m,
        )  # fmt: skip
        v = self.values
        start = unknowns_of(problem, v.scale, v.anchors, v.biases, v.clock_s)
        self._take(solution(problem, start, rounds=5))

    def joined(self, problem: Problem, window: Window, n_frames: int, *, is_free: bool) -> Problem:
        """Return an adjustment with the ranges of its key frames in it."""
        if self.values is None or self.terms is None:
            return problem
        index = np.full(n_frames, -1)
        index[window.frames] = np.arange(len(window.frames))
        bundle = RangeBundle(self.terms, self.values, self._rules.kernel, is_free)
        return replace(problem, further=bundle.at(index, len(window.frames)))

    def take(self, problem: Problem, found: Adjusted) -> None:
        """Take scale, anchors, biases and clock from an adjustment in which they were free."""
        bundle = problem.further
        if not isinstance(bundle, RangeBundle):
            return
        self.values = bundle.changed(found.extra)
        rows = bundle.terms.row
        self.weight[rows] = found.further_weight
        error = bundle.rows(found.R_cw, found.t_cw, found.extra).error
        self.error_m[rows] = error * bundle.terms.sigma_m
