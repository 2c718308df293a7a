"""``ssm-graph smooth``: a mission folder in, a result folder out."""

from __future__ import annotations

import argparse
from typing import Any

from rich.console import Console

from factors.kernels import KERNELS, KernelChoice, TruncatedKernel
from factors.similarity import Similarity
from ssm_graph.base.errors import ConfigError
from ssm_graph.cli.options import add_command, add_kernel_options, kernel_of
from ssm_graph.cli.run_mission import add_mission_arguments, run_mission
from ssm_graph.engine.reweighting import GncStart, Graduation
from ssm_graph.mission.estimate import Estimate
from ssm_graph.mission.mission import Mission
from ssm_graph.mission.problem import ProblemConfig
from ssm_graph.report.terminal.progress import ProgressDisplay
from ssm_graph.smoothers.batch import SmootherConfig
from ssm_graph.smoothers.faults.search import FaultSearch
from ssm_graph.smoothers.mission import smooth

GNC = "gnc-tls"
CHOICES = {**KERNELS, GNC: KernelChoice(TruncatedKernel, "width")}
"""Kernels by name; that of graduated non-convexity comes with a schedule of its own."""


def add_parser(commands: Any, *, epilog: str) -> None:
    """Declare the command and its options."""
    parser = add_command(
        commands,
        "smooth",
        summary="smooth a mission folder",
        description="Smooth a recorded mission; writes trajectory.csv, beams.csv, summary.json and "
        "figure.png. Where mission.toml gives prior sigmas of mounting, scale, lever arms, clocks "
        "or depth offset, these are calibrated: calibration.toml has the lines to put in place. "
        "Where pings are off the water (column water_track), its current is estimated.",
        epilog=epilog,
    )
    add_mission_arguments(parser)
    _add_kernel_options(parser)
    _add_loop_options(parser)
    parser.set_defaults(run=run)


def _add_kernel_options(parser: argparse.ArgumentParser) -> None:
    more = "; gnc-tls: truncated least squares by graduated non-convexity"
    add_kernel_options(parser, CHOICES, more=more)
    parser.add_argument(
        "--gnc-start",
        choices=[start.name.lower() for start in GncStart],
        default=None,
        help="start gnc-tls from least squares with every weight 1, as published, or from the "
        "gated forward pass (default: ones)",
    )
    parser.add_argument(
        "--similarity",
        choices=[kind.name.lower() for kind in Similarity],
        default=None,
        help="judge a beam by residual and posterior variance, or by the residual alone "
        "(default: expected for similarity kernels, plain for M-estimators and gnc-tls)",
    )


def _add_loop_options(parser: argparse.ArgumentParser) -> None:
    loop = SmootherConfig()
    parser.add_argument(
        "--max-iterations",
        type=int,
        default=loop.max_iterations,
        metavar="N",
        help=f"limit of the similarity loop (default: {loop.max_iterations})",
    )

    parser.add_argument(
        "--adapt-noise",
        action="store_true",
        help="repeat the solution with the sigma of each beam that its errors ask for; without it "
        "a note says where it differs from the stated one",
    )
    parser.add_argument(
        "--find-faults",
        action=argparse.BooleanOptionalAction,
        default=True,
        help="look for what is off for long (beams, the bottom, scale, mounting, fixes, depth, "
        "inertial data) and free the answer of it; single bad pings are the kernel's business "
        "(default: yes)",
    )


def run(arguments: argparse.Namespace, console: Console, errors: Console) -> bool:
    """Smooth, with the loop that was asked for."""
    loop = loop_from(arguments)

    def solve(mission: Mission, graph: ProblemConfig, show: ProgressDisplay) -> Estimate:
        return smooth(mission, loop, problem_config=graph, on_iteration=show, on_stage=show.stage)

    return run_mission(arguments, console, errors, solve, _settings(loop))


def loop_from(arguments: argparse.Namespace) -> SmootherConfig:
    """Return the settings of the loop; what does not belong to the kernel is refused."""
    graduation = None
    if arguments.kernel == GNC:
        graduation = Graduation(GncStart[(arguments.gnc_start or GncStart.ONES.name).upper()])
    elif arguments.gnc_start is not None:
        raise ConfigError(
            f"--gnc-start: expected with --kernel {GNC}, got {arguments.kernel}; leave it out"
        )
    similarity = arguments.similarity
    return SmootherConfig(
        kernel=kernel_of(arguments, CHOICES),
        similarity=None if similarity is None else Similarity[similarity.upper()],
        graduation=graduation,
        fault_search=FaultSearch() if arguments.find_faults else None,
        adapt_noise=arguments.adapt_noise,
        max_iterations=arguments.max_iterations,
    )


def _settings(loop: SmootherConfig) -> dict[str, Any]:
    return {
        "kernel": loop.weighting,
        "similarity": loop.judged_by.name.lower(),
        "adapt_noise": loop.adapt_noise,
        "find_faults": loop.fault_search is not None,
        "max_iterations": loop.max_iterations,
        "tolerance_sigmas": loop.tolerance,
    }
