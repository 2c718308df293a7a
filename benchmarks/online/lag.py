"""How the error falls as the lag grows: the filter, fixed lags, the batch smoother.

``python -m benchmarks.online.lag --keep`` (some twenty minutes on two cores; a quick look is
``--missions 2 --duration 60 --lags 0,1,10,60``).
"""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from itertools import pairwise, product
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator

import ssm_graph as sg
from benchmarks.missions import survey
from benchmarks.processes import side_by_side
from benchmarks.report import DOCS, Option, Report, ratio_text, spread_text, table
from factors.similarity import LogKernel
from ssm_graph.base.frozen import Array
from ssm_graph.evaluation.statistics import paired_difference
from ssm_graph.mission.estimate import since_first_ping
from ssm_graph.report.style import (
    DASHED,
    EAST_NORTH_UP,
    Look,
    add_footnote,
    add_legend,
    dress,
    line,
    new_figure,
    save,
)
from ssm_graph.simulation import Grade, SimulatedMission

GRADES = ("NAVIGATION", "TACTICAL")
FILTER, BATCH = "filter", "batch"
DELAYED, NEWEST = "delayed", "newest"
UNITS = {"velocity": "mm/s", "horizontal": "m", "heading": "deg"}
LOOKS = {
    f"{grade.lower()}, {track}": Look(color, dash, "o", 1.5)
    for grade, color in zip(GRADES, EAST_NORTH_UP[:2], strict=True)
    for track, dash in ((DELAYED, "-"), (NEWEST, DASHED))
}


class Row(NamedTuple):
    """One track of one estimator on one mission; errors are root mean squares."""

    grade: str
    seed: int
    estimator: str
    """`FILTER`, a lag in seconds, or `BATCH`"""
    track: str
    """`DELAYED` or `NEWEST`; the filter has the same for both, the batch has only the first"""
    velocity: float
    horizontal: float
    heading: float
    sigmas_from_batch: float
    """largest difference in position, velocity or attitude, in the batch's posterior sigmas"""
    weight_from_batch: float
    wall_s: float
    status: str


class Rows(list[Row]):
    """All rows of a run."""

    def of(self, grade: str, estimator: str, track: str, field: str) -> Array:
        """Return a number of one track on all missions of a grade (N,), by seed."""
        key = grade, estimator, track
        kept = [row for row in self if (row.grade, row.estimator, row.track) == key]
        return np.array([getattr(row, field) for row in sorted(kept, key=lambda row: row.seed)])


def run_mission(grade: str, seed: int, duration_s: float, lags: Sequence[str]) -> list[Row]:
    """Simulate a mission and solve it by all estimators."""
    sim = survey(duration_s, Grade[grade], seed=seed, outliers=0.2)
    problem = sg.build_problem(sim.mission)
    batch = sg.SsmSmoother(sg.SmootherConfig(LogKernel())).solve(problem)
    (filtered,) = sg.filter_problems([problem], "ssm-log")
    found = [(FILTER, DELAYED, filtered), (FILTER, NEWEST, filtered), (BATCH, DELAYED, batch)]
    for lag in lags:
        newest, delayed = sg.solve_fixed_lag(problem, sg.FixedLagConfig(float(lag)))
        found += [(lag, NEWEST, newest), (lag, DELAYED, delayed)]
    rows = []
    for name, track, estimate in found:
        numbers = *_errors(sim, estimate), *_differences(problem, estimate, batch), estimate.wall_s
        rows.append(Row(grade, seed, name, track, *numbers, estimate.status.name))
    return rows


def _errors(sim: SimulatedMission, estimate: sg.Estimate) -> tuple[float, float, float]:
    """Return the errors from the first ping on: before it there is but the initial state."""
    trajectory = since_first_ping(estimate.trajectory)
    metrics = sg.evaluate(trajectory, sim.truth_at(trajectory.time_s))
    heading = math.degrees(metrics.rmse_attitude[2])
    return 1e3 * metrics.rmse_velocity_m_per_s, metrics.rmse_horizontal_m, heading


def _differences(
    problem: sg.Problem, estimate: sg.Estimate, batch: sg.Estimate
) -> tuple[float, float]:
    """Return the largest difference of states, in sigmas, and of weights."""
    ours, other = estimate.trajectory, batch.trajectory
    p, q = (problem.frame.p_n_from_geodetic(x.lat, x.lon, x.height) for x in (ours, other))
    turn = ours.roll_pitch_heading - other.roll_pitch_heading
    sigmas = (
        (p - q) / np.sqrt(np.diagonal(other.position_cov_enu, axis1=1, axis2=2)),
        (ours.velocity_enu - other.velocity_enu) / other.velocity_sigma_enu,
        np.arctan2(np.sin(turn), np.cos(turn)) / other.attitude_sigma,
    )
    weights = np.abs(estimate.beams.weight - batch.beams.weight)
    return float(np.max(np.abs(sigmas))), float(np.max(weights))


def grade_lines(rows: Rows, grade: str, estimators: Sequence[str]) -> list[str]:
    """Return the table of a grade."""
    columns = list(product(UNITS, (DELAYED, NEWEST)))
    header = ["lag, s", *(f"{name}, {track}, {UNITS[name]}" for name, track in columns), "time, s"]
    cells = []
    for estimator in estimators:
        means = [spread_text(rows.of(grade, estimator, track, name)) for name, track in columns]
        wall_s = np.median(rows.of(grade, estimator, DELAYED, "wall_s"))
        cells.append([estimator, *means, f"{wall_s:.2f}"])
    return [f"## {grade.capitalize()} grade", "", *table(header, cells), ""]


