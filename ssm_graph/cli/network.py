"""``ssm-graph network``: guaranteed bounds of a sensor network, and what a patent's are worth."""

from __future__ import annotations

import argparse
import shlex
import sys
from pathlib import Path

from rich.console import Console

from ssm_graph.cli.terminal import say

DESCRIPTION = """\
Run a network of nodes that watch one robot: the recursion of the patent beside sets that are worth
their bound, under noise that stays within its bounds in every way it can. Or, of kind "fleet", AUVs
over acoustic links: each leads its own set on, and cuts it by ranges to others whose sets it hears.

files in DIR:
  summary.md      what holds and what is vacuous, every filter, Table 1
  table.csv       the same numbers
  figures/*.png   figures 2 to 11 of the patent by their numbers; sets in the plane, tubes, error
                  against bound, what bits, steps and keys cost; of a fleet, its ways and sets

study file (TOML); everything but the name has the value of the setting that it is based on:
  name = "mine"
  base = "patent"                     # also: quiet, compass, walls, coarse
  runs = 20
  seed = 0
  disturbances = "patent, uniform, corner, adversary, search"
  [setting]
  n_nodes = 4
  n_steps = 40
  speed_m = 1.0                       # advance in a step
  turn_amplitude_rad = 0.25           # turn in step k: amplitude * cos(rate * k)
  turn_rate_rad = 0.15
  saturation = [20.0, 30.0, 20.0]     # m, m, rad
  motion_bound = [0.3, 0.3, 0.4]      # of the noise in a step: m, m, rad
  position_bound_m = 1.2              # of the noise of a measured position
  compass_bound_rad = 0.1             # without it there is no compass
  initial_variance = 2.0              # P_0 is so many times the identity
  true_scale = 1.0                    # above 1 the bound of positions is a lie
  [network]
  edges = [[1, 2], [2, 1]]            # node 2 sends to node 1, and so on
  loss = 0.3
  delay_steps = [1, 5]
  [code]
  d = 0.01                            # interval of the quantiser
  key = 1.0                           # of the patent; it is no encryption
  bits = 32                           # fewer are residues, completed by the receiver's set

of a fleet, each vehicle by itself and by ranges, errors uniform and at the corners of their bounds:
  name = "mine"
  kind = "fleet"
  runs = 5
  seed = 0
  [fleet]
  n_vehicles = 4
  n_steps = 600                       # of a second
  speed_m_per_s = 1.2
  start_bound_m = 2.0
  dvl_bound_m_per_s = 0.02            # of each component of the velocity
  compass_bound_deg = 2.0
  turn_bound_deg = 0.02               # of the gyro's turn in a second
  depth_bound_m = 0.3
  fix_bound_m = 2.5
  fix_every_s = 30
  n_surfaced = 2                      # the first vehicles, which have fixes
  [links]
  slot_s = 10                         # from packet to packet; the vehicles take turns
  loss = 0.3
  range_bound_m = 0.5
  false_range = 1.0                   # above 1 the bound of ranges is a lie
"""


def declare(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("study", type=Path, metavar="STUDY.toml", help="what to run")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="result folder")
    parser.add_argument("--no-figures", action="store_true", help="draw no figures")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace, console: Console, errors: Console) -> bool:
    """Run the study, write page, table and figures; good if no set missed its truth."""
    from ssm_graph.io.results.place import check_result_place
    from ssm_graph.systems.sensor_network.setting import read_study
    from ssm_graph.systems.sensor_network.study import (
        SET_FILTERS,
        plain_words,
        read_network_study,
        run_network_study,
        write_network_result,
    )

    check_result_place(arguments.out)
    if read_study(arguments.study)["kind"] == "fleet":
        return _run_fleet(arguments, console, errors)
    study = read_network_study(arguments.study)
    result = run_network_study(study, lambda what: errors.print(what, highlight=False))
    command = shlex.join(["ssm-graph", *sys.argv[1:]])
    write_network_result(arguments.out, result, command=command)
    if not arguments.no_figures:
        from ssm_graph.systems.sensor_network.figures import save_network_figures

        errors.print("figures", highlight=False)
        save_network_figures(arguments.out / "figures", study)
    for line in plain_words(result):
        say(console, line)
    say(console, f"results in {arguments.out}")
    sets = [row for row in result.rows if row.filter in SET_FILTERS]
    return study.setting.true_scale > 1.0 or all(row.n_outside == 0 for row in sets)


def _run_fleet(arguments: argparse.Namespace, console: Console, errors: Console) -> bool:
    """Do the same of a fleet."""
    from ssm_graph.systems.sensor_network.fleet_study import (
        fleet_words,
        read_fleet_study,
        run_fleet_study,
        write_fleet_result,
    )

    study = read_fleet_study(arguments.study)
    result = run_fleet_study(study, lambda what: errors.print(what, highlight=False))
    write_fleet_result(arguments.out, result, command=shlex.join(["ssm-graph", *sys.argv[1:]]))
    if not arguments.no_figures:
        from ssm_graph.systems.sensor_network.fleet_figure import save_fleet_figure

        save_fleet_figure(arguments.out / "figures", result)
    for line in fleet_words(result):
        say(console, line)
    say(console, f"results in {arguments.out}")
    is_lie = study.setting.false_range > 1.0
    return is_lie or all(row.n_outside == 0 for row in result.rows)
