"""The missions of a study: simulated ones with something wrong with their DVL, or recorded ones."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final

from ssm_graph.simulation import (
    CurrentSettings,
    Fault,
    FaultShape,
    GnssSettings,
    Grade,
    Loss,
    OutlierKind,
    Outliers,
    Sensor,
    SimulationConfig,
    WaterTrack,
    scenario_config,
)

WITHOUT_SIZE: Final = {OutlierKind.NONE, OutlierKind.BLOCKED}
"""Kinds whose offsets are not drawn."""

Label = str | float


@dataclass(frozen=True, slots=True)
class StudyFault:
    """A programmed fault, the same in every trial or on the next beams in each."""

    beams: tuple[int, ...]
    """Beams from 0."""
    start_s: float
    length_s: float
    offset_m_per_s: tuple[float, ...] = (0.0,)
    """m/s, one for all or one for each of ``beams``."""
    is_turned_by_seed: bool = False
    """Whether the seed is added to the beams, modulo their number."""
    shape: FaultShape = FaultShape.CONSTANT
    share: float = 0.0
    """By how much a covered beam reads low in the end; of readings with spikes."""
    n_beams: int = 4
    """Of the scenario's DVL."""
    sensor: Sensor = field(default=Sensor.DVL, repr=False)
    size: tuple[float, ...] = field(default=(), repr=False)
    axes: tuple[int, ...] = field(default=(), repr=False)

    @property
    def further(self) -> object:
        """What its ``repr`` leaves out, None for nothing: ids of old cells stay as they are."""
        further = (self.sensor, self.size, self.axes)
        return None if further == (Sensor.DVL, (), ()) else further

    def of_trial(self, seed: int) -> Fault:
        """Return the fault of one trial."""
        turn = seed if self.is_turned_by_seed else 0
        offsets = self.offset_m_per_s
        return Fault(
            beams=tuple((beam + turn) % self.n_beams for beam in self.beams),
            start_s=self.start_s,
            end_s=self.start_s + self.length_s,
            offset_m_per_s=offsets[0] if len(offsets) == 1 else offsets,
            shape=self.shape,
            share=self.share,
            sensor=self.sensor,
            size=self.size,
            axes=self.axes,
        )


@dataclass(frozen=True, slots=True)
class Cell:
    """Simulated missions of one kind; all that is wrong with their DVL is said here."""

    case: str
    """Name in tables and figures."""
    scenario: str
    """One of :data:`ssm_graph.simulation.SCENARIOS`; its own DVL errors are left out."""
    duration_s: float
    outliers: Outliers = Outliers()
    faults: tuple[StudyFault, ...] = ()
    losses: tuple[Loss, ...] = ()
    dropout_rate: float = 0.0
    current: CurrentSettings | None = field(default=None, repr=False)
    """None for that of the scenario."""
    water_track: WaterTrack | None = field(default=None, repr=False)
    """None for that of the scenario."""
    gnss_windows_s: tuple[tuple[float, float], ...] | None = field(default=None, repr=False)
    """Times with fixes, s; None for those of the scenario."""
    realistic: bool = field(default=False, repr=False)
    """Whether instruments err as real ones of the grade."""

    @property
    def id(self) -> str:
        """Name and digest of the whole definition: runs of another one are never taken for it."""
        water = repr((self.current, self.water_track)) if self.current or self.water_track else ""
        further = [self.gnss_windows_s, self.realistic, *(fault.further for fault in self.faults)]
        more = repr(further) if any(further) else ""
        return f"{self.case}#{digest(repr(self) + water + more)}"

    def clean_config(self, grade: Grade, seed: int) -> SimulationConfig:
        """Return the settings of the run without DVL errors, which all cells have in common.

        A DVL that tracks the water keeps its losses: they decide which pings are off the water.
        """
        config = scenario_config(
            self.scenario,
            grade=grade,
            seed=seed,
            duration_s=self.duration_s,
            outliers=Outliers(),
            faults=(),
            losses=(),
            dropout_rate=0.0,
        )
        water_track = self.water_track or config.water_track
        return replace(
            config,
            current=self.current or config.current,
            water_track=water_track,
            losses=self.losses if water_track else (),
            realistic=self.realistic or config.realistic,
            gnss=config.gnss
            if self.gnss_windows_s is None
            else replace(config.gnss or GnssSettings(), windows=self.gnss_windows_s),
        )

    def faults_of(self, seed: int) -> tuple[Fault, ...]:
        """Return the programmed faults of one trial."""
        return tuple(fault.of_trial(seed) for fault in self.faults)

    def labels(self) -> Mapping[str, Label]:
        """Return what the rows of a table say about the cell; NaN where it does not apply."""
        kind = self.outliers.kind
        low, high = (math.nan, math.nan) if kind in WITHOUT_SIZE else self.outliers.low_high
        return {
            "case": self.case,
            "kind": kind.name.lower(),
            "rate": 0.0 if kind is OutlierKind.NONE else self.outliers.rate,
            "size_low_m_per_s": low,
            "size_high_m_per_s": high,
            "duration_s": self.duration_s,
        }


@dataclass(frozen=True, slots=True)
class Recording:
    """One recorded mission; there is one trial, of seed 0, and no truth about its beams."""

    case: str
    """Name of the folder."""
    folder: Path
    content: str
    """Digest of the folder's files."""
    duration_s: float
    """Of the inertial data."""

    @property
    def id(self) -> str:
        """Name and digest of the content."""
        return f"{self.case}#{self.content}"

    def labels(self) -> Mapping[str, Label]:
        """Return what the rows of a table say about the mission."""
        unknown = dict.fromkeys(("rate", "size_low_m_per_s", "size_high_m_per_s"), math.nan)
        return {"case": self.case, "kind": "", **unknown, "duration_s": self.duration_s}


Source = Cell | Recording


def digest(content: str | bytes) -> str:
    """Return a short digest."""
    data = content.encode() if isinstance(content, str) else content
    return hashlib.sha256(data).hexdigest()[:10]
