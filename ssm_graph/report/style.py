"""How figures look: colours, axes, panels, legends, thinning; no global state is touched."""

from __future__ import annotations

import math
import os
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.axis import Axis, XAxis
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.lines import Line2D
from matplotlib.text import Text
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter, NullLocator
from numpy.typing import NDArray

from ssm_graph.base.errors import DataError
from ssm_graph.base.frozen import Array
from ssm_graph.evaluation.comparison import is_oracle

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
GREY: Final = "#8C8C8C"

MAX_METHODS: Final = 8
"""As many methods or fewer are all shown; of more, those of `DEFAULT_METHODS`."""
GRAPH_PREFIXES: Final = ("smoother", "gnc", "fixed-lag", "graph")
"""Names of methods that solve a factor graph begin like this; so does the `oracle`."""

TICKS_OF_DECADES: Final[tuple[tuple[float, tuple[float, ...]], ...]] = (
    (0.7, (1.0, 2.0, 3.0, 5.0, 7.0)),
    (1.6, (1.0, 2.0, 5.0)),
    (2.8, (1.0, 3.0)),
    (math.inf, (1.0,)),
)
"""Which multiples of powers of ten are labelled on an axis of less than so many decades."""

Dash = str | tuple[float, tuple[float, ...]]

DASHED: Final[Dash] = (0.0, (4.0, 1.6))
SHORT: Final[Dash] = (0.0, (2.0, 1.2))
DASH_DOT: Final[Dash] = (0.0, (5.0, 1.5, 1.2, 1.5))
LONG: Final[Dash] = (0.0, (8.0, 2.0))
DASH_DOT_DOT: Final[Dash] = (0.0, (5.0, 1.3, 1.0, 1.3, 1.0, 1.3))
BLACK: Final = "#000000"


@dataclass(frozen=True, slots=True)
class Look:
    """How one method is drawn, in every figure."""

    color: str
    dash: Dash
    marker: str
    width: float = 1.3


LOOKS: Final[Mapping[str, Look]] = {
    "oracle": Look(BLACK, "-", "o", 1.5),
    "ekf-oracle": Look(BLACK, DASHED, "s", 1.5),
    "ekf": Look("#7F7F7F", DASHED, "v"),
    "ekf-gate-beam": Look("#E69F00", DASH_DOT, "^"),
    "ssmkf-log": Look("#CC79A7", LONG, "D"),
    "rstkf": Look("#56B4E9", DASHED, "P"),
    "mckf": Look("#999933", SHORT, "X"),
    "ssm-log": Look("#D55E00", DASHED, "<"),
    "ssm-log+rts": Look("#882255", DASH_DOT_DOT, ">"),
    "smoother-log": Look("#0072B2", "-", "o", 1.7),
    "gnc-tls": Look("#009E73", "-", "s"),
    "smoother-gnc-tls": Look("#009E73", "-", "s"),
}
"""Colours by Okabe and Ito, and by Tol; lines and markers differ where colours are close."""
DEFAULT_METHODS: Final = tuple(LOOKS)
"""What figures show where there are more methods than a reader can tell apart."""
OTHER_COLORS: Final = ("#44AA99", "#332288", "#AA4499", "#117733", "#6699CC", "#CC6677")
"""Of the methods without a look of their own (Paul Tol's muted colours)."""
OTHER_DASHES: Final = (DASHED, DASH_DOT, SHORT, DASH_DOT_DOT, LONG)
MARKERS: Final = "hpd*vs^D<P>X"


class Curve(NamedTuple):
    """A line, or marks."""

    x: Array
    y: Array
    options: Mapping[str, Any]
    """Of ``Axes.plot``."""


