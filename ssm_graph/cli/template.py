"""``ssm-graph template``: commented files to fill in, for columns of anyone."""

from __future__ import annotations

import argparse
from importlib.resources import files
from pathlib import Path
from typing import Final

from rich.console import Console

from ssm_graph.base.errors import ConfigError
from ssm_graph.cli.terminal import say

TEMPLATES: Final = ("map", "vehicle")
DESCRIPTION = """\
Write map.toml and vehicle.toml, commented, to fill in: what the columns of your tables are, with
units, signs and axes, and what is known of the vehicle. Then

  ssm-graph convert --map map.toml FILES --out MISSION
  ssm-graph smooth MISSION --out RESULT
  ssm-graph report RESULT

ssm-graph inspect FILE.csv --draft-map map.toml drafts a map of a table's own columns instead.
"""


def declare(parser: argparse.ArgumentParser) -> None:
    """Declare the command's options."""
    parser.add_argument(
        "--out",
        type=Path,
        default=Path(),
        metavar="DIR",
        help="folder of the files (default: the current one)",
    )
    parser.add_argument("--overwrite", action="store_true", help="write over files of these names")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace, console: Console, _: Console) -> bool:
    """Write both files."""
    paths = {name: arguments.out / f"{name}.toml" for name in TEMPLATES}
    for path in paths.values():
        if path.exists() and not arguments.overwrite:
            raise ConfigError(
                f"--out: {path} is there already; give another folder, or --overwrite"
            )
    arguments.out.mkdir(parents=True, exist_ok=True)
    folder = files("ssm_graph.io.columns")
    for name, path in paths.items():
        path.write_text((folder / f"{name}_template.toml").read_text("utf-8"), "utf-8")
    say(console, f"{' and '.join(str(path) for path in paths.values())}: fill them in")
    return True
