"""``ssm-graph locate-simulate``: write a simulated drive over an HD map."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Final

from rich.console import Console

from ssm_graph.base.errors import ConfigError
from ssm_graph.cli.options import number_option
from ssm_graph.cli.terminal import say
from ssm_graph.io.results.place import check_is_free

DESCRIPTION: Final = """\
Drive a random route over a map (lanelet2 .osm, CommonRoad .xml, OpenDRIVE .xodr), or the way of an
Argoverse 2 log (its folder), and write what the vehicle records.
"""


def declare(parser: argparse.ArgumentParser) -> None:
    """Declare the command's options."""
    parser.add_argument("map", type=Path, metavar="MAP", help="a map, or an Argoverse 2 log folder")
    parser.add_argument(
        "--out", type=Path, required=True, metavar="DIR", help="folder of the drive"
    )
    parser.add_argument("--overwrite", action="store_true", help="write over an earlier drive")
    parser.add_argument(
        "--case", default="plain", help="plain, traffic or motorway (default: plain)"
    )
    number_option(parser, "--seed", "N", "same seed, same drive", 0, kind=int)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace, console: Console, _: Console) -> bool:
    """Simulate a drive and write it."""
    from ssm_graph.systems.road_map.av2_log import MAP
    from ssm_graph.systems.road_map.folder import write_drive
    from ssm_graph.systems.road_map.study import drive_of

    if arguments.case == "damaged":
        raise ConfigError("--case damaged: the damage is to the map; damage the map file instead")
    check_is_free(arguments.out, may_overwrite=arguments.overwrite)
    drive = drive_of(str(arguments.map), arguments.case, arguments.seed)[0]
    file = arguments.map / MAP if arguments.map.is_dir() else arguments.map
    write_drive(arguments.out, drive, file)
    say(
        console,
        f"{arguments.out}: {drive.chassis.time_s[-1]:.1f} s, {len(drive.curves.time_s)} curves, "
        f"{len(drive.gnss.time_s)} fixes, seed {arguments.seed}",
    )
    return True
