"""The figure of a soak: error with its band, health, memory and latency of every case."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from benchmarks.online.stream import HEALTHS
from benchmarks.soak.stream import HOUR_S, Soaked
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
)

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
    axes.fill_between(at, low, binned(band, edges), color=BOUND, linewidth=0.0, step="post")
    axes.step(at, binned(error, edges), color=OUTLIER, linewidth=0.8, where="post")
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


def binned(values: Array, edges: np.ndarray[tuple[int], np.dtype[np.intp]]) -> Array:
    """Return the largest value of each bin."""
    return np.asarray(np.fmax.reduceat(values, edges))
