"""``ssm-graph locate-convert``: turn a segment of comma2k19 into a drive's folder."""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import Final

from rich.console import Console

from ssm_graph.cli.terminal import say
from ssm_graph.io.results.place import check_is_free
from ssm_graph.systems.road_map.comma2k19 import RECEIVERS, drive_of_comma2k19
from ssm_graph.systems.road_map.folder import read_curves, write_drive
from ssm_graph.systems.road_map.maps.read import read_map
from ssm_graph.systems.road_map.motion import motion_errors

DESCRIPTION: Final = """\
Turn a segment of comma2k19 into a folder that ssm-graph locate reads. SEGMENT is a folder with the
arrays of one segment as .npy files, the data set's own tree with underscores for slashes
(processed_log_CAN_speed_t.npy). Speed, yaw rate, fixes of one receiver and the reference come of
it; what a camera sees does not: --curves names the table of a lane detector (docs/road-map.md has
its columns, times from the begin of the segment). It also says what the drive tells of its own
instruments: scale of the speed, bias of the yaw rate, delay of the fixes.
"""


def declare(parser: argparse.ArgumentParser) -> None:
    """Declare the command's options."""
    parser.add_argument("segment", type=Path, metavar="SEGMENT", help="folder of .npy files")
    parser.add_argument(
        "--map", type=Path, required=True, metavar="MAP", help="a map that knows its place on Earth"
    )
    parser.add_argument(
        "--out", type=Path, required=True, metavar="DIR", help="folder of the drive"
    )
    parser.add_argument("--curves", type=Path, metavar="FILE", help="table of a lane detector")
    parser.add_argument("--receiver", choices=RECEIVERS, default="ublox", help="default: ublox")
    parser.add_argument("--overwrite", action="store_true", help="write over an earlier drive")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace, console: Console, _: Console) -> bool:
    """Convert a segment, write it, and say what it tells of its instruments."""
    check_is_free(arguments.out, may_overwrite=arguments.overwrite)
    road_map = read_map(arguments.map)
    curves = None if arguments.curves is None else read_curves(arguments.curves)
    drive = drive_of_comma2k19(
        arguments.segment, road_map, receiver=arguments.receiver, curves=curves
    )
    write_drive(arguments.out, drive, arguments.map)
    found = motion_errors(drive.chassis, drive.gnss)
    sigma = found.sigma[3:]
    say(
        console,
        f"{arguments.out}: {drive.chassis.time_s[-1]:.1f} s, {len(drive.gnss.time_s)} fixes, "
        f"{len(drive.curves.time_s)} curves",
    )
    say(
        console,
        f"by the drive alone: speed times {1.0 + found.scale:.4f} ({sigma[0]:.4f}), yaw rate less "
        f"{math.degrees(found.bias):.3f} deg/s ({math.degrees(sigma[1]):.3f}), fixes stamped "
        f"{found.delay_s:.3f} s too late ({sigma[2]:.3f}): delay_s of [gnss] in drive.toml",
    )
    if len(drive.curves.time_s) == 0:
        say(console, "note: without curves no lane is found; fill curves.csv, or give --curves")
    return True
