"""What a study is read by: Markdown tables and a tidy CSV."""

from __future__ import annotations

import csv
import math
import platform
from collections.abc import Sequence
from dataclasses import fields
from importlib.metadata import version
from itertools import groupby
from pathlib import Path

from benchmarks.study_cases import CASES
from benchmarks.study_runs import Run
from benchmarks.study_summary import Row
from ssm_graph.evaluation import Interval

HEADER = (
    "method",
    "runs",
    "failed",
    "horizontal rms, m",
    "ratio to oracle",
    "NEES/3 final",
    "NEES/3 epochs",
    "inside 3σ E/N/U, %",
    "outliers rejected, %",
    "good weight",
    "good rejected, %",
    "iterations",
    "s",
    "status",
)
LEGEND = """\
Horizontal rms: mean over runs with its 95 % interval (Student's t). Ratio: of the means, over the
same runs, with the 95 % interval of a paired bootstrap. NEES/3 final: position at the last epoch,
mean over runs, and in brackets where 95 % of such means lie if the covariance is right; `!` marks
one outside. NEES/3 epochs: mean over all epochs, which depend on each other. Inside 3σ: share of
all epochs of all runs, position, per axis. Outliers rejected: share of those of 0.5 m/s and more
that end with a weight below 0.05. Good weight and good rejected: mean weight of the beams that no
outlier touches, and their share below 0.05. Failed runs (no trajectory) are in no mean. s: wall
time of building and smoothing on a busy machine.
"""


def write_csv(path: Path, runs: Sequence[Run]) -> None:
    """Write one row for every run."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, [spec.name for spec in fields(Run)])
        writer.writeheader()
        writer.writerows(run.to_dict() for run in runs)


def markdown(rows: Sequence[Row], *, title: str, command: str, code: str, seeds: str) -> str:
    """Return the whole report."""
    lines = [
        f"# {title}",
        "",
        f"    {command}",
        "",
        f"ssm-graph {code}, gtsam {version('gtsam')}, numpy {version('numpy')}, "
        f"Python {platform.python_version()}; {seeds}.",
        "",
        LEGEND,
    ]
    for (case, grade), group in groupby(rows, key=lambda row: (row.case, row.grade)):
        lines += [f"## {case}, {grade.lower()}", "", _description(case), ""]
        lines += table(HEADER, [_cells(row) for row in group])
        lines.append("")
    return "\n".join(lines)


def table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Return the lines of a Markdown table."""
    lines = [header, ["---"] * len(header), *rows]
    return ["| " + " | ".join(cells) + " |" for cells in lines]


def _description(case: str) -> str:
    text = CASES[case].description if case in CASES else "?"
    return text[0].upper() + text[1:] + "."


def _cells(row: Row) -> list[str]:
    mark = "" if row.is_consistent or math.isnan(row.nees_final.value) else " !"
    return [
        row.method,
        str(row.n_runs),
        str(row.n_failed),
        interval(row.rms_horizontal_m),
        interval(row.ratio),
        interval(row.nees_final) + mark,
        number(row.nees_mean),
        "/".join(f"{100.0 * share:.2f}" for share in row.inside),
        f"{100.0 * row.rejected:.2f} of {row.n_large_outliers}" if row.n_large_outliers else "–",
        f"{row.good_weight:.3f}",
        f"{100.0 * row.good_rejected:.2f}",
        f"{row.iterations:.1f}",
        f"{row.seconds:.1f}",
        row.statuses,
    ]


def interval(shown: Interval) -> str:
    """Return a value with its interval in brackets, as far as there are any."""
    if math.isnan(shown.value):
        return "–"
    if not (math.isfinite(shown.low) and math.isfinite(shown.high)):
        return number(shown.value)
    return f"{number(shown.value)} [{number(shown.low)}, {number(shown.high)}]"


def number(value: float) -> str:
    """Return a number with three digits that count."""
    if math.isnan(value):
        return "–"
    return f"{value:.3f}" if abs(value) < 10.0 else f"{value:.3g}"
