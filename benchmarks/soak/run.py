"""Hours of a vehicle's life at full speed: whether the live estimator stays right and small.

``python -m benchmarks.soak.run --keep`` (24 h of each case; see the times in the result); a quick
look is ``--hours 1 --cases depth "all of these"``.
"""

from __future__ import annotations

import argparse
import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from benchmarks.online.stream import HEALTHS
from benchmarks.processes import side_by_side
from benchmarks.report import RESULTS, Option, Report, note, rms, table
from benchmarks.soak.stream import AXES, CASES, HOUR_S, Soaked, longest_run, soak
from ssm_graph.base.code_version import code_version
from ssm_graph.base.frozen import Array
from ssm_graph.mission.navigation import Health
from ssm_graph.report.style import (
    BOUND,
    ESTIMATE,
    OUTLIER,
    SMALL,
    add_footnote,
    dress,
    log_ticks,
    new_figure,
    save,
)
from ssm_graph.simulation import Grade

COLORS = {
    Health.ALIGNING: "#BBBBBB",
    Health.GOOD: "#4DAF7C",
    Health.DEGRADED: "#E69F00",
    Health.BAD: "#C1272D",
}
BINS = 1500
"""Of each panel: the largest error and the mean sigma of each is drawn"""


def draw(runs: Sequence[Soaked], title: str) -> Figure:
    """Return the figure: one row of panels for each case."""
    figure = new_figure(10.0, 0.6 + 2.1 * len(runs), title)
    panels = figure.subplots(len(runs), 3, squeeze=False, width_ratios=[3, 1, 1])
    for run, (left, middle, right) in zip(runs, panels, strict=True):
        draw_errors(left, run)
        dress(middle, title="resident size", x="h", y="MB")
        middle.plot(run.rss_s / HOUR_S, run.rss_mb, color=ESTIMATE, linewidth=1.0)
        middle.set_ylim(bottom=0.0)
        draw_latency(right, run)
    figure.legend(
        handles=[Patch(color=COLORS[health], label=health.name.lower()) for health in HEALTHS],
        loc="outside upper right",
        ncols=len(HEALTHS),
        fontsize=SMALL,
        frameon=False,
    )
    add_footnote(
        figure,
        "Left: horizontal error, the largest of each bin, over three sigmas of the horizontal "
        "position (band); the strip is the worst health of each bin. Right: median, 99th "
        "percentile and largest latency of a keyframe in each hour.",
    )
    return figure


def draw_errors(axes: Axes, run: Soaked) -> None:
    """Draw horizontal error, band and health."""
    dress(axes, title=run.name, x="h", y="m")
    hours = run.time_s / HOUR_S
    edges = np.unique(np.linspace(0, len(hours), min(BINS, len(hours)) + 1).astype(int))[:-1]
    error = np.hypot(run.error[:, 0], run.error[:, 1])
    band = 3.0 * np.hypot(run.sigma[:, 0], run.sigma[:, 1])
    at = hours[edges]
    low = max(float(np.nanpercentile(error, 1.0)), 1e-2)
    axes.fill_between(
        at, low, np.fmax.reduceat(band, edges), color=BOUND, linewidth=0.0, step="post"
    )
    axes.step(at, np.fmax.reduceat(error, edges), color=OUTLIER, linewidth=0.8, where="post")
    axes.set_yscale("log")
    axes.set_ylim(bottom=low)
    worst = np.maximum.reduceat(run.health, edges)
    strip = axes.inset_axes((0.0, 1.0, 1.0, 0.045), sharex=axes)
    strip.set_axis_off()
    for i, health in enumerate(HEALTHS):
        strip.fill_between(
            at, 0.0, 1.0, where=worst == i, color=COLORS[health], linewidth=0.0, step="post"
        )
    strip.set_ylim(0.0, 1.0)
    axes.title.set_position((0.0, 1.05))


def draw_latency(axes: Axes, run: Soaked) -> None:
    """Draw what a keyframe cost, hour by hour."""
    dress(axes, title="latency", x="h", y="ms")
    rows = hourly(run)
    at = np.arange(len(rows)) + 0.5
    for label, column in zip(("median", "99 %", "largest"), np.array(rows).T, strict=True):
        axes.plot(at, column, marker=".", linewidth=1.0, markersize=4.0, label=label)
    axes.legend(fontsize=SMALL, frameon=False, handlelength=1.2, ncols=3, columnspacing=0.8)
    log_ticks(axes.yaxis, 1.0, 1000.0)
    axes.set_xlim(0.0, len(rows))


