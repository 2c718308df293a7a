"""The missions of a study: simulated ones with something wrong with their DVL, or recorded ones.

A trial is one of them as every method sees it, made only once in each process.
"""

from __future__ import annotations

import hashlib
import math
from collections import OrderedDict
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from ssm_graph.graph.first_values import FirstValues
from ssm_graph.io.mission_folder.folder import read_mission
from ssm_graph.mission.mission import Mission
from ssm_graph.mission.problem import Problem, build_problem, with_dvl
from ssm_graph.mission.start.alignment import align
from ssm_graph.simulation import (
    CurrentSettings,
    Fault,
    FaultShape,
    Grade,
    Loss,
    OutlierKind,
    Outliers,
    SimulatedMission,
    SimulationConfig,
    WaterTrack,
    scenario_config,
    simulate,
    with_dvl_errors,
)
from ssm_graph.smoothers.batch import warm_start
from ssm_graph.smoothers.mission import smooth

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
    """By how much a covered beam reads low in the end."""
    n_beams: int = 4
    """Of the scenario's DVL."""

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

    @property
    def id(self) -> str:
        """Name and digest of the whole definition: runs of another one are never taken for it."""
        water = repr((self.current, self.water_track)) if self.current or self.water_track else ""
        return f"{self.case}#{digest(repr(self) + water)}"

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


CACHE_LIMIT_S: Final = 60_000.0
"""Mission time that a process keeps, s: at 20 kB a second with 100 Hz inertial data, 1.2 GB."""
MAX_BLOCK: Final = 100
"""Seeds that a job has at most."""


@dataclass(eq=False)
class Trial:
    """A mission with its problem; methods share both and change neither.

    The gravity of the problem's inertial chain is an exception: every method sets it for its own
    states before it uses it.
    """

    seed: int
    mission: Mission
    """With an initial state."""
    problem: Problem
    simulated: SimulatedMission | None = None
    """None for a recorded mission."""

    @cached_property
    def oracle_mission(self) -> Mission:
        """The mission of a method that is told the bad beams: they are missing."""
        if self.simulated is None:
            raise TypeError("nobody knows the bad beams of a recorded mission")
        return self.simulated.without_outliers()

    @cached_property
    def oracle_problem(self) -> Problem:
        """The problem of a method that is told the bad beams."""
        return with_dvl(self.problem, self.oracle_mission)

    @cached_property
    def warm_start(self) -> FirstValues:
        """Where all smoothers of the problem start."""
        return warm_start(self.problem)

    @property
    def is_outlier(self) -> NDArray[np.bool_] | None:
        """(N, 4) the beams that an outlier or fault acts on; None where nobody knows."""
        return None if self.simulated is None else self.simulated.is_outlier

    @property
    def duration_s(self) -> float:
        """Length of the inertial data, s."""
        return float(self.mission.imu.time_s[-1] - self.mission.imu.start_s)


class MissionCache:
    """Missions used last, up to a total of mission time."""

    def __init__(self, limit_s: float = CACHE_LIMIT_S) -> None:
        self.limit_s = limit_s
        self._kept: OrderedDict[Hashable, tuple[float, Any]] = OrderedDict()

    def get(self, key: Hashable, make: Callable[[], Any], *, length_s: float) -> Any:
        """Return what ``make`` returned for this key, of ``length_s`` of mission time."""
        if key not in self._kept:
            self._make_room(length_s)
            self._kept[key] = (length_s, make())
        self._kept.move_to_end(key)
        return self._kept[key][1]

    def __len__(self) -> int:
        return len(self._kept)

    def _make_room(self, length_s: float) -> None:
        total = sum(length for length, _ in self._kept.values()) + length_s
        while self._kept and total > self.limit_s:
            total -= self._kept.popitem(last=False)[1][0]


CACHE = MissionCache()
"""That of this process."""


def block_size(duration_s: float) -> int:
    """Return how many seeds of missions of this length are worked on together: the cache's fill."""
    return max(1, min(MAX_BLOCK, int(CACHE_LIMIT_S // duration_s)))


def simulated_trials(
    cell: Cell, grade: Grade, seeds: Sequence[int], *, cache: MissionCache = CACHE
) -> list[Trial]:
    """Return the trials of a cell; only their DVL logs are drawn for this cell alone."""
    return [_simulated_trial(cell, grade, seed, cache) for seed in seeds]


def _simulated_trial(cell: Cell, grade: Grade, seed: int, cache: MissionCache) -> Trial:
    config = cell.clean_config(grade, seed)

    def make() -> tuple[SimulatedMission, Problem]:
        simulated = simulate(config)
        return simulated, build_problem(simulated.mission)

    water = (config.current, config.water_track, config.losses)
    key = (cell.scenario, grade.name, cell.duration_s, seed, water)
    clean, problem = cache.get(key, make, length_s=cell.duration_s)
    simulated = with_dvl_errors(
        clean,
        outliers=cell.outliers,
        faults=cell.faults_of(seed),
        losses=cell.losses,
        dropout_rate=cell.dropout_rate,
    )
    return Trial(seed, simulated.mission, with_dvl(problem, simulated.mission), simulated)


def recorded_trial(recording: Recording, *, cache: MissionCache = CACHE) -> Trial:
    """Return the trial of a mission folder, aligned where it has no initial state."""

    def make() -> Trial:
        mission = with_initial(read_mission(recording.folder))
        return Trial(0, mission, build_problem(mission))

    trial: Trial = cache.get(recording, make, length_s=recording.duration_s)
    return trial


def with_initial(mission: Mission) -> Mission:
    """Return the mission with an initial state, the same for all methods.

    Where alignment leaves several headings, the default smoother chooses between them.
    """
    if mission.initial is not None:
        return mission
    alignment = align(mission)
    start, *others = alignment.candidates
    notes = [f"aligned: {alignment.method}"]
    if others:
        estimate = smooth(mission)
        start = estimate.start
        notes.append(
            f"heading at the start chosen by the smoother: {estimate.status.name}, "
            f"{estimate.reason}"
        )
    return replace(mission, initial=start, notes=(*mission.notes, *notes))
