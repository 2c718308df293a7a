"""``ssm-graph inspect``: what is in a file, folder, bag or mission."""

from __future__ import annotations

import argparse
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from ssm_graph.base.times import UNIX_FROM_S, UNIX_UNTIL_S
from ssm_graph.cli.terminal import say, say_json
from ssm_graph.io.file_kind import check_is_file
from ssm_graph.report.clock import clocked
from ssm_graph.report.terminal.progress import ProgressDisplay

DESCRIPTION = """\
Say what is at a path, by its content: format; of every sensor rows, rate, jitter, gaps, repeats and
what it reads (gravity, turn rate, beams with a speed, ranges); what is odd; clocks, units and axes
that the data contradict; and whether it can be smoothed, or what is missing.

PATH is a mission folder, a ROS bag, a maker's log, an instrument's own output, or a table.

examples:
  ssm-graph inspect dive.bag --figure dive.png
  ssm-graph inspect logs --draft-map map.toml        # a folder of tables of any columns
"""


def declare(parser: argparse.ArgumentParser) -> None:
    """Declare the command's options."""
    parser.add_argument("path", type=Path, metavar="PATH", help="what to look at")
    parser.add_argument("--figure", type=Path, metavar="FILE", help="draw it: .png, .pdf or .svg")
    parser.add_argument("--json", action="store_true", help="print JSON instead of tables")
    parser.add_argument(
        "--draft-map",
        type=Path,
        metavar="FILE",
        help="of a table, or a folder of tables: draft the map of their columns that ssm-graph "
        "convert --map reads",
    )
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace, console: Console, errors: Console) -> bool:
    """Look, tell, and draw."""
    from ssm_graph.inspection.look import inspect_path

    check_is_file(arguments.path)
    with ProgressDisplay(errors) as show:
        show.stage(f"reading {arguments.path}")
        found = inspect_path(arguments.path, show.stage)
    if arguments.draft_map is not None:
        _draft(arguments.path, arguments.draft_map, errors)
    if arguments.json:
        say_json(console, found.as_dict())
    else:
        _tell(found, console)
    if arguments.figure is not None:
        from ssm_graph.inspection.picture import save_picture

        say(errors, f"figure: {save_picture(found, arguments.figure)}")
    return found.can_be_smoothed


def _draft(path: Path, out: Path, errors: Console) -> None:
    from ssm_graph.base.errors import ConfigError, DataError
    from ssm_graph.io.columns.draft import draft_map
    from ssm_graph.io.columns.sources import ENDINGS, read_source

    if out.exists():
        raise ConfigError(f"--draft-map: {out} is there already; give another name")
    inside = sorted(path.iterdir()) if path.is_dir() else [path]
    tables = [one for one in inside if not path.is_dir() or one.suffix.lower() in ENDINGS]
    if not tables:
        raise DataError(f"{path}: no table ({', '.join(ENDINGS)}) to draft a map of")
    with ProgressDisplay(errors) as show:
        show.stage(f"drafting a map of {path}")
        drafted = draft_map(*map(read_source, tables))
    out.write_text(drafted.text, encoding="utf-8")
    what = ", ".join(f"[{name}]" for name in drafted.found) or "no section"
    say(errors, f"{out}: {what} drafted of {path}; look at every line")


def _tell(found: Any, console: Console) -> None:
    say(console, f"{found.path}: {found.kind}")
    if found.sensors:
        begins_s = (one.timing.begin_s for one in found.sensors if one.timing.n)
        begin_s = min(begins_s, default=0.0)
        if UNIX_FROM_S <= begin_s <= UNIX_UNTIL_S:
            day = datetime.fromtimestamp(begin_s, UTC)
            say(console, f"  begins {day:%Y-%m-%d %H:%M:%S} UTC")
        table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
        table.add_column("sensor", style="bold")
        clock = "UTC" if UNIX_FROM_S <= begin_s <= UNIX_UNTIL_S else "s"
        headings = ("rows", f"from, {clock}", f"to, {clock}", "rate, Hz", "jitter, ms", "gaps")
        for heading in (*headings, "in gaps, s"):
            table.add_column(heading, justify="right")
        for one in found.sensors:
            timing = one.timing
            table.add_row(
                one.name,
                f"{timing.n}",
                _when(timing.begin_s),
                _when(timing.end_s),
                f"{timing.rate_hz:.4g}",
                f"{1e3 * timing.jitter_s:.2f}",
                f"{timing.n_gaps}",
                f"{timing.in_gaps_s:.1f}",
            )
        console.print(table)
    for one in found.sensors:
        for fact in one.facts:
            say(console, f"  {one.name}: {fact}")
        for odd in one.oddities:
            text = clocked(odd, begin_s)
            console.print(Text(f"  {one.name}: {text}", style="yellow"), soft_wrap=True)
    for note in found.notes:
        console.print(Text(f"note: {note}", style="yellow"), soft_wrap=True)
    for suspect in found.suspects:
        console.print(Text(f"suspect: {suspect}", style="bold red"), soft_wrap=True)
    style = "bold green" if found.can_be_smoothed and not found.suspects else "bold red"
    console.print(Text(f"verdict: {found.verdict}", style=style), soft_wrap=True)


def _when(time_s: float) -> str:
    """Return a time of the log, s; of a clock that is Unix time, UTC."""
    if not UNIX_FROM_S <= time_s <= UNIX_UNTIL_S:
        return f"{time_s:.2f}"
    return f"{datetime.fromtimestamp(round(time_s), UTC):%H:%M:%S}"