def hourly(run: Soaked) -> list[list[float]]:
    """Return median, 99th percentile and largest latency of each hour, ms."""
    is_new = np.diff(run.latency_s, prepend=np.nan) != 0.0
    hour = (run.time_s[is_new] / HOUR_S).astype(int)
    ms = 1e3 * run.latency_s[is_new]
    return [np.percentile(ms[hour == h], [50.0, 99.0, 100.0]).tolist() for h in np.unique(hour)]


WANTED = 0.99
"""Share of the good time that the truth has to lie inside three sigmas, every axis for itself"""
FLAT_MB_PER_H = 1.0
WARM_H = 0.25
"""Memory counts from then on: windows, buffers and the allocator have filled"""

LEGEND = f"""\
Scenario `survey`, 100 Hz inertial, depth 2 Hz, no GNSS; initial state given. Every case has its own
seed. `bottom losses`: no beam for ten minutes of every hour. `stuck beam`: one beam repeats its
reading for 15 minutes of every hour. `IMU gaps`: a second of samples missing of every ten minutes,
at a time drawn from them. `all of these`: also without depth. The newest state is asked for twice a
ping interval and compared with the truth at its own time. Inside: share of the time of good health
at which the error is within three of its sigmas, of the worst axis, and mean of the nine; wanted
{WANTED:.0%} or more. Outside: longest unbroken stretch of good health with any axis outside three
sigmas. Beyond: how long the health was good with any axis beyond five. Memory: growth of the
resident size from {WARM_H:g} h on, by least squares.
"""


def run_all(args: argparse.Namespace) -> list[Soaked]:
    """Run all cases, each in a process of its own: resident sizes are counted by process.

    A case that was finished before, by the same code with the same settings, is taken from ``out``.
    """
    args.out.mkdir(parents=True, exist_ok=True)
    cases = [
        (args.out, case, args.hours, args.seed + list(CASES).index(case), args.dvl_hz, args.grade)
        for case in args.cases
    ]
    return side_by_side(soaked_once, cases, args.jobs, each_fresh=True)


def soaked_once(out: Path, case: str, hours: float, seed: int, dvl_hz: float, grade: str) -> Soaked:
    """Return the run of a case, kept in a folder as soon as it is done."""
    told = [code_version(), case, f"{hours=}", f"{seed=}", f"{dvl_hz=}", f"{grade=!s}"]
    file = out / (re.sub(r"[^\w.=+-]+", "_", "_".join(told)) + ".npz")
    if file.exists():
        with np.load(file) as kept:
            return Soaked.unpack(kept)
    run = soak(case, hours=hours, seed=seed, dvl_hz=dvl_hz, grade=grade)
    unfinished = file.with_suffix(".part.npz")
    arrays: dict[str, Any] = run.pack()
    np.savez(unfinished, **arrays)
    unfinished.replace(file)
    return run


def goals(run: Soaked) -> list[str]:
    """Return the row of a case in the table of goals."""
    inside = shares_inside(run)
    period_s = float(np.median(np.diff(run.time_s)))
    outside_s, first = longest_run(run.is_outside.any(axis=1) & run.is_good, period_s)
    growth = growth_mb_per_h(run)
    worst = int(np.argmin(inside))
    is_met = inside[worst] >= WANTED and growth < FLAT_MB_PER_H
    where = f" at {run.time_s[first] / HOUR_S:.2f} h" if outside_s else ""
    return [
        run.name,
        f"{100 * inside[worst]:.2f} % ({AXES[worst]})",
        f"{100 * inside.mean():.2f} %",
        f"{outside_s:.0f} s{where}",
        f"{beyond_s(run):.0f} s",
        f"{growth:+.2f}",
        "yes" if is_met else "**no**",
    ]


GOALS_HEADER = ["case", "inside, worst axis", "inside, mean", "longest outside"]
GOALS_HEADER += ["beyond 5 sigmas", "MB/h", "goals met"]


def shares_inside(run: Soaked) -> Array:
    """Return the share of the good time inside three sigmas (9,); 0 without any."""
    if not run.is_good.any():
        return np.zeros(len(AXES))
    return np.asarray(1.0 - run.is_outside[run.is_good].mean(axis=0))


