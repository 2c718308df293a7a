"""Figures of a comparison of methods: one mission in detail, and what many missions tell."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from matplotlib.figure import Figure

from ssm_graph.base.errors import DataError
from ssm_graph.report.comparison.cells import Row, Series
from ssm_graph.report.comparison.missions import Example, draw_beam_weights, draw_errors_over_time
from ssm_graph.report.comparison.runs import (
    draw_end_error,
    draw_error_against_rate,
    draw_error_against_size,
    draw_nees,
)
from ssm_graph.report.comparison.style import looks_of
from ssm_graph.report.mission.style import save

NAMES = (
    "errors_over_time.png",
    "beam_weights.png",
    "error_against_rate.png",
    "error_against_size.png",
    "nees_over_time.png",
    "end_error_cdf.png",
)
"""All figures, in the order in which they are written."""


def save_figures(
    folder: Path,
    rows: Sequence[Row],
    series: Mapping[tuple[str, str, str], Series],
    examples: Sequence[Example],
) -> list[Path]:
    """Draw and save the figures of a comparison; one whose data are missing is skipped.

    Methods look the same in all figures. Where there are more than eight, lines are drawn for
    those of `ssm_graph.report.comparison.style.DEFAULT_METHODS`, and a footnote names the others.

    Parameters
    ----------
    folder : where the PNG files go; made if it does not exist.
    rows : one mapping for every mission and method, as of a study's table; NaN is unknown.
    series : by case, grade and method: time (T,) s, horizontal error (N, T) m, velocity error
        (N, T) m/s and position NEES divided by 3 (N, T) of N runs; NaN is unknown.
    examples : name, estimate and reference of every method on one and the same mission.

    Returns
    -------
    The files that were written.

    Raises
    ------
    DataError
        A file cannot be written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise DataError(f"{folder}: cannot make the folder: {error.strerror or error}") from error
    names = [str(row["method"]) for row in rows] + [method for _, _, method in series]
    looks = looks_of([*names, *(name for name, _, _ in examples)])
    figures: Sequence[Figure | None] = (
        draw_errors_over_time(examples, looks),
        draw_beam_weights(examples, looks),
        draw_error_against_rate(rows, looks),
        draw_error_against_size(rows, looks),
        draw_nees(rows, series, looks),
        draw_end_error(rows, looks),
    )
    return [
        save(figure, folder / name)
        for name, figure in zip(NAMES, figures, strict=True)
        if figure is not None
    ]
