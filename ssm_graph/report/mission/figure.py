"""One page that shows a run: track, errors against their bounds, and what each beam was worth."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.gridspec import SubplotSpec
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from ssm_graph.base.earth import LocalFrame
from ssm_graph.base.errors import DataError
from ssm_graph.base.frozen import Array
from ssm_graph.evaluation.errors import ErrorSeries, Metrics, evaluate
from ssm_graph.mission.estimate import (
    OUTLIER_WEIGHT,
    Calibration,
    CurrentTrack,
    Determined,
    Estimate,
    Trajectory,
)
from ssm_graph.mission.fault import DetectedFault
from ssm_graph.mission.mission import Reference
from ssm_graph.report import style
from ssm_graph.report.beams import (
    draw_points,
    innovation_axis,
    points_of,
    top_of_weights,
)
from ssm_graph.report.style import Band, Curve, Panel

PAGE_INCHES = (8.27, 10.8)
PAGE_DPI = 170
AXES_NAMES = ("east", "north", "up")
MAX_TITLE: Final = 80
"""Letters of a heading that fit the page."""
MARKS_ACROSS: Final = 18
"""Cells across the track, in each of which one rejected ping is marked; more would bury it."""
WIDE_BEAMS: Final = 4
"""So many panels have room for a full time axis side by side."""
LEVEL_LABELS: Final = 6
"""So many labels have room side by side."""
COLOURS: Final = {
    Determined.GREEN: style.EAST_NORTH_UP[2],
    Determined.AMBER: style.REDUCED,
    Determined.RED: style.OUTLIER,
}


def save_figure(
    path: Path | str, estimate: Estimate, reference: Reference | None = None, *, title: str = ""
) -> None:
    """Draw one estimate on a page and save it; the ending of ``path`` decides the format.

    With a reference errors are shown inside their 3-sigma bounds, else the bounds alone. Long
    runs are thinned to what a page can show; outliers are kept.

    Raises :class:`DataError`: there is nothing to draw, or the file cannot be written.

    Parameters
    ----------
    path : for example ``run/figure.png``; the folder must exist.
    estimate, reference : what is drawn; a reference without overlap in time is left out.
    title : heading of the page, for example the mission's name.
    """
    path = Path(path)
    if len(estimate.trajectory.time_s) == 0:
        raise DataError(f"{path}: cannot draw an estimate without keyframes")
    if not path.parent.is_dir():
        raise DataError(f"{path}: cannot write the figure: no folder {str(path.parent)!r}")
    figure = draw_figure(estimate, reference, title=title)
    known = figure.canvas.get_supported_filetypes()
    if path.suffix.removeprefix(".").lower() not in known:
        raise DataError(
            f"{path}: cannot write a figure of type {path.suffix!r}; known are {', '.join(known)}"
        )
    style.save(figure, path, dpi=PAGE_DPI)


def draw_figure(
    estimate: Estimate, reference: Reference | None = None, *, title: str = ""
) -> Figure:
    """Return the page as a figure that belongs to no window and no global state."""
    trajectory = estimate.trajectory
    metrics = _metrics(trajectory, reference)
    errors = metrics.errors if metrics else None
    layout = ConstrainedLayoutEngine(h_pad=0.05, w_pad=0.05)
    figure = Figure(figsize=PAGE_INCHES, layout=layout)
    title = title if len(title) <= MAX_TITLE else f"{title[:MAX_TITLE]}…"
    heading = figure.suptitle(f"{title or 'Estimate'}\n", x=0.012, ha="left", color=style.INK)
    heading.set(fontsize=12.0, fontweight="bold", linespacing=1.4)
    caption = _caption(estimate, metrics)
    figure.text(0.012, 0.973, caption, va="top", fontsize=style.SMALL + 0.5, color=style.INK)
    further = _further_panels(estimate)
    heights = [5.9 - 0.6 * len(further), 3.5 - 0.5 * len(further), *(1.1 for _ in further)]
    grid = figure.add_gridspec(len(heights), 1, height_ratios=heights)
    upper = grid[0].subgridspec(4, 2, width_ratios=[1.2, 1.0], height_ratios=[1.0, 1.0, 1.0, 1.25])
    _draw_track(figure.add_subplot(upper[:3, 0]), estimate, reference if errors else None)
    places = (upper[0, 1], upper[1, 1], upper[2, 1], upper[3, 0], upper[3, 1])
    for panel, place in zip(_error_panels(trajectory, errors), places, strict=True):
        axes = figure.add_subplot(place)
        style.draw_panel(axes, panel)
        axes.tick_params(labelbottom=bool(panel.x))
    _draw_beams(figure, grid[1], estimate)
    for row, draw in enumerate(further, start=2):
        draw(figure.add_subplot(grid[row]))
    return figure


def _further_panels(estimate: Estimate) -> list[Callable[[Axes], None]]:
    """Return what draws the panels that not every run has."""
    current, calibration, faults = estimate.current, estimate.calibration, estimate.faults
    panels: list[Callable[[Axes], None]] = []
    if faults:
        panels.append(lambda axes: _draw_faults(axes, faults, estimate.trajectory.time_s))
    if current is not None:
        panels.append(lambda axes: style.draw_panel(axes, _current_panel(current)))
    if calibration is not None:
        panels.append(lambda axes: _draw_calibration(axes, calibration))
    return panels


def _metrics(trajectory: Trajectory, reference: Reference | None) -> Metrics | None:
    if reference is None:
        return None
    try:
        return evaluate(trajectory, reference)
    except DataError:  # no overlap: `evaluate` says so elsewhere, the page is drawn without
        return None


def _caption(estimate: Estimate, metrics: Metrics | None) -> str:
    parts = [estimate.method, estimate.kernel, estimate.status.name]
    if metrics is not None:
        parts.append(f"horizontal error {metrics.rmse_horizontal_m:.3g} m rms")
        parts.append(f"{metrics.end_error_m:.3g} m at the end")
        if metrics.path_length_m > 0.0:
            parts.append(f"{metrics.drift_percent:.2g} % of {metrics.path_length_m:.0f} m")
    return "  ·  ".join(parts)


def _corner(n_columns: int) -> dict[str, Any]:
    """Return the options of a legend beside the title."""
    place = {"loc": "lower right", "bbox_to_anchor": (1.0, 0.98), "borderpad": 0.0}
    return {**place, "ncols": n_columns, "columnspacing": 1.0}


def _error_panel(
    what: str,
    trajectory: Trajectory,
    errors: ErrorSeries | None,
    values: Array | None,
    sigma: Array,
    *,
    names: Sequence[str],
    colors: Sequence[str] = style.EAST_NORTH_UP,
    **look: Any,
) -> Panel:
    """Return errors (E, C) inside the widest of the bounds (K, C) that the estimator claims.

    Without errors these are shown: one as a band, several as a curve each.
    """
    divisor, x = style.time_axis(trajectory.time_s)
    kept = style.thinned(len(sigma))
    since = (trajectory.time_s[kept] - trajectory.time_s[0]) / divisor
    known = errors is not None and values is not None and bool(np.isfinite(values).any())
    look = {"x": x, "title": f"{what} {'error' if known else 'uncertainty'}", **look}
    if not known and len(names) > 1:
        curves = [
            Curve(since, 3.0 * s[kept], _line(color, f"3σ {name}"))
            for s, color, name in zip(sigma.T, colors, names, strict=False)
        ]
        return Panel(curves=curves, y_limits=(0.0, None), **look)
    widest = sigma.max(axis=1)
    bound = 3.0 * widest[kept]
    band = Band(since, -bound, bound, {"color": style.BOUND, "alpha": 0.45, "label": "±3σ"})
    curves = []
    if errors is not None and values is not None and known:
        kept = style.thinned(len(values))
        error_s = (errors.time_s[kept] - trajectory.time_s[0]) / divisor
        for value, color, name in zip(values[kept].T, colors, names, strict=False):
            curves.append(Curve(*style.broken_at_gaps(error_s, value), _line(color, name)))
    limit = _limit(values if known else np.zeros(1), widest)
    return Panel(bands=[band], curves=curves, y_limits=limit, **look)


def _line(color: str, label: str) -> dict[str, Any]:
    return {"color": color, "linewidth": 0.9, "label": label}


def _limit(error: Array | None, sigma: Array) -> tuple[float, float] | None:
    """Return limits that show all of the error and, unless they dwarf it, all of the bounds."""
    largest = 0.0 if error is None else float(np.nanmax(np.abs(error), initial=0.0))
    bound = 3.0 * float(np.nanmax(sigma, initial=0.0))
    limit = 1.1 * max(largest, min(bound, 8.0 * largest) if largest > 0.0 else bound)
    return (-limit, limit) if np.isfinite(limit) and limit > 0.0 else None


def _error_panels(trajectory: Trajectory, errors: ErrorSeries | None) -> list[Panel]:
    """Return east, north and up, then the velocity, then the angle that a DVL track depends on."""
    variance = np.diagonal(trajectory.position_cov_enu, axis1=1, axis2=2)
    position, velocity = np.sqrt(np.maximum(variance, 0.0)), trajectory.velocity_sigma_enu
    heading = np.rad2deg(trajectory.attitude_sigma[:, [2]])
    known: list[Array | None] = [None] * 5
    if errors is not None:
        known = [errors.position_enu[:, [i]] for i in range(3)]
        known += [errors.velocity_enu, np.rad2deg(errors.roll_pitch_heading[:, [2]])]
    own = trajectory, errors
    panels = []
    for i, axis in enumerate(AXES_NAMES):
        look: dict[str, Any] = {"y": f"{axis}, m", "colors": [style.EAST_NORTH_UP[i]]}
        look |= {"legend": _corner(2)} if i == 0 else {"title": ""}
        look |= {} if i == 2 else {"x": ""}
        sigma = position[:, [i]]
        panels.append(_error_panel("Position", *own, known[i], sigma, names=["error"], **look))
    look = {"names": AXES_NAMES, "y": "velocity, m/s", "legend": _corner(4)}
    panels.append(_error_panel("Velocity", *own, known[3], velocity, **look))
    look = {"names": ["error"], "y": "heading, deg"}
    return [*panels, _error_panel("Heading", *own, known[4], heading, **look)]


def _current_panel(current: CurrentTrack) -> Panel:
    """Return the components of the current that were estimated, each with its own bounds."""
    divisor, x = style.time_axis(current.time_s)
    kept = style.thinned(len(current.time_s))
    since = (current.time_s[kept] - current.time_s[0]) / divisor
    value, bound = current.velocity_enu[kept], 3.0 * current.sigma_enu[kept]
    bands, curves = [], []
    for i in np.flatnonzero(current.sigma_enu.any(axis=0)):
        low, high = value[:, i] - bound[:, i], value[:, i] + bound[:, i]
        color = style.EAST_NORTH_UP[i]
        bands.append(Band(since, low, high, {"color": color, "alpha": 0.2}))
        curves.append(Curve(since, value[:, i], _line(color, AXES_NAMES[i])))
    title = "Current of the water, with ±3σ"
    look: dict[str, Any] = {"title": title, "x": x, "y": "current, m/s", "legend": _corner(3)}
    return Panel(bands=bands, curves=curves, **look)


def _draw_faults(axes: Axes, faults: Sequence[DetectedFault], time_s: Array) -> None:
    """Draw a row for each sensor that was off, a bar from when to when with what it did."""
    divisor, x = style.time_axis(time_s)
    sensors = list(dict.fromkeys(fault.sensor for fault in faults))
    for fault in faults:
        row, begin = sensors.index(fault.sensor), (fault.begin_s - time_s[0]) / divisor
        color = style.OUTLIER if fault.is_suspect else style.REDUCED
        width = (fault.end_s - fault.begin_s) / divisor
        axes.barh(row, width, left=begin, height=0.7, color=color, alpha=0.75)
        is_late = begin > 0.6 * np.ptp(time_s) / divisor
        place = {"ha": "right", "x": begin + width} if is_late else {"ha": "left", "x": begin}
        axes.text(y=row, s=f" {fault.what} ", va="center", fontsize=style.SMALL - 1.0, **place)
    axes.set_yticks(np.arange(len(sensors)), sensors)
    axes.set_ylim(len(sensors) - 0.5, -0.5)
    axes.set_xlim(0.0, np.ptp(time_s) / divisor or 1.0)
    title = "Sensors that were off; red where the answer may be wrong for it"
    style.dress(axes, title=title, x=x)


def _draw_calibration(axes: Axes, calibration: Calibration) -> None:
    """Draw each value with three of its sigmas, in units of the sigma that it had before."""
    values = calibration.values
    axes.axhspan(-3.0, 3.0, color=style.BOUND, alpha=0.35, linewidth=0.0)
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
    if len(values) > LEVEL_LABELS:
        axes.tick_params(axis="x", labelrotation=18.0)
    axes.set_xlim(-0.7, len(values) - 0.3)
    title = "Calibration: off what is stated, with ±3σ; the band is what was known before"
    style.dress(axes, title=title, y="sigmas before")
    axes.tick_params(axis="x", labelsize=style.SMALL - 1.0)
    axes.grid(visible=False, axis="x")


def _draw_track(axes: Axes, estimate: Estimate, reference: Reference | None) -> None:
    """Draw east and north of the first keyframe, m or km, with the pings of rejected beams."""
    path = estimate.trajectory
    frame = LocalFrame(float(path.lat[0]), float(path.lon[0]), float(path.height[0]))
    p_n = frame.p_n_from_geodetic(path.lat, path.lon, path.height)[:, :2]
    unit, scale = ("km", 1e-3) if np.nanmax(np.abs(p_n), initial=0.0) > 5000.0 else ("m", 1.0)
    p_n = scale * p_n
    curves = []
    if reference is not None:
        track = scale * _reference_track(reference, frame, path.time_s)
        look = {"color": style.REFERENCE, "linewidth": 2.6, "alpha": 0.35, "label": "reference"}
        curves.append(Curve(track[:, 0], track[:, 1], look))
    look = {"color": style.ESTIMATE, "linewidth": 1.3, "label": "estimate"}
    kept = style.thinned(len(p_n))
    curves.append(Curve(p_n[kept, 0], p_n[kept, 1], look))
    rejected = np.unique(estimate.beams.time_s[estimate.beams.weight < OUTLIER_WEIGHT])
    if len(rejected):
        at = np.column_stack([np.interp(rejected, path.time_s, column) for column in p_n.T])
        at = at[_apart(at, p_n)]
        look = {"marker": "x", "markersize": 3.0, "markeredgewidth": 0.7, "color": style.OUTLIER}
        look |= {"linestyle": "", "alpha": 0.7}
        look |= {"label": f"beam weight < {OUTLIER_WEIGHT:g} ({len(rejected)} pings)"}
        curves.append(Curve(at[:, 0], at[:, 1], look))
    for place, marker, face, label in ((0, "o", style.INK, "start"), (-1, "s", "white", "end")):
        look = {"marker": marker, "color": style.INK, "markersize": 5.5, "markerfacecolor": face}
        look |= {"linestyle": "", "label": label}
        curves.append(Curve(p_n[[place], 0], p_n[[place], 1], look))
    below = {"loc": "upper left", "bbox_to_anchor": (-0.04, -0.09), "ncols": 5}
    below |= {"columnspacing": 0.8, "handletextpad": 0.4}
    x, y = f"east, {unit}", f"north, {unit}"
    style.draw_panel(axes, Panel(title="Track", x=x, y=y, curves=curves, legend=below))
    axes.set_aspect("equal", adjustable="datalim")
    axes.margins(0.06)


def _apart(marks: Array, track: Array) -> NDArray[np.intp]:
    """Return which marks (M, 2) to show, one in each of the cells that the track's extent has."""
    extent = float(np.nanmax(np.ptp(track, axis=0), initial=0.0)) or 1.0
    cells = np.floor(marks / extent * MARKS_ACROSS)
    return np.unique(cells, axis=0, return_index=True)[1]


