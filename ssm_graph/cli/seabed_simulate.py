"""``ssm-graph seabed-simulate``: write a simulated mission over a seabed, with its map."""

from __future__ import annotations

import argparse
from dataclasses import replace
from typing import Final

from rich.console import Console

from ssm_graph.base.usual import SEABED_DIVE_S, SEABED_RELIEF_M
from ssm_graph.cli.options import add_mission_output, choice_option, number_option
from ssm_graph.cli.terminal import say
from ssm_graph.io.mission_folder.folder import write_mission
from ssm_graph.io.results.place import check_is_free
from ssm_graph.simulation import Grade

DESCRIPTION: Final = """\
Simulate a dive over a seabed with the spectrum of real ones: survey lines 40 m deep over ground at
80 m, whose DVL ranges are met with the seabed beam by beam, and the map that a survey made of it.
The stated start is off by up to --start metres. Writes a mission folder with [map].
"""


def declare(parser: argparse.ArgumentParser) -> None:
    """Declare the command's options."""
    choice_option(parser, "--grade", Grade, "of the inertial sensors (default: mems)", Grade.MEMS)
    number_option(parser, "--duration", "SECONDS", "length of the dive", SEABED_DIVE_S)
    number_option(
        parser, "--relief", "METRES", "of the seabed, 1 sigma; 0 is flat", SEABED_RELIEF_M
    )
    number_option(parser, "--start", "METRES", "by which the start is off at most", 300.0)
    number_option(parser, "--seed", "N", "same seed, same dive", 0, kind=int)
    add_mission_output(parser)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace, console: Console, _: Console) -> bool:
    """Simulate and write."""
    from ssm_graph.systems.seabed.simulate import (
        DIVE,
        DiveSettings,
        mission_with_map,
        simulate_dive,
    )
    from ssm_graph.systems.seabed.terrain import FLAT, ROUGH

    check_is_free(arguments.out, may_overwrite=arguments.overwrite)
    terrain = FLAT if arguments.relief == 0.0 else replace(ROUGH, relief_m=arguments.relief)
    mission = replace(
        DIVE, seed=arguments.seed, grade=arguments.grade, duration_s=arguments.duration
    )
    dive = simulate_dive(DiveSettings(mission=mission, terrain=terrain, start_m=arguments.start))
    write_mission(arguments.out, mission_with_map(dive), table_format=arguments.format)
    say(
        console,
        f"{arguments.out}: {len(dive.mission.dvl.time_s)} pings over a map of "
        f"{' by '.join(map(str, dive.map.height.shape))} cells, seed {arguments.seed}",
    )
    return True
