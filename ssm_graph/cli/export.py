"""``ssm-graph export``: a result in the formats of other software."""

from __future__ import annotations

import argparse
from pathlib import Path

from rich.console import Console

from ssm_graph.base.errors import ConfigError
from ssm_graph.cli.terminal import say
from ssm_graph.io.export.formats import FORMATS, export_track
from ssm_graph.io.export.track import parse_epoch, track_of
from ssm_graph.io.results.tables import read_results

DESCRIPTION = f"""\
Write the trajectory of a result folder in other formats:

{chr(10).join(f"  {name:11} {form.suffix:9} {form.about}" for name, form in FORMATS.items())}

Positions are those of the inertial unit, heights above the WGS-84 ellipsoid, local metres along
east, north and up of the first position. Body axes of tum, kitti, csv and mcap are forward, left,
up (REP 103). Times from 2001 on are taken for Unix time; of other clocks say --epoch where a format
needs UTC. In Python: ``sg.export_track(sg.track_of(sg.read_results("result")), "kml", path)``.
"""


def declare(parser: argparse.ArgumentParser) -> None:
    """Declare the command's options."""
    parser.add_argument("result", type=Path, metavar="RESULT", help="folder of smooth or filter")
    parser.add_argument(
        "--format",
        required=True,
        metavar="A,B,C",
        help=f"one or more of {', '.join(FORMATS)}",
    )
    parser.add_argument(
        "--out",
        type=Path,
        metavar="PATH",
        help="file, or folder for several formats (default: RESULT-export/MISSION.SUFFIX)",
    )
    parser.add_argument(
        "--epoch",
        metavar="UTC",
        help="UTC of time_s = 0, such as 2026-05-01T10:00:00Z, where times are no Unix time",
    )
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace, console: Console, _: Console) -> bool:
    """Write every format that was asked for."""
    names = [name.strip() for name in arguments.format.split(",") if name.strip()]
    epoch_s = None if arguments.epoch is None else parse_epoch(arguments.epoch)
    results = read_results(arguments.result)
    track = track_of(results, epoch_s=epoch_s)
    result: Path = arguments.result.resolve()
    out: Path = arguments.out or result.with_name(f"{result.name}-export")
    is_file = arguments.out is not None and len(names) == 1 and bool(out.suffix)
    if result in (out.resolve(), *out.resolve().parents):
        raise ConfigError(
            f"--out: {out} would lie in the result folder, whose files are one set; try "
            f"{result.name}-export beside it"
        )
    stem = "".join(c if c.isalnum() or c in "-_." else "_" for c in track.name)[:80]
    for name in names:
        suffix = FORMATS[name].suffix if name in FORMATS else ""
        path = out if is_file else out / f"{stem}{suffix}"
        for written in export_track(track, name, path):
            say(console, f"{written}: {written.stat().st_size:,} bytes")
    if results.summary.get("local_start"):
        say(console, f"note: {results.summary['local_start']}")
    return True
