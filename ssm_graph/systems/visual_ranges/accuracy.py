"""How far a result is from a true path and true anchors, aligned with and without scale."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ssm_graph.systems.visual_ranges.ranging import RangingResult
from ssm_graph.systems.visual_ranges.result import VisualResult
from ssm_graph.systems.visual_ranges.sequence import PathTruth, Sequence
from ssm_graph.systems.visual_ranges.similarity3 import Sim3, umeyama

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Accuracy:
    """Errors of a result."""

    n_frames: int
    similar_m: float
    """Rms error of the path aligned by rotation, translation and scale, m: it flatters."""
    metric_m: float
    """Rms error of the metric path aligned by rotation and translation, m; NaN without scale."""
    scale_error: float
    """Estimated over true scale, less one; NaN without scale."""
    anchor_m: Array
    """(J,) error of each anchor after the metric alignment, m; NaN where unknown."""
    to_world: Sim3
    """Map units to the world of the truth, with scale."""
    metric_to_world: Sim3 | None
    """Metres of the map to the world of the truth; None without scale."""


def true_places(truth: PathTruth, time_s: Array, longest_s: float = 0.25) -> Array:
    """Return the true places (N, 3) at times (N,), m; NaN outside and in gaps."""
    at = np.clip(np.searchsorted(truth.time_s, time_s), 1, max(len(truth.time_s) - 1, 1))
    found = np.column_stack([np.interp(time_s, truth.time_s, x) for x in truth.position_m.T])
    inside = (time_s >= truth.time_s[0] - 1e-6) & (time_s <= truth.time_s[-1] + 1e-6)
    if len(truth.time_s) > 1:
        inside &= truth.time_s[at] - truth.time_s[at - 1] <= longest_s
    found[~inside] = np.nan
    return found


def accuracy(sequence: Sequence, result: VisualResult) -> Accuracy | None:
    """Return the errors against the sequence's truth; None without one or with too few poses."""
    if sequence.truth is None:
        return None
    true = true_places(sequence.truth, result.time_s)
    place = result.position
    kept = np.isfinite(true).all(axis=1) & np.isfinite(place).all(axis=1)
    if kept.sum() < 10:
        return None
    true, place = true[kept], place[kept]
    similar = umeyama(place, true, with_scale=True)
    error = float(np.sqrt(np.mean(np.sum((similar.apply(place) - true) ** 2, axis=1))))
    ranging: RangingResult | None = result.ranging
    if ranging is None or not ranging.has_scale:
        return Accuracy(int(kept.sum()), error, np.nan, np.nan, np.zeros(0), similar, None)
    metric = umeyama(ranging.scale * place, true, with_scale=False)
    moved = metric.apply(ranging.scale * place)
    metric_m = float(np.sqrt(np.mean(np.sum((moved - true) ** 2, axis=1))))
    anchors = np.full(len(ranging.anchors), np.nan)
    places = sequence.anchor_truth_m
    for j, name in enumerate(sequence.ranges.names):
        if places is not None and j < len(ranging.anchors) and ranging.anchors[j].name == name:
            estimate = metric.apply(ranging.anchors[j].place_m)
            anchors[j] = float(np.linalg.norm(estimate - places[j]))
    ratio = ranging.scale / similar.scale - 1.0
    return Accuracy(int(kept.sum()), error, metric_m, ratio, anchors, similar, metric)
