"""Entry point: parses the words, runs the command, turns errors into exit codes."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Collection, Sequence
from enum import IntEnum
from importlib import import_module
from importlib.metadata import version
from typing import Final

from ssm_graph.base.errors import (
    ConfigError,
    DataError,
    MissingExtraError,
    SolverError,
    SsmGraphError,
    nearest_hint,
)
from ssm_graph.cli.terminal import (
    console_on,
    interrupt,
    occupy_closed_streams,
    say,
    signals_to,
    silent,
)


class ExitCode(IntEnum):
    """What a command ends with."""

    GOOD = 0
    CRASH = 1
    USAGE = 2
    DATA = 3
    NOT_GOOD = 4
    NO_RESULT = 5
    INTERRUPTED = 130


COMMANDS: Final = {
    "simulate": "write a simulated mission folder with truth as reference",
    "smooth": "smooth a mission folder",
    "filter": "filter a mission folder, or smooth it with a fixed lag",
    "online": "navigate live from instruments on sockets, or replay a mission as if live",
    "compare": "compare methods on many simulated or recorded missions",
    "inspect": "say what is in a file, folder, bag or mission, and whether it can be smoothed",
    "instruments": "list the inertial units and DVLs whose figures are known by name",
    "template": "write map.toml and vehicle.toml to fill in, for tables of any columns",
    "convert": "turn a maker's log, a ROS bag or tables of any columns into a mission folder",
    "export": "write a result for QGIS, Google Earth, evo, xarray, Foxglove, multibeam software",
    "report": "write a page about a result, for a browser and for print",
    "locate": "find the lane of a road vehicle in an HD map",
    "locate-convert": "turn a segment of comma2k19 into a drive's folder",
    "locate-simulate": "write a simulated drive over an HD map",
    "locate-study": "many simulated drives over HD maps, by several methods",
    "seabed": "find where a mission began on a map of the seabed",
    "seabed-simulate": "write a simulated mission over a seabed, with its map",
    "slam": "path and map from odometry and observed landmarks",
    "slam-study": "compare filters of landmark SLAM on simulated runs",
    "visual": "metric path, map and anchors from a camera and ranges",
    "visual-simulate": "write a simulated recording of a camera and ranges",
    "integrity": "a second witness of a smoothed mission: guaranteed bounds",
    "network": "guaranteed bounds of a sensor network",
    "network-run": "nodes of a network as processes, by UDP",
    "help": "help about a command, or about exit codes",
    "completion": "let a shell complete commands and options",
}
"""Summary of every command; the module of its name is loaded when it is the one that is given."""

GROUPS: Final = {
    "a log, and what is in it": ("inspect", "template", "convert", "instruments", "simulate"),
    "an answer": ("smooth", "filter", "online"),
    "what comes of it": ("report", "export", "compare", "integrity"),
    "landmark SLAM": ("slam", "slam-study"),
    "a start from a map": (
        *("locate", "locate-convert", "locate-simulate", "locate-study"),
        *("seabed", "seabed-simulate"),
    ),
    "guaranteed bounds in a network": ("network", "network-run"),
    "camera and ranges": ("visual", "visual-simulate"),
}
"""Commands by what they are for; those of no group stand at the end."""
EXIT_CODE_HELP: Final = """\
exit codes:
  0    done; for smooth and filter: converged; for online: ended in order, the last answer good;
       for compare: every run has a result
  1    a defect of this program
  2    a wrong option or setting, a missing extra
  3    the data of a mission cannot be used; the message says where and why
  4    locate: the lane is not known; seabed: the place is not known; visual: no scale, or one that
       has to be doubted;
       smooth or filter ended with a result that must not be trusted blindly (iteration limit,
       interrupted after the first iteration, run away, or the data contradict it); it is written
       all the same, and its status says so; online: ended in order, the last answer was not good;
       compare: some runs have no result, the table says why; network, network-run: a set missed
       its truth or gave an alarm; integrity: the answer left the set, or a bound is false
  5    smooth found no finite result, visual could not start a map: nothing is written; online:
       there never was an answer, what came is logged
  130  interrupted, nothing written; compare keeps finished runs and goes on when started again, and
       so does online; it ends in order at the first SIGINT, SIGTERM or SIGHUP, like this at a
       second SIGINT or SIGTERM
