"""How figures look: colours, axes and the thinning of long series; no global state is touched."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from ssm_graph.base.errors import DataError
from ssm_graph.base.frozen import Array

REDUCED_WEIGHT: Final = 0.5
"""A beam speed with less weight than this is shown as one that lost influence."""
MAX_POINTS: Final = 5000
"""Points of a curve that are drawn; no page shows more."""

EAST_NORTH_UP: Final = ("#0072B2", "#D55E00", "#009E73")
"""Colours of axes, told apart by colour-blind readers too (Okabe and Ito)."""
ESTIMATE: Final = "#0072B2"
REFERENCE: Final = "#4D4D4D"
BOUND: Final = "#9DB7CC"
NOMINAL: Final = "#3B6E8F"
REDUCED: Final = "#E69F00"
OUTLIER: Final = "#C1272D"
INK: Final = "#262626"
GRID: Final = "#E3E3E3"
SMALL: Final = 7.0
"""pt"""
NORMAL: Final = 8.5
DPI: Final = 150


def dress(axes: Axes, *, title: str = "", x: str = "", y: str = "") -> None:
    """Give one pair of axes the common look; labels carry their units."""
    axes.set_title(title, fontsize=NORMAL, color=INK, loc="left", fontweight="bold", pad=4.0)
    axes.set_xlabel(x, fontsize=SMALL + 0.5, color=INK, labelpad=2.0)
    axes.set_ylabel(y, fontsize=SMALL + 0.5, color=INK, labelpad=2.0)
    axes.tick_params(labelsize=SMALL, colors=INK, length=2.5, width=0.6)
    axes.grid(visible=True, color=GRID, linewidth=0.6)
    axes.set_axisbelow(True)
    for side, spine in axes.spines.items():
        spine.set_visible(side in ("left", "bottom"))
        spine.set_color("#8C8C8C")
        spine.set_linewidth(0.6)


def legend(axes: Axes, **options: Any) -> None:
    """Add a plain legend."""
    axes.legend(fontsize=SMALL, frameon=False, handlelength=1.4, **options)


def thinned(n: int, limit: int = MAX_POINTS) -> NDArray[np.intp]:
    """Return at most ``limit`` indices spread evenly over ``n``, first and last among them."""
    if n <= limit:
        return np.arange(n)
    return np.unique(np.linspace(0, n - 1, limit).astype(np.intp))


def thinned_outliers_first(weight: Array, limit: int = MAX_POINTS) -> NDArray[np.intp]:
    """Return at most ``limit`` indices in order: of those below `REDUCED_WEIGHT` up to a half.

    Each of the two kinds is spread evenly, so that no density is made up.
    """
    if len(weight) <= limit:
        return np.arange(len(weight))
    is_reduced = weight < REDUCED_WEIGHT
    reduced, nominal = np.flatnonzero(is_reduced), np.flatnonzero(~is_reduced)
    kept = reduced[thinned(len(reduced), max(limit // 2, limit - len(nominal)))]
    return np.sort(np.r_[kept, nominal[thinned(len(nominal), limit - len(kept))]])


def broken_at_gaps(time_s: Array, values: Array) -> tuple[Array, Array]:
    """Return the series with NaN put where a step is ten times the median, so that lines break."""
    if len(time_s) < 3:
        return time_s, values
    steps = np.diff(time_s)
    at = np.flatnonzero(steps > 10.0 * np.median(steps)) + 1
    return np.insert(time_s, at, np.nan), np.insert(values, at, np.nan, axis=0)


def time_axis(time_s: Array) -> tuple[float, str]:
    """Return the divisor of seconds and the label of a time axis over ``time_s``."""
    span = float(np.ptp(time_s)) if len(time_s) else 0.0
    for limit, divisor, unit in ((900.0, 1.0, "s"), (10_800.0, 60.0, "min")):
        if span <= limit:
            return divisor, f"time since start, {unit}"
    return 3600.0, "time since start, h"


def save(figure: Figure, path: Path, *, dpi: int | None = None) -> Path:
    """Write a figure, whole or not at all, and return its path."""
    part = path.with_name(f".{path.stem}.part-{os.getpid()}{path.suffix}")
    try:
        figure.savefig(part, dpi=dpi or DPI)
        part.replace(path)
    except OSError as error:
        raise DataError(f"{path}: cannot write the figure: {error.strerror or error}") from error
    finally:
        part.unlink(missing_ok=True)
    return path
