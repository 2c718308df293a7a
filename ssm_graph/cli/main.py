"""Entry point: parses the words, runs the command, turns errors into exit codes."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
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
from ssm_graph.cli.terminal import console_on, interrupt, occupy_closed_streams, say, signals_to


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
    "locate-simulate": "write a simulated drive over an HD map",
    "locate-study": "many simulated drives over HD maps, by several methods",
    "slam": "path and map from odometry and observed landmarks",
    "slam-study": "compare filters of landmark SLAM on simulated runs",
    "integrity": "a second witness of a smoothed mission: guaranteed bounds",
    "network": "guaranteed bounds of a sensor network",
    "network-run": "nodes of a network as processes, by UDP",
}
"""Summary of every command; the module of its name is loaded when it is the one that is given."""

EPILOG = """\
exit codes:
  0    done; for smooth and filter: converged; for online: ended in order, the last answer good;
       for compare: every run has a result
  1    a defect of this program
  2    a wrong option or setting, a missing extra
  3    the data of a mission cannot be used; the message says where and why
  4    locate: the lane is not known;
       smooth or filter ended with a result that must not be trusted blindly (iteration limit,
       interrupted after the first iteration, run away, or the data contradict it); it is written
       all the same, and its status says so; online: ended in order, the last answer was not good;
       compare: some runs have no result, the table says why; network, network-run: a set missed
       its truth or gave an alarm; integrity: the answer left the set, or a bound is false
  5    smooth found no finite result, nothing is written; online: there never was an answer, what
       came is logged
  130  interrupted, nothing written; compare keeps finished runs and goes on when started again, and
       so does online; it ends in order at the first SIGINT, SIGTERM or SIGHUP, like this at a
       second SIGINT or SIGTERM
"""

EXIT_CODES: tuple[tuple[type[SsmGraphError], ExitCode], ...] = (
    (ConfigError, ExitCode.USAGE),
    (MissingExtraError, ExitCode.USAGE),
    (DataError, ExitCode.DATA),
    (SolverError, ExitCode.NO_RESULT),
    (SsmGraphError, ExitCode.CRASH),
)


def build_parser(words: Sequence[str]) -> argparse.ArgumentParser:
    """Return the parser of all commands; the one that the words name has its options declared."""
    parser = argparse.ArgumentParser(
        prog="ssm-graph",
        description="Inertial and DVL navigation with a similarity weight for every beam.",
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=version("ssm-graph"))
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    given = next((word for word in words if not word.startswith("-")), None)
    for name, summary in COMMANDS.items():
        module = import_module(f"ssm_graph.cli.{name.replace('-', '_')}") if name == given else None
        command = commands.add_parser(
            name,
            help=summary,
            description=module.DESCRIPTION if module else None,
            epilog=EPILOG,
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        if module:
            module.declare(command)
    return parser


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
    try:
        with signals_to(interrupt):
            is_good = arguments.run(arguments, console, errors)
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
    except KeyboardInterrupt:
        errors.print("interrupted")
        code = ExitCode.INTERRUPTED
    failure = getattr(console.file, "failure", None)
    if failure is not None:
        say(errors, f"standard output: {failure}; files are not concerned")
    return code


if __name__ == "__main__":
    sys.exit(main())
