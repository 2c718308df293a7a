"""Scale and anchors as they are given out, with what became of every range."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum

import numpy as np

from ssm_graph.base.frozen import Array, ReadOnlyArrays
from ssm_graph.systems.visual_ranges.ranges import Indices
from ssm_graph.systems.visual_ranges.start import StartState


class AnchorState(Enum):
    """How far an anchor is known."""

    UNKNOWN = "not placed yet"
    AMBIGUOUS = "other places fit as well, or it is not sharp"
    READY = "known"
    DOUBTFUL = "its last ranges contradict its place: hidden, or moved"


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Anchor(ReadOnlyArrays):
    """An anchor as it stands."""

    name: str
    state: AnchorState
    place_m: Array
    """(3,) map axes, m; NaN while unknown"""
    covariance: Array
    """(3, 3) m^2"""
    bias_m: float
    bias_sigma_m: float
    alternatives_m: Array
    """(n, 3) places that fit as well"""
    n_ranges: int
    nlos_share: float
    """Of its ranges, with a weight below 0.05."""


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class VehicleResult(ReadOnlyArrays):
    """What the vehicle's own sensors tell of the map."""

    down: Array
    """(3,) unit vector, map axes"""
    down_covariance: Array
    """(2, 2) rad^2, across it"""
    depth_m: float
    """Of the map's origin; 0 without a depth sensor."""
    scale: float
    """Metres a map unit by them alone."""
    sigma_log_scale: float
    range_unit: float
    """Unit of the ranges in metres: assumed over true sound speed; NaN without ranges."""
    range_unit_sigma: float
    contradiction: str
    """What speaks against this scale and that of the ranges being one; "" where nothing does."""


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class RangingResult(ReadOnlyArrays):
    """Scale, anchors and what became of every range."""

    state: StartState
    scale: float
    """Metres a map unit; NaN without."""
    sigma_log_scale: float
    clock_s: float
    """Time of a measurement less its stamp."""
    clock_sigma_s: float
    anchors: tuple[Anchor, ...]
    error_m: Array
    """(M,) predicted minus measured, m; NaN where not used"""
    weight: Array
    """(M,) NaN where not used"""
    anchor_of: Indices
    """(M,) index of each range's anchor among `anchors`; one that moved is two"""
    scale_history: Array
    """(H, 3) time s, scale, its relative sigma"""
    reasons: tuple[str, ...]
    """Why scale or anchors are not ready."""
    advice: str
    started_s: float
    """Time at which there was a scale for the first time; NaN before."""
    vehicle: VehicleResult | None = None
    """None where it told no scale."""
    lever_error_m: Array = field(default_factory=lambda: np.zeros(3))
    """(3,) what the stated lever arm is off by, camera axes; zero where it is exact."""

    @property
    def has_scale(self) -> bool:
        """Whether map units can be turned into metres."""
        return self.state.has_scale
