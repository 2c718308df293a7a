"""``ssm-graph locate`` and its companions: a road vehicle finds its lane in a map."""

from __future__ import annotations

import argparse
import json
import os
from pathlib import Path
from typing import Any, Final

import numpy as np
from rich.console import Console

from ssm_graph.base.errors import ConfigError
from ssm_graph.cli.options import add_command, number_option, say
from ssm_graph.io.results.place import check_is_free

METHODS: Final = ("annealed", "patent", "patent-min-max", "patent-sum")
DESCRIPTION = """\
Find the lane of a road vehicle in an HD map, from one poor fix, speed and yaw rate, and the curves
that a camera detects. DRIVE is a folder with drive.toml; docs/road-map.md has its format.

The answer is one of
  CONVERGED         the lane is known, and the place along it (exit code 0)
  UNRESOLVED_ALONG  the lane is known, the place along it is not: the road looks alike (0)
  AMBIGUOUS         more than one lane explains what was seen; the rivals are listed (4)
  FAILED            no lane explains what was seen, or nothing was seen (4)

With --out it writes result.json (verdict, pose, sigmas, hypotheses), track.csv and locate.png.
"""


def add_parser(commands: Any, *, epilog: str) -> None:
    """Declare the commands and their options."""
    parser = add_command(
        commands,
        "locate",
        summary="find the lane of a road vehicle in an HD map",
        description=DESCRIPTION,
        epilog=epilog,
    )
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
    _add_simulate(commands, epilog)
    _add_study(commands, epilog)


def _add_simulate(commands: Any, epilog: str) -> None:
    parser = add_command(
        commands,
        "locate-simulate",
        summary="write a simulated drive over an HD map",
        description="Drive a random route over a map (lanelet2 .osm, CommonRoad .xml, OpenDRIVE\n"
        ".xodr), or the way of an Argoverse 2 log, and write what the vehicle records.",
        epilog=epilog,
    )
    parser.add_argument("map", type=Path, metavar="MAP", help="a map, or an Argoverse 2 log folder")
    parser.add_argument(
        "--out", type=Path, required=True, metavar="DIR", help="folder of the drive"
    )
    parser.add_argument("--overwrite", action="store_true", help="write over an earlier drive")
    parser.add_argument(
        "--case", default="plain", help="plain, traffic or motorway (default: plain)"
    )
    number_option(parser, "--seed", "N", "same seed, same drive", 0, kind=int)
    parser.set_defaults(run=run_simulate)


def _add_study(commands: Any, epilog: str) -> None:
    parser = add_command(
        commands,
        "locate-study",
        summary="many simulated drives over maps, by several methods",
        description="Simulate drives over maps and Argoverse 2 logs, locate them, and tell how "
        "often the lane is\nright, declared, and declared wrongly. Finished drives are kept in "
        "DIR: interrupted and started\nagain, only what is missing is done. Seeds below 100 were "
        "used to choose settings.",
        epilog=epilog,
    )
    parser.add_argument("maps", type=Path, nargs="+", metavar="MAP", help="maps or log folders")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="result folder")
    parser.add_argument(
        "--case", default="plain", help="plain, damaged, traffic or motorway (default: plain)"
    )
    parser.add_argument("--methods", default="annealed", metavar="A,B", help=", ".join(METHODS))
    number_option(parser, "--first-seed", "N", "the first drive", 1000, kind=int)
    number_option(parser, "--seeds", "N", "drives on each map", 200, kind=int)
    number_option(parser, "--jobs", "N", "processes", os.cpu_count() or 1, kind=int)
    parser.add_argument("--fresh", action="store_true", help="throw earlier drives in DIR away")
    parser.set_defaults(run=run_study)


def run(arguments: argparse.Namespace, console: Console, _: Console) -> bool:
    """Locate a drive and say in which lane it ends."""
    from ssm_graph.systems.road_map.folder import read_drive

    if arguments.out is not None:
        check_is_free(arguments.out, may_overwrite=arguments.overwrite)
    drive, road_map = read_drive(arguments.drive)
    for note in road_map.notes[:10]:
        say(console, f"map: {note}")
    if arguments.method == "patent":
        return _run_patent(arguments, drive, road_map, console)
    from ssm_graph.systems.road_map.locate import locate
    from ssm_graph.systems.road_map.results import write_located

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


def _run_patent(arguments: argparse.Namespace, drive: Any, road_map: Any, console: Console) -> bool:
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


def run_simulate(arguments: argparse.Namespace, console: Console, _: Console) -> bool:
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


def run_study(arguments: argparse.Namespace, console: Console, errors: Console) -> bool:
    """Simulate, locate, and tell how often it is right."""
    from ssm_graph.study.ledger import ERROR, Ledger, run_trials
    from ssm_graph.systems.road_map.study import HEADER, keys_of, settings_of, summary, trial

    methods = [name.strip() for name in arguments.methods.split(",")]
    unknown = [name for name in methods if name not in METHODS]
    if unknown:
        raise ConfigError(
            f"--methods: expected some of {', '.join(METHODS)}, got {', '.join(unknown)}"
        )
    seeds = range(arguments.first_seed, arguments.first_seed + arguments.seeds)
    path = arguments.out / f"{arguments.case}.jsonl"
    ledger = Ledger(path, settings_of(arguments.case), fresh=arguments.fresh)
    keys = keys_of(arguments.maps, arguments.case, methods, seeds)

    def told(done: int, wanted: int, _: object) -> None:
        if done % 20 == 0 or done == wanted:
            say(errors, f"{done} of {wanted} drives")

    rows = run_trials(trial, keys, ledger, n_jobs=arguments.jobs, on_progress=told)
    lines = [
        "| " + " | ".join(cells) + " |" for cells in (HEADER, ["---"] * len(HEADER), *summary(rows))
    ]
    for line in lines:
        say(console, line)
    (arguments.out / f"{arguments.case}.md").write_text("\n".join(lines) + "\n", encoding="utf-8")
    failed = [str(row[ERROR]) for row in rows.values() if ERROR in row]
    for text in dict.fromkeys(failed):
        say(errors, f"{failed.count(text)} drives without a result: {text}")
    return not failed
