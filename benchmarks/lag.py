"""How the error falls as the lag grows: the filter, fixed lags, the batch smoother.

``python benchmarks/lag.py --keep`` (some twenty minutes on two cores; a quick look is
``--missions 2 --duration 60 --lags 0,1,10,60``).
"""

from __future__ import annotations

import argparse
import csv
import math
import multiprocessing
import sys
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from itertools import pairwise, product
from pathlib import Path
from typing import NamedTuple

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator

from benchmarks.report import Report
from benchmarks.speed import table
from factors.similarity import LogKernel
from ssm_graph.base.frozen import Array
from ssm_graph.evaluation import evaluate, mean_with_interval, paired_ratio
from ssm_graph.evaluation.statistics import paired_difference
from ssm_graph.filters.navigation.named import filter_problems
from ssm_graph.mission.estimate import Estimate, since_first_ping
from ssm_graph.mission.problem import Problem, build_problem
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
from ssm_graph.simulation import (
    Grade,
    OutlierKind,
    Outliers,
    SimulatedMission,
    scenario_config,
    simulate,
)
from ssm_graph.smoothers.batch import SmootherConfig, SsmSmoother
from ssm_graph.smoothers.fixed_lag import FixedLagConfig, solve_fixed_lag

RESULTS = Path(__file__).resolve().parent / "results"
DOCS = Path(__file__).resolve().parents[1] / "docs"
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
    outliers = Outliers(OutlierKind.SPARSE, rate=0.2)
    settings = {"grade": Grade[grade], "seed": seed, "duration_s": duration_s}
    sim = simulate(scenario_config("survey", outliers=outliers, **settings))
    problem = build_problem(sim.mission)
    batch = SsmSmoother(SmootherConfig(LogKernel())).solve(problem)
    (filtered,) = filter_problems([problem], "ssm-log")
    found = [(FILTER, DELAYED, filtered), (FILTER, NEWEST, filtered), (BATCH, DELAYED, batch)]
    for lag in lags:
        newest, delayed = solve_fixed_lag(problem, FixedLagConfig(float(lag)))
        found += [(lag, NEWEST, newest), (lag, DELAYED, delayed)]
    rows = []
    for name, track, estimate in found:
        numbers = *_errors(sim, estimate), *_differences(problem, estimate, batch), estimate.wall_s
        rows.append(Row(grade, seed, name, track, *numbers, estimate.status.name))
    return rows


def _errors(sim: SimulatedMission, estimate: Estimate) -> tuple[float, float, float]:
    """Return the errors from the first ping on: before it there is but the initial state."""
    trajectory = since_first_ping(estimate.trajectory)
    metrics = evaluate(trajectory, sim.truth_at(trajectory.time_s))
    heading = math.degrees(metrics.rmse_attitude[2])
    return 1e3 * metrics.rmse_velocity_m_per_s, metrics.rmse_horizontal_m, heading


def _differences(problem: Problem, estimate: Estimate, batch: Estimate) -> tuple[float, float]:
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


def run_all(missions: int, duration_s: float, lags: Sequence[str], jobs: int) -> Rows:
    """Run all missions, seeds from 0, side by side."""
    rows = Rows()
    with ProcessPoolExecutor(jobs, mp_context=multiprocessing.get_context("spawn")) as pool:
        cases = product(range(missions), GRADES)
        futures = [pool.submit(run_mission, g, seed, duration_s, lags) for seed, g in cases]
        for number, future in enumerate(as_completed(futures), start=1):
            rows += future.result()
            print(f"{number} of {len(futures)} missions", file=sys.stderr, flush=True)
    return rows


def grade_lines(rows: Rows, grade: str, estimators: Sequence[str]) -> list[str]:
    """Return the table of a grade."""
    columns = list(product(UNITS, (DELAYED, NEWEST)))
    header = ["lag, s", *(f"{name}, {track}, {UNITS[name]}" for name, track in columns), "time, s"]
    cells = []
    for estimator in estimators:
        means = [_mean(rows.of(grade, estimator, track, name)) for name, track in columns]
        wall_s = np.median(rows.of(grade, estimator, DELAYED, "wall_s"))
        cells.append([estimator, *means, f"{wall_s:.2f}"])
    return [f"## {grade.capitalize()} grade", "", *table(header, cells), ""]


def _mean(x: Array) -> str:
    if len(x) == 0:
        return "–"
    interval = mean_with_interval(x)
    return f"{interval.value:.3g} ± {interval.half_width:.2g}"


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
    ratio = paired_ratio(x[lags[-1]], x[FILTER], np.random.default_rng(0))
    steps = {
        pair: paired_difference(x[pair[1]], x[pair[0]], other=pair[0]).difference
        for pair in pairwise(lags)
    }
    rises = [f"{a} to {b} s" for (a, b), step in steps.items() if step.value > 0.0]
    sure = [f"{a} to {b} s" for (a, b), step in steps.items() if step.low > 0.0]
    told = f"{ratio.value:.3f} ({ratio.low:.3f} to {ratio.high:.3f})"
    return [told, ", ".join(rises) or "none", ", ".join(sure) or "none"]


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


def parse_args(argv: Sequence[str] | None = None) -> argparse.Namespace:
    """Return the settings given on the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--missions", type=int, default=6, help="of each grade, two or more")
    parser.add_argument("--duration", type=float, default=300.0, help="of a mission, s")
    parser.add_argument("--lags", default="0,1,3,10,30,100,300", help="s, one or more above 0")
    parser.add_argument("--jobs", type=int, default=2, help="processes")
    parser.add_argument("--out", type=Path, default=Path("out/lag"))
    parser.add_argument("--keep", action="store_true", help="write to benchmarks/results and docs")
    return parser.parse_args(argv)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the benchmark; write report, figure and the numbers of every mission."""
    args = parse_args(argv)
    page = Report("lag", "Error against lag", argv)
    lags = [f"{lag:g}" for lag in sorted(map(float, args.lags.split(",")))]
    rows = run_all(args.missions, args.duration, lags, args.jobs)
    size = f"{args.missions} missions of {args.duration:g} s of each grade"
    lines = [*page.head(), f"{size}.\n{LEGEND}", *findings(rows, lags, args.duration)]
    for grade in GRADES:
        lines += grade_lines(rows, grade, [FILTER, *lags, BATCH])
    page.write("\n".join(lines), (args.out, RESULTS)[: 1 + args.keep])
    for figures in (args.out, DOCS)[: 1 + args.keep]:
        save(draw(rows, lags, f"Error against lag: {size}"), figures / "lag.png")
    with (args.out / "lag.csv").open("w", encoding="utf-8", newline="") as file:
        csv.writer(file).writerows([Row._fields, *sorted(rows)])
    return 0


if __name__ == "__main__":
    sys.exit(main())
