"""Figures of one mission, estimated by several methods: errors over time and beam weights."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, NullLocator

from ssm_graph.base.errors import DataError
from ssm_graph.base.frozen import Array
from ssm_graph.evaluation import ErrorSeries, evaluate
from ssm_graph.mission.estimate import BeamTable, Estimate
from ssm_graph.mission.mission import Reference
from ssm_graph.report.comparison.style import (
    Look,
    add_footnote,
    add_legend,
    line,
    log_ticks,
    new_figure,
    shown_methods,
)
from ssm_graph.report.mission.style import (
    INK,
    NOMINAL,
    OUTLIER,
    REDUCED_WEIGHT,
    SMALL,
    dress,
    thinned_outliers_first,
    time_axis,
)
from ssm_graph.sensors.dvl import N_BEAMS

Example = tuple[str, Estimate, Reference]
"""Name of the method, its estimate, and the truth of the mission."""

PER_BEAM: Final = ("ssm-log", "smoother-log")
"""Whose weights are shown, the first that is there."""
PER_PING: Final = "ssmkf-log"
"""Has one auxiliary parameter for all beams of a ping."""
MAX_WINDOWS: Final = 120
"""More epochs than these are shown as rms over windows, or noise would hide the methods."""
WINDOWS_S: Final = (1.0, 2.0, 5.0, 10.0, 20.0, 30.0, 60.0, 120.0, 300.0, 600.0, 1800.0, 3600.0)
LARGE_RATIO: Final = 5.0
"""A panel whose methods differ by more than this is logarithmic."""


def draw_errors_over_time(examples: Sequence[Example], looks: Mapping[str, Look]) -> Figure | None:
    """Draw horizontal velocity and position error of every method; None without any."""
    errors = _errors(examples)
    if not errors:
        return None
    methods, left_out = shown_methods(errors)
    start_s = min(series.time_s[0] for series in errors.values())
    end_s = max(series.time_s[-1] for series in errors.values())
    divisor, label = time_axis(np.array([start_s, end_s]))
    n_epochs = max(len(series.time_s) for series in errors.values())
    window_s = _window_s(end_s - start_s) if n_epochs > MAX_WINDOWS else 0.0
    figure = new_figure(9.0, 5.6, "Errors of one mission over time")
    panels = figure.subplots(2, 1, sharex=True)
    for axes, is_velocity in zip(panels, (True, False), strict=True):
        curves = {
            m: _windowed(*_norm(errors[m], is_velocity=is_velocity), start_s, window_s)
            for m in methods
        }
        for method in reversed(methods):
            time_s, values = curves[method]
            axes.plot((time_s - start_s) / divisor, values, **line(looks[method]))
        _scale(axes, [values for _, values in curves.values()])
        title = "Horizontal velocity error" if is_velocity else "Horizontal position error"
        unit = "velocity error, m/s" if is_velocity else "position error, m"
        dress(axes, title=title, x="" if is_velocity else label, y=unit)
        axes.set_xlim(0.0, max((end_s - start_s) / divisor, 1e-9))
    panels[0].tick_params(labelbottom=False)
    figure.align_ylabels(panels)
    add_legend(figure, methods, looks)
    note = "Length of the horizontal error vector"
    note += f", rms over windows of {window_s:g} s." if window_s else "."
    add_footnote(figure, note, left_out)
    return figure


def _errors(examples: Sequence[Example]) -> dict[str, ErrorSeries]:
    """Return the errors by method; estimates without a time in common are left out."""
    errors = {}
    for method, estimate, reference in examples:
        try:
            errors[method] = evaluate(estimate.trajectory, reference).errors
        except DataError:
            continue
    return errors


def _norm(errors: ErrorSeries, *, is_velocity: bool) -> tuple[Array, Array]:
    if not is_velocity:
        return errors.time_s, errors.horizontal
    return errors.time_s, np.hypot(errors.velocity_enu[:, 0], errors.velocity_enu[:, 1])


def _window_s(span_s: float) -> float:
    return next((w for w in WINDOWS_S if span_s / w <= MAX_WINDOWS), span_s / MAX_WINDOWS)


def _windowed(time_s: Array, values: Array, start_s: float, window_s: float) -> tuple[Array, Array]:
    """Return middles of windows and the rms in each, NaN without a value; as is without windows."""
    if window_s <= 0.0:
        return time_s, values
    window = ((time_s - start_s) / window_s).astype(np.intp)
    known = np.isfinite(values)
    n = int(window.max()) + 1
    count = np.bincount(window[known], minlength=n)
    total = np.bincount(window[known], weights=values[known] ** 2, minlength=n)
    rms = np.where(count > 0, np.sqrt(total / np.maximum(count, 1)), np.nan)
    return np.asarray(start_s + (np.arange(n) + 0.5) * window_s), np.asarray(rms)


def _scale(axes: Axes, curves: Sequence[Array]) -> None:
    """Choose between a linear and a logarithmic axis by how much methods differ."""
    known = [c[np.isfinite(c) & (c > 0.0)] for c in curves]
    known = [c for c in known if len(c)]
    if not known:
        return
    largest = [float(c.max()) for c in known]
    if max(largest) > LARGE_RATIO * min(largest):
        low = min(float(np.quantile(c, 0.02)) for c in known)
        log_ticks(axes.yaxis, low / 1.2, 1.3 * max(largest))
    else:
        axes.set_ylim(0.0, 1.06 * max(largest))


def draw_beam_weights(examples: Sequence[Example], looks: Mapping[str, Look]) -> Figure | None:
    """Draw innovation and auxiliary parameter of each beam; None without beams."""
    tables = {m: estimate.beams for m, estimate, _ in examples if len(estimate.beams.time_s)}
    if not tables:
        return None
    main = next((m for m in PER_BEAM if m in tables), next(iter(tables)))
    other = PER_PING if PER_PING in tables and main != PER_PING else None
    beams = tables[main]
    start_s = float(beams.time_s.min())
    figure = new_figure(10.0, 8.0, f"Innovations of the four beams and their weights, {main}")
    grid = figure.add_gridspec(2, 2)
    columns: tuple[list[Axes], list[Axes]] = ([], [])
    for beam in range(N_BEAMS):
        cell = grid[beam // 2, beam % 2].subgridspec(2, 1, height_ratios=[1.25, 1.0])
        upper = figure.add_subplot(cell[0])
        lower = figure.add_subplot(cell[1], sharex=upper)
        _draw_innovations(upper, _of_beam(beams, beam), start_s)
        if other is not None:
            _draw_weights(
                lower, _of_beam(tables[other], beam), start_s, looks[other], is_main=False
            )
        _draw_weights(lower, _of_beam(beams, beam), start_s, looks[main], is_main=True)
        divisor, label = time_axis(beams.time_s)
        span = float(np.ptp(beams.time_s)) / divisor or 1.0
        upper.set_xlim(-0.01 * span, 1.01 * span)
        _innovation_axis(upper, beams.innovation)
        shown = [tables[m].weight for m in (main, other) if m is not None]
        top = np.nanmax(np.concatenate(shown), initial=1.0)
        lower.set_ylim(-0.06, 1.08 * float(top))
        dress(upper, title=f"Beam {beam + 1}", y="innovation, m/s")
        dress(lower, x=label if beam >= 2 else "", y="weight, –")
        upper.tick_params(labelbottom=False)
        columns[beam % 2].extend([upper, lower])
    for column in columns:
        figure.align_ylabels(column)
    _beam_legend(figure, main, other, looks)
    add_footnote(figure, _beam_note(other))
    return figure


def _of_beam(beams: BeamTable, beam: int) -> tuple[Array, Array, Array]:
    """Return time, innovation and weight of a beam, thinned to what a panel can show."""
    mine = np.flatnonzero(beams.beam == beam + 1)
    mine = mine[thinned_outliers_first(beams.weight[mine])]
    return beams.time_s[mine], beams.innovation[mine], beams.weight[mine]


def _draw_innovations(axes: Axes, beam: tuple[Array, Array, Array], start_s: float) -> None:
    time_s, innovation, weight = beam
    divisor, _ = time_axis(time_s)
    is_reduced = weight < REDUCED_WEIGHT
    for mine, color, size in ((~is_reduced, NOMINAL, 1.7), (is_reduced, OUTLIER, 3.0)):
        axes.plot((time_s[mine] - start_s) / divisor, innovation[mine], **_dots(color, size))


def _draw_weights(
    axes: Axes, beam: tuple[Array, Array, Array], start_s: float, look: Look, *, is_main: bool
) -> None:
    time_s, _, weight = beam
    divisor, _ = time_axis(time_s)
    since = (time_s - start_s) / divisor
    size = 2.4 if is_main else 1.8
    axes.plot(since, weight, **_dots(look.color, size))


def _dots(color: str, size: float) -> dict[str, Any]:
    return {
        "color": color,
        "linestyle": "",
        "marker": "o",
        "markersize": size,
        "markeredgewidth": 0.0,
        "alpha": 0.8,
    }


def _innovation_axis(axes: Axes, innovation: Array) -> None:
    """Scale linearly over the noise of good beams and logarithmically beyond, alike for all."""
    size = np.abs(innovation[np.isfinite(innovation)])
    if len(size) == 0:
        return
    noise = 1.4826 * float(np.median(size)) or 1e-3
    linear = 5.0 * noise
    largest = 1.6 * max(float(size.max()), linear)
    axes.set_yscale("symlog", linthresh=linear, linscale=1.4)
    axes.set_ylim(-largest, largest)
    near = float(f"{2.5 * noise:.0e}")
    decades = 10.0 ** np.arange(math.ceil(math.log10(1.5 * near)), math.ceil(math.log10(largest)))
    decades = decades[decades > 1.3 * linear]
    ticks = [near, *decades[:: max(1, math.ceil(len(decades) / 2))]]
    axes.set_yticks([*(-tick for tick in reversed(ticks)), 0.0, *ticks])
    axes.yaxis.set_minor_locator(NullLocator())
    axes.yaxis.set_major_formatter(FuncFormatter(lambda v, _: f"{v:g}".replace("-", "−")))


def _beam_legend(figure: Figure, main: str, other: str | None, looks: Mapping[str, Look]) -> None:
    entries = [
        (NOMINAL, f"innovation, weight ≥ {REDUCED_WEIGHT:g}"),
        (OUTLIER, f"innovation, weight < {REDUCED_WEIGHT:g}"),
        (looks[main].color, f"weight, {main}"),
    ]
    if other is not None:
        entries.append((looks[other].color, f"weight, {other}"))
    handles = [
        Line2D([], [], **{**_dots(color, 5.0), "alpha": 1.0, "label": label})
        for color, label in entries
    ]
    figure.legend(
        handles=handles,
        loc="outside right center",
        fontsize=SMALL + 1.0,
        frameon=False,
        handlelength=1.2,
        labelspacing=0.8,
        labelcolor=INK,
    )


def _beam_note(other: str | None) -> str:
    note = "Innovation axes are linear over the noise of good beams, logarithmic beyond."
    if other is not None:
        note += f" {other} has one weight for all beams of a ping."
    return note
