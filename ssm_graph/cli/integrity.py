"""``ssm-graph integrity``: the smoother's answer beside the set that the stated bounds allow."""

from __future__ import annotations

import argparse
from pathlib import Path

from rich.console import Console

from ssm_graph.cli.options import number_option
from ssm_graph.cli.terminal import say

DESCRIPTION = """\
Smooth a mission, and beside it lead on the set of all places that its inertial, DVL, depth, compass
and fix bounds allow; bounds are so many of the stated sigmas. Either the answer is inside, and the
truth within the distance that is told as long as every bound is true, or an alarm proves that one
is false. Writes integrity.csv and integrity.json. Ends with 0 if the answer is inside and no alarm
was raised.
"""


def declare(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("mission", type=Path, metavar="MISSION", help="mission folder")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="result folder")
    number_option(parser, "--sigmas", "K", "bounds are so many stated sigmas", 5.0)
    number_option(parser, "--block", "S", "noise averages out over blocks of so many seconds", 10.0)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace, console: Console, errors: Console) -> bool:
    """Smooth, check, write and say what came of it."""
    from ssm_graph.io.mission_folder.folder import read_mission
    from ssm_graph.io.results.place import check_result_place
    from ssm_graph.report.terminal.progress import ProgressDisplay
    from ssm_graph.smoothers.mission import smooth
    from ssm_graph.systems.sensor_network.integrity import (
        Agreement,
        check_integrity,
        write_integrity,
    )
    from ssm_graph.systems.sensor_network.witness import WitnessBounds

    bounds = WitnessBounds(sigmas=arguments.sigmas, block_s=arguments.block)
    check_result_place(arguments.out)
    with ProgressDisplay(errors) as show:
        show.stage("reading the mission")
        mission = read_mission(arguments.mission)
        estimate = smooth(mission, on_iteration=show, on_stage=show.stage)
        show.stage("leading the set on")
        found = check_integrity(mission, estimate, bounds)
        write_integrity(arguments.out, found)
    say(console, f"smoother: {estimate.status.name}: {estimate.reason}")
    say(console, f"witness: {found.agreement.name}: {found.reason}")
    for fault in found.faults:
        say(console, f"  {fault.sentence}")
    say(console, f"results in {arguments.out}")
    return found.agreement is Agreement.INSIDE
