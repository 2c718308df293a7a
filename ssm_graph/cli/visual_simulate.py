"""``ssm-graph visual-simulate``: write a simulated recording of a camera and ranges."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Final

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from ssm_graph.cli.options import number_option
from ssm_graph.cli.terminal import say
from ssm_graph.io.results.place import check_is_free

if TYPE_CHECKING:
    from ssm_graph.systems.visual_ranges.simulate import Run

DESCRIPTION: Final = """\
Render the images of a camera that is carried through a room or a corridor with repeating walls,
simulate ranges to anchors with all their faults, and write both as a folder for ssm-graph visual:
visual.toml, images, times.csv, ranges.csv, and the truth.

In the world `bottom` a vehicle carries it over boulders in murky water, with depth, dead reckoning
and two-way acoustic ranges once a second (sigma 0.1 m) by a sound speed that is 1 % off; images
come at 10 Hz. The options of rates, sigma and clock are not for it.
"""


def declare(parser: argparse.ArgumentParser) -> None:
    """Declare the command's options."""
    parser.add_argument("world", metavar="WORLD", help="room, corridor, or bottom (under water)")
    parser.add_argument(
        "--out", type=Path, required=True, metavar="DIR", help="folder of the recording"
    )
    parser.add_argument("--overwrite", action="store_true", help="write over an earlier recording")
    number_option(parser, "--seed", "N", "same seed, same recording", 0, kind=int)
    number_option(parser, "--duration-s", "S", "of the walk", 60.0)
    number_option(parser, "--rate-hz", "HZ", "of images", 20.0)
    number_option(parser, "--anchors", "N", "0 to 3", 1, kind=int)
    number_option(parser, "--range-rate-hz", "HZ", "of each anchor", 10.0)
    number_option(parser, "--sigma-m", "M", "of ranges in line of sight", 0.08)
    number_option(parser, "--bias-m", "M", "of all ranges", 0.05)
    number_option(
        parser, "--nlos", "SHARE", "of ranges without line of sight, too long, in bursts", 0.0
    )
    number_option(parser, "--clock-s", "S", "stamps of the ranges less their true times", 0.0)
    parser.add_argument(
        "--covered-s", nargs=2, type=float, metavar=("FROM", "TO"), help="lens covered, s"
    )
    parser.add_argument(
        "--silent-s", nargs=2, type=float, metavar=("FROM", "TO"), help="no ranges, s"
    )
    parser.add_argument("--small", action="store_true", help="320 x 240 instead of 640 x 480")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace, console: Console, errors: Console) -> bool:
    """Simulate and write."""
    from dataclasses import replace

    from ssm_graph.systems.visual_ranges.simulate import (
        CAMERA,
        SMALL_CAMERA,
        ImageFaults,
        Run,
        under_water,
    )
    from ssm_graph.systems.visual_ranges.simulated_ranges import RangeFaults

    check_is_free(arguments.out, may_overwrite=arguments.overwrite)
    ranges = RangeFaults(
        rate_hz=arguments.range_rate_hz,
        sigma_m=arguments.sigma_m,
        bias_m=arguments.bias_m,
        nlos_share=arguments.nlos,
        clock_s=arguments.clock_s,
        silent_s=tuple(arguments.silent_s or (0.0, 0.0)),
    )
    if arguments.world == "bottom":
        asked = replace(
            under_water(arguments.seed, arguments.duration_s),
            n_anchors=arguments.anchors,
            camera=SMALL_CAMERA if arguments.small else CAMERA,
            images=ImageFaults(covered_s=tuple(arguments.covered_s or (0.0, 0.0))),
        )
        asked = replace(
            asked,
            ranges=replace(
                asked.ranges,
                bias_m=arguments.bias_m,
                nlos_share=arguments.nlos,
                silent_s=tuple(arguments.silent_s or (0.0, 0.0)),
            ),
        )
        return _written(arguments, asked, console, errors)
    asked = Run(
        arguments.world,
        arguments.seed,
        arguments.duration_s,
        arguments.rate_hz,
        arguments.anchors,
        camera=SMALL_CAMERA if arguments.small else CAMERA,
        ranges=ranges,
        images=ImageFaults(covered_s=tuple(arguments.covered_s or (0.0, 0.0))),
    )
    return _written(arguments, asked, console, errors)


def _written(arguments: argparse.Namespace, asked: Run, console: Console, errors: Console) -> bool:
    from ssm_graph.systems.visual_ranges.readers.own_folder import write_own_folder
    from ssm_graph.systems.visual_ranges.simulate import simulate

    simulated = simulate(asked)
    sequence = simulated.sequence
    columns = (TextColumn("images"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=errors, transient=True) as progress:
        task = progress.add_task("", total=len(sequence))
        for _ in write_own_folder(arguments.out, sequence):
            progress.advance(task)
    say(
        console,
        f"{arguments.out}: {sequence.duration_s:.1f} s, {len(sequence)} images, "
        f"{len(sequence.ranges)} ranges to {sequence.ranges.n_anchors} anchors "
        f"({int(simulated.is_nlos.sum())} without line of sight), seed {arguments.seed}",
    )
    return True