class Band(NamedTuple):
    """What lies between two curves."""

    x: Array
    low: Array | float
    high: Array | float
    options: Mapping[str, Any]
    """Of ``Axes.fill_between``."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Panel:
    """All of one pair of axes; labels carry their units."""

    title: str = ""
    x: str = ""
    y: str = ""
    bands: Sequence[Band] = ()
    curves: Sequence[Curve] = ()
    """The last is on top."""
    x_limits: tuple[float, float] | None = None
    y_limits: tuple[float | None, float | None] | None = None
    is_log_x: bool = False
    """Logarithmic within its limits, with plain numbers."""
    is_log_y: bool = False
    x_ticks: Sequence[float] = ()
    """Without any, those of the axis."""
    level: float = math.nan
    """Where a thin line is drawn across."""
    legend: Mapping[str, Any] = field(default_factory=dict)
    """Options of a legend; without any there is none."""


def draw_panel(axes: Axes, panel: Panel) -> None:
    """Draw a panel and give it the common look."""
    for band in panel.bands:
        axes.fill_between(band.x, band.low, band.high, **{"linewidth": 0.0, **band.options})
    if math.isfinite(panel.level):
        axes.axhline(panel.level, color=GREY, linewidth=0.8, zorder=0.7)
    for curve in panel.curves:
        axes.plot(curve.x, curve.y, **curve.options)
    dress(axes, title=panel.title, x=panel.x, y=panel.y)
    if panel.x_limits is not None:
        if panel.is_log_x:
            log_ticks(axes.xaxis, *panel.x_limits)
        axes.set_xlim(*panel.x_limits)
    if panel.y_limits is not None:
        low, high = panel.y_limits
        if panel.is_log_y and low and high:
            log_ticks(axes.yaxis, low, high)
        axes.set_ylim(low, high)
    if panel.x_ticks:
        axes.set_xticks(panel.x_ticks)
        axes.xaxis.set_minor_locator(NullLocator())
    if panel.legend:
        legend(axes, **panel.legend)


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
        spine.set_color(GREY)
        spine.set_linewidth(0.6)


def legend(axes: Axes, **options: Any) -> None:
    """Add a plain legend."""
    axes.legend(fontsize=SMALL, frameon=False, handlelength=1.4, **options)


def thinned(n: int, limit: int = MAX_POINTS) -> NDArray[np.intp]:
    """Return at most ``limit`` indices spread evenly over ``n``, first and last among them."""
    if n <= limit:
        return np.arange(n)
    return np.unique(np.linspace(0, n - 1, limit).astype(np.intp))


def thinned_to_extremes(values: Array, limit: int = MAX_POINTS) -> NDArray[np.intp]:
    """Return about ``limit`` indices of a curve (N,): the lowest and highest of each stretch.

    A spike of one row stays; so do all NaN, where the curve breaks.
    """
    if len(values) <= limit:
        return np.arange(len(values))
    width = -(-len(values) // (limit // 2))
    padded = np.r_[values, np.full(-len(values) % width, np.nan)].reshape(-1, width)
    is_nan = np.isnan(padded)
    first = width * np.arange(len(padded))
    low = first + np.argmin(np.where(is_nan, np.inf, padded), axis=1)
    high = first + np.argmax(np.where(is_nan, -np.inf, padded), axis=1)
    ends = [0, len(values) - 1]
    return np.unique(np.r_[ends, low, high, np.flatnonzero(np.isnan(values))])


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
    """Write a figure, whole or not at all, and return its path; a ``$`` in a name is a ``$``."""
    part = path.with_name(f".{path.stem}.part-{os.getpid()}{path.suffix}")
    for text in figure.findobj(Text):
        assert isinstance(text, Text)
        text.set_parse_math(False)
    try:
        with rc_context({"text.parse_math": False}):  # of ticks that are made while drawing
            figure.savefig(part, dpi=dpi or DPI)
        part.replace(path)
    except OSError as error:
        raise DataError(f"{path}: cannot write the figure: {error.strerror or error}") from error
    finally:
        part.unlink(missing_ok=True)
    return path


def is_graph(method: str) -> bool:
    """Return whether a method solves a factor graph, by its name."""
    return method == "oracle" or method.startswith(GRAPH_PREFIXES)


def looks_of(methods: Iterable[str]) -> dict[str, Look]:
    """Return the look of every method: oracles black, graph methods solid, filters dashed."""
    looks: dict[str, Look] = {}
    n_other = 0
    for method in dict.fromkeys(methods):
        if method in LOOKS:
            looks[method] = LOOKS[method]
            continue
        color = BLACK if is_oracle(method) else OTHER_COLORS[n_other % len(OTHER_COLORS)]
        dash = "-" if is_graph(method) else OTHER_DASHES[n_other % len(OTHER_DASHES)]
        looks[method] = Look(color, dash, MARKERS[n_other % len(MARKERS)])
        n_other += 1
    return looks


def shown_methods(methods: Iterable[str]) -> tuple[list[str], list[str]]:
    """Return the methods that a figure shows, in the order of `DEFAULT_METHODS`, and the others.

    All are shown if they are `MAX_METHODS` or fewer, or if none is of the default ones; then the
    first `MAX_METHODS`.
    """
    present = list(dict.fromkeys(methods))
    default: list[str] = [method for method in DEFAULT_METHODS if method in present]
    if len(present) <= MAX_METHODS:
        shown = default + [method for method in present if method not in default]
    else:
        shown = default or present[:MAX_METHODS]
    return shown, [method for method in present if method not in shown]


def new_figure(width: float, height: float, title: str) -> Figure:
    """Return an empty figure in inches that belongs to no window and no global state."""
    layout = ConstrainedLayoutEngine(h_pad=0.06, w_pad=0.06, hspace=0.03, wspace=0.03)
    figure = Figure(figsize=(width, height), layout=layout, facecolor="white")
    heading = figure.suptitle(title, x=0.012, ha="left", color=INK)
    heading.set(fontsize=NORMAL + 2.0, fontweight="bold")
    return figure


def add_legend(
    figure: Figure,
    methods: Sequence[str],
    looks: Mapping[str, Look],
    *,
    has_markers: bool = False,
    extra: Sequence[object] = (),
) -> None:
    """Add the legend of the methods at the right of all panels."""
    handles = [
        Line2D([], [], marker=looks[m].marker if has_markers else "", label=m, **line(looks[m]))
        for m in methods
    ]
    figure.legend(
        handles=[*handles, *extra],
        loc="outside right center",
        fontsize=SMALL + 1.0,
        frameon=False,
        handlelength=4.0,
        labelspacing=0.7,
        labelcolor=INK,
    )


def line(look: Look) -> dict[str, Any]:
    """Return the options of a method's line, but for its marker."""
    return {
        "color": look.color,
        "linestyle": look.dash,
        "linewidth": look.width,
        "markersize": 4.0,
        "markeredgewidth": 0.0,
    }


