"""``ssm-graph locate``: a road vehicle finds its lane in a map."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np
from rich.console import Console

from ssm_graph.cli.options import number_option
from ssm_graph.cli.terminal import say
from ssm_graph.io.results.place import check_is_free

if TYPE_CHECKING:
    from ssm_graph.systems.road_map.drive import Drive
    from ssm_graph.systems.road_map.maps.road_map import RoadMap

DESCRIPTION: Final = """\
Find the lane of a road vehicle in an HD map, from one poor fix, speed and yaw rate, and the curves
that a camera detects. DRIVE is a folder with drive.toml; docs/road-map.md has its format.

The answer is one of
  CONVERGED         the lane is known, and the place along it (exit code 0)
  UNRESOLVED_ALONG  the lane is known, the place along it is not: the road looks alike (0)
  AMBIGUOUS         more than one lane explains what was seen; the rivals are listed (4)
  FAILED            no lane explains what was seen, or nothing was seen (4)

With --out it writes result.json (verdict, pose, sigmas, hypotheses), track.csv and locate.png.
"""


def declare(parser: argparse.ArgumentParser) -> None:
    """Declare the command's options."""
    parser.add_argument("drive", type=Path, metavar="DRIVE", help="folder with drive.toml")
    parser.add_argument(
        "--method",
        choices=("annealed", "patent"),
        default="annealed",
        help="annealed particle filter, or the patent's method to the letter (default: annealed)",
    )
    parser.add_argument("--out", type=Path, metavar="DIR", help="folder of the results")
    parser.add_argument("--overwrite", action="store_true", help="write over earlier results")
    number_option(parser, "--seed", "N", "of the particles", 0, kind=int)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace, console: Console, _: Console) -> bool:
    """Locate a drive and say in which lane it ends."""
    from ssm_graph.systems.road_map.folder import read_drive
    from ssm_graph.systems.road_map.locate import locate
    from ssm_graph.systems.road_map.results import write_located

    if arguments.out is not None:
        check_is_free(arguments.out, may_overwrite=arguments.overwrite)
    drive, road_map = read_drive(arguments.drive)
    for note in road_map.notes[:10]:
        say(console, f"map: {note}")
    if arguments.method == "patent":
        return _run_patent(arguments, drive, road_map, console)

    found = locate(drive, road_map, seed=arguments.seed)
    x, y, yaw = found.pose
    say(console, f"{found.verdict.name}: {found.verdict.value}")
    say(console, f"  {found.reason}")
    say(
        console,
        f"  at {found.track.time_s[-1]:.2f} s: x {x:.3f} m, y {y:.3f} m, heading "
        f"{np.mod(90.0 - np.degrees(yaw), 360.0):.2f} deg; sigma across {found.sigmas[0]:.3f} m, "
        f"along {found.sigmas[1]:.2f} m, heading {np.degrees(found.sigmas[2]):.2f} deg",
    )
    if np.isfinite(found.first_fix_s):
        say(
            console,
            f"  lane first known after {found.first_fix_s:.1f} s and {found.first_fix_m:.0f} m; "
            f"{found.cpu_ms:.1f} ms of processor an update",
        )
    if arguments.out is not None:
        write_located(arguments.out, drive, road_map, found)
        say(console, f"  written: {arguments.out}")
    return found.verdict.has_lane


def _run_patent(
    arguments: argparse.Namespace, drive: Drive, road_map: RoadMap, console: Console
) -> bool:
    from ssm_graph.systems.road_map.patent import locate_by_patent
    from ssm_graph.systems.road_map.simulate import indices_of

    area = road_map.within(drive.gnss.x_y, 110.0)
    found = locate_by_patent(drive, indices_of(area), seed=arguments.seed)
    x, y, yaw = found.refined
    is_done = bool(np.isfinite(found.converged_s))
    told = f"said to be converged after {found.converged_s:.1f} s" if is_done else "not converged"
    say(
        console,
        f"patent: {told}; x {x:.3f} m, y {y:.3f} m, heading "
        f"{np.mod(90.0 - np.degrees(yaw), 360.0):.2f} deg; no covariance, no rivals",
    )
    if arguments.out is not None:
        arguments.out.mkdir(parents=True, exist_ok=True)
        text = json.dumps(
            {
                "method": "patent",
                "x_m": x,
                "y_m": y,
                "yaw_rad": yaw,
                "converged_s": found.converged_s if is_done else None,
            },
            indent=2,
        )
        (arguments.out / "result.json").write_text(text + "\n", encoding="utf-8")
    return is_done
