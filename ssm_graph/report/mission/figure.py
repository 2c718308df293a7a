"""One page that shows a run: track, errors against their bounds, and what each beam was worth."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine

from ssm_graph.base.errors import DataError
from ssm_graph.evaluation import Metrics, evaluate
from ssm_graph.mission.estimate import Estimate, Trajectory
from ssm_graph.mission.mission import Reference
from ssm_graph.report.mission.beam_panels import draw_beams
from ssm_graph.report.mission.calibration_panel import draw_calibration
from ssm_graph.report.mission.current_panel import draw_current
from ssm_graph.report.mission.error_panels import draw_heading, draw_position, draw_velocity
from ssm_graph.report.mission.style import INK, SMALL, save
from ssm_graph.report.mission.track_panel import draw_track

PAGE_INCHES = (8.27, 10.8)
PAGE_DPI = 170


def save_figure(
    path: Path | str, estimate: Estimate, reference: Reference | None = None, *, title: str = ""
) -> None:
    """Draw one estimate on a page and save it; the ending of ``path`` decides the format.

    With a reference errors are shown inside their 3-sigma bounds, else the bounds alone. Long
    runs are thinned to what a page can show; outliers are kept.

    Parameters
    ----------
    path : for example ``run/figure.png``; the folder must exist.
    estimate, reference : what is drawn; a reference without overlap in time is left out.
    title : heading of the page, for example the mission's name.

    Raises
    ------
    DataError
        There is nothing to draw, or the file cannot be written.
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
    save(figure, path, dpi=PAGE_DPI)


def draw_figure(
    estimate: Estimate, reference: Reference | None = None, *, title: str = ""
) -> Figure:
    """Return the page as a figure that belongs to no window and no global state."""
    trajectory = estimate.trajectory
    metrics = _metrics(trajectory, reference)
    errors = metrics.errors if metrics else None
    layout = ConstrainedLayoutEngine(h_pad=0.05, w_pad=0.05)
    figure = Figure(figsize=PAGE_INCHES, layout=layout)
    heading = figure.suptitle(f"{title or 'Estimate'}\n", x=0.012, ha="left", color=INK)
    heading.set(fontsize=12.0, fontweight="bold", linespacing=1.4)
    caption = _caption(estimate, metrics)
    figure.text(0.012, 0.973, caption, va="top", fontsize=SMALL + 0.5, color=INK)
    further = _further_panels(estimate)
    heights = [5.9 - 0.6 * len(further), 3.5 - 0.5 * len(further), *(1.1 for _ in further)]
    grid = figure.add_gridspec(len(heights), 1, height_ratios=heights)
    upper = grid[0].subgridspec(4, 2, width_ratios=[1.2, 1.0], height_ratios=[1.0, 1.0, 1.0, 1.25])
    draw_track(figure.add_subplot(upper[:3, 0]), estimate, reference if errors else None)
    draw_position([figure.add_subplot(upper[i, 1]) for i in range(3)], trajectory, errors)
    draw_velocity(figure.add_subplot(upper[3, 0]), trajectory, errors)
    draw_heading(figure.add_subplot(upper[3, 1]), trajectory, errors)
    draw_beams(figure, grid[1], estimate.beams, trajectory_s=trajectory.time_s)
    for row, draw in enumerate(further, start=2):
        draw(figure.add_subplot(grid[row]))
    return figure


def _further_panels(estimate: Estimate) -> list[Callable[[Axes], None]]:
    """Return what draws the panels that not every run has."""
    current, calibration = estimate.current, estimate.calibration
    panels: list[Callable[[Axes], None]] = []
    if current is not None:
        panels.append(lambda axes: draw_current(axes, current))
    if calibration is not None:
        panels.append(lambda axes: draw_calibration(axes, calibration))
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
