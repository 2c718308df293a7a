"""``ssm-graph report``: a result as one page for a browser and for print."""

from __future__ import annotations

import argparse
import webbrowser
from datetime import UTC, datetime
from pathlib import Path

from rich.console import Console

from ssm_graph.base.errors import DataError
from ssm_graph.cli.terminal import say
from ssm_graph.io.export.track import epoch_of, parse_epoch
from ssm_graph.io.results.place import PAGE_NAME
from ssm_graph.io.results.tables import read_aids, read_protection, read_results

DESCRIPTION = """\
Write one page about a result: the verdict in words first, the track with its uncertainty, height,
speed and attitude with linked axes of time to zoom in, weights and innovations of all beams and
aids, their whiteness, calibration, faults, what was assumed, versions and settings. The file holds
all it shows: it opens without a network, on a phone too, and prints. Needs the extra 'report'.
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
    parser.add_argument("--open", action="store_true", help="open it in the browser at once")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace, console: Console, _: Console) -> bool:
    """Write the page."""
    from ssm_graph.report.page.content import Content
    from ssm_graph.report.page.page import write_page

    results = read_results(arguments.result)
    if len(results.trajectory["time_s"]) == 0:
        raise DataError(f"{arguments.result}: trajectory.csv has no row: there is nothing to show")
    epoch_s = None if arguments.epoch is None else parse_epoch(arguments.epoch)
    content = Content(
        trajectory=results.trajectory,
        beams=results.beams,
        summary=results.summary,
        aids=read_aids(arguments.result),
        epoch_s=epoch_of(results, epoch_s),
        protection=read_protection(arguments.result),
    )
    path: Path = arguments.out or arguments.result / PAGE_NAME
    now = datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC")
    version = (results.summary.get("versions") or {}).get("ssm_graph")
    write_page(content, path, footer=f"ssm-graph {version}; {arguments.result}; page of {now}")
    say(console, f"{path}: {path.stat().st_size:,} bytes")
    if arguments.open:
        webbrowser.open(path.resolve().as_uri())
    return True
