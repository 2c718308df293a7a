"""How the error falls as the lag grows: the filter, fixed lags, the batch smoother.

``python benchmarks/lag.py --keep`` (some twenty minutes on two cores; a quick look is
``--missions 2 --duration 60 --lags 0,1,10,60``). The missions are spread over ``--jobs`` processes.
"""

from __future__ import annotations

import argparse
import csv
import math
import multiprocessing
import sys
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import NullLocator

from benchmarks.speed import table
from factors.similarity import LogKernel
from ssm_graph.data import Array
from ssm_graph.estimate import Estimate
from ssm_graph.evaluation import evaluate, mean_with_interval
from ssm_graph.evaluation.statistics import paired_difference, paired_ratio
from ssm_graph.filters.named import filter_problems
from ssm_graph.problem.problem import Problem, build_problem
from ssm_graph.report.compare_style import DASHED, add_footnote, new_figure
from ssm_graph.report.style import EAST_NORTH_UP, INK, SMALL, dress
from ssm_graph.simulation import (
    Grade,
    OutlierKind,
    Outliers,
    SimulatedMission,
    scenario_config,
    simulate,
)
from ssm_graph.smoothers.batch import SmootherConfig, SsmSmoother
from ssm_graph.smoothers.fixed_lag import FixedLagConfig, FixedLagSmoother

RESULTS = Path(__file__).resolve().parent / "results"
DOCS = Path(__file__).resolve().parents[1] / "docs"
GRADES = (Grade.NAVIGATION, Grade.TACTICAL)
COLORS = dict(zip(GRADES, EAST_NORTH_UP, strict=False))
FILTER, BATCH = "filter", "batch"
DELAYED, NEWEST = "delayed", "newest"
METRICS = {"velocity": "mm/s", "horizontal": "m", "heading": "deg"}
"""What is told, and its unit."""


class Row(NamedTuple):
    """One track of one estimator on one mission; errors are root mean squares."""

    grade: Grade
    seed: int
    estimator: str
    """`FILTER`, a lag in seconds, or `BATCH`"""
    track: str
    """`DELAYED` or `NEWEST`"""
    velocity: float
    horizontal: float
    heading: float
    wall_s: float
    status: str
    from_batch: float
    """largest difference of position, velocity and attitude, posterior sigmas of the batch"""
    weight_from_batch: float