def _reference_track(reference: Reference, frame: LocalFrame, time_s: Array) -> Array:
    """Return the part (M, 2) of the reference that belongs to the estimate's time, m."""
    p_n = frame.p_n_from_geodetic(reference.lat, reference.lon, reference.height)
    kept = np.isfinite(p_n).all(axis=1)
    kept &= (reference.time_s >= time_s[0] - 1.0) & (reference.time_s <= time_s[-1] + 1.0)
    _, track = style.broken_at_gaps(reference.time_s[kept], p_n[kept, :2])
    return np.asarray(track[style.thinned(len(track))])


def _draw_beams(figure: Figure, place: SubplotSpec, estimate: Estimate) -> None:
    """Draw innovations above weights, a column per beam, all on the same scales."""
    beams, time_s, n_beams = estimate.beams, estimate.trajectory.time_s, estimate.n_beams
    divisor, label = style.time_axis(time_s)
    span = float(np.ptp(time_s)) / divisor or 1.0
    grid = place.subgridspec(2, n_beams, height_ratios=[1.35, 1.0])
    upper: list[Axes] = []
    lower: list[Axes] = []
    for beam in range(n_beams):
        points = points_of(beams, beam)
        since = (points.time_s - time_s[0]) / divisor
        first = upper[0] if upper else None
        innovation = figure.add_subplot(grid[0, beam], sharey=first)
        weight = figure.add_subplot(grid[1, beam], sharex=innovation)
        draw_points(innovation, since, points.innovation, points.weight)
        draw_points(weight, since, points.weight, points.weight)
        innovation.set_xlim(-0.03 * span, 1.03 * span)
        weight.set_ylim(-0.06, top_of_weights(beams))
        style.dress(innovation, title=f"Beam {beam + 1}", y="" if upper else "innovation, m/s")
        x = label if n_beams <= WIDE_BEAMS else label.replace("time since start", "time")
        style.dress(weight, x=x, y="" if upper else "weight, –")
        if n_beams > WIDE_BEAMS:
            weight.xaxis.set_major_locator(MaxNLocator(2))
        innovation.tick_params(labelbottom=False, labelleft=not upper)
        weight.tick_params(labelleft=not upper)
        upper.append(innovation)
        lower.append(weight)
    figure.align_ylabels([upper[0], lower[0]])
    linear = innovation_axis(upper[0], beams.innovation)
    for axes in upper if linear is not None else ():
        look = {"color": style.INK, "linewidth": 0.7, "alpha": 0.6, "dashes": (3, 3)}
        axes.axhline(linear, label="innovations logarithmic beyond", **look)
        axes.axhline(-linear, **look)
    handles, names = upper[0].get_legend_handles_labels()
    figure.legend(
        handles,
        names,
        loc="outside lower center",
        ncols=len(names),
        fontsize=style.SMALL,
        frameon=False,
        markerscale=1.6,
    )
