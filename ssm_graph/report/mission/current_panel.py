"""The current of the water over time inside its 3-sigma bounds."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes

from ssm_graph.mission.estimate import CurrentTrack
from ssm_graph.report.mission.style import EAST_NORTH_UP, dress, legend, thinned, time_axis

AXES_NAMES = ("east", "north", "up")


def draw_current(axes: Axes, current: CurrentTrack) -> None:
    """Draw the components that were estimated, each with its own bounds."""
    divisor, label = time_axis(current.time_s)
    shown = thinned(len(current.time_s))
    since = (current.time_s[shown] - current.time_s[0]) / divisor
    sigma_enu = current.sigma_enu
    for i in np.flatnonzero(sigma_enu.any(axis=0)):
        value, bound = current.velocity_enu[shown, i], 3.0 * sigma_enu[shown, i]
        color = EAST_NORTH_UP[i]
        axes.fill_between(since, value - bound, value + bound, color=color, alpha=0.2, linewidth=0)
        axes.plot(since, value, color=color, linewidth=0.9, label=AXES_NAMES[i])
    dress(axes, title="Current of the water, with ±3σ", x=label, y="current, m/s")
    legend(axes, loc="lower right", bbox_to_anchor=(1.0, 0.98), ncols=3, borderpad=0.0)
