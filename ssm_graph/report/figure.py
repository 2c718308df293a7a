"""One page that shows a run: track, errors against their bounds, and what each beam was worth."""

from __future__ import annotations

import os
from pathlib import Path

from matplotlib.figure import Figure

from ssm_graph.data import Reference
from ssm_graph.errors import DataError
from ssm_graph.estimate import Estimate, Trajectory
from ssm_graph.evaluation import ErrorSeries, error_series
from ssm_graph.report.beam_panels import draw_beams
from ssm_graph.report.error_panels import draw_heading, draw_position, draw_velocity
from ssm_graph.report.style import INK, SMALL
from ssm_graph.report.track_panel import draw_track

PAGE_INCHES = (8.27, 10.8)
DPI = 170


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
    figure = draw_figure(estimate, reference, title=title)
    part = path.with_name(f".{path.stem}.part-{os.getpid()}{path.suffix}")
    try:
        figure.savefig(part, dpi=DPI)
        part.replace(path)
    except (OSError, ValueError) as error:
        raise DataError(f"{path}: cannot write the figure: {error}") from error
    finally:
        part.unlink(missing_ok=True)


def draw_figure(
    estimate: Estimate, reference: Reference | None = None, *, title: str = ""
) -> Figure:
    """Return the page as a figure that belongs to no window and no global state."""
    trajectory = estimate.trajectory
    errors = _errors(trajectory, reference)
    figure = Figure(figsize=PAGE_INCHES, layout="constrained")
    figure.set_constrained_layout_pads(h_pad=0.05, w_pad=0.05)
    figure.suptitle(
        title or "Estimate", x=0.012, ha="left", fontsize=13.0, fontweight="bold", color=INK
    )
    figure.text(
        0.988, 0.988, _caption(estimate), ha="right", va="top", fontsize=SMALL + 0.5, color=INK
    )
    grid = figure.add_gridspec(4, 1, height_ratios=[4.0, 1.8, 1.9, 1.5])
    top = grid[0].subgridspec(3, 2, width_ratios=[1.2, 1.0])
    draw_track(figure.add_subplot(top[:, 0]), estimate, reference if errors else None)
    draw_position([figure.add_subplot(top[i, 1]) for i in range(3)], trajectory, errors)
    middle = grid[1].subgridspec(1, 2, width_ratios=[1.2, 1.0])
    draw_velocity(figure.add_subplot(middle[0]), trajectory, errors)
    draw_heading(figure.add_subplot(middle[1]), trajectory, errors)
    draw_beams(figure, (grid[2], grid[3]), estimate.beams, trajectory_s=trajectory.time_s)
    figure.align_ylabels()
    return figure


def _errors(trajectory: Trajectory, reference: Reference | None) -> ErrorSeries | None:
    if reference is None:
        return None
    try:
        return error_series(trajectory, reference)
    except DataError:  # no overlap: `evaluate` says so, the page is drawn without
        return None


def _caption(estimate: Estimate) -> str:
    return f"{estimate.method} · {estimate.kernel}\n{estimate.status.name}"
