"""What the figures of a comparison have in common: which methods they show, and how each looks."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

from matplotlib.axis import Axis, XAxis
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter, NullLocator

from ssm_graph.evaluation.comparison import is_oracle
from ssm_graph.report.mission.style import INK, NORMAL, SMALL

MAX_METHODS: Final = 8
"""As many methods or fewer are all shown; of more, those of `DEFAULT_METHODS`."""
DEFAULT_METHODS: Final = (
    "oracle",
    "ekf-oracle",
    "ekf",
    "ekf-gate-beam",
    "ssmkf-log",
    "rstkf",
    "mckf",
    "ssm-log",
    "ssm-log+rts",
    "smoother-log",
    "gnc-tls",
    "smoother-gnc-tls",
)
"""What figures show where there are more methods than a reader can tell apart."""
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
OTHER_COLORS: Final = (
    "#44AA99",
    "#332288",
    "#AA4499",
    "#117733",
    "#6699CC",
    "#CC6677",
)
"""Of the methods without a look of their own (Paul Tol's muted colours)."""
OTHER_DASHES: Final = (DASHED, DASH_DOT, SHORT, DASH_DOT_DOT, LONG)
MARKERS: Final = "hpd*vs^D<P>X"


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


def _plain(value: float, _position: object) -> str:
    if 1e-3 <= value < 1e5:
        return f"{value:g}"
    mantissa, exponent = f"{value:.0e}".split("e")
    factor = "" if mantissa == "1" else f"{mantissa}\\cdot"
    return f"${factor}10^{{{int(exponent)}}}$"
