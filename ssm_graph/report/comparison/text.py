"""Numbers and tables of a comparison as text."""

from __future__ import annotations

import math
from collections.abc import Sequence

from ssm_graph.evaluation import Interval


def table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Return the lines of a Markdown table, the first column to the left."""
    ruler = ["---" if column == 0 else "---:" for column in range(len(header))]
    texts = [[plain(text) for text in line] for line in (header, *rows)]
    return ["| " + " | ".join(cells) + " |" for cells in (texts[0], ruler, *texts[1:])]


def plain(text: str) -> str:
    """Return a text on one line that ends no cell of a table."""
    return " ".join(text.split()).replace("|", "\\|").replace("<", "&lt;")


def interval(shown: Interval, scale: float = 1.0) -> str:
    """Return a value with its interval in brackets, as far as there are any."""
    if math.isnan(shown.value) or not math.isfinite(shown.half_width):
        return digits(scale * shown.value)
    return (
        f"{digits(scale * shown.value)} [{digits(scale * shown.low)}, {digits(scale * shown.high)}]"
    )


def probability(p: float) -> str:
    """Return a p value with two digits, small ones as a bound."""
    if math.isnan(p):
        return "–"
    return "< 0.001" if p < 0.001 else f"{p:.2g}"


def digits(value: float) -> str:
    """Return a number with three digits that count."""
    if not math.isfinite(value):
        return "–" if math.isnan(value) else f"{value}"
    if value != 0.0 and not 1e-4 <= abs(value) < 1e6:
        return f"{value:.2e}"
    decimals = decimals_of(value)
    return f"{round(value, decimals):.{max(decimals, 0)}f}"


def decimals_of(value: float) -> int:
    """Return how many decimals show three digits; below zero if not all of the integer ones."""
    if value == 0.0:
        return 0
    return 2 - int(f"{abs(value):.2e}".partition("e")[2])
