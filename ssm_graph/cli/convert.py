"""``ssm-graph convert``: turn a maker's log into a mission folder."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from rich.console import Console

from ssm_graph.cli.options import add_command, add_mission_output
from ssm_graph.io.blueye import convert_blueye
from ssm_graph.io.mission import write_mission


def add_parser(commands: Any, *, epilog: str) -> None:
    """Declare the command and its options."""
    parser = add_command(
        commands,
        "convert",
        summary="turn a maker's log into a mission folder",
        description="Convert a log. So far: Blueye X3 MCAP (extra 'blueye').",
        epilog=epilog,
    )
    parser.add_argument("log", type=Path, metavar="LOG", help="the maker's file")
    add_mission_output(parser)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace, console: Console, _: Console) -> bool:
    """Convert and write."""
    mission = convert_blueye(arguments.log)
    write_mission(arguments.out, mission, table_format=arguments.format)
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
