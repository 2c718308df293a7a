"""Innovations and weights, beam by beam: which of them were believed, and when."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.gridspec import SubplotSpec
from matplotlib.ticker import FuncFormatter, NullLocator

from ssm_graph.base.frozen import Array
from ssm_graph.mission.estimate import OUTLIER_WEIGHT, BeamTable
from ssm_graph.report.mission.style import (
    NOMINAL,
    OUTLIER,
    REDUCED,
    REDUCED_WEIGHT,
    SMALL,
    dress,
    thinned_outliers_first,
    time_axis,
)
from ssm_graph.sensors.dvl import N_BEAMS

CLASSES: Final = (
    (REDUCED_WEIGHT, np.inf, NOMINAL, f"weight ≥ {REDUCED_WEIGHT:g}", 1.6),
    (OUTLIER_WEIGHT, REDUCED_WEIGHT, REDUCED, "reduced", 3.0),
    (-np.inf, OUTLIER_WEIGHT, OUTLIER, f"below {OUTLIER_WEIGHT:g}", 3.4),
)
"""Least and largest weight, colour, name and size of the three kinds of points."""


def draw_beams(
    figure: Figure,
    place: SubplotSpec,
    beams: BeamTable,
    *,
    trajectory_s: Array,
) -> None:
    """Draw innovations above weights, a column per beam, all on the same scales."""
    divisor, label = time_axis(trajectory_s)
    span = float(np.ptp(trajectory_s)) / divisor or 1.0
    grid = place.subgridspec(2, N_BEAMS, height_ratios=[1.35, 1.0])
    upper: list[Axes] = []
    left: list[Axes] = []
    for beam in range(N_BEAMS):
        mine = np.flatnonzero(beams.beam == beam + 1)
        mine = mine[thinned_outliers_first(beams.weight[mine])]
        since = (beams.time_s[mine] - trajectory_s[0]) / divisor
        first = upper[0] if upper else None
        innovation = figure.add_subplot(grid[0, beam], sharey=first)
        weight = figure.add_subplot(grid[1, beam], sharex=innovation)
        _scatter(innovation, since, beams.innovation[mine], beams.weight[mine])
        _scatter(weight, since, beams.weight[mine], beams.weight[mine])
        innovation.set_xlim(-0.03 * span, 1.03 * span)
        weight.set_ylim(-0.06, max(1.06, 1.06 * float(np.max(beams.weight, initial=1.0))))
        dress(innovation, title=f"Beam {beam + 1}", y="" if upper else "innovation, m/s")
        dress(weight, x=label, y="" if upper else "weight, –")
        innovation.tick_params(labelbottom=False, labelleft=not upper)
        weight.tick_params(labelleft=not upper)
        upper.append(innovation)
        left = left or [innovation, weight]
    figure.align_ylabels(left)
    _symlog(upper[0], beams.innovation)
    _class_legend(figure, upper[0])


def _scatter(axes: Axes, since: Array, values: Array, weight: Array) -> None:
    for low, high, color, name, size in CLASSES:
        mine = (weight >= low) & (weight < high)
        axes.plot(
            since[mine],
            values[mine],
            "o",
            color=color,
            markersize=size,
            markeredgewidth=0.0,
            alpha=0.55 if color == NOMINAL else 0.9,
            label=name,
            rasterized=True,
        )


def _symlog(axes: Axes, innovation: Array) -> None:
    """Scale linearly over the normal noise and logarithmically beyond, where outliers are."""
    size = np.abs(innovation[np.isfinite(innovation)])
    if len(size) == 0:
        return
    noise = 1.4826 * float(np.median(size)) or 1e-3
    linear = 5.0 * noise
    largest = 1.5 * max(float(size.max()), linear)
    axes.set_yscale("symlog", linthresh=linear, linscale=1.5)
    axes.set_ylim(-largest, largest)
    decades = 10.0 ** np.arange(np.ceil(np.log10(linear)), np.ceil(np.log10(largest)))
    near = _round(2.5 * noise)
    ticks = [0.0, near, *decades[decades > 1.5 * near]]
    axes.set_yticks([*(-tick for tick in reversed(ticks[1:])), *ticks])
    axes.yaxis.set_minor_locator(NullLocator())
    axes.yaxis.set_major_formatter(FuncFormatter(_plain))


def _round(value: float) -> float:
    """Return the value to one digit."""
    return float(f"{value:.0e}")


def _plain(value: float, _position: Any) -> str:
    return f"{value:g}".replace("-", "−")


def _class_legend(figure: Figure, axes: Axes) -> None:
    handles, names = axes.get_legend_handles_labels()
    figure.legend(
        handles,
        names,
        loc="outside lower center",
        ncols=len(names),
        fontsize=SMALL,
        frameon=False,
        markerscale=1.6,
    )