def parse_args(argv: Sequence[str] | None = None) -> argparse.Namespace:
    """Return the settings given on the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--missions", type=int, default=10, help="of each grade; at least two")
    parser.add_argument("--duration", type=float, default=300.0, help="of a mission, s")
    parser.add_argument("--lags", default="0,1,2,5,10,30,100,300", help="s, with commas between")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--out", type=Path, default=Path("out/lag"))
    parser.add_argument(
        "--keep", action="store_true", help="write benchmarks/results/lag.md and docs/lag.png too"
    )
    return parser.parse_args(argv)


def run_mission(grade: Grade, seed: int, duration_s: float, lags: Sequence[float]) -> list[Row]:
    """Simulate a mission and solve it by all estimators."""
    sim = simulate(
        scenario_config(
            "survey",
            grade=grade,
            seed=seed,
            duration_s=duration_s,
            outliers=Outliers(OutlierKind.SPARSE, rate=0.2),
        )
    )
    problem = build_problem(sim.mission)
    batch = SsmSmoother(SmootherConfig(LogKernel())).solve(problem)
    (filtered,) = filter_problems([problem], "ssm-log")
    found = [(FILTER, DELAYED, filtered), (FILTER, NEWEST, filtered), (BATCH, DELAYED, batch)]
    for lag in lags:
        newest, delayed = FixedLagSmoother(FixedLagConfig(lag)).solve(problem)
        found += [(f"{lag:g}", NEWEST, newest), (f"{lag:g}", DELAYED, delayed)]
    return [
        Row(grade, seed, estimator, track, *_errors(sim, estimate), estimate.wall_s,
            estimate.status.name, *_differences(problem, estimate, batch))
        for estimator, track, estimate in found
    ]  # fmt: skip


def _errors(sim: SimulatedMission, estimate: Estimate) -> tuple[float, float, float]:
    """Return the errors from the first ping on: before it there is but the initial state."""
    trajectory = estimate.trajectory
    first = int(np.argmax(trajectory.n_beams > 0))
    metrics = evaluate(trajectory, sim.truth_at(trajectory.time_s[first:]))
    velocity, heading = metrics.rmse_velocity_m_per_s, metrics.rmse_attitude[2]
    return 1e3 * velocity, metrics.rmse_horizontal_m, math.degrees(heading)


def _differences(problem: Problem, estimate: Estimate, batch: Estimate) -> tuple[float, float]:
    """Return the largest difference of the states, in sigmas, and of the weights."""
    ours, other = estimate.trajectory, batch.trajectory
    p, q = (problem.frame.p_n_from_geodetic(x.lat, x.lon, x.height) for x in (ours, other))
    turn = ours.roll_pitch_heading - other.roll_pitch_heading
    sigmas: list[Array] = [
        (p - q) / np.sqrt(np.diagonal(other.position_cov_enu, axis1=1, axis2=2)),
        (ours.velocity_enu - other.velocity_enu) / other.velocity_sigma_enu,
        np.arctan2(np.sin(turn), np.cos(turn)) / other.attitude_sigma,
    ]
    weight = np.abs(estimate.beams.weight - batch.beams.weight)
    return float(np.max(np.abs(sigmas))), float(np.max(weight))


def run_all(missions: int, duration_s: float, lags: Sequence[float], jobs: int) -> list[Row]:
    """Run all missions, seeds from 0, side by side."""
    rows: list[Row] = []
    with ProcessPoolExecutor(jobs, mp_context=multiprocessing.get_context("spawn")) as pool:
        futures = [
            pool.submit(run_mission, grade, seed, duration_s, lags)
            for seed in range(missions)
            for grade in GRADES
        ]
        for number, future in enumerate(as_completed(futures), start=1):
            rows += future.result()
            print(f"{number} of {len(futures)} missions", file=sys.stderr, flush=True)
    return sorted(rows, key=lambda row: (row.grade.name, row.seed))


def values(rows: Sequence[Row], grade: Grade, estimator: str, track: str, field: str) -> Array:
    """Return a number (N,) of one track on all missions of a grade."""
    key = grade, estimator, track
    return np.array([getattr(r, field) for r in rows if (r.grade, r.estimator, r.track) == key])


def grade_lines(rows: Sequence[Row], grade: Grade, estimators: Sequence[str]) -> list[str]:
    """Return the table of a grade."""
    columns = [(metric, track) for metric in METRICS for track in (DELAYED, NEWEST)]
    header = ["lag, s", *(f"{m}, {track}, {METRICS[m]}" for m, track in columns), "time, s"]
    cells = []
    for name in estimators:
        wall = np.median(values(rows, grade, name, DELAYED, "wall_s"))
        means = [_mean(values(rows, grade, name, track, m)) for m, track in columns]
        cells.append([name, *means, f"{wall:.2f}"])
    return [f"## {grade.name.capitalize()} grade", "", *table(header, cells), ""]


def _mean(x: Array) -> str:
    if len(x) == 0:
        return "–"
    interval = mean_with_interval(x)
    return f"{interval.value:.3g} ± {interval.half_width:.2g}"


def findings(rows: Sequence[Row], lags: Sequence[str], duration_s: float) -> list[str]:
    """Return what the numbers say: where errors rise with the lag, and how near the batch is."""
    lines = [
        f"- {grade.name.capitalize()}, {track}, {metric}: {_course(rows, grade, track, metric, lags)}"
        for grade in GRADES
        for track in (DELAYED, NEWEST)
        for metric in METRICS
    ]
    if float(lags[-1]) >= duration_s:
        whole = [r for r in rows if (r.estimator, r.track) == (lags[-1], DELAYED)]
        lines.append(
            "- Lag of the whole mission against batch: position, velocity and attitude within "
            f"{max(r.from_batch for r in whole):.1e} posterior sigmas, weights within "
            f"{max(r.weight_from_batch for r in whole):.1e}."
        )
    bad = [r for r in rows if r.status != "CONVERGED"]
    names = "; ".join(f"{r.grade.name} {r.seed} {r.estimator} {r.track} {r.status}" for r in bad)
    return [*lines, f"- {len(rows) - len(bad)} of {len(rows)} tracks CONVERGED. {names}".rstrip()]


def _course(rows: Sequence[Row], grade: Grade, track: str, metric: str, lags: Sequence[str]) -> str:
    """Return in words how an error goes from the filter to the longest lag."""
    x = {lag: values(rows, grade, lag, track, metric) for lag in (FILTER, *lags)}
    ratio = paired_ratio(x[lags[-1]], x[FILTER], np.random.default_rng(0))
    rises = []
    for a, b in pairwise(lags):
        step = paired_difference(x[b], x[a], other=a).difference
        if step.value > 0.0:
            rises.append(f"{a} to {b} s, {step.value:.1g} ({step.low:.1g} to {step.high:.1g})")
    return (
        f"{ratio.value:.3f} ({ratio.low:.3f} to {ratio.high:.3f}) of the filter's at {lags[-1]} s; "
        f"mean rises at {len(rises)} of {len(lags) - 1} steps"
        + (f", {METRICS[metric]}: {'; '.join(rises)}." if rises else ".")
    )


def draw(rows: Sequence[Row], lags: Sequence[str], title: str) -> Figure:
    """Return velocity and horizontal error against the lag."""
    figure = new_figure(8.6, 3.9, title)
    panels = figure.subplots(1, 2)
    for axes, metric in zip(panels, ("velocity", "horizontal"), strict=True):
        places = _places(axes, lags)
        for grade in GRADES:
            for track, dash in ((DELAYED, "-"), (NEWEST, DASHED)):
                shown = [x for x in places if len(values(rows, grade, x, track, metric))]
                means = [mean_with_interval(values(rows, grade, x, track, metric)) for x in shown]
                axes.plot(
                    [places[x] for x in shown], [m.value for m in means], linestyle=dash,
                    color=COLORS[grade], linewidth=1.5, marker="o", markersize=3.5,
                )  # fmt: skip
        axes.set_ylim(bottom=0.0)
        dress(axes, title=f"{metric} error", x="lag, s", y=f"rms, {METRICS[metric]}")
    handles = [
        Line2D([], [], color=COLORS[g], linestyle=dash, label=f"{g.name.lower()}, {track}")
        for g in GRADES
        for track, dash in ((DELAYED, "-"), (NEWEST, DASHED))
    ]
    figure.legend(handles=handles, loc="outside right center", fontsize=SMALL + 1.0,
                  frameon=False, handlelength=4.0, labelcolor=INK)  # fmt: skip
    add_footnote(
        figure, "Newest: as known when it came. Delayed: as known when it left the window."
    )
    return figure


def _places(axes: Axes, lags: Sequence[str]) -> dict[str, float]:
    """Scale the axis by decades, with what has no place on it at the ends; return all places."""
    positive = {lag: float(lag) for lag in lags if float(lag) > 0.0}
    low, high = min(positive.values()), max(positive.values())
    zero = {lag: 0.4 * low for lag in lags if float(lag) == 0.0}
    places = {FILTER: 0.16 * low, **zero, **positive, BATCH: 2.5 * high}
    axes.set_xscale("log")
    axes.set_xticks(list(places.values()), list(places))
    axes.xaxis.set_minor_locator(NullLocator())
    return places


LEGEND = """\
Scenario `survey`, 20 % of the pings with sparse outliers, 100 Hz inertial, 1 Hz DVL, depth, no GNSS;
both grades on the same seeds. Root mean squares over the keyframes from the first ping on; mean over
missions ± half of its 95 % interval (Student's t); time is the median wall time of a mission.
`filter` is `ssm-log`, linearised once at the prediction; all others linearise at every pass. Newest:
each state as known when it came. Delayed: as known when it left the window, or at the end of the
mission. Below, ratios of means are of the same missions with bootstrap intervals, and so are steps
from lag to lag, with Student's t interval; all at 95 %.
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the benchmark; write report, figure and the numbers of every mission."""
    args = parse_args(argv)
    about = f"{machine()}; load average before {os.getloadavg()[0]:.1f}."
    command = shlex.join(["python", "benchmarks/lag.py", *(argv or sys.argv[1:])])
    lags = [f"{lag:g}" for lag in sorted(float(text) for text in args.lags.split(","))]
    rows = run_all(args.missions, args.duration, [float(lag) for lag in lags], args.jobs)
    size = f"{args.missions} missions of {args.duration:g} s and each grade"
    lines = ["# Error against lag", "", f"    {command}", "", about, "", f"{size}. {LEGEND}"]
    lines += [*findings(rows, lags, args.duration), ""]
    for grade in GRADES:
        lines += grade_lines(rows, grade, [FILTER, *lags, BATCH])
    text = "\n".join(lines)
    print(text)
    folders = [(args.out, args.out), *([(RESULTS, DOCS)] if args.keep else [])]
    for results, figures in folders:
        results.mkdir(parents=True, exist_ok=True)
        (results / "lag.md").write_text(text, encoding="utf-8")
        save(draw(rows, lags, f"Error against lag, {size}"), figures / "lag.png")
    with (args.out / "lag.csv").open("w", encoding="utf-8", newline="") as file:
        csv.writer(file).writerows(
            [Row._fields, *(row._replace(grade=row.grade.name) for row in rows)]
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
