"""``ssm-graph smooth``: a mission folder in, a result folder out."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from factors.kernels import KERNELS, KernelChoice
from factors.m_estimators import TruncatedKernel
from factors.similarity import Kernel, Similarity
from ssm_graph.cli.options import add_command
from ssm_graph.data import GnssLog, Mission, Reference
from ssm_graph.errors import ConfigError, DataError
from ssm_graph.estimate import Estimate
from ssm_graph.evaluation import Metrics, evaluate, reference_from_gnss
from ssm_graph.io.mission import read_mission
from ssm_graph.io.results import write_results
from ssm_graph.problem.problem import ProblemConfig
from ssm_graph.report.figure import save_figure
from ssm_graph.report.progress import ProgressDisplay
from ssm_graph.report.summary import summary_table
from ssm_graph.smoothers.batch import SmootherConfig
from ssm_graph.smoothers.gnc import GncStart, Graduation
from ssm_graph.smoothers.mission import smooth

GNC = "gnc-tls"
CHOICES = {**KERNELS, GNC: KernelChoice(TruncatedKernel, "width")}
"""Kernels by name; that of graduated non-convexity comes with a schedule of its own."""
PARAMETERS = {
    "dof": ("NUMBER", "degrees of freedom"),
    "width": ("SIGMAS", "residual at which a beam begins to be or is an outlier"),
    "phi": ("SIGMAS2", "squared residual up to which a beam counts in full"),
}
"""Metavariable and meaning of the kernels' parameters."""


def add_parser(commands: Any, *, epilog: str) -> None:
    """Declare the command and its options."""
    parser = add_command(
        commands,
        "smooth",
        summary="smooth a mission folder",
        description="Smooth a recorded mission; writes trajectory.csv, beams.csv, summary.json and "
        "figure.png.",
        epilog=epilog,
    )
    parser.add_argument("mission", type=Path, metavar="MISSION", help="mission folder")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="result folder")
    _add_kernel_options(parser)
    _add_other_options(parser)
    parser.set_defaults(run=run)


def _add_kernel_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--kernel",
        choices=CHOICES,
        default="log",
        help="log, sqrt, exp: similarity kernels; gaussian: least squares; huber, cauchy, dcs, "
        "geman-mcclure: classical M-estimators; gnc-tls: truncated least squares by graduated "
        "non-convexity (default: log)",
    )
    for name, (metavar, meaning) in PARAMETERS.items():
        defaults = (
            f"{choice.default:.5g} for {kernel}"
            for kernel, choice in CHOICES.items()
            if choice.parameter == name
        )
        parser.add_argument(
            f"--{name}",
            type=float,
            default=None,
            metavar=metavar,
            help=f"{meaning} (default: {', '.join(defaults)})",
        )
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


def _add_other_options(parser: argparse.ArgumentParser) -> None:
    loop, graph = SmootherConfig(), ProblemConfig()
    parser.add_argument(
        "--max-iterations",
        type=int,
        default=loop.max_iterations,
        metavar="N",
        help=f"limit of the similarity loop (default: {loop.max_iterations})",
    )
    parser.add_argument(
        "--merge-rate",
        type=float,
        default=graph.merge_rate_hz,
        metavar="HZ",
        help=f"rate to which inertial samples are merged (default: {graph.merge_rate_hz:g})",
    )
    parser.add_argument(
        "--keyframe-interval",
        type=float,
        default=graph.keyframe_interval_s,
        metavar="SECONDS",
        help="keyframes this far apart while DVL and GNSS are silent "
        f"(default: {graph.keyframe_interval_s:g})",
    )
    parser.add_argument(
        "--gnss-until",
        type=float,
        metavar="SECONDS",
        help="use GNSS only so long from the begin of the inertial data; the rest becomes the "
        "reference",
    )
    parser.add_argument("--no-figure", action="store_true", help="write no figure.png")


