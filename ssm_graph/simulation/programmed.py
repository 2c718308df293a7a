"""Faults of DVL beams exactly where they are asked for: sudden ones, slow ones, stuck beams."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum

import numpy as np

from ssm_graph.base.frozen import Array
from ssm_graph.sensors.dvl import N_BEAMS
from ssm_graph.simulation._checks import require, require_beams, require_window
from ssm_graph.simulation.faults import BeamFaults


class FaultShape(Enum):
    """How a programmed fault goes on from its begin."""

    CONSTANT = "a constant offset"
    DRIFT = "an offset that grows evenly from zero to its size at the end"
    COVERED = "a covered transducer: reads low by a share that grows evenly from zero to its size"
    STUCK = "the beam stays at the speed it had at the begin, its noise goes on"


@dataclass(frozen=True, slots=True)
class Fault:
    """A fault of some beams in ``[start_s, end_s)``."""

    beams: tuple[int, ...]
    """Beams from 0."""
    start_s: float
    end_s: float
    offset_m_per_s: float | tuple[float, ...] = 0.0
    """m/s, one for all or one for each of ``beams``; of CONSTANT and DRIFT."""
    shape: FaultShape = FaultShape.CONSTANT
    share: float = 0.0
    """By how much a COVERED beam reads low in the end; 1 reads zero."""

    def __post_init__(self) -> None:
        require_beams("Fault.beams", self.beams, N_BEAMS)
        require_window("Fault", self.start_s, self.end_s)
        size = np.size(self.offset_m_per_s)
        require(
            size in (1, len(self.beams)),
            "Fault.offset_m_per_s",
            expected=f"1 or {len(self.beams)} offsets",
            got=self.offset_m_per_s,
            hint="give one offset for all beams or one for each",
        )
        require(
            self.has_offset or not np.any(self.offset_m_per_s),
            "Fault.offset_m_per_s",
            expected=f"none with {self.shape.name}",
            got=self.offset_m_per_s,
            hint="leave it out",
        )
        is_covered = self.shape is FaultShape.COVERED
        require(
            0.0 < self.share <= 1.0 if is_covered else self.share == 0.0,
            "Fault.share",
            expected="above 0, at most 1, with COVERED alone",
            got=self.share,
            hint="write 30 % as 0.3" if is_covered else "leave it out",
        )

    @property
    def has_offset(self) -> bool:
        """Whether the shape has a size in m/s."""
        return self.shape in (FaultShape.CONSTANT, FaultShape.DRIFT)

    def offset(self, time_s: Array, speed: Array) -> Array:
        """Return what the fault adds (N, n beams), m/s, to ``speed`` (N, n beams).

        The pings at ``time_s`` (N,) are those inside the fault.
        """
        age = ((time_s - self.start_s) / (self.end_s - self.start_s))[:, None]
        if self.shape is FaultShape.COVERED:
            return np.asarray(-self.share * age * speed)
        if self.shape is FaultShape.STUCK:
            return np.asarray(speed[:1] - speed)
        size = np.broadcast_to(self.offset_m_per_s, speed.shape)
        return np.asarray(size * age if self.shape is FaultShape.DRIFT else size)


def add_faults(
    drawn: BeamFaults, faults: Sequence[Fault], time_s: Array, speed: Array
) -> BeamFaults:
    """Return ``drawn`` with programmed faults added to pings of clean ``speed`` (N, 4)."""
    offset, mask = drawn.offset.copy(), drawn.is_outlier.copy()
    for fault in faults:
        inside = np.flatnonzero((fault.start_s <= time_s) & (time_s < fault.end_s))
        where = np.ix_(inside, np.array(fault.beams))
        offset[where] += fault.offset(time_s[inside], speed[where])
        mask[where] = True
    return BeamFaults(offset, mask)
