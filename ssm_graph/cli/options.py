"""Options that several commands share."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from factors.kernels import KernelChoice
from factors.similarity import Kernel
from ssm_graph.base.errors import ConfigError
from ssm_graph.io.tables.files import TableFormat

if TYPE_CHECKING:
    from ssm_graph.study.methods import Family


def number_option(
    parser: Any,
    flag: str,
    metavar: str,
    meaning: str,
    default: float | None = None,
    kind: Callable[[str], float] = float,
) -> None:
    """Add an option that holds a number; without a default the meaning says what is the case."""
    tail = "" if default is None else f" (default: {default:g})"
    parser.add_argument(flag, type=kind, default=default, metavar=metavar, help=meaning + tail)


def choice_option(
    parser: Any, flag: str, kind: type[Enum], meaning: str, default: Enum | None = None
) -> None:
    """Add an option that names a member of an enumeration, in upper or lower case."""
    names = [str(m.value) if m.value == m.name else m.name.lower() for m in kind]

    def member(word: str) -> Enum:
        try:
            return kind[word.upper()]
        except KeyError:
            expected = f"{', '.join(names[:-1])} or {names[-1]}"
            raise argparse.ArgumentTypeError(f"expected {expected}, got {word!r}") from None

    choices = "{" + ",".join(names) + "}"
    parser.add_argument(flag, type=member, default=default, metavar=choices, help=meaning)


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
    parser.add_argument("--overwrite", action="store_true", help="write over files that are there")


def table_format_option(parser: argparse.ArgumentParser) -> None:
    """Add in which format tables are written."""
    meaning = "format of the tables (default: csv)"
    choice_option(parser, "--format", TableFormat, meaning, TableFormat.CSV)


PARAMETERS: Final = {
    "dof": ("NUMBER", "degrees of freedom"),
    "width": ("SIGMAS", "residual at which a beam begins to be or is an outlier"),
    "phi": ("SIGMAS2", "squared residual up to which a beam counts in full"),
    "alpha": ("SHAPE", "2 for least squares, 1, 0, -2 and less for losses that end ever sooner"),
}
"""Metavariable and meaning of the kernels' parameters."""
KERNEL_HELP: Final = (
    "log, sqrt, exp: similarity kernels; gaussian: least squares; huber, cauchy, dcs, "
    "geman-mcclure: classical M-estimators; general: Barron's loss; truncated: a hard gate"
)


def add_kernel_options(
    parser: argparse.ArgumentParser, choices: Mapping[str, KernelChoice], *, more: str = ""
) -> None:
    """Add the kernel and the parameters of kernels."""
    parser.add_argument(
        "--kernel", choices=choices, default="log", help=f"{KERNEL_HELP}{more} (default: log)"
    )
    for name, (metavar, meaning) in PARAMETERS.items():
        owners = {k: c.default for k, c in choices.items() if c.parameter == name}
        defaults = ", ".join(f"{default:.5g} for {kernel}" for kernel, default in owners.items())
        help_text = f"{meaning} (default: {defaults})"
        parser.add_argument(f"--{name}", type=float, metavar=metavar, help=help_text)


def kernel_of(arguments: argparse.Namespace, choices: Mapping[str, KernelChoice]) -> Kernel:
    """Return the kernel that was asked for by :func:`add_kernel_options`."""
    given = {name: getattr(arguments, name) for name in PARAMETERS}
    return kernel_from(choices, arguments.kernel, **given)


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
