"""``ssm-graph smooth``: a mission folder in, a result folder out."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from rich.console import Console

from factors.kernels import KERNELS, GeneralKernel, KernelChoice, TruncatedKernel
from factors.similarity import Kernel, Similarity
from ssm_graph.base.errors import ConfigError
from ssm_graph.base.usual import MAX_ITERATIONS
from ssm_graph.cli.answers import add_answer_arguments, asks, check_asked
from ssm_graph.cli.options import (
    add_kernel_options,
    choice_option,
    kernel_of,
    number_option,
)
from ssm_graph.cli.run_mission import add_mission_arguments, run_mission
from ssm_graph.engine.reweighting import GncStart, Graduation

if TYPE_CHECKING:
    from ssm_graph.mission.estimate import Estimate
    from ssm_graph.mission.mission import Mission
    from ssm_graph.mission.problem import ProblemConfig
    from ssm_graph.report.terminal.progress import ProgressDisplay
    from ssm_graph.smoothers.settings import SmootherConfig

GNC = "gnc-tls"
ADAPTIVE = "adaptive"


def _general(width: float = GeneralKernel.width) -> Kernel:
    return GeneralKernel(width=width)


CHOICES = {
    **KERNELS,
    GNC: KernelChoice(TruncatedKernel, "width"),
    ADAPTIVE: KernelChoice(_general, "width"),
}
"""Kernels by name; the last two come with schedules of their own."""


DESCRIPTION: Final = """\
Smooth a recorded mission; writes trajectory.csv, beams.csv, summary.json and figure.png. Where
mission.toml gives prior sigmas of mounting, scale, lever arms, clocks or depth offset, these are
calibrated: calibration.toml has the lines to put in place. Where pings are off the water (column
water_track), its current is estimated. With a map of the seabed, a start in doubt is looked for on
it, and the map keeps the answer from drifting.

examples:
  ssm-graph smooth MISSION --out RESULT
  ssm-graph smooth MISSION --out RESULT --gnss-until 70           # what fixes withheld say of it
  ssm-graph smooth MISSION --out RESULT --rate 100 --point camera # answers at 100 Hz, elsewhere
"""


def declare(parser: argparse.ArgumentParser) -> None:
    """Declare the command's options."""
    add_mission_arguments(parser)
    parser.add_argument(
        "--map",
        type=Path,
        metavar="FILE",
        help="map of the seabed (GeoTIFF, NetCDF, ESRI ASCII grid, XYZ) that the DVL's ranges are "
        "compared with; [map] in mission.toml states what it is off by (default: that of [map])",
    )
    _add_kernel_options(parser)
    _add_loop_options(parser)
    add_answer_arguments(parser, afterwards=False)
    parser.set_defaults(run=run)


def _add_kernel_options(parser: argparse.ArgumentParser) -> None:
    more = (
        "; gnc-tls: truncated least squares by graduated non-convexity; adaptive: Barron's loss of "
        "the shape under which the residuals are likeliest"
    )
    add_kernel_options(parser, CHOICES, more=more)
    meaning = "start gnc-tls from least squares with every weight 1, as published, or from the "
    meaning += "gated forward pass (default: ones)"
    choice_option(parser, "--gnc-start", GncStart, meaning)
    meaning = "judge a beam by residual and posterior variance, or by the residual alone "
    meaning += "(default: expected for similarity kernels, plain for M-estimators and gnc-tls)"
    choice_option(parser, "--similarity", Similarity, meaning)


def _add_loop_options(parser: argparse.ArgumentParser) -> None:
    limit = "limit of the similarity loop"
    number_option(parser, "--max-iterations", "N", limit, MAX_ITERATIONS, kind=int)
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
    from ssm_graph.cli.export import export, exports_of
    from ssm_graph.io.seabed.section import with_map_file
    from ssm_graph.sensors.seabed import TerrainLog
    from ssm_graph.smoothers.mission import smooth

    loop = loop_from(arguments)

    def solve(mission: Mission, graph: ProblemConfig, show: ProgressDisplay) -> Estimate:
        if arguments.map is not None:
            mission = with_map_file(mission, arguments.map)
        if mission.aids.get(TerrainLog) is None:
            return smooth(
                mission, loop, problem_config=graph, on_iteration=show, on_stage=show.stage
            )
        from ssm_graph.systems.seabed.dive import smooth_dive

        dive = smooth_dive(
            mission, loop, problem_config=graph, on_iteration=show, on_stage=show.stage
        )
        assert dive.estimate is not None
        return dive.estimate

    check_asked(arguments)
    is_good = run_mission(arguments, console, errors, solve, _settings(loop))
    if asks(arguments):
        result: Path = arguments.out.resolve()
        export(arguments, result, ["csv"], exports_of(result), console, errors)
    return is_good


def loop_from(arguments: argparse.Namespace) -> SmootherConfig:
    """Return the settings of the loop; what does not belong to the kernel is refused."""
    from ssm_graph.smoothers.faults.search import FaultSearch
    from ssm_graph.smoothers.settings import SmootherConfig

    graduation = None
    if arguments.kernel == GNC:
        graduation = Graduation(arguments.gnc_start or GncStart.ONES)
    elif arguments.gnc_start is not None:
        raise ConfigError(
            f"--gnc-start: expected with --kernel {GNC}, got {arguments.kernel}; leave it out"
        )
    return SmootherConfig(
        kernel=kernel_of(arguments, CHOICES),
        similarity=arguments.similarity,
        graduation=graduation,
        adapt_shape=arguments.kernel == ADAPTIVE,
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
