"""Innovations and weights of beams, however many: which of them were believed, and when."""

from __future__ import annotations

import math
from typing import Any, Final, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import FuncFormatter, NullLocator

from ssm_graph.base.frozen import Array
from ssm_graph.mission.estimate import OUTLIER_WEIGHT, BeamTable
from ssm_graph.report import style

CLASSES: Final = (
    (style.REDUCED_WEIGHT, np.inf, style.NOMINAL, f"weight ≥ {style.REDUCED_WEIGHT:g}", 1.6),
    (OUTLIER_WEIGHT, style.REDUCED_WEIGHT, style.REDUCED, "reduced", 3.0),
    (-np.inf, OUTLIER_WEIGHT, style.OUTLIER, f"below {OUTLIER_WEIGHT:g}", 3.4),
)
"""Least and largest weight, colour, name and size of the three kinds of points."""


class BeamPoints(NamedTuple):
    """The speeds of one beam, thinned to what a panel can show."""

    time_s: Array
    innovation: Array
    weight: Array


def points_of(beams: BeamTable, beam: int) -> BeamPoints:
    """Return the points of a beam, counted from 0; outliers are thinned last."""
    mine = np.flatnonzero(beams.beam == beam + 1)
    mine = mine[style.thinned_outliers_first(beams.weight[mine])]
    return BeamPoints(beams.time_s[mine], beams.innovation[mine], beams.weight[mine])


def dots(color: str, size: float, **options: Any) -> dict[str, Any]:
    """Return the options of points."""
    look = {"linestyle": "", "marker": "o", "markeredgewidth": 0.0, "alpha": 0.9}
    return {"color": color, "markersize": size, "rasterized": True, **look, **options}


def draw_points(axes: Axes, since: Array, values: Array, weight: Array) -> None:
    """Draw values over time, each point by the class of its weight."""
    for low, high, color, name, size in CLASSES:
        mine = (weight >= low) & (weight < high)
        alpha = 0.55 if color == style.NOMINAL else 0.9
        axes.plot(since[mine], values[mine], **dots(color, size, alpha=alpha, label=name))


def top_of_weights(*tables: BeamTable) -> float:
    """Return where an axis of weights ends: 1 or what is more."""
    return 1.06 * max(float(np.nanmax(table.weight, initial=1.0)) for table in tables)


def innovation_axis(axes: Axes, innovation: Array) -> float | None:
    """Scale linearly over the normal noise and logarithmically beyond, where outliers are.

    Returns where the one becomes the other, None where there is nothing to scale.
    """
    size = np.abs(innovation[np.isfinite(innovation)])
    if len(size) == 0:
        return None
    noise = 1.4826 * float(np.median(size)) or 1e-3
    linear = 5.0 * noise
    largest = 1.5 * max(float(size.max()), linear)
    axes.set_yscale("symlog", linthresh=linear, linscale=1.5)
    axes.set_ylim(-largest, largest)
    near = float(f"{2.5 * noise:.0e}")
    decades = 10.0 ** np.arange(math.ceil(math.log10(linear)), math.ceil(math.log10(largest)))
    decades = decades[decades > 1.5 * near]
    ticks = [near, *decades[:: max(1, math.ceil(len(decades) / 2))]]
    axes.set_yticks([*(-tick for tick in reversed(ticks)), 0.0, *ticks])
    axes.yaxis.set_minor_locator(NullLocator())
    axes.yaxis.set_major_formatter(FuncFormatter(lambda v, _: f"{v:g}".replace("-", "−")))
    return linear
