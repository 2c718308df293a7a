"""One mission of a study as every method sees it, made only once in each process."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from ssm_graph.graph.first_values import FirstValues
from ssm_graph.io.mission_folder.folder import read_mission
from ssm_graph.mission.mission import Mission
from ssm_graph.mission.problem import Problem, build_problem, with_dvl
from ssm_graph.mission.start.alignment import align
from ssm_graph.simulation import Grade, SimulatedMission, simulate, with_dvl_errors
from ssm_graph.smoothers.batch import warm_start
from ssm_graph.smoothers.mission import smooth
from ssm_graph.study.cells import Cell, Recording

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
        """The mission of a method that is told the bad readings: they are missing."""
        if self.simulated is None:
            raise TypeError("nobody knows the bad beams of a recorded mission")
        return self.simulated.without_outliers()

    @cached_property
    def oracle_problem(self) -> Problem:
        """The problem of a method that is told the bad readings."""
        assert self.simulated is not None
        return _problem_of(self.simulated, self.oracle_mission, self.problem)

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
    more = (config.gnss, config.realistic)
    key = (cell.scenario, grade.name, cell.duration_s, seed, water, more)
    clean, problem = cache.get(key, make, length_s=cell.duration_s)
    simulated = with_dvl_errors(
        clean,
        outliers=cell.outliers,
        faults=cell.faults_of(seed),
        losses=cell.losses,
        dropout_rate=cell.dropout_rate,
    )
    problem = _problem_of(simulated, simulated.mission, problem)
    return Trial(seed, simulated.mission, problem, simulated)


def _problem_of(simulated: SimulatedMission, mission: Mission, clean: Problem) -> Problem:
    """Return the problem of a mission; where no more than its beams are bad, by the clean one."""
    if simulated.is_bad.keys() == {"dvl"}:
        return with_dvl(clean, mission)
    return build_problem(mission)


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