def run(arguments: argparse.Namespace, console: Console, errors: Console) -> bool:
    """Read, smooth, compare, write and show."""
    loop = loop_from(arguments)
    graph = ProblemConfig(arguments.merge_rate, arguments.keyframe_interval)
    with ProgressDisplay(errors) as show:
        show.stage("reading the mission")
        mission = read_mission(arguments.mission)
        withheld: GnssLog | None = None
        if arguments.gnss_until is not None:
            mission, withheld = withhold_gnss(mission, arguments.gnss_until)
        estimate = smooth(
            mission, loop, problem_config=graph, on_iteration=show, on_stage=show.stage
        )
        show.stage("writing results")
        estimate, reference, metrics = _compare(estimate, mission, withheld)
        write_results(
            arguments.out,
            estimate,
            mission=mission,
            metrics=metrics,
            settings=_settings(arguments, loop, graph),
        )
        if not arguments.no_figure:
            save_figure(arguments.out / "figure.png", estimate, reference, title=mission.name)
    console.print(summary_table(estimate, metrics))
    console.print(f"results in {arguments.out}", highlight=False, soft_wrap=True)
    return estimate.status.is_good


def loop_from(arguments: argparse.Namespace) -> SmootherConfig:
    """Return the settings of the loop; what does not belong to the kernel is refused."""
    given = {name: getattr(arguments, name) for name in PARAMETERS}
    graduation = None
    if arguments.kernel == GNC:
        graduation = Graduation(GncStart[(arguments.gnc_start or GncStart.ONES.name).upper()])
    elif arguments.gnc_start is not None:
        raise ConfigError(
            f"--gnc-start: expected with --kernel {GNC}, got {arguments.kernel}; leave it out"
        )
    similarity = arguments.similarity
    return SmootherConfig(
        kernel=kernel_from(arguments.kernel, **given),
        similarity=None if similarity is None else Similarity[similarity.upper()],
        graduation=graduation,
        max_iterations=arguments.max_iterations,
    )


def kernel_from(name: str, **given: float | None) -> Kernel:
    """Return a kernel by name; a parameter that it does not have is refused."""
    choice = CHOICES[name]
    for parameter, value in given.items():
        if value is not None and parameter != choice.parameter:
            owners = [kernel for kernel, c in CHOICES.items() if c.parameter == parameter]
            raise ConfigError(
                f"--{parameter}: expected with --kernel {' or '.join(owners)}, got {name}; "
                "leave it out"
            )
    try:
        return choice.kernel(given.get(choice.parameter))
    except ValueError as error:
        raise ConfigError(f"--kernel {name}: {error}") from error


def withhold_gnss(mission: Mission, until_s: float) -> tuple[Mission, GnssLog]:
    """Return the mission with GNSS up to ``until_s`` after its begin, and the other fixes."""
    gnss = mission.gnss
    if gnss is None:
        raise ConfigError("--gnss-until: expected a mission with GNSS, got one without")
    used = gnss.time_s < mission.imu.start_s + until_s
    if not used.any() or used.all():
        first, last = gnss.time_s[[0, -1]] - mission.imu.start_s
        raise ConfigError(
            f"--gnss-until: expected a time between the first fix at {first:.1f} s and the last "
            f"at {last:.1f} s, got {until_s:g} s"
        )
    return replace(mission, gnss=_fixes(gnss, used)), _fixes(gnss, ~used)


def _fixes(gnss: GnssLog, kept: np.ndarray[Any, np.dtype[np.bool_]]) -> GnssLog:
    return replace(
        gnss,
        time_s=gnss.time_s[kept],
        lat=gnss.lat[kept],
        lon=gnss.lon[kept],
        height=gnss.height[kept],
        sigma_enu=gnss.sigma_enu[kept],
    )


def _compare(
    estimate: Estimate, mission: Mission, withheld: GnssLog | None
) -> tuple[Estimate, Reference | None, Metrics | None]:
    """Compare with the mission's reference or the withheld fixes; a note where that fails."""
    reference = mission.reference
    if withheld is not None:
        reference = reference_from_gnss(withheld, estimate.trajectory)
    if reference is None:
        return estimate, None, None
    try:
        return estimate, reference, evaluate(estimate.trajectory, reference)
    except DataError as error:
        notes = (*estimate.notes, f"not compared with the reference: {error}")
        return replace(estimate, notes=notes), None, None


def _settings(
    arguments: argparse.Namespace, loop: SmootherConfig, graph: ProblemConfig
) -> dict[str, Any]:
    return {
        "kernel": loop.weighting,
        "similarity": loop.judged_by.name.lower(),
        "max_iterations": loop.max_iterations,
        "tolerance_sigmas": loop.tolerance,
        "merge_rate_hz": graph.merge_rate_hz,
        "keyframe_interval_s": graph.keyframe_interval_s,
        "gnss_until_s": arguments.gnss_until,
    }
