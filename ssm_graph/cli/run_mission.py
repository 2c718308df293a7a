"""What every command does that makes a result folder of one mission folder."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

from rich.console import Console

from ssm_graph.base.errors import ConfigError, DataError
from ssm_graph.base.usual import KEYFRAME_INTERVAL_S, MERGE_RATE_HZ
from ssm_graph.cli.options import number_option
from ssm_graph.cli.terminal import say
from ssm_graph.io.results.place import FIGURES, check_result_place

if TYPE_CHECKING:
    from ssm_graph.evaluation.errors import Metrics
    from ssm_graph.mission.estimate import Estimate
    from ssm_graph.mission.mission import Mission, Reference
    from ssm_graph.mission.problem import ProblemConfig
    from ssm_graph.report.terminal.progress import ProgressDisplay
    from ssm_graph.sensors.gnss import GnssLog

Solve: TypeAlias = "Callable[[Mission, ProblemConfig, ProgressDisplay], Estimate]"
"""Estimates a mission and tells the display how far it is."""


def add_mission_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the mission folder, the result folder, and what belongs to neither estimator."""
    parser.add_argument("mission", type=Path, metavar="MISSION", help="mission folder")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="result folder")
    merged = "rate to which inertial samples are merged"
    number_option(parser, "--merge-rate", "HZ", merged, MERGE_RATE_HZ)
    apart = "keyframes this far apart while DVL and GNSS are silent"
    number_option(parser, "--keyframe-interval", "SECONDS", apart, KEYFRAME_INTERVAL_S)
    until = "use GNSS only so long from the begin of the inertial data; the rest becomes the "
    number_option(parser, "--gnss-until", "SECONDS", until + "reference")
    parser.add_argument(
        "--figure", choices=FIGURES, default="png", help="of the figure (default: png)"
    )
    parser.add_argument("--no-figure", action="store_true", help="write no figure")


def run_mission(
    arguments: argparse.Namespace,
    console: Console,
    errors: Console,
    solve: Solve,
    settings: dict[str, Any],
) -> bool:
    """Read, estimate, compare, write and show; return whether the result may be trusted.

    The settings are those of the estimator, for ``summary.json``.
    """
    from ssm_graph.evaluation.errors import withhold_gnss
    from ssm_graph.io.mission_folder.folder import CALIBRATION_NAME, read_mission
    from ssm_graph.io.mission_folder.toml import read_mission_toml
    from ssm_graph.io.results.summary import input_fields
    from ssm_graph.io.results.tables import write_results
    from ssm_graph.mission.problem import ProblemConfig
    from ssm_graph.report.mission.summary import summary_table
    from ssm_graph.report.terminal.progress import ProgressDisplay

    graph = ProblemConfig(arguments.merge_rate, arguments.keyframe_interval)
    check_result_place(arguments.out)
    with ProgressDisplay(errors) as show:
        show.stage("reading the mission")
        mission = read_mission(arguments.mission)
        axes = read_mission_toml(arguments.mission).body
        withheld: GnssLog | None = None
        if arguments.gnss_until is not None:
            try:
                mission, withheld = withhold_gnss(mission, arguments.gnss_until)
            except ConfigError as error:
                raise ConfigError(f"--gnss-until: {error}") from error
        estimate = solve(mission, graph, show)
        show.stage("writing results")
        estimate, reference, metrics = _compare(estimate, mission, withheld)

        def draw(path: Path) -> None:
            from ssm_graph.report.mission.figure import save_figure

            show.stage("drawing the figure")
            save_figure(path, estimate, reference, title=mission.name)

        write_results(
            arguments.out,
            estimate,
            mission=mission,
            metrics=metrics,
            settings={
                **settings,
                "merge_rate_hz": graph.merge_rate_hz,
                "keyframe_interval_s": graph.keyframe_interval_s,
                "gnss_until_s": arguments.gnss_until,
            },
            inputs=input_fields(arguments.mission),
            axes=axes,
            draw=None if arguments.no_figure else draw,
            figure_name=FIGURES[arguments.figure],
        )
    console.print(summary_table(estimate, metrics))
    say(console, f"results in {arguments.out}")
    if estimate.calibration is not None:
        path = arguments.out / CALIBRATION_NAME
        say(console, f"lines for mission.toml in {path}")
    return estimate.status.is_good


def _compare(
    estimate: Estimate, mission: Mission, withheld: GnssLog | None
) -> tuple[Estimate, Reference | None, Metrics | None]:
    """Compare with the mission's reference or the withheld fixes; a note where that fails."""
    from ssm_graph.evaluation.errors import evaluate, reference_from_gnss

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
