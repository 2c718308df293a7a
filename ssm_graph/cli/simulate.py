"""``ssm-graph simulate``: write a simulated mission with its truth as reference."""

from __future__ import annotations

import argparse
from dataclasses import replace
from typing import Any, Final

import numpy as np
from rich.console import Console

from ssm_graph.base.frozen import Array
from ssm_graph.cli.options import add_mission_output, choice_option
from ssm_graph.cli.terminal import say
from ssm_graph.io.results.place import check_is_free
from ssm_graph.sensors.dvl import MOST_BEAMS
from ssm_graph.simulation import (
    SCENARIOS,
    Grade,
    OutlierKind,
    Outliers,
    default_mount,
    janus_beams,
    scenario_config,
    simulate,
)

_SCENARIOS = "\n".join(f"  {name:12}{s.description}" for name, s in SCENARIOS.items())
DESCRIPTION: Final = f"Simulate a mission.\n\nscenarios:\n{_SCENARIOS}"


def declare(parser: argparse.ArgumentParser) -> None:
    """Declare the command's options."""
    parser.add_argument("scenario", metavar="SCENARIO", choices=list(SCENARIOS))
    usual = "(default: that of the scenario)"
    choice_option(parser, "--grade", Grade, f"grade of the inertial sensors {usual}")
    choice_option(parser, "--outliers", OutlierKind, f"kind of DVL outliers {usual}")
    parser.add_argument(
        "--rate", type=float, help="share of pings with an outlier, 0 to 1 (default: 0.1)"
    )
    parser.add_argument(
        "--beams",
        type=_beams,
        metavar="1..8|velocity",
        help="DVL of so many beams around (of five one looks down), or one that gives a velocity: "
        "three beams along its axes (default: 4)",
    )
    parser.add_argument(
        "--duration", type=float, metavar="SECONDS", help=f"length of the mission {usual}"
    )
    parser.add_argument(
        "--imu-rate", type=float, metavar="HZ", help=f"inertial samples per second {usual}"
    )
    parser.add_argument(
        "--realistic",
        action="store_true",
        help="instruments err as real ones of the grade: scale factors, misalignments, vibration, "
        "noise with tails that changes slowly (default: bias, walk and white noise as stated)",
    )
    parser.add_argument(
        "--calibrate",
        action="store_true",
        help="with --realistic, the mission states what its instruments err in: it asks for scale, "
        "misalignment and g-sensitivity of its IMU, in the sizes of the grade, and for slow errors",
    )
    parser.add_argument("--seed", type=int, default=0, help="same seed, same mission (default: 0)")
    add_mission_output(parser)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace, console: Console, errors: Console) -> bool:
    """Simulate and write."""
    from ssm_graph.io.mission_folder.folder import write_mission
    from ssm_graph.report.terminal.progress import ProgressDisplay

    check_is_free(arguments.out, may_overwrite=arguments.overwrite)
    usual = scenario_config(arguments.scenario)
    told: dict[str, Any] = {
        "seed": arguments.seed,
        "grade": arguments.grade,
        "duration_s": arguments.duration,
        "imu_rate_hz": arguments.imu_rate,
        "realistic": arguments.realistic or None,
        "calibrates": arguments.calibrate or None,
    }
    if arguments.beams is not None:
        told["dvl"] = replace(usual.dvl, mount=default_mount(arguments.beams))
    if arguments.outliers is not None or arguments.rate is not None:
        rate = usual.outliers.rate if arguments.rate is None else arguments.rate
        told["outliers"] = Outliers(arguments.outliers or usual.outliers.kind, rate)
    changes = {name: value for name, value in told.items() if value is not None}
    with ProgressDisplay(errors) as show:
        show.stage("simulating")
        simulated = simulate(scenario_config(arguments.scenario, **changes))
        show.stage("writing the mission")
        write_mission(arguments.out, simulated.mission, table_format=arguments.format)
    mission = simulated.mission
    say(
        console,
        f"{arguments.out}: {len(mission.imu.time_s)} inertial samples, "
        f"{len(mission.dvl.time_s)} pings, {int(simulated.is_outlier.sum())} beam outliers, "
        f"seed {arguments.seed}",
    )
    return True


def _beams(word: str) -> Array:
    """Return beam directions (B, 3) in instrument axes."""
    if word == "velocity":
        return np.eye(3)
    if not word.isdecimal() or not 1 <= int(word) <= MOST_BEAMS:
        raise argparse.ArgumentTypeError(f"expected 1 to {MOST_BEAMS} or velocity, got {word!r}")
    return janus_beams(int(word))
