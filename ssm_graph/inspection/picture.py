"""One picture of all that was found: when each sensor spoke, and what it read."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np

from ssm_graph.base.errors import DataError
from ssm_graph.inspection.look import Inspection
from ssm_graph.inspection.timing import GAP_STEPS
from ssm_graph.report import style

MOST_CURVES: Final = 9
_PANEL_HEIGHT: Final = 1.25
"""Inches."""


def save_picture(found: Inspection, path: Path) -> Path:
    """Draw clocks side by side and below them what the sensors read; return the file.

    Raises :class:`DataError` where nothing has a time, or the file cannot be written.
    """
    if path.suffix not in (".png", ".pdf", ".svg"):
        raise DataError(f"{path}: expected a figure that ends in .png, .pdf or .svg")
    sensors = [one for one in found.sensors if one.timing.n > 1]
    if not sensors:
        raise DataError(f"{found.path}: no sensor with times was found: there is nothing to draw")
    begin = min(one.timing.begin_s for one in sensors)
    end = max(one.timing.end_s for one in sensors)
    divisor, label = style.time_axis(np.array([begin, end]))
    curves = [(one, name, values) for one in sensors for name, values in one.curves.items()][
        :MOST_CURVES
    ]
    heights = [0.35 * len(sensors) + 0.5, *[_PANEL_HEIGHT] * len(curves)]
    what = found.kind.partition(",")[0]
    figure = style.new_figure(7.5, sum(heights) + 0.7, f"{found.path.name}: {what}")
    axes = np.atleast_1d(
        figure.subplots(len(heights), 1, sharex=True, gridspec_kw={"height_ratios": heights})
    )
    for row, one in enumerate(sensors):
        axes[0].broken_barh(
            [((a - begin) / divisor, (b - a) / divisor) for a, b in _spoken(one.time_s)],
            (len(sensors) - 1 - row + 0.15, 0.7),
            facecolors=style.EAST_NORTH_UP[row % 3],
        )
    axes[0].set_yticks(
        np.arange(len(sensors))[::-1] + 0.5,
        [f"{one.name}, {one.timing.rate_hz:.3g} Hz" for one in sensors],
    )
    style.dress(axes[0], title="when each sensor spoke; white is a gap")
    for place, (one, name, values) in zip(axes[1:], curves, strict=True):
        kept = style.thinned(len(values))
        since = (one.time_s[kept] - begin) / divisor
        place.plot(since, values[kept], ".", markersize=1.5, color=style.ESTIMATE)
        style.dress(place, title=f"{one.name}: {name}")
        if np.all(values[kept] % 1.0 == 0.0):  # a count
            place.set_ylim(-0.2, values.max() + 0.4)
            place.yaxis.get_major_locator().set_params(integer=True)
    axes[-1].set_xlabel(label, fontsize=style.SMALL + 0.5, color=style.INK)
    return style.save(figure, path)


def _spoken(time_s: np.ndarray[tuple[int], np.dtype[np.float64]]) -> list[tuple[float, float]]:
    """Return begin and end of every stretch without a gap."""
    ordered = np.sort(time_s)
    steps = np.diff(ordered)
    usual = float(np.median(steps[steps > 0.0])) if np.any(steps > 0.0) else 1.0
    cut = np.flatnonzero(steps > max(GAP_STEPS * usual, 1e-9)) + 1
    return [(float(part[0]), float(part[-1]) + usual) for part in np.split(ordered, cut)]