def beyond_s(run: Soaked) -> float:
    """Return for how long the health was good while an axis was off by more than five sigmas, s."""
    is_far = ~(np.abs(run.error) <= 5.0 * run.sigma).all(axis=1)
    return float((run.is_good & is_far).sum()) * float(np.median(np.diff(run.time_s)))


def growth_mb_per_h(run: Soaked) -> float:
    """Return the slope of the resident size; NaN for a run too short to tell."""
    late = run.rss_s >= WARM_H * HOUR_S
    if late.sum() < 10:
        return np.nan
    return float(np.polyfit(run.rss_s[late] / HOUR_S, run.rss_mb[late], 1)[0])


def by_health(run: Soaked) -> list[list[str]]:
    """Return share of the time and root mean square errors under each health."""
    rows = []
    for i, health in enumerate(HEALTHS):
        at = run.health == i
        if at.any():
            e = run.error[at]
            horizontal, velocity = (rms(np.linalg.norm(e[:, s], axis=1)) for s in _PARTS)
            heading = np.degrees(rms(e[:, 8]))
            share = f"{100 * at.mean():.3f} %"
            cells = [f"{horizontal:.2f}", f"{1e3 * velocity:.1f}", f"{heading:.3f}"]
            rows.append([run.name, health.name.lower(), share, *cells])
    return rows


_PARTS = (slice(0, 2), slice(3, 6))


def costs(run: Soaked) -> list[str]:
    """Return latency in the first and the last hour, memory and wall time."""
    hours = hourly(run)
    cells = [" / ".join(f"{ms:.1f}" for ms in hours[i]) for i in (0, -1)]
    late = run.rss_mb[run.rss_s >= WARM_H * HOUR_S]
    sizes = late if len(late) else run.rss_mb
    memory = f"{sizes[0]:.0f} / {sizes.max():.0f} / {sizes[-1]:.0f}"
    return [run.name, *cells, memory, f"{run.wall_s / 60.0:.1f}"]


def report(runs: Sequence[Soaked]) -> list[str]:
    """Return the tables."""
    lines = [*table(GOALS_HEADER, [goals(run) for run in runs]), ""]
    header = ["case", "health", "time", "horizontal, m", "velocity, mm/s", "heading, deg"]
    rows = [row for run in runs for row in by_health(run)]
    lines += ["## Errors by health, root mean square", "", *table(header, rows), ""]
    shares = [[run.name, *(f"{100 * x:.2f}" for x in shares_inside(run))] for run in runs]
    lines += ["## Inside three sigmas while good, %", "", *table(["case", *AXES], shares), ""]
    header = ["case", "latency of the first hour, ms: median / 99 % / largest", "of the last hour"]
    header += ["resident size, MB: begin / most / end", "wall time, min"]
    lines += ["## Cost", "", *table(header, [costs(run) for run in runs]), ""]
    rows = [[run.name, counted(run.events), counted(run.refused)] for run in runs]
    lines += ["## Events", "", *table(["case", "events", "messages refused"], rows), ""]
    return lines


def counted(counts: dict[str, int]) -> str:
    """Return counts as text."""
    return ", ".join(f"{kind} {n}" for kind, n in sorted(counts.items())) or "none"


def main() -> None:
    """Run the soak; write report, figure and the numbers."""
    page = Report(
        *(__file__, "Soak", __doc__),
        Option("--hours", 24.0, "of each case"),
        Option("--dvl-hz", 1.0, "pings a second"),
        Option("--cases", list(CASES), "what goes wrong", CASES),
        Option("--grade", "NAVIGATION", "of sensors", [grade.name for grade in Grade]),
        Option("--seed", 0, "of the first case"),
        Option("--jobs", 2, "processes"),
    )
    args = page.args
    os.environ["OPENBLAS_NUM_THREADS"] = "1"  # for the processes that are begun from here
    runs = run_all(args)
    size = f"{args.hours:g} h of {{}} case, {args.dvl_hz:g} Hz DVL, {args.grade.lower()} grade"
    page.write([f"{size.format('each')}.\n{LEGEND}", *report(runs)])
    for folder in page.places(RESULTS):
        save(draw(runs, size.format("every")), folder / "soak.png")
    is_bad = any(goals(run)[-1] != "yes" for run in runs)
    note("goals missed" if is_bad else "all goals met")


if __name__ == "__main__":
    main()
