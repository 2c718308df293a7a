"""``ssm-graph filter``: as ``smooth``, by an estimator that goes keyframe by keyframe."""

from __future__ import annotations

import argparse
from dataclasses import replace
from typing import Any, Final

from rich.console import Console

from ssm_graph.base.errors import ConfigError, nearest_hint
from ssm_graph.cli.options import add_command, method_lines
from ssm_graph.cli.run_mission import add_mission_arguments, run_mission
from ssm_graph.mission.estimate import Estimate
from ssm_graph.mission.mission import Mission
from ssm_graph.mission.problem import ProblemConfig, build_problem
from ssm_graph.report.terminal.progress import ProgressDisplay
from ssm_graph.study.methods import FAMILIES, Method, parse_method, parse_methods
from ssm_graph.study.trials import Trial, with_initial

DEFAULT: Final = "ssm-log"
METHODS: Final = {
    name: family
    for name, family in FAMILIES.items()
    if family.is_recursive and not family.is_oracle
}
"""Those that need nothing but the mission and go keyframe by keyframe."""

DESCRIPTION: Final = """\
Filter a recorded mission; writes trajectory.csv, beams.csv, summary.json and figure.png as smooth
does. Without [initial] the start is aligned as for smooth: the whole mission has its say in that.
"""


def add_parser(commands: Any, *, epilog: str) -> None:
    """Declare the command and its options."""
    parser = add_command(
        commands,
        "filter",
        summary="filter a mission folder, or smooth it with a fixed lag",
        description=f"{DESCRIPTION}\nmethods:\n{method_lines(METHODS)}",
        epilog=epilog,
    )
    add_mission_arguments(parser)
    parser.add_argument(
        "--method",
        default=DEFAULT,
        metavar="NAME[:NUMBER]",
        help="one of those above; the number is its parameter (default: %(default)s)",
    )
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace, console: Console, errors: Console) -> bool:
    """Filter by the method that was asked for."""
    method = method_from(arguments.method)

    def solve(mission: Mission, graph: ProblemConfig, show: ProgressDisplay) -> Estimate:
        return filter_mission(mission, method, graph, show)

    return run_mission(arguments, console, errors, solve, {"method": method.name})


def method_from(text: str) -> Method:
    """Return a method by name; one that solves for all keyframes at once is refused."""
    name = text.strip().partition(":")[0]
    if name not in METHODS:
        raise ConfigError(f"--method: {text!r} is no filter; {nearest_hint(name, METHODS)}")
    (checked,) = parse_methods([text], where="--method")
    return parse_method(checked)


def filter_mission(
    mission: Mission, method: Method, graph: ProblemConfig, show: ProgressDisplay
) -> Estimate:
    """Align where there is no start, build the problem, and go through it."""
    if mission.initial is None:
        show.stage("aligning")
        mission = with_initial(mission)
    show.stage("preintegrating")
    problem = build_problem(mission, graph)
    show.stage(f"{method.name}: {problem.n_keyframes} keyframes")
    (estimate,) = method.solver([Trial(0, mission, problem)], on_keyframe=show.keyframe)
    return replace(estimate, notes=mission.notes + estimate.notes)
