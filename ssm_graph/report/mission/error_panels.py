"""Errors over time inside the bounds that the estimator claims for itself."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes

from ssm_graph.base.frozen import Array
from ssm_graph.evaluation import ErrorSeries
from ssm_graph.mission.estimate import Trajectory
from ssm_graph.report.mission.style import (
    BOUND,
    EAST_NORTH_UP,
    broken_at_gaps,
    dress,
    legend,
    thinned,
    time_axis,
)

AXES_NAMES = ("east", "north", "up")


def draw_position(
    panels: Sequence[Axes], trajectory: Trajectory, errors: ErrorSeries | None
) -> None:
    """Draw east, north and up on three axes, one above the other."""
    variance = np.diagonal(trajectory.position_cov_enu, axis1=1, axis2=2)
    sigma = np.sqrt(np.maximum(variance, 0.0))
    _, label = time_axis(trajectory.time_s)
    for i, axes in enumerate(panels):
        error = None if errors is None else errors.position_enu[:, i]
        has_error = _draw(axes, trajectory, sigma[:, i], errors, error, color=EAST_NORTH_UP[i])
        what = "error" if has_error else "uncertainty"
        is_last = i == len(panels) - 1
        dress(
            axes,
            title=f"Position {what}" if i == 0 else "",
            x=label if is_last else "",
            y=f"{AXES_NAMES[i]}, m",
        )
        axes.tick_params(labelbottom=is_last)
        if i == 0:
            legend(axes, loc="lower right", bbox_to_anchor=(1.0, 0.98), ncols=2, borderpad=0.0)


def draw_velocity(axes: Axes, trajectory: Trajectory, errors: ErrorSeries | None) -> None:
    """Draw all three components with the widest of their bounds."""
    divisor, label = time_axis(trajectory.time_s)
    widest = trajectory.velocity_sigma_enu.max(axis=1)
    has_error = errors is not None and bool(np.isfinite(errors.velocity_enu).any())
    if errors is not None and has_error:
        _draw_bounds(axes, trajectory, widest, label="±3σ")
        for i in range(3):
            _draw_line(
                axes,
                (errors.time_s - trajectory.time_s[0]) / divisor,
                errors.velocity_enu[:, i],
                color=EAST_NORTH_UP[i],
                label=AXES_NAMES[i],
            )
        _limit(axes, errors.velocity_enu, widest)
    else:
        for i in range(3):
            _draw_line(
                axes,
                (trajectory.time_s - trajectory.time_s[0]) / divisor,
                3.0 * trajectory.velocity_sigma_enu[:, i],
                color=EAST_NORTH_UP[i],
                label=f"3σ {AXES_NAMES[i]}",
            )
        axes.set_ylim(bottom=0.0)
    title = "Velocity error" if has_error else "Velocity uncertainty"
    dress(axes, title=title, x=label, y="velocity, m/s")
    legend(
        axes,
        loc="lower right",
        bbox_to_anchor=(1.0, 0.98),
        ncols=4,
        columnspacing=1.0,
        borderpad=0.0,
    )


def draw_heading(axes: Axes, trajectory: Trajectory, errors: ErrorSeries | None) -> None:
    """Draw the heading, the angle that a DVL track depends on."""
    _, label = time_axis(trajectory.time_s)
    sigma = np.rad2deg(trajectory.attitude_sigma[:, 2])
    error = None if errors is None else np.rad2deg(errors.roll_pitch_heading[:, 2])
    has_error = _draw(axes, trajectory, sigma, errors, error, color=EAST_NORTH_UP[0])
    title = "Heading error" if has_error else "Heading uncertainty"
    dress(axes, title=title, x=label, y="heading, deg")


def _draw(
    axes: Axes,
    trajectory: Trajectory,
    sigma: Array,
    errors: ErrorSeries | None,
    error: Array | None,
    *,
    color: str,
) -> bool:
    """Draw one error with its bounds; return whether there is an error to draw."""
    divisor, _ = time_axis(trajectory.time_s)
    _draw_bounds(axes, trajectory, sigma, label="±3σ")
    if errors is None or error is None or not np.isfinite(error).any():
        _limit(axes, np.zeros(1), sigma)
        return False
    since = (errors.time_s - trajectory.time_s[0]) / divisor
    _draw_line(axes, since, error, color=color, label="error")
    _limit(axes, error, sigma)
    return True


def _draw_bounds(axes: Axes, trajectory: Trajectory, sigma: Array, *, label: str) -> None:
    divisor, _ = time_axis(trajectory.time_s)
    shown = thinned(len(sigma))
    since = (trajectory.time_s[shown] - trajectory.time_s[0]) / divisor
    bound = 3.0 * sigma[shown]
    axes.fill_between(since, -bound, bound, color=BOUND, alpha=0.45, linewidth=0.0, label=label)


def _draw_line(axes: Axes, since: Array, values: Array, *, color: str, label: str) -> None:
    shown = thinned(len(values))
    axes.plot(*broken_at_gaps(since[shown], values[shown]), color=color, linewidth=0.9, label=label)


def _limit(axes: Axes, error: Array, sigma: Array) -> None:
    """Show all of the error and, unless they dwarf it, all of the bounds."""
    largest = np.nanmax(np.abs(error), initial=0.0)
    bound = 3.0 * np.nanmax(sigma, initial=0.0)
    limit = 1.1 * max(largest, min(bound, 8.0 * largest) if largest > 0.0 else bound)
    if np.isfinite(limit) and limit > 0.0:
        axes.set_ylim(-limit, limit)