def add_footnote(figure: Figure, note: str, left_out: Sequence[str] = ()) -> None:
    """Put a note, and which methods the figure does not show, below everything."""
    columns = int(17.0 * figure.get_figwidth())
    lines = textwrap.wrap(note, columns)
    if left_out:
        names = f"Not shown ({len(left_out)}): {', '.join(left_out)}"
        lines += textwrap.wrap(names, columns, break_on_hyphens=False)
    if lines:
        text = figure.supxlabel("\n".join(lines), x=0.012, ha="left", color="#595959")
        text.set(fontsize=SMALL + 0.5, linespacing=1.25)


def log_ticks(axis: Axis, low: float, high: float) -> None:
    """Scale an axis by decades from ``low`` to ``high`` with plain numbers that do not crowd."""
    decades = math.log10(high / low)
    axes = axis.axes
    if isinstance(axis, XAxis):
        axes.set_xscale("log")
        axes.set_xlim(low, high)
    else:
        axes.set_yscale("log")
        axes.set_ylim(low, high)
    subs = next(subs for limit, subs in TICKS_OF_DECADES if decades < limit)
    axis.set_major_locator(LogLocator(10.0, subs=subs, numticks=9))
    axis.set_major_formatter(FuncFormatter(_plain))
    axis.set_minor_formatter(NullFormatter())
    if decades > 4.0:
        axis.set_minor_locator(NullLocator())


_RAISED: Final = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def _plain(value: float, _position: object) -> str:
    if 1e-3 <= value < 1e5:
        return f"{value:g}"
    mantissa, exponent = f"{value:.0e}".split("e")
    factor = "" if mantissa == "1" else f"{mantissa}·"
    return f"{factor}10{str(int(exponent)).translate(_RAISED)}"
