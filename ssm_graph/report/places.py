"""What figures of a place that was looked for have in common: particles over time, shares."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from matplotlib.axes import Axes

from ssm_graph.base.frozen import Array
from ssm_graph.report.style import INK

_SHOWN_SHARE: Final = 1e-3
"""Shares below would be 0.0 %, and lie over each other."""


def draw_snapshots(
    axes: Axes, snapshots: Sequence[tuple[float, Array]], colours: Sequence[str], digits: int
) -> None:
    """Draw particles at a few of the times at which they were kept, one colour each.

    Parameters
    ----------
    snapshots : times, s, with particles (n, 2 or more), x and y first, m.
    digits : of the times in the legend.
    """
    picked = np.unique(np.linspace(0, len(snapshots) - 1, len(colours)).astype(int))
    for colour, row in zip(colours, picked, strict=False):
        when, states = snapshots[row]
        axes.plot(*states[:, :2].T, ".", color=colour, markersize=1.8, zorder=2)
        label = f"particles, {when:.{digits}f} s"
        axes.plot([], [], ".", color=colour, markersize=8.0, label=label)


def write_share(axes: Axes, pose: Sequence[float], share: float) -> None:
    """Write beside a place, x and y first, its share of the evidence; nothing beside none."""
    if share < _SHOWN_SHARE:
        return
    axes.annotate(
        f"{100.0 * share:.1f} %",
        (pose[0], pose[1]),
        fontsize=6.5,
        color=INK,
        xytext=(4, 3),
        textcoords="offset points",
        zorder=6,
    )


def box_around(places: Sequence[Array], margin_m: float) -> tuple[Array, Array]:
    """Return least and largest x and y (2,) of points (n, 2) with a margin about them, m."""
    low = np.min([p.min(axis=0) for p in places], axis=0) - margin_m
    return low, np.max([p.max(axis=0) for p in places], axis=0) + margin_m
