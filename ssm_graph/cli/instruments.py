"""``ssm-graph instruments``: inertial units and DVLs whose figures are known by name."""

from __future__ import annotations

import argparse
import json

import tomli_w
from rich import box
from rich.console import Console
from rich.table import Table

from ssm_graph.cli.terminal import say, say_json
from ssm_graph.io.instruments.library import KEY, Preset, asked_for, preset, presets

DESCRIPTION = f"""\
List the instruments whose noise, bias, scale and geometry are known by name, with what these are
of; with a NAME, its figures and the keys of mission.toml that they make.

  [imu]
  {KEY} = "VN-100"              # keys beside it win; what no source gives is asked for
  [dvl]
  {KEY} = "DVL1000"

basis: 'read' is the maker's sheet, read for this list; 'quoted' is the sheet as other sources
quote it; 'published' are published figures, not read from a sheet here; '-' has no figures.
"""


def declare(parser: argparse.ArgumentParser) -> None:
    """Declare the command's options."""
    parser.add_argument("name", metavar="NAME", nargs="?", help="one instrument (default: all)")
    parser.add_argument("--json", action="store_true", help="print JSON")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace, console: Console, _: Console) -> bool:
    """List them, or show one."""
    found = presets()
    if arguments.name is not None:
        found = (preset(None, arguments.name, place="NAME"),)
    if arguments.json:
        say_json(console, [_as_dict(one) for one in found])
    elif arguments.name is None:
        _list(found, console)
    else:
        _show(found[0], console)
    return True


def _as_dict(one: Preset) -> dict[str, object]:
    return {
        "name": one.name,
        "section": one.section,
        "maker": one.maker,
        "sheet": one.sheet,
        "basis": one.basis,
        "published": list(one.published),
        "figures": dict(one.figures),
        "keys": one.keys,
    }


def _list(found: tuple[Preset, ...], console: Console) -> None:
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    for heading in ("section", "name", "maker", "figures", "basis"):
        table.add_column(heading, no_wrap=heading == "name")
    for one in found:
        table.add_row(
            one.section,
            one.name,
            one.maker,
            str(len(one.figures)),
            one.basis if one.figures else "-",
        )
    console.print(table)
    say(console, "ssm-graph instruments NAME  shows one; figures that have no source are absent")


def _show(one: Preset, console: Console) -> None:
    say(console, f"{one.maker} {one.name}: {one.source}")
    for name, value in one.figures.items():
        say(console, f"  {name} = {value}")
    from ssm_graph.io.mission_folder.toml import required_keys

    if missing := asked_for(one.section, one.keys, required_keys(one.section)):
        say(console, f"  no source gives, so state beside it: {', '.join(missing)}")
    say(console, f"\n[{one.section}]\n{KEY} = {json.dumps(one.name)}\n# which stands for")
    say(console, tomli_w.dumps(one.keys).rstrip())
