"""The figure of a start on the seabed: particles over time, places, the last overlay, errors."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np
from matplotlib.axes import Axes

from ssm_graph.base.frozen import Array
from ssm_graph.mission.mission import Mission
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
from ssm_graph.sensors.seabed import SeabedGrid, TerrainLog
from ssm_graph.systems.seabed.dive import Dive
from ssm_graph.systems.seabed.locate import Located
from ssm_graph.systems.seabed.search import Stiff
from ssm_graph.systems.seabed.track import Track

_COLOURS: Final = ("#F6C28B", "#F0983E", "#C9561B", "#7A2A0B")
"""Of the particles, the later the darker."""
_MARGIN_M: Final = 120.0
_SHOWN_PINGS: Final = 400


def seabed_figure(path: Path, mission: Mission, dive: Dive) -> None:
    """Write the figure of a start that was looked for: four panels."""
    found, track = dive.located, dive.track
    assert found is not None
    assert track is not None
    log = mission.aids[TerrainLog]
    figure = new_figure(11.0, 9.0, f"{mission.name}: {found.verdict.name}")
    axes = figure.subplots(2, 2)
    truth = _truth(mission, log.grid, found.track.time_s)
    _particles(axes[0, 0], log.grid, found, truth)
    _places(axes[0, 1], log.grid, found, truth)
    _profile(axes[1, 0], log, track, found)
    _errors(axes[1, 1], found, truth)
    figure.savefig(path, dpi=DPI)


def _truth(mission: Mission, grid: SeabedGrid, time_s: Array) -> Array | None:
    """Return where the reference was (N, 2), m; None without one, and where no place is known."""
    r = mission.reference
    if r is None or mission.local is not None:
        return None
    lat, lon, height = (np.interp(time_s, r.time_s, a) for a in (r.lat, r.lon, r.height))
    return np.asarray(grid.frame.p_n_from_geodetic(lat, lon, height)[:, :2])


def _chart(axes: Axes, grid: SeabedGrid, low: Array, high: Array) -> None:
    x = np.linspace(low[0], high[0], 240)
    y = np.linspace(low[1], high[1], 240)
    depth = -grid.height_at(*np.meshgrid(x, y))
    if np.isfinite(depth).any():
        image = axes.pcolormesh(
            x, y, depth, cmap="Blues", shading="auto", rasterized=True, zorder=0
        )
        axes.figure.colorbar(image, ax=axes, label="depth (m)", shrink=0.85)
        if np.nanmax(depth) - np.nanmin(depth) > 0.5:
            axes.contour(x, y, depth, 12, colors=GREY, linewidths=0.4, zorder=1)
    axes.set_xlim(low[0], high[0])
    axes.set_ylim(low[1], high[1])
    axes.set_aspect("equal", adjustable="box")


def _window(places: list[Array], margin_m: float) -> tuple[Array, Array]:
    low, high = box_around(places, margin_m)
    half = 0.5 * float((high - low).max())
    middle = 0.5 * (low + high)
    return middle - half, middle + half


def _particles(axes: Axes, grid: SeabedGrid, found: Located, truth: Array | None) -> None:
    circle = found.middle + np.array([[-1.0, -1.0], [1.0, 1.0]]) * found.radius_m
    _chart(axes, grid, *_window([found.way, circle], 0.3 * _MARGIN_M))
    draw_snapshots(axes, found.snapshots, _COLOURS, digits=0)
    turn = np.linspace(0.0, 2.0 * np.pi, 100)
    x, y = found.middle[:, None] + found.radius_m * np.stack([np.cos(turn), np.sin(turn)])
    axes.plot(x, y, "--", color=INK, linewidth=0.8, label="searched", zorder=3)
    if truth is not None:
        axes.plot(*truth.T, color=REFERENCE, linewidth=1.2, label="truth", zorder=4)
    dress(axes, title="Particles over time", x="east (m)", y="north (m)")
    legend(axes, loc="best")


def _places(axes: Axes, grid: SeabedGrid, found: Located, truth: Array | None) -> None:
    told = found.hypotheses[:8]
    starts = np.array([h.pose[:2] for h in told])
    _chart(axes, grid, *_window([found.way, starts], _MARGIN_M))
    for number, h in enumerate(told):
        colour = ESTIMATE if number == 0 else REDUCED
        axes.plot(*h.pose[:2], "o", color=colour, markersize=5.0 if number == 0 else 3.5, zorder=5)
        write_share(axes, h.pose, h.share)
    axes.plot(*found.way.T, color=ESTIMATE, linewidth=1.4, label="way from the best place")
    if truth is not None:
        axes.plot(*truth.T, "--", color=REFERENCE, linewidth=1.0, label="truth")
    dress(axes, title="Places of the start, with evidence", x="east (m)", y="north (m)")
    legend(axes, loc="best")


def _profile(axes: Axes, log: TerrainLog, track: Track, found: Located) -> None:
    """Draw what each beam met against what the map has there."""
    stiff = Stiff.of(log.grid, log.errors, track, _SHOWN_PINGS)
    ends, _ = stiff.ends_at(np.array(found.hypotheses[0].pose)[None])
    mapped = -(log.grid.height_at(ends[0, ..., 0], ends[0, ..., 1]) + found.bias_m)
    met = np.where(stiff.share > 0.0, -stiff.heights, np.nan)
    since = stiff.track.time_s
    for beam in range(met.shape[1]):
        label = "map at the beams' ends" if beam == 0 else None
        axes.plot(since, mapped[:, beam], color=GREY, linewidth=0.9, label=label)
        label = "beams" if beam == 0 else None
        axes.plot(since, met[:, beam], ".", color=ESTIMATE, markersize=1.8, label=label)
    off = np.abs(met - mapped) > 3.0 * np.sqrt(stiff.sigma_sq)
    rows, beams = np.nonzero(off)
    axes.plot(
        since[rows], met[rows, beams], "x", color=OUTLIER, markersize=4.0, label="beyond 3 sigma"
    )
    low, high = np.nanmin(mapped), np.nanmax(mapped)
    axes.set_ylim(high + 0.25 * (high - low) + 1.0, low - 0.25 * (high - low) - 1.0)
    dress(axes, title="Seabed met by the beams, from the best place", x="time (s)", y="depth (m)")
    legend(axes, loc="best")


def _errors(axes: Axes, found: Located, truth: Array | None) -> None:
    t = found.track
    sigma = np.sqrt(np.linalg.eigvalsh(t.cov)[:, -1])
    axes.plot(
        t.time_s, 3.0 * sigma, "--", color=ESTIMATE, linewidth=0.9, label="3 sigma, particles"
    )
    if truth is not None:
        error = np.hypot(*(t.x_y - truth).T)
        axes.plot(t.time_s, error, color=ESTIMATE, label="error, particles")
        best = np.hypot(*(found.way - truth).T)
        axes.plot(t.time_s, best, color=REFERENCE, label="error of the way from the best place")
    axes.set_yscale("log")
    dress(axes, title="Error and sigma", x="time (s)", y="m")
    legend(axes, loc="best")
