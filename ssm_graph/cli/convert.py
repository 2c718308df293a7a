"""``ssm-graph convert``: turn a maker's log into a mission folder."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from rich.console import Console

from ssm_graph.io.blueye import convert_blueye
from ssm_graph.io.mission import TableFormat, write_mission


def add_parser(commands: Any, *, epilog: str) -> None:
    """Declare the command and its options."""
    parser: argparse.ArgumentParser = commands.add_parser(
        "convert",
        help="turn a maker's log into a mission folder",
        description="Convert a log. So far: Blueye X3 MCAP (extra 'blueye').",
        epilog=epilog,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("log", type=Path, metavar="LOG", help="the maker's file")
    parser.add_argument(
        "--format",
        type=str.lower,
        choices=[table.name.lower() for table in TableFormat],
        default=TableFormat.CSV.name.lower(),
        help="format of the tables (default: csv)",
    )
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="mission folder")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace, console: Console, _: Console) -> bool:
    """Convert and write."""
    mission = convert_blueye(arguments.log)
    write_mission(arguments.out, mission, table_format=TableFormat[arguments.format.upper()])
    n_fixes = len(mission.gnss.time_s) if mission.gnss is not None else 0
    span_s = mission.imu.time_s[-1] - mission.imu.start_s
    console.print(
        f"{arguments.out}: {span_s:.1f} s, {len(mission.imu.time_s)} inertial samples, "
        f"{len(mission.dvl.time_s)} pings, {n_fixes} GNSS fixes",
        highlight=False,
        soft_wrap=True,
    )
    for note in mission.notes:
        console.print(f"note: {note}", style="yellow", highlight=False, markup=False)
    return True
