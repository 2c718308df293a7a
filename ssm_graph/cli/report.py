"""``ssm-graph report``: a result as one page for a browser and for print."""

from __future__ import annotations

import argparse
import webbrowser
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console

from ssm_graph.base.errors import SsmGraphError
from ssm_graph.cli.terminal import say
from ssm_graph.io.export.track import check_rows
from ssm_graph.io.results.place import PAGE_NAME, check_output_file
from ssm_graph.io.results.tables import read_aids, read_protection

if TYPE_CHECKING:
    from ssm_graph.base.frozen import Array
    from ssm_graph.evaluation.errors import ErrorSeries
    from ssm_graph.result import Result

DESCRIPTION = """\
Write one page about a result: the verdict in words first, the track with its uncertainty, height,
altitude, speed and attitude with linked axes of time to zoom in, errors against a reference where
there is one, weights and innovations of all beams and aids, their whiteness, calibration, faults,
data quality, what was assumed, versions and settings. The file holds all it shows: it opens without
a network, on a phone too, and prints. Needs the extra 'report'.

example:
  ssm-graph report RESULT --open
"""


def declare(parser: argparse.ArgumentParser) -> None:
    """Declare the command's options."""
    parser.add_argument("result", type=Path, metavar="RESULT", help="folder of smooth or filter")
    parser.add_argument(
        "--out", type=Path, metavar="FILE", help=f"the page (default: RESULT/{PAGE_NAME})"
    )
    parser.add_argument(
        "--epoch",
        metavar="UTC",
        help="UTC of time_s = 0, such as 2026-05-01T10:00:00Z, where times are no Unix time",
    )
    parser.add_argument(
        "--mission",
        type=Path,
        metavar="DIR",
        help="the mission folder, where it is no longer where the result was made of it: altitude "
        "and errors against the reference come from there",
    )
    parser.add_argument("--open", action="store_true", help="open it in the browser at once")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace, console: Console, errors: Console) -> bool:
    """Write the page."""
    path: Path = arguments.out or arguments.result / PAGE_NAME
    check_output_file(path)
    from ssm_graph.report.page.content import Content
    from ssm_graph.report.page.page import write_page
    from ssm_graph.report.terminal.progress import ProgressDisplay
    from ssm_graph.result import Result

    with ProgressDisplay(errors) as show:
        show.stage("reading the result")
        result = Result(arguments.result, mission=arguments.mission, epoch=arguments.epoch)
        results = result.tables
        check_rows(results)
        show.stage("reading the mission")
        altitude, of_errors, data, note = _of_mission(result)
        content = Content(
            trajectory=results.trajectory,
            beams=results.beams,
            summary=results.summary,
            aids=read_aids(arguments.result),
            epoch_s=result.epoch_s,
            protection=read_protection(arguments.result),
            altitude=altitude,
            errors=of_errors,
            data=data,
        )
        now = datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC")
        version = (results.summary.get("versions") or {}).get("ssm_graph")
        show.stage("drawing")
        write_page(content, path, footer=f"ssm-graph {version}; {arguments.result}; page of {now}")
    say(console, f"{path}: {path.stat().st_size:,} bytes")
    if note:
        say(console, f"note: {note}")
    if arguments.open:
        webbrowser.open(path.resolve().as_uri())
    return True


def _of_mission(
    result: Result,
) -> tuple[tuple[Array, Array] | None, ErrorSeries | None, list[tuple[str, ...]], str]:
    """Return altitude, errors against the reference, data quality, and why there are none."""
    from ssm_graph.evaluation.errors import error_series

    try:
        altitude, reference = result.altitude, result.reference
        of_errors = None
        if reference is not None:
            of_errors = error_series(result.estimate.trajectory, reference)
        return altitude, of_errors, _data(result), ""
    except SsmGraphError as error:
        return None, None, [], f"a page without altitude, errors and data quality: {error}"


def _data(result: Result) -> list[tuple[str, ...]]:
    """Return rows of the page's table of the mission's sensors."""
    from ssm_graph.inspection.sensors import sensors_of

    return [
        (
            one.name,
            f"{one.timing.n}",
            f"{one.timing.rate_hz:.4g}",
            f"{1e3 * one.timing.jitter_s:.2f}",
            f"{one.timing.n_gaps}",
            f"{one.timing.in_gaps_s:.1f}",
            "; ".join((*one.facts, *(f"⚠ {odd}" for odd in one.oddities))),
        )
        for one in sensors_of(result.mission)
    ]
