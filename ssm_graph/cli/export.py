"""``ssm-graph export``: a result in the formats of other software."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console

from ssm_graph.base.errors import ConfigError
from ssm_graph.cli.answers import add_answer_arguments, asked_track
from ssm_graph.cli.terminal import say
from ssm_graph.io.export.formats import FORMATS, check_format, export_track
from ssm_graph.io.results.place import check_output_file

DESCRIPTION = f"""\
Write the trajectory of a result folder in other formats:

{chr(10).join(f"  {name:11} {form.suffix:9} {form.about}" for name, form in FORMATS.items())}

Heights are above the WGS-84 ellipsoid, local metres along east, north and up of the first position,
UTM metres in its zone. Body axes of tum, kitti, csv and mcap are forward, left,
up (REP 103). Times from 2001 on are taken for Unix time; of other clocks say --epoch where a format
needs UTC. In Python: ``sg.export_track(sg.track_of(sg.read_results("result")), "kml", path)``.

examples:
  ssm-graph export RESULT --format kml,geopackage,csv
  ssm-graph export RESULT --format sbet --rate 100 --epoch 2026-05-01T10:00:00Z
  ssm-graph export RESULT --format csv --at photos.csv --point camera
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
    add_answer_arguments(parser, afterwards=True)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace, console: Console, errors: Console) -> bool:
    """Write every format that was asked for."""
    names = [name.strip() for name in arguments.format.split(",") if name.strip()]
    for name in names:
        check_format(name)
    result: Path = arguments.result.resolve()
    out: Path = arguments.out or exports_of(result)
    if result in (out.resolve(), *out.resolve().parents):
        raise ConfigError(
            f"--out: {out} would lie in the result folder, whose files are one set; try "
            f"{exports_of(result).name} beside it"
        )
    is_file = arguments.out is not None
    export(arguments, result, names, out, console, errors, is_file=is_file)
    return True


def exports_of(result: Path) -> Path:
    """Return the folder beside a result where its exports go."""
    return result.with_name(f"{result.name}-export")


def export(
    arguments: argparse.Namespace,
    result: Path,
    names: Sequence[str],
    out: Path,
    console: Console,
    errors: Console,
    *,
    is_file: bool = False,
) -> None:
    """Write the track that was asked for in formats; ``out`` may be a file where there is one."""
    from ssm_graph.io.results.tables import read_results
    from ssm_graph.report.terminal.progress import ProgressDisplay

    asked = asked_track(arguments, result, errors)
    for note in asked.notes:
        say(console, note)
    stem = "".join(c if c.isalnum() or c in "-_." else "_" for c in asked.track.name)[:80]
    for name in names:
        suffix = FORMATS[name].suffix
        is_whole = is_file and len(names) == 1 and bool(out.suffix)
        path = out if is_whole else out / f"{stem}{asked.suffix}{suffix}"
        check_output_file(path, *([arguments.at] if arguments.at else []))
        with ProgressDisplay(errors) as show:
            show.stage(f"writing {path}")
            files = export_track(asked.track, name, path)
        for written in files:
            say(console, f"{written}: {written.stat().st_size:,} bytes")
    said = read_results(result).summary.get("local_start")
    if said:
        say(console, f"note: {said}")
