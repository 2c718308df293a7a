"""The track from above, with the pings at which a beam was rejected."""

from __future__ import annotations

from typing import Final

import numpy as np
from matplotlib.axes import Axes

from ssm_graph.base.earth import LocalFrame
from ssm_graph.base.frozen import Array
from ssm_graph.mission.estimate import OUTLIER_WEIGHT, Estimate
from ssm_graph.mission.mission import Reference
from ssm_graph.report.mission.style import (
    ESTIMATE,
    INK,
    OUTLIER,
    REFERENCE,
    broken_at_gaps,
    dress,
    legend,
    thinned,
)

MAX_MARKS: Final = 200
"""Rejected pings that are marked; more would hide the track."""


def draw_track(axes: Axes, estimate: Estimate, reference: Reference | None) -> None:
    """Draw east and north of the estimate's first keyframe, m or km."""
    trajectory = estimate.trajectory
    frame = LocalFrame(
        float(trajectory.lat[0]), float(trajectory.lon[0]), float(trajectory.height[0])
    )
    p_n = frame.p_n_from_geodetic(trajectory.lat, trajectory.lon, trajectory.height)
    largest = np.nanmax(np.abs(p_n[:, :2]), initial=0.0)
    unit, scale = ("km", 1e-3) if largest > 5000.0 else ("m", 1.0)
    if reference is not None:
        _draw_reference(axes, reference, frame, trajectory.time_s, scale=scale)
    shown = thinned(len(p_n))
    axes.plot(*(scale * p_n[shown, :2].T), color=ESTIMATE, linewidth=1.3, label="estimate")
    rejected = _rejected_times(estimate)
    if len(rejected):
        at = scale * np.column_stack(
            [np.interp(rejected, trajectory.time_s, p_n[:, i]) for i in range(2)]
        )
        label = f"beam weight < {OUTLIER_WEIGHT:g}"
        axes.plot(*at.T, "x", color=OUTLIER, markersize=3.2, markeredgewidth=0.8, label=label)
    axes.plot(*(scale * p_n[0, :2]), "o", color=INK, markersize=5.5, label="start")
    axes.plot(
        *(scale * p_n[-1, :2]), "s", color=INK, markersize=5.5, markerfacecolor="white", label="end"
    )
    dress(axes, title="Track", x=f"east, {unit}", y=f"north, {unit}")
    axes.set_aspect("equal", adjustable="datalim")
    axes.margins(0.06)
    legend(
        axes,
        loc="upper left",
        bbox_to_anchor=(-0.04, -0.09),
        ncols=5,
        columnspacing=0.8,
        handletextpad=0.4,
    )


def _draw_reference(
    axes: Axes, reference: Reference, frame: LocalFrame, time_s: Array, *, scale: float
) -> None:
    """Draw the part of the reference that belongs to the estimate's time."""
    p_n = frame.p_n_from_geodetic(reference.lat, reference.lon, reference.height)
    kept = np.isfinite(p_n).all(axis=1)
    kept &= (reference.time_s >= time_s[0] - 1.0) & (reference.time_s <= time_s[-1] + 1.0)
    _, track = broken_at_gaps(reference.time_s[kept], scale * p_n[kept, :2])
    track = track[thinned(len(track))]
    axes.plot(*track.T, color=REFERENCE, linewidth=2.6, alpha=0.35, label="reference")


def _rejected_times(estimate: Estimate) -> Array:
    times = np.unique(estimate.beams.time_s[estimate.beams.weight < OUTLIER_WEIGHT])
    return np.asarray(times[thinned(len(times), MAX_MARKS)])