"""
SEE_CODES: Final = "exit codes: ssm-graph help codes"
QUIET: Final = "say nothing but errors; what --json prints is printed"

EXIT_CODES: tuple[tuple[type[SsmGraphError], ExitCode], ...] = (
    (ConfigError, ExitCode.USAGE),
    (MissingExtraError, ExitCode.USAGE),
    (DataError, ExitCode.DATA),
    (SolverError, ExitCode.NO_RESULT),
    (SsmGraphError, ExitCode.CRASH),
)


def build_parser(words: Sequence[str]) -> argparse.ArgumentParser:
    """Return the parser of all commands; the one that the words name has its options declared."""
    return _parser({next((word for word in words if not word.startswith("-")), "")})


def whole_parser() -> argparse.ArgumentParser:
    """Return the parser of all commands, each with its options; loads all of them."""
    return _parser(set(COMMANDS))


def command_parser(name: str) -> argparse.ArgumentParser:
    """Return the parser of one command."""
    return _subparser(_parser(set()).prog, name)


def _parser(wanted: Collection[str]) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="ssm-graph",
        description="Inertial and DVL navigation with a similarity weight for every beam.",
        epilog=f"{_grouped()}\n{SEE_CODES}\nhelp about a command: ssm-graph COMMAND --help",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=version("ssm-graph"))
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for name in COMMANDS:
        own = _subparser(parser.prog, name) if name in wanted else None
        if own is None:
            commands.add_parser(name)  # named by its group above
        else:
            made = commands.add_parser(name, parents=[own], add_help=False, help=COMMANDS[name])
            made.description, made.epilog = own.description, own.epilog
            made.formatter_class, made._defaults = own.formatter_class, own._defaults
    return parser


def _subparser(program: str, name: str) -> argparse.ArgumentParser:
    """Return the parser of a command, its module loaded."""
    module = import_module(f"ssm_graph.cli.{name.replace('-', '_')}")
    parser = argparse.ArgumentParser(
        prog=f"{program} {name}",
        description=module.DESCRIPTION,
        epilog=SEE_CODES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    module.declare(parser)
    parser.add_argument("--quiet", action="store_true", help=QUIET)
    return parser


def _grouped() -> str:
    """Return the commands by groups, one a line."""
    named = [name for names in GROUPS.values() for name in names]
    rest = tuple(name for name in COMMANDS if name not in named)
    lines = []
    for title, names in {**GROUPS, "more": rest}.items():
        lines += [f"{title}:", *(f"  {name:16} {COMMANDS[name]}" for name in names), ""]
    return "\n".join(lines)


def main(words: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code."""
    occupy_closed_streams()
    words = sys.argv[1:] if words is None else words
    parser = build_parser(words)
    if not words:
        parser.print_help(sys.stderr)
        return ExitCode.USAGE
    if not words[0].startswith("-") and words[0] not in COMMANDS:
        parser.exit(
            ExitCode.USAGE,
            f"error: {words[0]!r} is no command, {nearest_hint(words[0], COMMANDS)}\n",
        )
    arguments = parser.parse_args(words)
    console, errors = console_on(sys.stdout), console_on(sys.stderr, is_stderr=True)
    shown = console if getattr(arguments, "json", False) or not arguments.quiet else silent()
    told = silent() if arguments.quiet else errors
    try:
        with signals_to(interrupt):
            is_good = arguments.run(arguments, shown, told)
        code = ExitCode.GOOD if is_good else ExitCode.NOT_GOOD
    except SsmGraphError as error:
        from rich.text import Text

        errors.print(Text.assemble(("error:", "bold red"), f" {error}"), soft_wrap=True)
        code = next(code for kind, code in EXIT_CODES if isinstance(error, kind))
    except OSError as error:
        where = f"{error.filename}: " if error.filename else ""
        say(errors, f"error: {where}{error.strerror or error}")
        code = ExitCode.DATA
    except MemoryError as error:
        say(errors, f"error: out of memory: {str(error) or 'for what was asked for'}")
        code = ExitCode.DATA
    except (KeyboardInterrupt, ImportError) as error:
        # A package in C that is loaded meanwhile says of the interrupt that it could not begin.
        if not isinstance(error.__cause__ or error, KeyboardInterrupt):
            raise
        errors.print("interrupted")
        code = ExitCode.INTERRUPTED
    failure = getattr(console.file, "failure", None)
    if failure is not None:
        say(errors, f"standard output: {failure}; files are not concerned")
    return code


if __name__ == "__main__":
    sys.exit(main())
