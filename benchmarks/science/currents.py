"""What pings off the water are worth where bottom lock is lost for 20 minutes in a current.

``python -m benchmarks.science.currents --keep`` (about an hour on one core; a quick look is
``--missions 2``).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from benchmarks.missions import survey
from benchmarks.report import Option, Report, mean_text, note, ratio_text, rms, table
from ssm_graph import Estimate, Mission, Problem, SsmSmoother, Status, build_problem, evaluate
from ssm_graph.base.frozen import Array
from ssm_graph.evaluation.statistics import chi2_interval
from ssm_graph.mission.calibration import CURRENTS as CURRENT_VARIABLES
from ssm_graph.mission.problem import with_dvl
from ssm_graph.simulation import (
    CurrentSettings,
    Grade,
    Loss,
    SimulatedMission,
    WaterTrack,
    with_dvl_errors,
)

CURRENTS = {
    "random": CurrentSettings(sigma=0.5 / np.sqrt(2.0), vertical_sigma=0.01),
    "tide": CurrentSettings(tide=0.5, vertical_sigma=0.01),
}
"""Both of 0.5 m/s; the first is just what the mission states, the second changes less than that."""
GROUND, KNOWN = "ground alone", "current known"
WATER = {
    "1 beam": WaterTrack(beams=(0,)),
    "2 beams": WaterTrack(beams=(0, 1)),
    "3 beams": WaterTrack(beams=(0, 1, 2)),
    "4 beams": WaterTrack(),
    "4 beams, 10 %": WaterTrack(every=10),
}
"""What the water returns; 10 % of the pings in bottom lock are off the water too in the last."""
MISSIONS = (
    ("random", True, (GROUND, *WATER, KNOWN)),
    ("random", False, (GROUND, "4 beams", KNOWN)),
    ("tide", True, ("4 beams",)),
)
"""Current, whether bottom lock comes back, and what is compared."""


class Row(NamedTuple):
    """One mission as one method saw it."""

    grade: str
    mission: str
    method: str
    seed: int
    horizontal: float
    """rms of the whole mission, m"""
    velocity: float
    """rms within the loss, m/s"""
    nees_position: float
    """at the last keyframe, over 3"""
    current: float
    """rms of each level component within the loss, m/s; NaN where it is not estimated"""
    nees_current: float
    """in the middle of the loss, over 2"""
    status: str


class Times(NamedTuple):
    """Of a mission, s."""

    loss_s: float

    @property
    def lock_s(self) -> float:
        """Of bottom lock before the loss, and after it where there is an after."""
        return 0.25 * self.loss_s

    @property
    def end_s(self) -> float:
        """Of the loss."""
        return self.lock_s + self.loss_s

    def mission_of(self, sim: SimulatedMission, method: str) -> tuple[SimulatedMission, Mission]:
        """Return the run with the loss, and the mission that a method is given."""
        track = WATER.get(method, WaterTrack())
        other = replace(sim, config=replace(sim.config, water_track=track))
        losses = (Loss(self.lock_s, self.end_s),)
        sim = with_dvl_errors(other, outliers=sim.config.outliers, losses=losses)
        if method == KNOWN:
            return sim, sim.with_known_current()
        if method == GROUND:
            return sim, replace(sim.mission, dvl=sim.mission.dvl.of_ground())
        return sim, sim.mission


def run(
    sim: SimulatedMission, problem: Problem, times: Times, labels: tuple[str, str, str, int]
) -> Row:
    """Smooth one mission by one method, and judge it; ``problem`` has the inertial data."""
    sim, mission = times.mission_of(sim, labels[2])
    if mission.dvl.water_track is None:
        problem = replace(problem, extras=problem.extras.without(CURRENT_VARIABLES))
    estimate = SsmSmoother().solve(with_dvl(problem, mission))
    trajectory = estimate.trajectory
    metrics = evaluate(trajectory, sim.truth_at(trajectory.time_s))
    lost = (trajectory.time_s >= times.lock_s) & (trajectory.time_s < times.end_s)
    return Row(
        *labels,
        metrics.rmse_horizontal_m,
        rms(np.linalg.norm(metrics.errors.velocity_enu[lost], axis=1)),
        float(metrics.errors.nees_position[-1]) / 3.0,
        *current_of(estimate, sim, lost),
        estimate.status.name,
    )


def current_of(
    estimate: Estimate, sim: SimulatedMission, lost: np.ndarray[tuple[int], np.dtype[np.bool_]]
) -> tuple[float, float]:
    """Return rms within the loss and NEES in its middle of the level current, NaN without one."""
    found = estimate.current
    if found is None:
        return np.nan, np.nan
    error = (found.velocity_enu - sim.current.at(found.time_s))[:, :2]
    k = int(np.searchsorted(found.time_s, np.mean(found.time_s[lost])))
    nees = error[k] @ np.linalg.solve(found.covariance_enu[k, :2, :2], error[k]) / 2.0
    return rms(error[lost]), float(nees)


def runs(grades: Sequence[Grade], seeds: Sequence[int], times: Times) -> Iterator[Row]:
    """Yield all rows; methods of one mission share its run."""
    for grade in grades:
        for current, comes_back, methods in MISSIONS:
            end_s = times.end_s + (times.lock_s if comes_back else 0.0)
            for seed in seeds:
                flow = CURRENTS[current]
                sim = survey(end_s, grade, seed=seed, current=flow, water_track=WaterTrack())
                problem = build_problem(times.mission_of(sim, "4 beams")[1])
                name = f"{current}, {'lock regained' if comes_back else 'lost for good'}"
                for method in methods:
                    yield run(sim, problem, times, (grade.name.lower(), name, method, seed))


def report(rows: Sequence[Row]) -> list[str]:
    """Return one table for every grade and mission."""
    lines = []
    for grade, mission in dict.fromkeys((row.grade, row.mission) for row in rows):
        some = [row for row in rows if (row.grade, row.mission) == (grade, mission)]
        ground = [row for row in rows if row.grade == grade and row.method == GROUND]
        ground = [row for row in ground if row.mission.endswith(mission.partition(", ")[2])]
        methods = dict.fromkeys(row.method for row in some)
        cells = [_cells([row for row in some if row.method == m], ground) for m in methods]
        lines += [f"## {grade}, {mission}", "", *table(HEADER, cells), ""]
    return lines


HEADER = ["method", "runs", "horizontal rms, m", "ratio to ground alone"]
HEADER += ["velocity rms in the loss, mm/s", "ratio", "NEES/3 position"]
HEADER += ["current rms in the loss, mm/s", "NEES/2 current", "status"]


def _cells(rows: Sequence[Row], ground: Sequence[Row]) -> list[str]:
    good = sum(row.status == Status.CONVERGED.name for row in rows)
    return [
        rows[0].method,
        str(len(rows)),
        mean_text(_column(rows, "horizontal")),
        _ratio(rows, ground, "horizontal"),
        mean_text(1e3 * _column(rows, "velocity")),
        _ratio(rows, ground, "velocity"),
        _nees(_column(rows, "nees_position"), 3),
        mean_text(1e3 * _column(rows, "current")),
        _nees(_column(rows, "nees_current"), 2),
        f"{good} CONVERGED" + ("" if good == len(rows) else f" of {len(rows)}"),
    ]


def _column(rows: Sequence[Row], name: str) -> Array:
    return np.array([getattr(row, name) for row in rows])


def _ratio(rows: Sequence[Row], ground: Sequence[Row], name: str) -> str:
    seeds = {row.seed: getattr(row, name) for row in ground}
    return ratio_text(_column(rows, name), [seeds[row.seed] for row in rows])


def _nees(values: Array, dof: int) -> str:
    if np.isnan(values).all():
        return "–"
    expected = chi2_interval(dof, len(values))
    mark = "" if values.mean() in expected else " !"
    return f"{values.mean():.2f} [{expected.low:.2f}, {expected.high:.2f}]{mark}"


LEGEND = """\
A survey at 1.5 m/s in waves with a current of 0.5 m/s: 5 min of bottom lock, then 20 min without,
then 5 min with it again (`lock regained`) or the end (`lost for good`). A bad beam of 0.5 to 3 m/s
in 10 % of the pings all the time, depth at 2 Hz, no other aid. Sigma of a beam speed 0.005 m/s off
the ground, 0.01 m/s off the water. The current `random` is a Gauss-Markov process of 0.35 m/s along
east and north that is correlated over 6 h, and so stated; `tide` turns once in 12.4 h at 0.5 m/s,
which changes less, with the same statement. Both have 0.01 m/s up and down.

Methods: `ground alone` leaves the water out; `1 beam` to `4 beams` is what the water returns while
bottom lock is lost; with `10 %` every tenth ping is off the water in bottom lock too; `current
known` is told the current, so that it has bottom track all the time.

Mean over runs with its 95 % interval (Student's t); ratio of the means over the same seeds, with
the 95 % interval of a paired bootstrap. NEES: position at the last keyframe, current in the middle
of the loss; in brackets where 95 % of such means lie if the covariance is right, `!` marks one
outside.
"""


def main() -> None:
    """Run all missions and write the tables."""
    names = [grade.name.lower() for grade in Grade]
    page = Report(
        *(__file__, "Water track in a current", __doc__),
        Option("--missions", 8, "of each kind"),
        Option("--grades", ["navigation", "tactical", "industrial"], "of sensors", names),
        Option("--loss", 1200.0, "how long bottom lock is lost, s; before and after a quarter"),
    )
    grades = [Grade[name.upper()] for name in page.args.grades]
    rows = []
    for row in runs(grades, range(page.args.missions), Times(page.args.loss)):
        rows.append(row)
        note(str(row))
    page.write([LEGEND, *report(rows)])


if __name__ == "__main__":
    main()