def findings(rows: Rows, lags: Sequence[str], duration_s: float) -> list[str]:
    """Return how errors go with the lag, and how near the batch smoother comes."""
    header = ["grade", "states", "error", f"ratio, {lags[-1]} s to filter", "steps up", "sure"]
    series = product(GRADES, (DELAYED, NEWEST), UNITS)
    lines = table(header, [[*key, *_course(rows, key, lags)] for key in series])
    if float(lags[-1]) >= duration_s:
        whole = [row for row in rows if (row.estimator, row.track) == (lags[-1], DELAYED)]
        states = max(row.sigmas_from_batch for row in whole)
        weights = max(row.weight_from_batch for row in whole)
        lines += ["", "With a lag as long as the mission the delayed states are those of `batch`:"]
        lines += [f"position, velocity and attitude within {states:.1e} of its posterior sigmas,"]
        lines += [f"weights within {weights:.1e}."]
    bad = [" ".join(map(str, (*row[:4], row.status))) for row in rows if row.status != "CONVERGED"]
    return [*lines, "", f"Tracks not CONVERGED, of {len(rows)}: {'; '.join(bad) or 'none'}.", ""]


def _course(rows: Rows, series: tuple[str, str, str], lags: Sequence[str]) -> list[str]:
    """Return the ratio of the longest lag to the filter, and the steps at which the mean rises."""
    grade, track, name = series
    x = {lag: rows.of(grade, lag, track, name) for lag in (FILTER, *lags)}
    steps = {
        pair: paired_difference(x[pair[1]], x[pair[0]], other=pair[0]).difference
        for pair in pairwise(lags)
    }
    rises = [f"{a} to {b} s" for (a, b), step in steps.items() if step.value > 0.0]
    sure = [f"{a} to {b} s" for (a, b), step in steps.items() if step.low > 0.0]
    told = (", ".join(steps) or "none" for steps in (rises, sure))
    return [ratio_text(x[lags[-1]], x[FILTER]), *told]


def draw(rows: Rows, lags: Sequence[str], title: str) -> Figure:
    """Return velocity and horizontal error against the lag."""
    figure = new_figure(8.6, 3.9, title)
    for axes, name in zip(figure.subplots(1, 2), ("velocity", "horizontal"), strict=True):
        dress(axes, title=f"{name} error", x="lag, s", y=f"rms, {UNITS[name]}")
        places = _places(axes, lags)
        for (grade, track), look in zip(
            product(GRADES, (DELAYED, NEWEST)), LOOKS.values(), strict=True
        ):
            found = {at: rows.of(grade, x, track, name) for x, at in places.items()}
            means = {at: x.mean() for at, x in found.items() if len(x)}
            axes.plot(list(means), list(means.values()), marker=look.marker, **line(look))
        axes.set_ylim(bottom=0.0)
    add_legend(figure, list(LOOKS), LOOKS, has_markers=True)
    add_footnote(
        figure, "Newest: as known when it came. Delayed: as known when it left the window."
    )
    return figure


def _places(axes: Axes, lags: Sequence[str]) -> dict[str, float]:
    """Scale the axis by decades, what has no place on it at the ends; return where all stand."""
    above = {lag: float(lag) for lag in lags if lag != "0"}
    low, high = min(above.values()), max(above.values())
    zero = {"0": 0.4 * low} if "0" in lags else {}
    places = {FILTER: 0.16 * low, **zero, **above, BATCH: 2.5 * high}
    axes.set_xscale("log")
    axes.set_xticks(list(places.values()), list(places))
    axes.xaxis.set_minor_locator(NullLocator())
    return places


LEGEND = """\
Scenario `survey`: 100 Hz inertial, 1 Hz DVL, depth, no GNSS, sparse outliers in 20 % of the pings;
both grades on the same seeds. Root mean squares over the keyframes from the first ping on; mean
over missions ± half of its 95 % interval (Student's t); time is the median wall time of a mission.
`filter` is `ssm-log`, linearised once at the prediction; all others linearise at every pass.
Newest: each state as known when it came. Delayed: as known when it left the window, or at the end.
First table: ratio of means on the same missions with its 95 % bootstrap interval; steps from one
lag to the next at which the mean rises, and those of them where the 95 % interval of the mean
difference (Student's t, each for itself) lies above zero.
"""


def main() -> None:
    """Run the benchmark; write report, figure and the numbers of every mission."""
    report = Report(
        *(__file__, "Error against lag", __doc__),
        Option("--missions", 6, "of each grade, two or more"),
        Option("--duration", 300.0, "of a mission, s"),
        Option("--lags", "0,1,3,10,30,100,300", "s, one or more above 0"),
        Option("--jobs", 2, "processes"),
    )
    args = report.args
    lags = [f"{lag:g}" for lag in sorted(map(float, args.lags.split(",")))]
    cases = [(g, seed, args.duration, lags) for seed, g in product(range(args.missions), GRADES)]
    rows = Rows(row for mission in side_by_side(run_mission, cases, args.jobs) for row in mission)
    size = f"{args.missions} missions of {args.duration:g} s of each grade"
    lines = [f"{size}.\n{LEGEND}", *findings(rows, lags, args.duration)]
    for grade in GRADES:
        lines += grade_lines(rows, grade, [FILTER, *lags, BATCH])
    report.write(lines)
    for folder in report.places(DOCS):
        save(draw(rows, lags, f"Error against lag: {size}"), folder / "lag.png")
    with (args.out / "lag.csv").open("w", encoding="utf-8", newline="") as file:
        csv.writer(file).writerows([Row._fields, *sorted(rows)])


if __name__ == "__main__":
    main()
