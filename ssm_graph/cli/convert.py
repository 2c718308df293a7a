"""``ssm-graph convert``: turn a maker's log or a ROS bag into a mission folder."""

from __future__ import annotations

import argparse
import math
from pathlib import Path

from rich.console import Console

from ssm_graph.base.frames import BodyAxes
from ssm_graph.base.units import SEA_WATER, STANDARD_ATMOSPHERE
from ssm_graph.cli.options import add_mission_output, choice_option, number_option
from ssm_graph.io.ros.log import ROLES

DESCRIPTION = f"""\
Convert a log. LOG is one of

  a ROS bag        ROS 2: the folder, with metadata.yaml or without, or a single .mcap or .db3 file;
                   ROS 1: a .bag (extra 'ros')
  a Blueye X3 log  MCAP of the maker (extra 'blueye')
  an ArduPilot log dataflash .BIN, or telemetry .tlog (extra 'ardupilot'): IMU, GPS, barometer, and
                   VISO, the movements that a DVL sends; --water-density, --surface-height
  an instrument's  Water Linked; Teledyne PD0, PD4, PD5, PD6; Nortek AD2CP (DVL, ADCP with bottom
  own output       track) and Nucleus (dvl.csv, heading.csv, imu.csv of a Nucleus); NMEA 0183
                   (gnss.csv, heading.csv): tables for a mission folder, which mission.toml and
                   imu.csv make whole; of a Nucleus, with --vehicle, a mission
  tables of any    CSV, Parquet, MAT, HDF5 (extra 'columns'), with --map map.toml, which says what
  columns          their columns are: ssm-graph template writes one to fill in, ssm-graph inspect
                   FILE --draft-map drafts one of a table
  several files    inertial data in a table with the columns of imu.csv, in any columns with --map,
                   or of an ArduPilot log, with its depths and fixes, and recordings as above, with
                   --vehicle: one mission on the clock of the IMU, the others moved by the turns
                   they show

Of a ROS bag, topics are found by their type:

{chr(10).join(f"  {role:12} {' or '.join(types)}" for role, types in ROLES.items())}

imu and dvl have to be there; from usbl on they are read where --topic names them and the vehicle
has the section. What messages do not say, noise, lever arms and mounting, comes from
--vehicle, or is assumed; every assumption is printed as a note. More in docs/ros2.md.

examples:
  ssm-graph convert dive.bag --vehicle vehicle.toml --topic dvl=/dvl/data --out MISSION
  ssm-graph convert 00000042.BIN --out MISSION
  ssm-graph convert --map map.toml imu.csv dvl.csv gps.csv --out MISSION
  ssm-graph convert imu.csv survey.PD0 --vehicle vehicle.toml --out MISSION
  ssm-graph convert --map map.toml own_imu.csv survey.PD0 --out MISSION
"""


def declare(parser: argparse.ArgumentParser) -> None:
    """Declare the command's options."""
    parser.add_argument(
        "log",
        type=Path,
        metavar="LOG",
        nargs="+",
        help="file or folder to convert; several are merged: inertial data and recordings",
    )
    add_mission_output(parser)
    parser.add_argument(
        "--map",
        type=Path,
        metavar="FILE",
        help="of tables of any columns: which is which, in what unit, sign and axes",
    )
    _add_ros_options(parser)
    parser.set_defaults(run=run)


def _add_ros_options(parser: argparse.ArgumentParser) -> None:
    several = parser.add_argument_group("of several logs")
    number_option(
        several,
        "--clock-offset",
        "SECONDS",
        "what is added to the times of the recordings (default: found by turns)",
        kind=_number,
    )
    parser.add_argument(
        "--vehicle",
        type=Path,
        metavar="FILE",
        help="of ROS bags, ArduPilot logs, several logs and tables of any columns: noise, lever "
        "arms, DVL mounting and beam directions: a mission.toml (its tables need not exist) or a "
        "mission folder",
    )
    group = parser.add_argument_group("of ROS bags; water and its surface of ArduPilot logs too")
    group.add_argument(
        "--topic",
        type=_topic,
        action="append",
        metavar="SENSOR=NAME",
        help="the topic to read where several fit, such as imu=/imu/data; may be repeated, of the "
        "DVL for one topic off the ground and one off the water",
    )
    meaning = "axes of the IMU messages: forward-left-up as REP 103 has it, forward-right-down, "
    choice_option(group, "--body", BodyAxes, f"{meaning}right-forward-up (default: FLU)")
    density = f"of the water (default: {SEA_WATER:g}; fresh water has 1000)"
    air = "pressure at the surface, 0 for a sensor that reads 0 there "
    surface = "height of the water's surface above the WGS-84 ellipsoid "
    for flag, metavar, meaning in (
        ("--water-density", "KG_PER_M3", density),
        ("--atmosphere", "PA", f"{air}(default: {STANDARD_ATMOSPHERE:.0f})"),
        ("--surface-height", "M", f"{surface}(default: by the fixes, else 0)"),
    ):
        number_option(group, flag, metavar, meaning, kind=_number)
    group.add_argument(
        "--beams-against",
        action="store_true",
        default=None,
        help="the speeds are positive when the vehicle moves against the beam: of "
        "marine_acoustic_msgs (default: found by the velocity in the messages) and of an "
        "instrument's own output",
    )


def run(arguments: argparse.Namespace, console: Console, errors: Console) -> bool:
    """Convert and write; what it takes is loaded now."""
    from ssm_graph.cli.convert_run import convert

    return convert(arguments, console, errors)


def _topic(word: str) -> tuple[str, str]:
    role, separator, name = word.partition("=")
    if not separator or role not in ROLES or not name:
        raise argparse.ArgumentTypeError(
            f"expected SENSOR=NAME with a sensor of {', '.join(ROLES)}, got {word!r}"
        )
    return role, name


def _number(word: str) -> float:
    number = float(word)
    if not math.isfinite(number):
        raise ValueError
    return number
