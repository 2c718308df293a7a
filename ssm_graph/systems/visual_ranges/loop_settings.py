"""When two key frames are taken for one place."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class LoopSettings:
    """When two key frames are taken for one place."""

    is_on: bool = True
    least_gap: int = 20
    """Key frames between the two."""
    score_share: float = 0.45
    """Of the best score among the neighbours: what a candidate must have."""
    n_candidates: int = 3
    most_bits: int = 55
    """Of 256 that two descriptors of one corner may differ by."""
    ratio: float = 0.9
    """Of the best distance to the second best."""
    least_matches: int = 20
    least_inliers: int = 35
    least_share: float = 0.35
    """Inliers of all matches."""
    agree_alone: int = 3
    """Key frames in a row that have to find the same place, where no range can judge."""
    agree_with_ranges: int = 2
    range_limit_m: float = 0.35
    range_limit_sigmas: float = 4.0
    """Median of the ranges' errors after the loop: below the larger of the two."""
    drift_alone: float = 0.10
    """Share of the path between that the loop may correct, where no range can judge."""
    drift_with_ranges: float = 0.30
    scale_limit: float = 1.5
    """Factor of scale that a loop may correct."""
    rest: int = 5
    """Key frames after a loop before the next."""
