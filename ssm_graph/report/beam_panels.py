"""Innovations and weights, beam by beam: which of them were believed, and when."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.gridspec import SubplotSpec
from matplotlib.ticker import FuncFormatter, NullLocator

from ssm_graph.data import N_BEAMS, Array
from ssm_graph.estimate import BeamTable
from ssm_graph.report.style import (
    NOMINAL,
    OUTLIER,
    OUTLIER_WEIGHT,
    REDUCED,
    dress,
    thinned_outliers_first,
    time_axis,
)

REDUCED_WEIGHT: Final = 0.5
CLASSES: Final = (
    (REDUCED_WEIGHT, np.inf, NOMINAL, f"weight ≥ {REDUCED_WEIGHT:g}", 1.6),
    (OUTLIER_WEIGHT, REDUCED_WEIGHT, REDUCED, "reduced", 3.0),
    (-np.inf, OUTLIER_WEIGHT, OUTLIER, f"below {OUTLIER_WEIGHT:g}", 3.4),
)
"""Least and largest weight, colour, name and size of the three kinds of points."""


def draw_beams(
    figure: Figure,
    rows: tuple[SubplotSpec, SubplotSpec],
    beams: BeamTable,
    *,
    trajectory_s: Array,
) -> None:
    """Draw innovations above weights, a column per beam, all on the same scales."""
    divisor, label = time_axis(trajectory_s)
    span = (0.0, float(np.ptp(trajectory_s)) / divisor)
    shared: list[Axes | None] = [None, None]
    grids = [row.subgridspec(1, N_BEAMS) for row in rows]
    for beam in range(N_BEAMS):
        mine = np.flatnonzero(beams.beam == beam + 1)
        mine = mine[thinned_outliers_first(beams.weight[mine])]
        since = (beams.time_s[mine] - trajectory_s[0]) / divisor
        weight = beams.weight[mine]
        panels = []
        for row, values in enumerate((beams.innovation[mine], weight)):
            axes = figure.add_subplot(grids[row][beam], sharey=shared[row])
            shared[row] = shared[row] or axes
            _scatter(axes, since, values, weight)
            axes.set_xlim(span[0] - 0.02 * span[1], span[1] * 1.02 or 1.0)
            panels.append(axes)
        is_first = beam == 0
        dress(
            panels[0],
            title=f"Beam {beam + 1}",
            y="innovation, m/s" if is_first else "",
        )
        dress(panels[1], x=label, y="weight, –" if is_first else "")
        panels[0].tick_params(labelbottom=False)
        for axes in panels:
            axes.tick_params(labelleft=is_first)
        if is_first:
            _symlog(panels[0], beams.innovation)
            panels[1].set_ylim(-0.06, max(1.06, 1.06 * float(np.max(weight, initial=1.0))))
    _class_legend(figure, shared[0])


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


def _class_legend(figure: Figure, axes: Axes | None) -> None:
    if axes is None:
        return
    handles, names = axes.get_legend_handles_labels()
    figure.legend(
        handles,
        names,
        loc="outside lower center",
        ncols=len(names),
        fontsize=7.0,
        frameon=False,
        markerscale=1.6,
    )
