"""``ssm-graph seabed``: find where a mission began on a map of the seabed."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Final

from rich.console import Console

from ssm_graph.base.errors import ConfigError
from ssm_graph.cli.options import number_option
from ssm_graph.cli.terminal import say
from ssm_graph.io.mission_folder.folder import read_mission
from ssm_graph.io.results.place import check_is_free
from ssm_graph.io.seabed.section import with_map_file
from ssm_graph.report.terminal.progress import ProgressDisplay
from ssm_graph.sensors.seabed import TerrainLog

DESCRIPTION: Final = """\
Find where a mission began on a map of the seabed, from the ranges of its DVL and its depth.
MISSION is a mission folder; its [map] names the map, or --map does. docs/seabed.md has more.

The start is looked for about [initial], within its sigmas or within_m of [map]; with [local],
anywhere on the map. The answer is one of
  CONVERGED   the place is known (exit code 0)
  AMBIGUOUS   a few places explain the ranges; the rivals are listed (4)
  UNRESOLVED  the seabed says too little of the place, it is flat for example (4)
  FAILED      no place on the map explains the ranges (4)

With --out it writes result.json (verdict, place, sigmas, hypotheses), particles.csv and seabed.png.
"""


def declare(parser: argparse.ArgumentParser) -> None:
    """Declare the command's options."""
    parser.add_argument("mission", type=Path, metavar="MISSION", help="mission folder")
    parser.add_argument(
        "--map",
        type=Path,
        metavar="FILE",
        help="map that says where it is (default: that of [map])",
    )
    parser.add_argument("--out", type=Path, metavar="DIR", help="folder of the results")
    parser.add_argument("--overwrite", action="store_true", help="write over earlier results")
    number_option(parser, "--seed", "N", "of the particles", 0, kind=int)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace, console: Console, errors: Console) -> bool:
    """Find a start and say where it is."""
    from ssm_graph.systems.seabed.dive import find_start
    from ssm_graph.systems.seabed.results import place_of, write_located

    if arguments.seed < 0:
        raise ConfigError(f"--seed: expected a whole number from 0, got {arguments.seed}")
    if arguments.out is not None:
        check_is_free(arguments.out, may_overwrite=arguments.overwrite)
    mission = read_mission(arguments.mission)
    if arguments.map is not None:
        mission = with_map_file(mission, arguments.map)
    if mission.aids.get(TerrainLog) is None:
        raise ConfigError(
            f"{arguments.mission}: there is no map; expected [map] in mission.toml, or --map FILE"
        )
    with ProgressDisplay(errors) as show:
        dive = find_start(mission, on_iteration=show, on_stage=show.stage, seed=arguments.seed)
    found = dive.located
    assert found is not None
    say(console, f"{found.verdict.name}: {found.verdict.value}")
    say(console, f"  {found.reason}")
    place = place_of(mission, found)
    say(
        console,
        f"  at the first ping: {place['lat_deg']:.7f}, {place['lon_deg']:.7f} deg, "
        f"{place['x_m']:.1f} m east, {place['y_m']:.1f} m north of the map's origin; sigma "
        f"{place['sigma_x_m']:.1f} m, {place['sigma_y_m']:.1f} m",
    )
    if arguments.out is not None:
        write_located(arguments.out, mission, dive)
        say(console, f"  written: {arguments.out}")
    return found.verdict.is_known
