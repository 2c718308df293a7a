"""Options that several commands share."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from factors.kernels import KernelChoice
from factors.similarity import Kernel
from ssm_graph.base.errors import ConfigError
from ssm_graph.io.mission_folder.reader import TableFormat
from ssm_graph.study.methods import Family


def add_command(commands: Any, name: str, *, summary: str, description: str, epilog: str) -> Any:
    """Return the parser of a new command, its text kept line by line."""
    return commands.add_parser(
        name,
        help=summary,
        description=description,
        epilog=epilog,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )


def method_lines(families: Mapping[str, Family]) -> str:
    """Return what methods there are, one a line, each with its parameter's default."""
    return "\n".join(
        f"  {name if family.default is None else f'{name}[:{family.default:g}]':26} "
        f"{family.description}"
        for name, family in families.items()
    )


def add_mission_output(parser: argparse.ArgumentParser) -> None:
    """Add where and in which format a mission folder is written."""
    table_format_option(parser)
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="mission folder")


def table_format_option(parser: argparse.ArgumentParser) -> None:
    """Add in which format tables are written."""
    parser.add_argument(
        "--format",
        type=_table_format,
        choices=list(TableFormat),
        default=TableFormat.CSV,
        metavar="{" + ",".join(table.name.lower() for table in TableFormat) + "}",
        help="format of the tables (default: csv)",
    )


def _table_format(word: str) -> TableFormat:
    try:
        return TableFormat[word.upper()]
    except KeyError:
        raise argparse.ArgumentTypeError(f"expected csv or parquet, got {word!r}") from None


def kernel_from(choices: Mapping[str, KernelChoice], name: str, **given: float | None) -> Kernel:
    """Return a kernel by name; a parameter that it does not have is refused."""
    choice = choices[name]
    for parameter, value in given.items():
        if value is not None and parameter != choice.parameter:
            owners = [kernel for kernel, c in choices.items() if c.parameter == parameter]
            raise ConfigError(
                f"--{parameter}: expected with --kernel {' or '.join(owners)}, got {name}; "
                "leave it out"
            )
    try:
        return choice.kernel(given.get(choice.parameter))
    except ValueError as error:
        raise ConfigError(f"--kernel {name}: {error}") from error
