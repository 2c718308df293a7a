"""``ssm-graph help``: what a command does, and what it ends with."""

from __future__ import annotations

import argparse

from rich.console import Console

from ssm_graph.base.errors import ConfigError, nearest_hint
from ssm_graph.cli.terminal import say

CODES = "codes"
METHODS = "methods"
DESCRIPTION = """\
Show the help of a command, with 'codes' what commands end with, or with 'methods' what filter
and compare can be asked for.
"""


def declare(parser: argparse.ArgumentParser) -> None:
    """Declare the command's options."""
    parser.add_argument("topic", nargs="?", metavar="COMMAND|codes|methods", help="what about")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace, console: Console, _: Console) -> bool:
    """Show it."""
    from ssm_graph.cli.main import COMMANDS, EXIT_CODE_HELP, build_parser, command_parser

    topic: str | None = arguments.topic
    if topic is None:
        say(console, build_parser(()).format_help())
    elif topic == CODES:
        say(console, EXIT_CODE_HELP)
    elif topic == METHODS:
        say(console, _methods())
    elif topic in COMMANDS:
        say(console, command_parser(topic).format_help())
    else:
        hint = nearest_hint(topic, [*COMMANDS, CODES, METHODS])
        raise ConfigError(f"help: {topic!r} is no command, {hint}")
    return True


def _methods() -> str:
    """Return every method, those of ``filter`` first; loads all estimators."""
    from ssm_graph.cli.options import method_lines
    from ssm_graph.study.methods import FAMILIES, RECURSIVE

    rest = {name: family for name, family in FAMILIES.items() if name not in RECURSIVE}
    return (
        "of filter and compare, with the parameter that each has where none is given:\n"
        f"{method_lines(RECURSIVE)}\n\nof compare alone:\n{method_lines(rest)}"
    )
