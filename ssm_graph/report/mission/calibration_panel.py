"""What was found of the instruments, each value beside what was known of it before."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes

from ssm_graph.mission.estimate import Calibration, Determined
from ssm_graph.report.mission.style import BOUND, EAST_NORTH_UP, OUTLIER, REDUCED, SMALL, dress

COLOURS = {
    Determined.GREEN: EAST_NORTH_UP[2],
    Determined.AMBER: REDUCED,
    Determined.RED: OUTLIER,
}
LEVEL = 6
"""So many labels have room side by side."""


def draw_calibration(axes: Axes, calibration: Calibration) -> None:
    """Draw each value with three of its sigmas, in units of the sigma that it had before."""
    values = calibration.values
    axes.axhspan(-3.0, 3.0, color=BOUND, alpha=0.35, linewidth=0.0)
    for i, value in enumerate(values):
        axes.errorbar(
            i,
            value.value / value.prior_sigma,
            yerr=3.0 * value.sigma / value.prior_sigma,
            fmt="o",
            color=COLOURS[value.determined],
            markersize=3.0,
            elinewidth=1.2,
            capsize=2.0,
        )
    labels = [f"{v.label}\n{v.value / v.unit:.3g}" for v in values]
    axes.set_xticks(np.arange(len(values)), labels)
    if len(values) > LEVEL:
        axes.tick_params(axis="x", labelrotation=18.0)
    axes.set_xlim(-0.7, len(values) - 0.3)
    title = "Calibration: off what is stated, with ±3σ; the band is what was known before"
    dress(axes, title=title, y="sigmas before")
    axes.tick_params(axis="x", labelsize=SMALL - 1.0)
    axes.grid(visible=False, axis="x")
