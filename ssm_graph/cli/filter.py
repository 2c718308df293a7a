"""``ssm-graph filter``: as ``smooth``, by an estimator that goes keyframe by keyframe."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, Final

from rich.console import Console

from ssm_graph.base.errors import ConfigError
from ssm_graph.base.usual import FILTER
from ssm_graph.cli.run_mission import add_mission_arguments, run_mission

if TYPE_CHECKING:
    from ssm_graph.mission.estimate import Estimate
    from ssm_graph.mission.mission import Mission
    from ssm_graph.mission.problem import ProblemConfig
    from ssm_graph.report.terminal.progress import ProgressDisplay

DESCRIPTION: Final = """\
Filter a recorded mission; writes trajectory.csv, beams.csv, summary.json and figure.png as smooth
does. Without [initial] the start is aligned as for smooth: the whole mission has its say in that.

Kalman filters, their robust relatives, similarity weights for a ping or for every beam, fixed lags:
ssm-graph help methods lists them.
"""


def declare(parser: argparse.ArgumentParser) -> None:
    """Declare the command's options."""
    add_mission_arguments(parser)
    parser.add_argument(
        "--method",
        default=FILTER,
        metavar="NAME[:NUMBER]",
        help="one of ssm-graph help methods; the number is its parameter (default: %(default)s)",
    )
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace, console: Console, errors: Console) -> bool:
    """Filter by the method that was asked for."""
    from ssm_graph.study.methods import filter_mission

    method = method_from(arguments.method)

    def solve(mission: Mission, graph: ProblemConfig, show: ProgressDisplay) -> Estimate:
        return filter_mission(
            mission, method, problem_config=graph, on_keyframe=show.keyframe, on_stage=show.stage
        )

    return run_mission(arguments, console, errors, solve, {"method": method})


def method_from(text: str) -> str:
    """Return the checked name of a filter; one that solves for all keyframes at once is refused."""
    from ssm_graph.study.methods import parse_filter

    try:
        return parse_filter(text).name
    except ConfigError as error:
        raise ConfigError(f"--method: {error}") from error
