"""Figures of a located drive: particles, the last picture on the map, rivals, error and sigma."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes

from ssm_graph.base.frozen import Array
from ssm_graph.report.places import box_around, draw_snapshots, write_share
from ssm_graph.report.style import (
    DPI,
    ESTIMATE,
    GREY,
    INK,
    OUTLIER,
    REDUCED,
    REFERENCE,
    dress,
    legend,
    new_figure,
)
from ssm_graph.systems.road_map.drive import Drive, Poses
from ssm_graph.systems.road_map.locate import Located
from ssm_graph.systems.road_map.maps.road_map import LineKind, Mark, RoadMap
from ssm_graph.systems.road_map.refinement import sigmas_of
from ssm_graph.systems.road_map.window import in_plane

_MARGIN_M: Final = 25.0
_LEAST_SHOWN_M: Final = 1e-3
"""An error that changes its sign would stretch a logarithmic axis without end; maps hold 1 mm."""
_COLOURS: Final = ("#9DB7CC", "#56B4E9", "#0072B2", "#004466")


def located_figure(path: Path, drive: Drive, road_map: RoadMap, found: Located) -> None:
    """Write the figure of a drive: four panels."""
    figure = new_figure(11.0, 8.0, f"{drive.name}: {found.verdict.name}")
    axes = figure.subplots(2, 2)
    _particles(axes[0, 0], drive, road_map, found)
    _overlay(axes[0, 1], drive, road_map, found)
    _hypotheses(axes[1, 0], road_map, found)
    _errors(axes[1, 1], drive, found)
    figure.savefig(path, dpi=DPI)


def _draw_map(axes: Axes, road_map: RoadMap, low: Array, high: Array) -> None:
    for line in road_map.lines:
        if np.any(line.points.max(axis=0) < low) or np.any(line.points.min(axis=0) > high):
            continue
        style: dict[str, Any] = {"color": INK, "linewidth": 0.8}
        if line.kind is LineKind.LANE_LINE:
            dash = "--" if line.mark is Mark.DASHED else "-"
            style = {"color": GREY, "linewidth": 0.7, "linestyle": dash}
        axes.plot(*line.points.T, **style, zorder=1)
    axes.set_xlim(low[0], high[0])
    axes.set_ylim(low[1], high[1])
    axes.set_aspect("equal", adjustable="box")


def _particles(axes: Axes, drive: Drive, road_map: RoadMap, found: Located) -> None:
    places = [found.track.pose[:, :2], drive.gnss.x_y]
    if drive.truth is not None:
        places.append(drive.truth.x_y)
    low, high = box_around(places, _MARGIN_M)
    middle, half_m = 0.5 * (low + high), 0.5 * float((high - low).max())
    low, high = middle - half_m, middle + half_m  # room for the legend beside a straight way
    _draw_map(axes, road_map, low, high)
    draw_snapshots(axes, found.snapshots, _COLOURS, digits=1)
    axes.plot(*drive.gnss.x_y.T, "x", color=REDUCED, markersize=4.0, label="GNSS")
    if drive.truth is not None:
        axes.plot(*drive.truth.x_y.T, color=REFERENCE, linewidth=1.0, label="truth")
    axes.plot(*found.track.pose[:, :2].T, color=ESTIMATE, linewidth=1.0, label="mean")
    dress(axes, title="Particles over time", x="x (m)", y="y (m)")
    legend(axes, loc="best")


def _overlay(axes: Axes, drive: Drive, road_map: RoadMap, found: Located) -> None:
    low, high = found.pose[:2] - 30.0, found.pose[:2] + 30.0
    _draw_map(axes, road_map, low, high)
    curves = drive.curves
    rows = np.flatnonzero(curves.time_s == found.track.time_s[-1])
    for row in rows:
        points = curves.points(np.array([row]), 20)[0]
        colour = OUTLIER if curves.kind[row] == LineKind.BOUNDARY else ESTIMATE
        axes.plot(*in_plane(found.pose, points), color=colour, linewidth=1.6, alpha=0.8)
    _arrow(axes, found.pose, ESTIMATE, "estimate")
    if drive.truth is not None:
        _arrow(axes, drive.truth.at(found.track.time_s[-1:])[0], REFERENCE, "truth")
    title = "Last picture on the map (red: boundaries, blue: lane lines)"
    dress(axes, title=title, x="x (m)", y="y (m)")
    legend(axes, loc="best")


def _arrow(axes: Axes, pose: Array, colour: str, label: str) -> None:
    ahead = pose[:2] + 4.0 * np.array([np.cos(pose[2]), np.sin(pose[2])])
    axes.plot(*np.column_stack([pose[:2], ahead]), color=colour, linewidth=2.0, label=label)
    axes.plot(*pose[:2], "o", color=colour, markersize=4.0)


def _hypotheses(axes: Axes, road_map: RoadMap, found: Located) -> None:
    told = found.hypotheses[:8]
    places = np.array([h.pose for h in told] or [tuple(found.pose)])
    low, high = box_around([places[:, :2]], 20.0)
    _draw_map(axes, road_map, low, high)
    for number, hypothesis in enumerate(told):
        _arrow(axes, np.array(hypothesis.pose), ESTIMATE if number == 0 else REDUCED, "")
        write_share(axes, hypothesis.pose, hypothesis.share)
    dress(axes, title="Places that the last stretch allows, with evidence", x="x (m)", y="y (m)")


def _errors(axes: Axes, drive: Drive, found: Located) -> None:
    track = found.track
    sigmas = np.array([sigmas_of(p, c) for p, c in zip(track.pose, track.cov, strict=True)])
    names = ("across", "along")
    for column, (name, colour) in enumerate(zip(names, (ESTIMATE, REDUCED), strict=True)):
        axes.plot(
            track.driven_m,
            2.0 * sigmas[:, column],
            "--",
            color=colour,
            linewidth=0.9,
            label=f"2 sigma {name}",
        )
        if drive.truth is not None:
            error = _error(drive.truth, found)[:, column]
            axes.plot(track.driven_m, np.abs(error), color=colour, label=f"error {name}")
    if np.isfinite(found.first_fix_m):
        axes.axvline(found.first_fix_m, color=GREY, linewidth=0.8, label="lane first known")
    axes.set_yscale("log")
    axes.set_ylim(bottom=_LEAST_SHOWN_M)
    dress(axes, title="Error and sigma of the particles", x="driven (m)", y="error, 2 sigma (m)")
    legend(axes, loc="best")


def _error(truth: Poses, found: Located) -> Array:
    at = truth.at(found.track.time_s)
    d = found.track.pose[:, :2] - at[:, :2]
    c, s = np.cos(at[:, 2]), np.sin(at[:, 2])
    return np.column_stack([c * d[:, 1] - s * d[:, 0], c * d[:, 0] + s * d[:, 1]])
