"""``ssm-graph slam``: path and map from odometry and observed landmarks."""

from __future__ import annotations

import argparse
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Final

from rich.console import Console

from factors.kernels import KERNELS
from ssm_graph.base.errors import ConfigError
from ssm_graph.cli.options import (
    add_kernel_options,
    choice_option,
    kernel_of,
    number_option,
)
from ssm_graph.cli.terminal import say
from ssm_graph.io.results.place import check_result_place

if TYPE_CHECKING:
    from ssm_graph.systems.landmark_slam.solve import Asked

DESCRIPTION: Final = """\
Solve a log of odometry and observed landmarks in the plane: where the vehicle went, where the
landmarks are, with sigmas, and how much each observation counts.

INPUT is a folder with landmarks.toml (docs/landmark-slam.md), a folder of the UTIAS MRCLAM data
(with --robot), or a graph: .g2o, .graph or .toro (TORO), .pyfg, or text with ODOMETRY and LANDMARK
rows (Victoria Park in GTSAM's examples). Relations of poses that meet again are weighed too.

files in DIR:
  path.csv        pose and sigmas where something was seen, and every second between
  landmarks.csv   places, sigmas, how often seen
  weights.csv     every observation with its weight
  summary.json    what was asked for, noise used and found, errors where there is a truth
  figure.png      path and map with ellipses
"""


class NoiseUsed(Enum):
    """Which sigmas are taken."""

    STATED = "stated"
    OBSERVATIONS = "observations"
    ALL = "all"


class AssociationUsed(Enum):
    """How observations find their landmarks."""

    KNOWN = "known"
    NEAREST = "nearest"
    JOINT = "joint"


def declare(parser: argparse.ArgumentParser) -> None:
    """Declare the command's options."""
    parser.add_argument("input", type=Path, metavar="INPUT", help="folder or graph")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="result folder")
    number_option(
        parser, "--robot", "N", "of a MRCLAM folder, 1 to 5, or of a PyFG file, 1 is A", kind=int
    )
    parser.add_argument(
        "--method",
        default="smoother",
        metavar="NAME",
        help="smoother (of the whole log), isam2 or fixed-lag (pose by pose), or a filter of "
        "slam-study, such as ekf-weighted (default: smoother)",
    )
    text = "of --method fixed-lag: older poses are dropped (default: 20)"
    number_option(parser, "--lag", "S", text)
    text = "stated, or found from the log: that of the observations, or all, taken for white "
    text += "(default: stated; observations where the log states none)"
    choice_option(parser, "--noise", NoiseUsed, text, None)
    text = "landmarks by their names, by the nearest in a gate, or jointly (default: known)"
    choice_option(parser, "--association", AssociationUsed, text, AssociationUsed.KNOWN)
    add_kernel_options(parser, KERNELS)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace, console: Console, errors: Console) -> bool:
    """Read, solve, write."""
    from ssm_graph.systems.landmark_slam.solve import solve_input, write_solved

    check_result_place(arguments.out)
    solved = solve_input(arguments.input, asked_of(arguments))
    for note in solved.notes:
        say(errors, f"note: {note}")
    write_solved(arguments.out, solved)
    for line in solved.lines():
        say(console, line)
    say(console, f"results in {arguments.out}")
    return solved.is_good


def asked_of(arguments: argparse.Namespace) -> Asked:
    """Return what the options ask for."""
    from ssm_graph.systems.landmark_slam.association import Association
    from ssm_graph.systems.landmark_slam.incremental import LAG_S
    from ssm_graph.systems.landmark_slam.methods import FILTERS, INCREMENTAL, check_method
    from ssm_graph.systems.landmark_slam.solve import Asked

    method = check_method(arguments.method)
    if method not in (*FILTERS, *INCREMENTAL, "smoother"):
        raise ConfigError(
            f"--method: expected smoother, isam2, fixed-lag or a filter, got {method}; try "
            "smoother with --noise all"
        )
    if arguments.lag is not None and (method != "fixed-lag" or not arguments.lag > 0.0):
        raise ConfigError(
            f"--lag {arguments.lag:g}: expected seconds above 0, with --method fixed-lag, got "
            f"{method}"
        )
    noise: NoiseUsed | None = arguments.noise
    if method != "smoother" and noise not in (None, NoiseUsed.STATED):
        raise ConfigError(f"--noise {noise.value}: expected with --method smoother, got {method}")
    return Asked(
        method,
        learns_observations=None if noise is None else noise is not NoiseUsed.STATED,
        learns_control=noise is NoiseUsed.ALL,
        association=Association[arguments.association.name],
        kernel=kernel_of(arguments, KERNELS),
        robot=arguments.robot,
        lag_s=LAG_S if arguments.lag is None else arguments.lag,
    )
