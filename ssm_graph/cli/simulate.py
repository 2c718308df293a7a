"""``ssm-graph simulate``: write a simulated mission with its truth as reference."""

from __future__ import annotations

import argparse
from dataclasses import replace
from typing import Any

import numpy as np
from rich.console import Console

from ssm_graph.base.frozen import Array
from ssm_graph.cli.options import add_command, add_mission_output, say
from ssm_graph.io.mission_folder.folder import write_mission
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


def add_parser(commands: Any, *, epilog: str) -> None:
    """Declare the command and its options."""
    scenarios = "\n".join(f"  {name:9}{s.description}" for name, s in SCENARIOS.items())
    parser = add_command(
        commands,
        "simulate",
        summary="write a simulated mission folder with truth as reference",
        description=f"Simulate a mission.\n\nscenarios:\n{scenarios}",
        epilog=epilog,
    )
    parser.add_argument("scenario", metavar="SCENARIO", choices=list(SCENARIOS))
    parser.add_argument(
        "--grade",
        type=str.lower,
        choices=[grade.name.lower() for grade in Grade],
        help="grade of the inertial sensors (default: that of the scenario)",
    )
    parser.add_argument(
        "--outliers",
        type=str.lower,
        choices=[kind.name.lower() for kind in OutlierKind],
        help="kind of DVL outliers (default: that of the scenario)",
    )
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
    parser.add_argument("--duration", type=float, metavar="SECONDS", help="length of the mission")
    parser.add_argument("--imu-rate", type=float, metavar="HZ", help="inertial samples per second")
    parser.add_argument(
        "--realistic",
        action="store_true",
        help="instruments err as real ones of the grade: scale factors, misalignments, vibration, "
        "noise with tails that changes slowly (default: bias, walk and white noise as stated)",
    )
    parser.add_argument(
        "--calibrate-imu",
        action="store_true",
        help="with --realistic, the mission asks for scale, misalignment and g-sensitivity of its "
        "IMU, in the sizes of the grade",
    )
    parser.add_argument("--seed", type=int, default=0, help="same seed, same mission (default: 0)")
    add_mission_output(parser)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace, console: Console, _: Console) -> bool:
    """Simulate and write."""
    changes: dict[str, Any] = {"seed": arguments.seed}
    if arguments.realistic:
        changes["realistic"] = True
    if arguments.calibrate_imu:
        changes["calibrates_imu"] = True
    if arguments.grade is not None:
        changes["grade"] = Grade[arguments.grade.upper()]
    if arguments.duration is not None:
        changes["duration_s"] = arguments.duration
    if arguments.imu_rate is not None:
        changes["imu_rate_hz"] = arguments.imu_rate
    if arguments.beams is not None:
        dvl = scenario_config(arguments.scenario).dvl
        changes["dvl"] = replace(dvl, mount=default_mount(arguments.beams))
    if arguments.outliers is not None or arguments.rate is not None:
        default = scenario_config(arguments.scenario).outliers
        kind = OutlierKind[arguments.outliers.upper()] if arguments.outliers else default.kind
        rate = arguments.rate if arguments.rate is not None else default.rate
        changes["outliers"] = Outliers(kind, rate)
    simulated = simulate(scenario_config(arguments.scenario, **changes))
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
